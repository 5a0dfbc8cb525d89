"""Writes the JSON Schemas of the messages: `python -m optipmb_schemas.export [OPTIONS] [DIR]`.

One file per message type, `<Type>.v1.schema.json`, describing the JSON form. With `--page FILE` the tables of a
documentation page are brought up to date as well, with `--asyncapi FILE` the AsyncAPI document. With `--check` nothing
is written: every file that is not up to date gets one line, and the exit status is 1.

A page marks where a table belongs with the comment `<!-- table: NAME -->` and its end with `<!-- end -->`; what lies
between is replaced. Names are message types, `limits` and `codes`.
"""

import argparse
import json
import re
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

from pydantic.fields import FieldInfo
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue

from optipmb_schemas import json_form
from optipmb_schemas.codec import MAJOR, MESSAGES, encoding_of
from optipmb_schemas.control import MemberSummary, SessionParameters, SessionState, SessionSummary
from optipmb_schemas.limits import DEFAULT
from optipmb_schemas.messages import (
    Attribute,
    Delivery,
    Detections,
    FieldOfView,
    LinkedObject,
    Points,
    Pose,
    Relocation,
    Tracks,
    ZoneCount,
    ZoneEvent,
)
from optipmb_schemas.model import Message

SUFFIX = ".schema.json"

_TABLE: Final = re.compile(r"(<!-- table: ([A-Za-z]+) -->\n).*?(<!-- end -->)", re.DOTALL)

_KINDS: Final[tuple[type[Message], ...]] = (
    *MESSAGES,
    Pose,
    Relocation,
    FieldOfView,
    Attribute,
    Delivery,
    ZoneEvent,
    ZoneCount,
    LinkedObject,
    MemberSummary,
    SessionSummary,
)
_KIND: Final = {kind.__name__: kind for kind in _KINDS}
_SENT: Final = (Detections, Points, Pose, Relocation, FieldOfView, SessionParameters)
"""What others send: its tables have the ranges of arrays."""


class _Untitled(GenerateJsonSchema):
    """Leaves out titles: they would repeat the names of the fields."""

    def field_title_should_be_set(self, schema: Any) -> bool:  # noqa: ARG002 - no field has one
        """Return False: no field has a title."""
        return False


def schema_of(kind: type[Message]) -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of the JSON form of a message type."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$id": f"urn:optipmb:{kind.__name__}.v{MAJOR}",
        "x-encoding": encoding_of(kind, form="json"),
        **kind.model_json_schema(schema_generator=_Untitled),
    }


def schema_files() -> dict[str, str]:
    """Return the names and texts of all schema files."""
    about = {"$schema": "https://json-schema.org/draft/2020-12/schema", "x-encoding": "application/json"}
    edges = {name: about | {"$id": f"urn:optipmb:{name}.v{MAJOR}"} | one for name, one in json_form.schemas().items()}
    return {
        f"{name}.v{MAJOR}{SUFFIX}": json.dumps(schema, indent=2, sort_keys=True) + "\n"
        for name, schema in ({kind.__name__: schema_of(kind) for kind in MESSAGES} | edges).items()
    }


def fill(page: str) -> str:
    """Return the page with all its tables up to date. Raises KeyError when it names a table that there is not."""
    return _TABLE.sub(lambda match: f"{match[1]}{table(match[2])}{match[3]}", page)


def table(name: str) -> str:
    """Return one table as Markdown lines."""
    if name == "limits":
        return _markdown(("limit", "default", "of"), ((f"`{n}`", f"{v:,}", text) for n, v, text in DEFAULT.described()))
    return _markdown(("field", "type", "meaning"), _rows(_KIND[name]))


def _rows(kind: type[Message]) -> Iterable[tuple[str, ...]]:
    """Yield a row per field; fields that repeat a message described before share one."""
    rows = list(_field_rows(kind))
    for first in (Detections, Tracks, SessionState):
        if kind is first:
            break
        known = set(_field_rows(first))
        same = [row for row in rows if row in known]
        if len(same) > 1:
            yield ", ".join(name for name, *_ in same), "", f"As in `{first.__name__}`."
            rows = [row for row in rows if row not in known]
    yield from rows


