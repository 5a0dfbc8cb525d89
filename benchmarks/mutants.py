"""Make small faults in the product and see which the nearest tests miss: `python benchmarks/mutants.py SEED N [CAP_S]`.

The same seed and sources give the same faults. Each is made in a copy of the tree, so that the tree is never touched.
Where a fault is in the tracker, its kernels run as Python. Undecided are a run beyond CAP_S seconds (default 900), for
a fault that hangs or a busy machine, and a test that fails without the fault, too.
"""

from __future__ import annotations

import ast
import copy
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from nearest import ROOT, nearest

PACKAGES = (
    "optipmb",
    "schemas/optipmb_schemas",
    "clients/optipmb_client",
    "clients/optipmb_tools",
    "service/optipmb_service",
)
COPIED = ("schemas", "service", "clients", "tests", "docs", "examples", "benchmarks", "docker", "node")
FAILED = re.compile(r"^(?:FAILED|ERROR) (\S+?)(?: - .*)?$", re.MULTILINE)

COMPARISONS = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.In: ast.NotIn, ast.NotIn: ast.In, ast.Is: ast.IsNot, ast.IsNot: ast.Is,
}  # fmt: skip
OPERATORS = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult}


@dataclass(frozen=True)
class Fault:
    """One changed expression of a module."""

    path: Path
    line: int
    before: str
    after: str
    text: str  # of the module
    wrong: str  # of the module with the fault

    def __str__(self) -> str:
        return f"{self.path.relative_to(ROOT)}:{self.line}: {self.before}  ->  {self.after}"


def mutated(node: ast.AST) -> ast.expr | None:
    """Return an expression with a small fault, None where there is none to make."""
    wrong = copy.copy(node)  # only its own fields are replaced
    match wrong:
        case ast.Compare(ops=[one]):
            wrong.ops = [COMPARISONS[type(one)]()]
        case ast.BinOp(op=one) if type(one) in OPERATORS:
            wrong.op = OPERATORS[type(one)]()
        case ast.BoolOp():
            wrong.op = ast.And() if isinstance(wrong.op, ast.Or) else ast.Or()
        case ast.UnaryOp(op=ast.Not() | ast.USub()):
            return wrong.operand
        case ast.Constant(value=int(value)) if not isinstance(value, bool):
            return ast.Constant(value + 1)
        case ast.Call(func=function, args=[first, second, *rest]) if not isinstance(
            first, ast.Starred | ast.Constant
        ) and ast.unparse(function) not in {"max", "min"}:
            wrong.args = [second, first, *rest]
        case _:
            return None
    return wrong if isinstance(wrong, ast.expr) else None


def expressions(tree: ast.AST) -> Iterator[ast.expr]:
    """Yield the expressions within functions, without annotations, decorators, texts, exceptions and logs."""
    for node in ast.iter_child_nodes(tree):
        inside = isinstance(tree, ast.FunctionDef | ast.AsyncFunctionDef)
        if isinstance(node, ast.JoinedStr | ast.Raise | ast.arguments | ast.Assert) or (
            inside and node in _about(tree)
        ):
            continue
        if isinstance(node, ast.Expr) and ast.unparse(node).startswith(("log.", "_log.")):
            continue
        if isinstance(node, ast.AnnAssign):
            yield from expressions(ast.Expr(node.value)) if node.value else ()
            continue
        if isinstance(node, ast.expr):
            yield node
        yield from expressions(node)


def _about(function: ast.AST) -> list[ast.AST]:
    assert isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef)
    return [*function.decorator_list, *([function.returns] if function.returns else [])]


def faults() -> list[tuple[Path, int]]:
    """Return where a fault can be made: modules, and numbers of expressions in them."""
    places = []
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            places += [(path, number) for number, _ in enumerate(_expressions_of(path))]
    return places


@cache
def _expressions_of(path: Path) -> list[ast.expr]:
    functions = [
        node
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    ]
    unique = {(one.lineno, one.col_offset, one.end_col_offset): one for node in functions for one in expressions(node)}
    return [one for _, one in sorted(unique.items()) if mutated(one) is not None]


