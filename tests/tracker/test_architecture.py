"""The tracker is pure computation: what its modules may import and may do, read from their source."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import optipmb

FOLDER = Path(optipmb.__file__).parent
MODULES = {path.stem: ast.parse(path.read_text(encoding="utf-8")) for path in sorted(FOLDER.glob("*.py"))}
ALLOWED = {
    "__future__", "collections", "contextlib", "dataclasses", "difflib", "functools", "hashlib", "importlib",
    "itertools", "math", "numba", "numpy", "operator", "optipmb", "pathlib", "pydantic", "pydantic_core", "re", "sys",
    "tomllib", "types", "typing",
}  # fmt: skip
EXCEPTIONS = {
    # to show why a first frame takes a while; a folder; processes that compile
    "compiled": {"fcntl", "logging", "os", "stat", "subprocess", "tempfile", "time"},
    "warm": {"gc", "os", "pickle"},  # the programs of those processes
    "parameters": {"fnmatch"},  # patterns of sensors
    "online": {"datetime", "matplotlib", "pandas", "pyarrow", "supervision"},  # dates, and forms that users ask for
}
TOUCHES_FILES = {"compiled", "parameters", "prepared", "warm"}
DOES_IO = {"open", "print", "input", "exec", "eval", "__import__"}


def imports(tree: ast.Module) -> set[str]:
    """Top-level names of everything that a module imports, at any place in the file."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports hide where a name comes from"
            names.add((node.module or "").split(".")[0])
    return names


def own_imports(tree: ast.Module) -> set[str]:
    """Modules of the package that a module imports when it runs (not for type checking alone)."""
    found = set()
    for node in tree.body:
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("optipmb."):
            found.add((node.module or "").split(".")[1])
    return found


@pytest.mark.parametrize("name", MODULES)
def test_a_module_imports_computation_only(name: str) -> None:
    """No service, client, schemas, network, clock or randomness; logging only for compiling."""
    assert imports(MODULES[name]) <= ALLOWED | EXCEPTIONS.get(name, set())


@pytest.mark.parametrize("name", sorted(set(MODULES) - TOUCHES_FILES))
def test_only_the_profiles_are_read(name: str) -> None:
    """No module but `parameters`, and what keeps compiled code, touches files; none prints or evaluates."""
    assert not imports(MODULES[name]) & {"pathlib", "importlib", "tomllib"}
    calls = [node.func for node in ast.walk(MODULES[name]) if isinstance(node, ast.Call)]
    assert not {call.id for call in calls if isinstance(call, ast.Name)} & DOES_IO


def test_parameters_writes_nothing() -> None:
    """Profiles are read, never written."""
    attributes = {node.attr for node in ast.walk(MODULES["parameters"]) if isinstance(node, ast.Attribute)}
    assert not attributes & {"write_text", "write_bytes", "open", "mkdir", "unlink"}
    calls = [node.func for node in ast.walk(MODULES["parameters"]) if isinstance(node, ast.Call)]
    assert not {call.id for call in calls if isinstance(call, ast.Name)} & DOES_IO


def test_no_state_outside_the_density() -> None:
    """No `global`, and no module-level container that a function could fill."""
    for name, tree in MODULES.items():
        assert not [node for node in ast.walk(tree) if isinstance(node, ast.Global | ast.Nonlocal)], name
        for node in tree.body:
            if isinstance(node, ast.Assign | ast.AnnAssign) and name != "__init__":
                assert not isinstance(node.value, ast.List | ast.Dict | ast.Set), f"{name}: {ast.unparse(node)}"


def test_modules_do_not_import_each_other_in_circles() -> None:
    """Modules can be read in an order in which every import comes first."""
    done: set[str] = set()
    left = {name: own_imports(tree) for name, tree in MODULES.items()}
    while left:
        ready = {name for name, needs in left.items() if needs <= done}
        assert ready, f"in a circle: {sorted(left)}"
        done |= ready
        left = {name: needs for name, needs in left.items() if name not in ready}


def test_every_module_is_described_and_of_readable_length() -> None:
    """A docstring each, and at most 1,000 lines."""
    for name, tree in MODULES.items():
        assert ast.get_docstring(tree), name
        assert len((FOLDER / f"{name}.py").read_text(encoding="utf-8").splitlines()) <= 1000, name


def test_the_public_names_exist_and_are_described() -> None:
    """Everything in `__all__` is there and has a docstring."""
    for name in optipmb.__all__:
        assert getattr(optipmb, name).__doc__, name


def test_importing_the_tracker_brings_in_no_other_package_and_no_network() -> None:
    """A fresh interpreter has neither zenoh nor the other packages nor sockets' users loaded."""
    code = "import sys, optipmb; print(' '.join(sorted({name.split('.')[0] for name in sys.modules})))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True)
    loaded = set(done.stdout.split())
    assert not loaded & {"zenoh", "msgpack", "optipmb_schemas", "optipmb_service", "optipmb_client", "typer"}
