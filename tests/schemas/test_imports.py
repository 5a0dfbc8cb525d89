"""The messages depend on no other part of the product."""

import ast
from pathlib import Path

import optipmb_schemas

PACKAGE = Path(optipmb_schemas.__file__).parent


def imported(source: str) -> set[str]:
    """Return the first names of all that a module imports, anywhere in it."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names.add("relative" if node.level else (node.module or "").split(".")[0])
    return names


def test_nothing_of_the_product_is_imported() -> None:
    """No module imports the tracker, the service or the client."""
    modules = list(PACKAGE.rglob("*.py"))
    assert len(modules) > 5
    forbidden = {"optipmb", "optipmb_service", "optipmb_client", "zenoh", "relative"}
    found = {module.name: imported(module.read_text()) & forbidden for module in modules}
    assert {name: names for name, names in found.items() if names} == {}


def test_the_search_finds_imports() -> None:
    """The search above sees imports of both kinds, also inside of functions."""
    source = "import optipmb.geometry\ndef f():\n    from optipmb_service.x import y\n    from . import z"
    assert imported(source) == {"optipmb", "optipmb_service", "relative"}