def fault(path: Path, number: int) -> Fault:
    """Make one fault."""
    text = path.read_text(encoding="utf-8")
    node = _expressions_of(path)[number]
    wrong = mutated(node)
    assert wrong is not None
    after = ast.unparse(wrong)
    lines = text.encode().splitlines(keepends=True)
    begin = sum(map(len, lines[: node.lineno - 1])) + node.col_offset
    end = sum(map(len, lines[: (node.end_lineno or 0) - 1])) + (node.end_col_offset or 0)
    changed = text.encode()[:begin] + f"({after})".encode() + text.encode()[end:]
    return Fault(path, node.lineno, ast.unparse(node), after, text, changed.decode())


def run(folder: Path, tests: list[str], cap_s: float, *, python: bool) -> list[str] | None:
    """Return the first test that fails in a copy; all where pytest itself fails, None beyond the time."""
    roots = os.pathsep.join(str(folder / part) for part in ("", "schemas", "service", "clients"))
    environment = os.environ | {"PYTHONPATH": roots} | ({"NUMBA_DISABLE_JIT": "1"} if python else {})
    options = ["-q", "-x", "-p", "no:cacheprovider", "-m", "not bounds and not ray and not alone and not accuracy"]
    options += ["--timeout", "0"]  # kernels as Python take longer than a test may: the run is bounded as a whole
    command = ["nice", sys.executable, "-m", "pytest", *options, *tests]
    with subprocess.Popen(
        command, cwd=folder, env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, text=True, start_new_session=True,
    ) as process:  # fmt: skip
        try:
            out, _ = process.communicate(timeout=cap_s)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            return None
    return FAILED.findall(out)[:1] or ([] if process.returncode in {0, 5} else tests)


def survives(folder: Path, one: Fault, cap_s: float) -> str:
    """Return `noticed`, `survives` or `undecided`."""
    tests = sorted(str(path.relative_to(ROOT)) for path in nearest({one.path}))
    place = folder / one.path.relative_to(ROOT)
    python = one.path.is_relative_to(ROOT / "optipmb")
    tracker = folder / "optipmb"
    if tracker.is_symlink():
        tracker.unlink()
    shutil.rmtree(tracker, ignore_errors=True)
    if python:
        shutil.copytree(ROOT / "optipmb", tracker, ignore=shutil.ignore_patterns("__pycache__"))
    else:
        tracker.symlink_to(ROOT / "optipmb")  # with its compiled kernels
    place.write_text(one.wrong, encoding="utf-8")
    failed = run(folder, tests, cap_s, python=python) if tests else []
    place.write_text(one.text, encoding="utf-8")
    if not failed:
        return "undecided" if failed is None else "survives"
    return "noticed" if run(folder, failed, cap_s, python=python) == [] else "undecided"


def main(seed: int, count: int, cap_s: float) -> None:
    """Make the faults, and print what becomes of each and how many survive."""
    results = []
    with tempfile.TemporaryDirectory(prefix="mutants-") as name:
        folder = Path(name) / ROOT.name
        for beside in {data.parent for data in ROOT.parent.glob("*/data")} - {ROOT}:  # with recorded data
            (Path(name) / beside.name).symlink_to(beside)
        for part in COPIED:
            shutil.copytree(ROOT / part, folder / part, ignore=shutil.ignore_patterns("__pycache__"))
        for file in filter(Path.is_file, ROOT.iterdir()):
            shutil.copy(file, folder)
        for one in [fault(*place) for place in random.Random(seed).sample(faults(), count)]:
            results.append(survives(folder, one, cap_s))
            print(f"{results[-1]:9} {one}", flush=True)
    print(f"seed {seed}: " + ", ".join(f"{results.count(one)} {one}" for one in ("noticed", "survives", "undecided")))


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3]) if len(sys.argv) > 3 else 900.0)
