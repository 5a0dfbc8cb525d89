"""Rules of the repository: directions of imports, pure computation, and names in the documentation."""

import ast
import dataclasses
import inspect
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import optipmb_client
import optipmb_schemas
import optipmb_service
import optipmb_tools
import pytest
from optipmb_tools.datasets.table.draft import Draft
from optipmb_tools.datasets.table.read import STEPS

import optipmb

DOCS = Path(__file__).parents[2] / "docs"
PACKAGES = {
    name: Path(next(iter(package.__path__)))
    for name, package in {
        "optipmb": optipmb,
        "optipmb_schemas": optipmb_schemas,
        "optipmb_client": optipmb_client,
        "optipmb_tools": optipmb_tools,
        "optipmb_service": optipmb_service,
    }.items()
}
SERVICE, TRACKER = PACKAGES["optipmb_service"], PACKAGES["optipmb"]

USES = {
    "optipmb": set(),
    "optipmb_schemas": set(),
    "optipmb_client": {"optipmb_schemas"},
    "optipmb_tools": {"optipmb", "optipmb_schemas", "optipmb_client"},
    "optipmb_service": {"optipmb", "optipmb_schemas", "optipmb_client"},
}
"""The packages of this repository that each imports: the tools start the service as a program."""

LINK = ("zenoh", "incoming", "errors", "merging", "trace_context")
"""Modules of the client that the service imports."""

AT_HOME = {
    "zenoh": PACKAGES["optipmb_client"] / "zenoh",
    "nats": SERVICE / "cluster",
    "starlette": SERVICE / "edges/http",
    "uvicorn": SERVICE / "edges/http",
    "grpc": SERVICE / "edges/grpc",
    "google": SERVICE / "edges/grpc",
    "grpc_health": SERVICE / "edges/grpc",
    "grpc_reflection": SERVICE / "edges/grpc",
    "grpc_status": SERVICE / "edges/grpc",
    "paho": SERVICE / "edges/mqtt.py",
    "opentelemetry.sdk": SERVICE / "streams/traces.py",
}
"""Where the service imports a library; of all packages, only the client's `zenoh/` imports Zenoh."""

IO = {"threading", "asyncio", "socket", "queue", "sqlite3", "os", "tempfile", "structlog"}

COMPUTATION = {
    "__future__", "collections", "contextlib", "dataclasses", "enum", "difflib", "functools", "hashlib", "importlib",
    "itertools", "llvmlite", "math", "numba", "numpy", "operator", "optipmb", "pathlib", "pydantic", "pydantic_core",
    "re", "sys", "tomllib", "types", "typing",
}  # fmt: skip
EXCEPTIONS = {
    # to show why a first frame takes a while; a folder; processes that compile
    "compiled": {"fcntl", "logging", "os", "stat", "subprocess", "tempfile", "time"},
    "camera_files": {"json"},  # a format of calibrations
    "warm": {"gc", "os", "pickle"},  # the programs of those processes
    "parameters": {"fnmatch"},  # patterns of sensors
    # dates, forms that users ask for, a page for notebooks, and warnings
    "online": {"datetime", "html", "io", "matplotlib", "pandas", "pyarrow", "supervision", "warnings"},
}
EXECUTES = {"rows": {"exec"}}  # the views of the columns of a record, which come from their declaration
TOUCHES_FILES = {"camera_files", "compiled", "parameters", "prepared", "warm"}


@cache
def tree(source: Path) -> ast.Module:
    return ast.parse(source.read_text(encoding="utf-8"))


@cache
def imported(source: Path) -> frozenset[str]:
    """Full names of everything that a module imports, with `package.name` for `from package import name`."""
    names = set()
    for part in ast.walk(tree(source)):
        if isinstance(part, ast.Import):
            names |= {alias.name for alias in part.names}
        elif isinstance(part, ast.ImportFrom):
            assert part.level == 0, f"{source}: imports are written in full"
            names |= {f"{part.module}.{alias.name}" for alias in part.names}
    return frozenset(names)


def first(source: Path) -> set[str]:
    return {name.partition(".")[0] for name in imported(source)}


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_import_only_what_stands_below_them(package: str) -> None:
    """A node needs the messages alone, the tracker nothing, and of the client the service needs its link."""
    for source in sorted(PACKAGES[package].rglob("*.py")):
        assert (first(source) & set(PACKAGES)) - {package} <= USES[package], source
        if package == "optipmb_service":
            client = {name.split(".")[1] for name in imported(source) if name.startswith("optipmb_client.")}
            assert client <= set(LINK), source


def test_libraries_of_an_edge_stay_there() -> None:
    """Zenoh, NATS, HTTP, the additions of gRPC and the recorder of traces are imported in one place each."""
    for package in PACKAGES.values():
        for source in sorted(package.rglob("*.py")):
            for library, home in (AT_HOME if package == SERVICE else {"zenoh": AT_HOME["zenoh"]}).items():
                used = any(name == library or name.startswith(f"{library}.") for name in imported(source))
                assert not used or source.is_relative_to(home), f"{source} imports {library}"


def test_folders_of_the_service_import_what_the_page_says() -> None:
    """The table of docs/architecture.md has each folder and module, and its allowed imports of the others."""
    page = (DOCS / "architecture.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)(?:/|\.py)` \|.*\| ([^|]*) \|$", page, re.MULTILINE)
    allowed = {folder: set(re.findall(r"`(\w+)`", imports)) for folder, imports in rows}
    for source in sorted(SERVICE.rglob("*.py")):
        folder, *rest = source.relative_to(SERVICE).parts
        place = folder if rest else source.stem
        if place in {"app", "__init__", "__main__"}:
            continue
        own = {name.split(".")[1] for name in imported(source) if name.startswith("optipmb_service.")}
        assert own - {place, "__version__"} <= allowed[place], source


