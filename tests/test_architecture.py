"""What holds for every module: layers, documentation, length, and what must not be imported or called."""

import ast
import re
from pathlib import Path

import pytest

CLONE = Path(__file__).parents[1]
PACKAGE = CLONE / "gym_dgpmpc"
BENCHMARKS = CLONE / "benchmarks"
MODULES = {
    ".".join(path.relative_to(CLONE).with_suffix("").parts): path
    for folder in (PACKAGE, BENCHMARKS)
    for path in folder.rglob("*.py")
}

LAYERS = (
    {"types", "errors", "autograd", "checks", "compiler", "extras", "forks", "formats", "randomness", "settings"},
    {"envs", "wrappers"},
    {"data"},
    {"gp"},
    {"inference"},
    {"dynamics"},
    {"tasks"},
    {"planning"},
    {"imagination"},
    {"policy_search"},
    {"checkpoints"},
    {"agents"},
    {"runs"},
    {"__init__"},
    {"options", "cli"},
    {"__main__", "zoo"},
    {"benchmarks"},
)
"""Each layer imports only from itself and from those above it. The public names stand below all that they name, and the
package `benchmarks`, which is not installed, below the whole of `gym_dgpmpc`."""

MOST_CODE, MOST_BODY = 250, 55
"""Lines of code in a module, and in a function's body: without docstrings, comments, blank lines and signatures."""
LONG_ON_PURPOSE = {"gym_dgpmpc.agents.mpc": 550}
"""One class, the agent, that is not cut in slices: it names what it has, and its loop stands on one screen."""

NEWER_THAN_PYTHON_3_10 = {
    "asyncio": {"Runner", "TaskGroup", "timeout"},
    "contextlib": {"chdir"},
    "datetime": {"UTC"},
    "enum": {"StrEnum", "ReprEnum", "member", "nonmember", "verify"},
    "itertools": {"batched"},
    "tomllib": {"load", "loads"},
    "typing": {
        "LiteralString",
        "Never",
        "NotRequired",
        "ReadOnly",
        "Required",
        "Self",
        "TypeAliasType",
        "TypeIs",
        "TypeVarTuple",
        "Unpack",
        "assert_never",
        "assert_type",
        "dataclass_transform",
        "override",
        "reveal_type",
    },
}

RUNS_CODE_FROM_FILES = {"pickle", "cloudpickle", "dill", "joblib", "shelve", "marshal"}
RUNS_CODE_FROM_FILES |= {"stable_baselines3.common.save_util", "torch.load", "torch.save"}
ALLOWED_ALL_THE_SAME = {
    # joblib's processes exchange pickles through pipes, with processes that this one has started; what loads and keeps
    # files (`joblib.load`, `joblib.dump`, `joblib.Memory`) stays forbidden there too.
    "benchmarks.executors": {
        "joblib", "joblib.Parallel", "joblib.delayed", "joblib.parallel_config",
        "joblib.externals.loky.process_executor", "joblib.externals.loky.process_executor.TerminatedWorkerError",
    },
}  # fmt: skip
"""By module, with the reason."""

GLOBAL_RANDOMNESS = {"random", "torch.distributions", "torch.manual_seed", "torch.seed", "torch.random"}
LENDS_GLOBAL_RANDOMNESS = "gym_dgpmpc.imagination.global_randomness"
"""The one module that touches it: it puts the states back after Stable-Baselines3 has drawn from them."""
TORCH_RANDOM = {
    f"torch.{name}"
    for name in (
        "bernoulli", "multinomial", "normal", "poisson", "rand", "rand_like", "randint", "randint_like", "randn",
        "randn_like", "randperm", "_standard_gamma", "binomial",
    )
}  # fmt: skip
TENSOR_RANDOM = {
    "bernoulli_", "cauchy_", "exponential_", "geometric_", "log_normal_", "normal_", "random_", "uniform_",
}  # fmt: skip

TENSOR_FACTORIES = {
    f"torch.{name}"
    for name in (
        "arange", "as_tensor", "asarray", "empty", "eye", "frombuffer", "full", "linspace", "logspace", "normal",
        "ones", "rand", "randint", "randn", "randperm", "range", "scalar_tensor", "tensor", "tril_indices",
        "triu_indices", "zeros",
    )
}  # fmt: skip
"""What takes dtype or device of the process's defaults where it is not told; `from_numpy`, *_like and new_* do not."""
ALWAYS_INTEGERS = {"torch.randint", "torch.randperm"}


NOTATION = PACKAGE.parent / "docs" / "notation.md"