def _field_rows(kind: type[Message]) -> Iterable[tuple[str, ...]]:
    properties = kind.model_json_schema()["properties"]
    for name, info in kind.model_fields.items():
        kept = "" if info.is_required() else _default(info)
        yield f"`{name}`", _type(kind, name, properties[name]) + kept, info.description or ""


def _default(info: FieldInfo) -> str:
    return ", optional" if info.default in (None, (), "") else f", default {str(info.default).lower()}"


def _type(kind: type[Message], name: str, schema: JsonSchemaValue) -> str:
    if name in kind.arrays:
        array = kind.arrays[name]
        values = array.range_described.removeprefix("a number ").removeprefix("an integer ") if kind in _SENT else ""
        return f"{array.dtype} {array.shape_described}" + (f", {values}" if values else "")
    alternatives = [part for part in schema.get("anyOf", [schema]) if part.get("type") != "null"]
    return _scalar(alternatives[0])


def _scalar(schema: JsonSchemaValue) -> str:
    if "$ref" in schema:
        return f"map `{schema['$ref'].rpartition('/')[2]}`"
    if "enum" in schema:
        return " or ".join(f"`{value}`" for value in schema["enum"])
    if schema.get("type") == "array":
        return f"list of {_scalar(schema['items'])}"
    if schema.get("pattern", "").endswith("{32}$") and "A-F" in schema["pattern"]:
        return "bytes (16)"
    return {"integer": "int", "number": "float", "boolean": "bool", "string": "text", "object": "map"}[schema["type"]]


def _markdown(head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    lines = [head, tuple("---" for _ in head), *rows]
    return "".join(f"| {' | '.join(cell.replace('|', '&#124;') for cell in line)} |\n" for line in lines)


def bring_up_to_date(files: dict[Path, str], command: str, *, check: bool, gone: Iterable[Path] = ()) -> int:
    """Write files, and return the exit status 0.

    With `check` nothing is written: each file that is not up to date, or `gone`, gets one line, and the status is 1.
    """
    lines = [f"{path}: missing" for path in files if not path.is_file()]
    lines += [f"{path}: not up to date" for path, text in files.items() if path.is_file() and read(path) != text]
    lines += [f"{path}: no such message" for path in gone]
    if check:
        sys.stdout.writelines(f"{line}; run {command}\n" for line in lines)
        return 1 if lines else 0
    for path, text in files.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return 0


def main(arguments: list[str] | None = None) -> int:
    """Run the command and return its exit status: 0 done, 1 not up to date, 2 not possible."""
    parser = argparse.ArgumentParser(
        prog="python -m optipmb_schemas.export", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("--check", action="store_true", help="write nothing, report what is not up to date")
    parser.add_argument("--page", type=Path, metavar="FILE", help="a documentation page whose tables are updated too")
    parser.add_argument("--asyncapi", type=Path, metavar="FILE", help="the AsyncAPI document of the interface")
    parser.add_argument("folder", type=Path, metavar="DIR", nargs="?", help="folder of the schema files")
    options = parser.parse_args(arguments)
    folder: Path | None = options.folder
    if folder is None and options.page is None and options.asyncapi is None:
        parser.error("nothing to write: expected DIR, --page or --asyncapi")
    try:
        files = {} if folder is None else {folder / name: text for name, text in schema_files().items()}
        if options.page:
            files[options.page] = fill(read(options.page))
        if options.asyncapi:
            from optipmb_schemas.asyncapi import document  # noqa: PLC0415  it imports this module

            files[options.asyncapi] = document()
        gone = sorted(set(folder.glob(f"*{SUFFIX}")) - files.keys()) if folder else []
        return bring_up_to_date(files, f"{parser.prog} without --check", check=options.check, gone=gone)
    except OSError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2


def read(path: Path) -> str:
    """Return the text of a file."""
    return path.read_text(encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
