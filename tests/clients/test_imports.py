"""Which way dependencies run: nodes and tools know the messages, and the tools the tracker."""

import ast
from collections.abc import Iterator
from pathlib import Path

import optipmb_client
import optipmb_schemas
import optipmb_service
import optipmb_tools

import optipmb

PACKAGES = (optipmb, optipmb_schemas, optipmb_client, optipmb_tools, optipmb_service)


def imported(source: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(source.read_text())):
        if isinstance(node, ast.Import):
            yield from (name.name.partition(".")[0] for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{source}: imports are written in full"
            yield (node.module or "").partition(".")[0]


def importers(package: str, name: str) -> set[str]:
    root = Path(next(each for each in PACKAGES if each.__name__ == package).__path__[0])
    sources = sorted(root.rglob("*.py"))
    assert len(sources) > 10
    return {str(source.relative_to(root)) for source in sources if name in set(imported(source))}


def test_nodes_need_the_messages_alone() -> None:
    """The package of a node imports neither tracker nor tools nor service."""
    assert [importers("optipmb_client", name) for name in ("optipmb", "optipmb_tools", "optipmb_service")] == [
        set()
    ] * 3


def test_the_messages_depend_on_no_other_part() -> None:
    """Their package imports neither tracker nor client nor service."""
    assert all(importers("optipmb_schemas", name) == set() for name in ("optipmb", "optipmb_client", "optipmb_service"))


def test_the_tools_do_not_know_the_service() -> None:
    """No module imports optipmb_service: the demo starts it as a program. No other package imports the tools."""
    assert importers("optipmb_tools", "optipmb_service") == set()
    assert all(importers(each.__name__, "optipmb_tools") == set() for each in PACKAGES if each is not optipmb_tools)


def test_the_tracker_is_imported_for_offline_tracking_alone() -> None:
    """Only what tracks offline, what tunes the tracker, and the matching of class names and places import optipmb."""
    offline = {path for path in importers("optipmb_tools", "optipmb") if not path.startswith("tuning/")}
    assert offline == {
        "datasets/interface.py",
        *(f"run/{name}.py" for name in ("dumps", "profiles", "smoothing", "tracking")),
    }


def test_zenoh_is_imported_in_one_folder() -> None:
    """Of all packages only the client imports zenoh, and of that only the folder zenoh/."""
    modules = {f"zenoh/{name}.py" for name in ("configuration", "connection", "handles", "session")}
    assert {each.__name__: importers(each.__name__, "zenoh") for each in PACKAGES} == {
        each.__name__: modules if each is optipmb_client else set() for each in PACKAGES
    }
