"""What docstrings of the service name is there."""

import ast
import re
from pathlib import Path

import optipmb_service
import pytest

ROOT = Path(optipmb_service.__file__).parent
SOURCES = sorted(ROOT.rglob("*.py"))


def named(doc: str, section: str) -> list[str]:
    """The names that a section of a docstring explains, each on a line of its own."""
    found = re.search(rf"^( *){section}:\n((?:\1 {{4}}.*\n|\n)+)", doc + "\n", re.MULTILINE)
    return re.findall(rf"^ {{{len(found[1]) + 4}}}(\S[^:\n]*): ", found[2], re.MULTILINE) if found else []


def arguments(function: ast.FunctionDef | ast.AsyncFunctionDef) -> set[str]:
    taken = function.args
    every = [*taken.posonlyargs, *taken.args, *taken.kwonlyargs, taken.vararg, taken.kwarg]
    return {one.arg for one in every if one is not None}


def attributes(owner: ast.ClassDef) -> set[str]:
    """The names of a class, and the attributes that its methods set."""
    names = {
        part.target.id for part in owner.body if isinstance(part, ast.AnnAssign) and isinstance(part.target, ast.Name)
    }
    names |= {part.name for part in owner.body if isinstance(part, ast.FunctionDef)}
    return names | {part.attr for part in ast.walk(owner) if isinstance(part, ast.Attribute)}


@pytest.mark.parametrize("source", SOURCES, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_docstrings_name_what_there_is(source: Path) -> None:
    """Each name among the arguments is one that is taken, and each among the attributes is one of the class."""
    wrong = []
    for part in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
        if not isinstance(part, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        doc, taken, own = ast.get_docstring(part, clean=False) or "", set[str](), set[str]()
        if isinstance(part, ast.ClassDef):
            inits = [one for one in part.body if isinstance(one, ast.FunctionDef) and one.name == "__init__"]
            own = attributes(part)
            taken = arguments(inits[0]) if inits else own
        else:
            taken = arguments(part)
        wrong += [f"{part.name}: {name}" for name in named(doc, "Args") if name not in taken]
        wrong += [f"{part.name}: {name}" for name in named(doc, "Attributes") if name not in own]
    assert wrong == []
