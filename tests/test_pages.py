"""The pages of the documentation: their Python runs at a tiny size, and the messages that they explain are there."""

import ast
import re
from functools import cache, wraps
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from stable_baselines3 import SAC
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

import gym_dgpmpc
from benchmarks.run import Run
from examples import own_task
from gym_dgpmpc import MPCAgent, planning
from tests.test_examples import TINY

ROOT = Path(own_task.__file__).parents[1]
RUN_ELSEWHERE = ("docs/benchmarks.md",)
PAGES = sorted(
    name
    for page in [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]
    if "```python\n" in page.read_text(encoding="utf-8")
    and (name := page.relative_to(ROOT).as_posix()) not in RUN_ELSEWHERE
)
IMAGINED = {"num_worlds": 2, "trial_every": 50}
TINIER = (
    TINY
    | IMAGINED
    | {
        "num_epochs": 1,
        "hidden_size": 8,
        "max_training_iterations": 2,
        "num_chains": 2,
        "imagined_timesteps": 100,
        "first_search_steps": 2,
        "search_steps": 1,
        "search_horizon": 3,
        "max_search_iterations": 1,
    }
)
NEEDS = re.compile(r"# (needs .*)\n")
"""The first line of a block that cannot run here, for its reader to see why."""


def python_of(page):
    """The Python of a page, block by block."""
    return re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), re.DOTALL)


@pytest.fixture
def tiny(monkeypatch):
    """Agents of settings that take no time, whatever a page gives them, that act for two steps after their training."""
    make, learn, imagine, learn_without_model = (
        MPCAgent.__init__,
        MPCAgent.learn,
        MPCAgent.imagine_policy,
        OnPolicyAlgorithm.learn,
    )

    @wraps(make)
    def make_tiny(agent, *args, **given):
        known = agent.part_settings(given.get("planner") or "cem")
        sizes = {
            name: size for name in known for own, size in TINIER.items() if name == own or name.endswith(f"_{own}")
        }
        make(agent, *args, **{"learning_starts": TINY["learning_starts"], **given, **sizes})

    @wraps(learn)
    def learn_little(agent, total_timesteps, *args, **given):
        return learn(agent, min(total_timesteps, agent.learning_starts + 2), *args, **given)

    @wraps(imagine)
    def imagine_little(agent, *args, **given):
        return imagine(agent, *args, **{**given, **IMAGINED, "total_timesteps": 100, "episode_steps": 5})

    @wraps(learn_without_model)
    def learn_one_batch(model, total_timesteps, **given):
        return learn_without_model(model, 1, **given)

    monkeypatch.setattr(MPCAgent, "__init__", make_tiny)
    monkeypatch.setattr(MPCAgent, "learn", learn_little)
    monkeypatch.setattr(MPCAgent, "imagine_policy", imagine_little)
    monkeypatch.setattr(OnPolicyAlgorithm, "learn", learn_one_batch)


def taken_for_granted(page):
    """What the blocks of a page use without making it, because its text says what they are."""
    if page == "docs/using.md":
        return {"env": gymnasium.make("gym_dgpmpc:ModCartPole-v0")}
    if page == "docs/own_task.md":
        generator = np.random.default_rng(0)
        sac = SAC("MlpPolicy", own_task.TwoTanks(), buffer_size=100, learning_starts=50)
        sac.learn(30)
        return {
            "sac": sac,
            **{name: generator.uniform(size=(30, 2)) for name in ("o", "n")},
            "a": generator.uniform(size=(30, 1)),
            "r": generator.uniform(size=30),
            "t": np.zeros(30, bool),
        }
    return {}


@pytest.mark.parametrize("page", PAGES)
def test_the_python_of_a_page_runs(page, tiny, tmp_path, monkeypatch):
    """Block by block in one namespace, as a reader would type them."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    if page == "docs/moving.md":
        rows = {"obs": np.zeros((30, 3)), "action": np.zeros((30, 1)), "next_obs": np.zeros((30, 3))}
        np.savez("replay_buffer.npz", **rows, reward=np.zeros(30), done=np.zeros(30, bool))
    namespace = {"__name__": "page", **taken_for_granted(page)}
    for number, block in enumerate(python_of(page)):
        if not NEEDS.match(block):
            exec(compile(block, f"{page}, block {number}", "exec"), namespace)
    agents = [value for value in namespace.values() if isinstance(value, MPCAgent)]
    assert agents  # every page of these is about one


def test_what_cannot_run_says_why():
    """A block that is left out by mistake would be one that nobody runs."""
    left_out = [found[1] for page in PAGES for block in python_of(page) if (found := NEEDS.match(block))]
    assert left_out == ["needs a dataset of Minari's on this machine", "needs a plant"]


def test_the_readme_begins_with_few_lines():
    (code,) = python_of("README.md")
    assert len([line for line in code.splitlines() if line]) <= 6


def test_a_run_of_ones_own_leaves_a_result(tmp_path, monkeypatch):
    """The block of docs/benchmarks.md, with one episode and small networks."""
    monkeypatch.chdir(tmp_path)
    (code,) = python_of("docs/benchmarks.md")
    planner = {name: TINY[name] for name in ("horizon", "num_candidates", "num_elites", "num_iterations")}
    asked = {"num_epochs": 1, "hidden_size": 8, **planner}
    tiny = code.replace('episodes=15, asked={"num_epochs": 20}', f"episodes=1, asked={asked}")
    assert tiny != code
    namespace = {}
    exec(tiny, namespace)
    run = namespace["run"]
    assert isinstance(run, Run) and run.is_finished(tmp_path / "results")


@pytest.mark.parametrize("package", [gym_dgpmpc, planning], ids=lambda package: package.__name__)
def test_the_reference_has_every_public_name(package):
    pages = [(ROOT / "docs" / name).read_text(encoding="utf-8") for name in ("api.md", "environment_reference.md")]
    shown = set(re.findall(r"(?:auto\w+::|\{docstring\}) ([\w.]+)", "\n".join(pages)))
    assert set(package.__all__) - {name.rpartition(".")[2] for name in shown} == set()


@cache
def texts():
    """Every text that stands in the package's code, with … where a value is put in, without its line breaks."""
    found = []
    for path in (ROOT / "gym_dgpmpc").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.JoinedStr):
                found.append("".join(part.value if isinstance(part, ast.Constant) else "…" for part in node.values))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.append(node.value)
    return found


def messages():
    page = (ROOT / "docs" / "errors.md").read_text(encoding="utf-8")
    cells = re.findall(r"^\| (`.*?) \|", page, re.MULTILINE)
    return [message for cell in cells for message in re.findall(r"`([^`]+)`", cell)]


@pytest.mark.parametrize("message", messages())
def test_a_message_that_is_explained_is_one_of_the_packages(message):
    pattern = ".*".join(re.escape(piece) for piece in message.split("…"))
    assert any(re.search(pattern, text, re.DOTALL) for text in texts()), f"no text of the package is {message!r}"