def test_folders_of_the_tracker_import_what_the_page_says() -> None:
    """What a folder imports, by types too, is in its row of docs/architecture.md; the modules on top import all."""
    page = (DOCS / "architecture.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)/` \|.*\| ([^|]*) \|$", page.split("\n## The tracker")[1], re.MULTILINE)
    allowed = {folder: set(re.findall(r"`(\w+)`", imports)) for folder, imports in rows}
    assert set(allowed) == {path.parent.name for path in TRACKER.rglob("*.py")} - {TRACKER.name}
    for source in sorted(TRACKER.glob("*/*.py")):
        own = {name.split(".")[1] for name in imported(source) if name.startswith("optipmb.")}
        assert own - {source.parent.name} <= allowed[source.parent.name], source


def test_no_modules_of_the_tracker_import_each_other_in_a_circle() -> None:
    """Imports for types count: each module can be read with those that it imports, and without the others."""
    modules = {".".join(path.relative_to(TRACKER.parent).with_suffix("").parts): path for path in TRACKER.rglob("*.py")}
    below = {
        name: {module for one in imported(path) for module in (one, one.rpartition(".")[0])} & modules.keys()
        for name, path in modules.items()
    }
    while free := {name for name, others in below.items() if not others & below.keys()}:
        below = {name: others for name, others in below.items() if name not in free}
    assert not below


@pytest.mark.parametrize("source", sorted((SERVICE / "session").glob("*.py")), ids=lambda path: path.stem)
def test_a_session_is_pure(source: Path) -> None:
    """A module of a session imports none that waits, stores, sends or logs."""
    assert not first(source) & IO


@pytest.mark.parametrize("source", sorted(TRACKER.rglob("*.py")), ids=lambda path: path.stem)
def test_the_tracker_is_pure_computation(source: Path) -> None:
    """No network, clock or randomness; files are read by few modules; no state outside the density."""
    assert first(source) <= COMPUTATION | EXCEPTIONS.get(source.stem, set())
    if source.stem not in TOUCHES_FILES:
        assert not first(source) & {"pathlib", "importlib", "tomllib"}
        calls = [node.func for node in ast.walk(tree(source)) if isinstance(node, ast.Call)]
        names = {call.id for call in calls if isinstance(call, ast.Name)}
        assert names & {"open", "print", "input", "exec", "eval"} <= EXECUTES.get(source.stem, set())
    assert not [node for node in ast.walk(tree(source)) if isinstance(node, ast.Global | ast.Nonlocal)]
    for node in tree(source).body:
        if isinstance(node, ast.Assign | ast.AnnAssign) and source.stem != "__init__":
            assert not isinstance(node.value, ast.List | ast.Dict | ast.Set), ast.unparse(node)


def test_importing_the_tracker_brings_in_no_other_package_and_no_network() -> None:
    """A fresh interpreter has neither zenoh nor the other packages loaded."""
    code = "import sys, optipmb; print(' '.join(sorted({name.split('.')[0] for name in sys.modules})))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True)
    loaded = set(done.stdout.split())
    assert not loaded & {"zenoh", "msgpack", "typer", *PACKAGES} - {"optipmb"}


def test_each_fault_of_reliability_has_tests_that_exist() -> None:
    """The rows of both pages have the same numbers, each with at least one test, which is a function of its file."""
    faults = re.findall(r"^\| (\d+) \|", (DOCS / "reliability.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert [int(number) for number in faults] == list(range(1, len(faults) + 1))
    page = (DOCS / "fault-tests.md").read_text(encoding="utf-8")
    rows = re.findall(r"^(\d+)\. (.*)$", page, re.MULTILINE)
    assert [number for number, _ in rows] == faults
    assert all("::test_" in row for _, row in rows)
    for file, name in re.findall(r"`(tests/\S+?\.py)::(test_\w+)`", page):
        functions = {part.name for part in ast.walk(tree(DOCS.parent / file)) if isinstance(part, ast.FunctionDef)}
        assert name in functions, f"{file}::{name}"


def test_steps_of_the_reading_of_tables_read_fields_that_earlier_steps_set() -> None:
    """Each function in STEPS, with those of its module that it calls, reads of the draft only what is set by then."""
    known = {"columns", "rows", "scored", "framed", "roles"}
    for step in STEPS:
        functions = {
            one.name: one for one in tree(Path(inspect.getfile(step))).body if isinstance(one, ast.FunctionDef)
        }
        called, names = [functions[step.__name__]], {step.__name__}
        for function in called:
            parts = {part.id for part in ast.walk(function) if isinstance(part, ast.Name)} & functions.keys()
            called += [functions[name] for name in sorted(parts - names)]
            names |= parts
        parts = [part for function in called for part in ast.walk(function)]
        read = {part.attr for part in parts if isinstance(part, ast.Attribute) and ast.unparse(part.value) == "draft"}
        calls = [part for part in parts if isinstance(part, ast.Call) and ast.unparse(part.func) == "replace"]
        fields = {one.name for one in dataclasses.fields(Draft)}
        assert read & fields <= known, f"{step.__module__}.{step.__name__}: {sorted(read & fields - known)}"
        known |= {word.arg for call in calls for word in call.keywords if word.arg} & fields
    assert fields <= known
