"""Which mutants there are: cosmic-ray's operators at every place of a package where they change what is computed."""

import ast
import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator

ROOT = Path(__file__).parents[2]
PACKAGES = ("gp", "inference", "dynamics", "planning", "data")

OPERATORS = (
    # Of cosmic-ray's hundred replacements of operators, those that a test cannot see by a type error alone.
    *(f"ReplaceBinaryOperator_{pair}" for pair in ("Add_Sub", "Sub_Add", "Mul_Div", "Div_Mul", "Add_Mul", "Mul_Add")),
    *(f"ReplaceBinaryOperator_{pair}" for pair in ("Pow_Mul", "FloorDiv_Mul", "Mod_FloorDiv", "BitOr_BitAnd")),
    *(f"ReplaceComparisonOperator_{pair}" for pair in ("Lt_LtE", "Lt_GtE", "LtE_Lt", "LtE_Gt", "Gt_GtE", "Gt_LtE")),
    *(f"ReplaceComparisonOperator_{pair}" for pair in ("GtE_Gt", "GtE_Lt", "Eq_NotEq", "NotEq_Eq", "Is_IsNot")),
    *("ReplaceComparisonOperator_IsNot_Is", "AddNot", "ReplaceAndWithOr", "ReplaceOrWithAnd"),
    *(f"ReplaceUnaryOperator_Delete_{operator}" for operator in ("USub", "Invert", "Not")),
    *("ReplaceTrueWithFalse", "ReplaceFalseWithTrue", "ReplaceBreakWithContinue", "ReplaceContinueWithBreak"),
    *("NumberReplacer", "ExceptionReplacer", "RemoveDecorator", "ZeroIterationForLoop"),
)


class Mutant(NamedTuple):
    """One operator at one place of a module."""

    module: str
    """Path of the file from the root of the repository."""
    operator: str
    occurrence: int
    line: int

    @property
    def package(self) -> str:
        return self.module.split("/")[1]

    @property
    def name(self) -> str:
        """Stays the same while the file does."""
        source = (ROOT / self.module).read_bytes()
        return f"{self.module}:{self.line}:{self.operator}:{self.occurrence}:{hashlib.sha1(source).hexdigest()[:8]}"

    def source(self) -> str:
        """The mutated file."""
        return mutate_code((ROOT / self.module).read_text(), get_operator(f"core/{self.operator}")(), self.occurrence)

    def change(self) -> str:
        """The line before and after."""
        lines = ((ROOT / self.module).read_text().splitlines(), self.source().splitlines())
        before, after = next(
            ((old, new) for old, new in zip(*lines, strict=False) if old != new), (lines[0][self.line - 1], "")
        )
        return f"{before.strip()}  →  {after.strip()}"


def mutants_of(package: str) -> list[Mutant]:
    """Every mutant of a package but those of messages and annotations (docstrings are text, which nothing changes)."""
    files = sorted((ROOT / "gym_dgpmpc" / package).rglob("*.py"))
    return [mutant for path in files for mutant in _mutants_in(path)]


def _mutants_in(path: Path) -> Iterator[Mutant]:
    source = path.read_text()
    nodes, left_out = list(ast_nodes(get_ast(source))), _left_out(ast.parse(source))
    for name in OPERATORS:
        operator, occurrence = get_operator(f"core/{name}")(), 0
        for node in nodes:
            is_marker = node.parent is not None and node.parent.type == "parameters"  # the star of keyword-only ones
            for start, end in operator.mutation_positions(node):
                if not is_marker and not any(first <= start and end <= last for first, last in left_out):
                    yield Mutant(str(path.relative_to(ROOT)), name, occurrence, start[0])
                occurrence += 1


def _left_out(tree: ast.Module) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Spans of what is raised and warned of, and of annotations."""
    left_out = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Raise) or (isinstance(node, ast.Call) and ast.unparse(node.func) == "warnings.warn"):
            left_out.append(node)
        elif isinstance(node, ast.ExceptHandler) and "." in ast.unparse(node.type):
            left_out.append(node.type)  # which ExceptionReplacer cannot read
        left_out += [part for part in (getattr(node, "annotation", None), getattr(node, "returns", None)) if part]
    return [((node.lineno, node.col_offset), (node.end_lineno, node.end_col_offset)) for node in left_out]