def imports(tree: ast.AST) -> set[str]:
    """Dotted names of everything that is imported, wherever in the module: `from a import b` gives a and a.b."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def layer_of(name: str) -> int:
    """The layer of a dotted name: "gym_dgpmpc.gp.kernels" is in that of gp, "benchmarks.run" in that of benchmarks."""
    package, _, rest = name.partition(".")
    part = "benchmarks" if package == "benchmarks" else rest.split(".")[0] or "__init__"
    for i, layer in enumerate(LAYERS):
        if part in layer:
            return i
    return LAYERS.index({"__init__"})  # a public name


def upward_imports(module: str, tree: ast.AST) -> list[str]:
    """Imports from a layer below the module's own."""
    names = {name for name in imports(tree) if name.split(".")[0] in ("gym_dgpmpc", "benchmarks")}
    # `from gym_dgpmpc import types` names the package itself too, but takes only the module from it.
    modules = {name.removesuffix(".__init__") for name in MODULES}
    names -= {"gym_dgpmpc"} if any(name.count(".") == 1 and name in modules for name in names) else set()
    return sorted(name for name in names if layer_of(name) > layer_of(module))


def dotted(node: ast.AST) -> str:
    """ "torch.randn" for the expression torch.randn; "" for what is no dotted name."""
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Attribute) and dotted(node.value):
        return f"{dotted(node.value)}.{node.attr}"
    return ""


def unseeded_calls(tree: ast.AST) -> list[str]:
    """Calls that draw from PyTorch's or NumPy's global random state."""
    found = []
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        name = dotted(node.func)
        method = node.func.attr if isinstance(node.func, ast.Attribute) else ""
        # Of f(**options) one cannot tell, so it passes.
        has_generator = any(keyword.arg in ("generator", None) for keyword in node.keywords)
        legacy_numpy = name.startswith(("np.random.", "numpy.random.")) and name.rsplit(".")[-1].islower()
        legacy_numpy = legacy_numpy and not name.endswith("default_rng")
        if legacy_numpy or ((name in TORCH_RANDOM or method in TENSOR_RANDOM) and not has_generator):
            found.append(f"line {node.lineno}: {name or method}")
    return found


def by_default(tree: ast.AST) -> list[str]:
    """Calls that make tensors without naming dtype and device, so that the process's defaults decide."""
    found = []
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call) or dotted(node.func) not in TENSOR_FACTORIES:
            continue
        name, named = dotted(node.func), {keyword.arg for keyword in node.keywords}
        needed = {"device"} if name in ALWAYS_INTEGERS else {"dtype", "device"}
        if not needed <= named:
            found.append(f"line {node.lineno}: {name} without {', '.join(sorted(needed - named))}")
    return found


