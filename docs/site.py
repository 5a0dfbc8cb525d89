"""Pages of the site that are generated: the quick start from the README, references and lists from the code."""

from __future__ import annotations

import ast
import re
import types
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, get_args

import optipmb_client
from mkdocs.structure.files import File
from pydantic import BaseModel

import optipmb

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files

ROOT: Final = Path(__file__).parent.parent
PAGES: Final = {"README.md": "index.md", "CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}
FIRST: Final = ("OnlineTracker", "OnlineTracks", "generic_parameters", "predict_tracks")
"""What most programs need of the library; the rest follows by name."""


def on_config(config: MkDocsConfig) -> None:
    """Write the version at the foot of each page."""
    config.copyright = f"OptiPMB {optipmb.__version__}"


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages."""
    pages = {page: _page(ROOT / source) for source, page in PAGES.items()}
    pages |= {"profiles.md": _profiles(), "api.md": _api(), "attack-tests.md": _attacks()}
    for page, text in pages.items():
        files.append(File.generated(config, page, content=text))
    return files


def _page(path: Path) -> str:
    """Return a page of the repository with its links as they are in the site."""
    text = path.read_text(encoding="utf-8").replace("](docs/", "](")
    for source, page in PAGES.items():
        text = text.replace(f"]({source})", f"]({page})")
    return text


def _attacks() -> str:
    """Return the list of the tests of attacks, each with its claim."""
    file = "tests/e2e/test_security.py"
    lines = ["# Tests of attacks", "", f"`pytest {file}::NAME` runs one.", "", "| name | claim |", "| --- | --- |"]
    lines += [
        f"| `{part.name}` | {ast.get_docstring(part)} |"
        for part in ast.parse((ROOT / file).read_text(encoding="utf-8")).body
        if isinstance(part, ast.FunctionDef) and part.name.startswith("test_")
    ]
    return "\n".join(lines)


def _profiles() -> str:
    """Return the reference of profiles: every field with its description, and the profiles that come along."""
    lines = [
        "# Profiles",
        "",
        "A profile is a TOML file. `optipmb profiles` lists the shipped profiles, shows and copies them.",
        "",
    ]
    lines += _fields(optipmb.Parameters, "Profile")
    lines += ["## Shipped profiles", ""]
    for name in optipmb.profiles():
        one = optipmb.load_profile(name)
        lines += [f"**{name}**: {1.0 / one.nominal_period:g} Hz; {', '.join(one.labels)}", ""]
    return "\n".join(lines)


def _fields(model: type[BaseModel], title: str) -> list[str]:
    lines = [f"## {title}", "", (model.__doc__ or "").strip().split("\n\n")[0].replace("\n", " "), ""]
    lines += ["| field | meaning | default |", "| --- | --- | --- |"]
    inner: list[str] = []
    for name, field in model.model_fields.items():
        default = "required" if field.is_required() else f"`{field.default!r}`"
        lines.append(f"| `{name}` | {field.description or ''} | {default} |")
        for part in _models(field.annotation):
            inner += _fields(part, f"`{name}`")
    return [*lines, "", *inner]


def _models(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and not isinstance(annotation, types.GenericAlias):
        return [annotation] if issubclass(annotation, BaseModel) else []
    return [model for part in get_args(annotation) for model in _models(part)]


def _api() -> str:
    """Return the reference of the public names of the library and of the node API."""
    lines = ["# Python", "", "## The library", ""]
    lines += [f"::: optipmb.{name}\n" for name in (*FIRST, *(name for name in optipmb.__all__ if name not in FIRST))]
    lines += ["## Nodes", ""]
    lines += [f"::: optipmb_client.{name}\n" for name in optipmb_client.__all__ if not re.fullmatch("[A-Z_]+", name)]
    return "\n".join(lines)
