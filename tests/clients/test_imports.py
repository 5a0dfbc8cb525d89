"""Which way dependencies run: the client knows the messages, and the tracker for offline tracking alone."""

import ast
import tomllib
from collections.abc import Iterator
from pathlib import Path

import optipmb_client
import optipmb_schemas
import optipmb_service

import optipmb

OTHERS = (optipmb, optipmb_schemas, optipmb_service)
SOURCES = sorted(Path(optipmb_client.__file__).parent.rglob("*.py"))


def imported(source: Path) -> Iterator[str]:
    """Give the top packages that a module imports, anywhere in it."""
    for node in ast.walk(ast.parse(source.read_text())):
        if isinstance(node, ast.Import):
            yield from (name.name.partition(".")[0] for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{source}: imports are written in full"
            yield (node.module or "").partition(".")[0]


def importers(package: str) -> set[str]:
    """Give the modules of the client that import a package."""
    root = Path(optipmb_client.__file__).parent
    return {str(source.relative_to(root)) for source in SOURCES if package in set(imported(source))}


def test_the_client_does_not_know_the_service() -> None:
    """No module imports optipmb_service: the demo starts it as a program."""
    assert len(SOURCES) > 20
    assert importers("optipmb_service") == set()


def test_the_tracker_is_imported_for_offline_tracking_alone() -> None:
    """Only what tracks offline, what tunes the tracker, and the matching of class names import optipmb."""
    offline = {path for path in importers("optipmb") if not path.startswith("tuning/")}
    assert offline == {"class_names.py", "dumps.py", "offline.py", "smoothing.py", "tracking.py"}


def test_zenoh_is_imported_in_one_folder() -> None:
    """Of all packages only the client imports zenoh, and of that only the folder zenoh/."""
    modules = {f"zenoh/{name}.py" for name in ("configuration", "connection", "handles", "session")}
    assert importers("zenoh") == modules
    others = [source for package in OTHERS for source in Path(package.__path__[0]).rglob("*.py")]
    assert len(others) > 100
    assert [source for source in others if "zenoh" in set(imported(source))] == []


def test_the_node_distribution_has_what_it_imports() -> None:
    """Every module of the client that a module of `optipmb-node` imports is in that distribution, too."""
    root = Path(optipmb_client.__file__).parent
    project = tomllib.loads((root.parents[1] / "node/pyproject.toml").read_text())
    places = project["tool"]["hatch"]["build"]["targets"]["wheel"]["force-include"].values()
    given = [root.parent / place for place in places if place.startswith("optipmb_client")]
    files = {file for place in given for file in (place.rglob("*.py") if place.is_dir() else [place])}
    assert all(file.exists() or file.name == "LICENSE" for file in files)
    missing = {
        name
        for file in files
        if file.suffix == ".py"
        for node in ast.walk(ast.parse(file.read_text()))
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("optipmb_client.")
        for name in [str(node.module)]
        if not {root.parent / f"{name.replace('.', '/')}{end}" for end in (".py", "/__init__.py")} & files
    }
    assert missing == set()