def forbidden(tree: ast.AST, names: set[str]) -> list[str]:
    """Imports and uses of the names, or of what is in them."""
    used = imports(tree) | {dotted(node) for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
    return sorted(name for name in used if any(name == bad or name.startswith(f"{bad}.") for bad in names))


def too_new(tree: ast.AST) -> list[str]:
    """Names of the standard library that Python 3.10 does not have."""
    newer = {f"{module}.{name}" for module, names in NEWER_THAN_PYTHON_3_10.items() for name in names}
    return forbidden(tree, newer)


@pytest.fixture(params=sorted(MODULES))
def module(request):
    return request.param


@pytest.fixture
def source(module):
    return MODULES[module].read_text(encoding="utf-8")


@pytest.fixture
def tree(source):
    return ast.parse(source, feature_version=(3, 10))


def test_every_package_has_a_layer():
    known = set().union(*LAYERS)
    assert {name.split(".")[1] for name in MODULES if name.startswith("gym_dgpmpc.")} <= known


def test_imports_only_from_above(module, tree):
    assert upward_imports(module, tree) == []


def test_says_what_it_is(tree):
    assert ast.get_docstring(tree)


def code_lines(source, first, last, tree):
    """How many lines of code there are between two lines."""
    texts = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            texts |= set(range(node.lineno, node.end_lineno + 1))
    lines = enumerate(source.splitlines(), start=1)
    return sum(
        bool(line.strip()) and not line.strip().startswith("#")
        for number, line in lines
        if first <= number <= last and number not in texts
    )


def test_can_be_read_at_once(module, source, tree):
    assert code_lines(source, 1, len(source.splitlines()), tree) <= LONG_ON_PURPOSE.get(module, MOST_CODE)
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            assert code_lines(source, node.body[0].lineno, node.end_lineno, tree) <= MOST_BODY, node.name


def test_what_is_long_on_purpose_is_long():
    for module in LONG_ON_PURPOSE:
        source = MODULES[module].read_text(encoding="utf-8")
        assert code_lines(source, 1, len(source.splitlines()), ast.parse(source)) > MOST_CODE


def test_runs_no_code_from_files(module, tree):
    assert set(forbidden(tree, RUNS_CODE_FROM_FILES)) <= ALLOWED_ALL_THE_SAME.get(module, set())


def test_exceptions_are_of_modules_that_need_them():
    for module, allowed in ALLOWED_ALL_THE_SAME.items():
        tree = ast.parse(MODULES[module].read_text(encoding="utf-8"))
        assert set(forbidden(tree, RUNS_CODE_FROM_FILES)) == allowed


def test_randomness_is_an_argument(module, tree):
    if module == LENDS_GLOBAL_RANDOMNESS:
        assert unseeded_calls(tree) and forbidden(tree, GLOBAL_RANDOMNESS)
        return
    assert unseeded_calls(tree) == []
    assert forbidden(tree, GLOBAL_RANDOMNESS) == []


def test_no_tensor_is_made_by_the_processs_defaults(module, tree):
    if module.startswith("gym_dgpmpc."):  # the benchmarks are programs, and set the defaults of their own process
        assert by_default(tree) == []


def test_needs_no_newer_python(tree):
    assert too_new(tree) == []


def test_the_notation_names_what_there_is():
    quoted = re.findall(r"`([^`]+)`", NOTATION.read_text(encoding="utf-8"))
    paths = {name for name in quoted if "/" in name or name.endswith(".py")}
    assert [name for name in paths if not (PACKAGE / name).exists()] == []
    # A name such as `Plan.mean`, `draw` or `states[t, p, k]`: every word of two letters or more is in the code.
    words = {word for name in set(quoted) - paths for word in re.findall(r"[A-Za-z_]{2,}", name)}
    code = {word for path in MODULES.values() for word in re.findall(r"\w+", path.read_text(encoding="utf-8"))}
    assert words - code - {"TaskHorizon"} == set()


@pytest.mark.parametrize(
    ("module_name", "line", "found"),
    [
        ("gym_dgpmpc.gp.layer", "from gym_dgpmpc.gp.kernels import Kernel", []),
        ("gym_dgpmpc.gp.layer", "from gym_dgpmpc import types", []),
        ("gym_dgpmpc.gp.layer", "import gym_dgpmpc.agents.mpc", ["gym_dgpmpc.agents.mpc"]),
        ("gym_dgpmpc.gp.layer", "def f():\n    from gym_dgpmpc import cli", ["gym_dgpmpc.cli"]),
        ("gym_dgpmpc.agents.mpc", "from gym_dgpmpc import PETSAgent", ["gym_dgpmpc", "gym_dgpmpc.PETSAgent"]),
        ("gym_dgpmpc.types", "import gym_dgpmpc", ["gym_dgpmpc"]),
        ("gym_dgpmpc.cli.benchmarks", "from benchmarks import run", ["benchmarks", "benchmarks.run"]),
        ("benchmarks.run", "from gym_dgpmpc.cli import common\nimport benchmarks.jobs", []),
    ],
)
def test_upward_imports_are_found(module_name, line, found):
    assert upward_imports(module_name, ast.parse(line)) == found


@pytest.mark.parametrize(
    ("line", "count"),
    [
        ("torch.randn(3, generator=g)", 0),
        ("x.normal_(generator=g)", 0),
        ("np.random.default_rng(0)", 0),
        ("np.random.SeedSequence(0)", 0),
        ("torch.randn(3)", 1),
        ("f(x)[0].normal_()", 1),
        ("np.random.normal()", 1),
    ],
)
def test_unseeded_calls_are_found(line, count):
    assert len(unseeded_calls(ast.parse(line))) == count


@pytest.mark.parametrize(
    ("line", "count"),
    [
        ("torch.zeros(3, dtype=x.dtype, device=x.device)", 0),
        ("torch.randperm(3, generator=g, device='cpu')", 0),
        ("x.new_zeros(3), torch.zeros_like(x), torch.from_numpy(y)", 0),
        ("torch.zeros(3)", 1),
        ("torch.eye(3, dtype=torch.float32).to(x)", 1),
        ("torch.randperm(3, generator=g)", 1),
        ("torch.tensor([1.0], device='cpu')", 1),
    ],
)
def test_tensors_made_by_default_are_found(line, count):
    assert len(by_default(ast.parse(line))) == count


@pytest.mark.parametrize("line", ["import pickle", "from torch import load", "torch.load(f)", "import joblib.memory"])
def test_code_from_files_is_found(line):
    assert forbidden(ast.parse(line), RUNS_CODE_FROM_FILES)


@pytest.mark.parametrize(
    "line", ["from typing import Self", "import typing\nx: typing.Self", "import tomllib\ntomllib.load(f)"]
)
def test_newer_names_are_found(line):
    assert too_new(ast.parse(line))
