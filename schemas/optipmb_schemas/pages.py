"""Tables of the documentation, made from the descriptions in the code.

A page marks where a table belongs with the comment `<!-- table: NAME -->` and its end with `<!-- end -->`; what lies
between is replaced. Names are those of the message types, `limits` and `codes`.
"""

import re
from collections.abc import Iterable
from typing import Final

from pydantic.fields import FieldInfo
from pydantic.json_schema import JsonSchemaValue

from optipmb_schemas.codec import MESSAGES
from optipmb_schemas.control import MemberSummary, SessionState, SessionSummary
from optipmb_schemas.errors import CODES
from optipmb_schemas.limits import DEFAULT
from optipmb_schemas.messages import Delivery, Detections, FieldOfView, Pose, Tracks
from optipmb_schemas.model import Message

_TABLE: Final = re.compile(r"(<!-- table: ([A-Za-z]+) -->\n).*?(<!-- end -->)", re.DOTALL)

_KINDS: Final[tuple[type[Message], ...]] = (*MESSAGES, Pose, FieldOfView, Delivery, MemberSummary, SessionSummary)
_KIND: Final = {kind.__name__: kind for kind in _KINDS}


def fill(page: str) -> str:
    """Return the page with all its tables up to date. Raises KeyError when it names a table that there is not."""
    return _TABLE.sub(lambda match: f"{match[1]}{table(match[2])}{match[3]}", page)


def table(name: str) -> str:
    """Return one table as Markdown lines."""
    if name == "limits":
        return _markdown(("limit", "default", "of"), ((f"`{n}`", f"{v:,}", text) for n, v, text in DEFAULT.described()))
    if name == "codes":
        return _markdown(("code", "meaning"), ((f"`{code}`", text) for code, text in CODES.items()))
    return _markdown(("field", "type", "meaning"), _rows(_KIND[name]))


def _rows(kind: type[Message]) -> Iterable[tuple[str, ...]]:
    """Yield a row per field; those that are as in a message described before share one."""
    rows = list(_fields(kind))
    for first in (Detections, Tracks, SessionState):
        if kind is first:
            break
        known = set(_fields(first))
        same = [row for row in rows if row in known]
        if len(same) > 1:
            yield ", ".join(name for name, *_ in same), "", f"As in `{first.__name__}`."
            rows = [row for row in rows if row not in known]
    yield from rows


def _fields(kind: type[Message]) -> Iterable[tuple[str, ...]]:
    properties = kind.model_json_schema()["properties"]
    for name, info in kind.model_fields.items():
        kept = "" if info.is_required() else _default(info)
        yield f"`{name}`", _type(kind, name, properties[name]) + kept, info.description or ""


def _default(info: FieldInfo) -> str:
    return ", optional" if info.default in (None, (), "") else f", default {str(info.default).lower()}"


def _type(kind: type[Message], name: str, schema: JsonSchemaValue) -> str:
    if name in kind.arrays:
        array = kind.arrays[name]
        values = array.range_described.removeprefix("a number ").removeprefix("an integer ")
        return f"{array.dtype} {array.shape_described}, {values}"
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
