"""What imports what: the arrows between the folders of the service, and what its pure folders leave alone."""

import ast
import re
from functools import cache
from pathlib import Path

import optipmb_service
import pytest

ROOT = Path(optipmb_service.__file__).parent
SOURCES = sorted(ROOT.rglob("*.py"))
MODULES = {".".join(("optipmb_service", *source.relative_to(ROOT).with_suffix("").parts)): source for source in SOURCES}
PAGE = (Path(__file__).parents[2] / "docs/architecture.md").read_text()

LINK = tuple(f"optipmb_client.{name}." for name in ("zenoh", "incoming", "errors", "merging", "trace_context"))
"""What the service may import of the client."""

ARROWS = {
    "cluster": set(),
    "telemetry": {"__version__"},
    "stream": {"cluster", "telemetry", "zenoh", "settings"},
    "ros2": {"settings", "zenoh"},
    "zenoh": {"settings"},
    "edge": {"zenoh"},
    "http": {"telemetry", "settings", "edge"},
    "grpc": {"telemetry", "settings", "zenoh", "edge"},
    "app": {
        "cluster",
        "telemetry",
        "stream",
        "zenoh",
        "edge",
        "http",
        "grpc",
        "ros2",
        "settings",
        "__version__",
    },
    "settings": set(),
    "__init__": set(),
    "__main__": {"app"},
}
"""What each folder, or module beside the folders, may import of the others; also for the type checker alone."""

PURE = {
    "arrivals",
    "checkpoint",
    "convert",
    "pending",
    "problems",
    "session",
    "state",
    "timeline",
    "transition",
    "values",
    "window",
    "worlds",
}
"""Modules of `stream/` that make up a session."""


def place_of(source: Path) -> str:
    """The folder of a module, or the module itself where it has none."""
    first, *rest = source.relative_to(ROOT).parts
    return first if rest else source.stem


def imported(text: str) -> set[str]:
    """Full names of everything that a module imports, with `package.name` for `from package import name`."""
    names = set()
    for part in ast.walk(ast.parse(text)):
        if isinstance(part, ast.Import):
            names |= {alias.name for alias in part.names}
        elif isinstance(part, ast.ImportFrom):
            assert part.level == 0, "imports are absolute"
            names |= {f"{part.module}.{alias.name}" for alias in part.names}
    return names


@pytest.mark.parametrize("source", SOURCES, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_arrows_run_one_way(source: Path) -> None:
    """App and edges import the streams, these the cluster and the transport, which import none of the others."""
    own = {name.split(".")[1] for name in imported(source.read_text()) if name.startswith("optipmb_service.")}
    assert own - {place_of(source)} <= ARROWS[place_of(source)]


@pytest.mark.parametrize("source", SOURCES, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_libraries_of_an_edge_stay_there(source: Path) -> None:
    """HTTP, gRPC and NATS are imported by their folders alone, OpenTelemetry by a module; of the client, its link."""
    names = imported(source.read_text())
    first = {name.partition(".")[0] for name in names}
    place = place_of(source)
    assert all(name.startswith(LINK) for name in names if name.partition(".")[0] == "optipmb_client")
    assert "zenoh" not in first
    assert place == "cluster" or "nats" not in first
    assert source.stem == "traces" or not {name for name in names if name.startswith("opentelemetry.sdk")}
    assert place == "http" or not first & {"starlette", "uvicorn"}
    assert place == "grpc" or not first & {"grpc", "google", "grpc_health", "grpc_reflection", "grpc_status"}


@pytest.mark.parametrize("name", sorted(PURE))
def test_a_session_is_pure(name: str) -> None:
    """A module of a session imports no other module of its folder, and none that waits, stores, sends or logs."""
    names = imported((ROOT / f"stream/{name}.py").read_text())
    own = {name.split(".")[2] for name in names if name.startswith("optipmb_service.stream.")}
    assert own <= PURE
    first = {name.partition(".")[0] for name in names}
    assert not first & {"threading", "asyncio", "socket", "queue", "sqlite3", "os", "tempfile", "structlog"}


def test_every_folder_is_listed() -> None:
    """The arrows name each folder, and each module without one."""
    assert {place_of(source) for source in SOURCES} == set(ARROWS)


def test_the_page_has_the_arrows() -> None:
    """The table of folders in docs/architecture.md says what each may import, and no more."""
    rows = re.findall(r"^\| `(\w+)(?:/|\.py)` \|.*\| ([^|]*) \|$", PAGE, re.MULTILINE)
    page = {folder: set(re.findall(r"`(\w+)`", imports)) for folder, imports in rows if folder in ARROWS}
    arrows = {place: names - {"__version__"} for place, names in ARROWS.items() if not place.startswith("__")}
    assert page == arrows | {"app": set()}
    assert ("app", "all") in rows
    assert arrows["app"] == set(arrows) - {"app"}


@cache
def floors(module: str) -> int:
    """Modules in the longest chain of imports that begins with one; imports inside functions do not count."""
    names = set()
    for statement in ast.parse(MODULES[module].read_text()).body:
        if isinstance(statement, ast.ImportFrom):
            names |= {f"{statement.module}.{alias.name}" for alias in statement.names} | {str(statement.module)}
    return 1 + max((floors(name) for name in names & set(MODULES)), default=0)


def test_the_page_has_the_number_of_modules_and_the_longest_chain() -> None:
    """Both are counted; a file that only makes a folder a package is none."""
    counted = [module for module in MODULES if not module.endswith("__init__")]
    said = re.search(r"They have (\d+) modules, (\d+) in the longest chain", PAGE)
    assert said is not None
    assert [int(number) for number in said.groups()] == [len(counted), max(map(floors, counted))]
