"""Kinds of scalar fields. None converts: a text is no number, `true` is no integer, 1.0 is no integer either.

Integers fit 64 bits with sign; numbers are finite.
"""

import math
import re
from functools import lru_cache
from typing import Annotated, Any, Final

from pydantic import AfterValidator, BeforeValidator, Field, PlainSerializer, WithJsonSchema

from optipmb_schemas.arrays import Array, Reals, first_descent
from optipmb_schemas.errors import cut, invalid

CHUNK: Final = r"[A-Za-z0-9_.-]+"
"""One part of a stream name or key."""
MAX_NAME: Final = 200
"""Most characters of a stream name, an instance name or a profile name."""
MAX_TEXT: Final = 500
"""Most characters of a text for people."""
RESERVED: Final = frozenset({"owner", "service"})
"""First parts that no stream may have, because keys of the service start with them."""

_INT64: Final = 2**63 - 1
_DEPTH: Final = 10  # within the nesting that decoding allows
_EPOCH: Final = 16
_SURROGATE: Final = re.compile("[\ud800-\udfff]")
_STREAM: Final = re.compile(rf"{CHUNK}/{CHUNK}/{CHUNK}")
_CHUNK: Final = re.compile(CHUNK)


def check_chunk(text: str) -> str:
    """Return `text` when it is one part of a key: letters, digits, `_`, `.` and `-`, not `.` or `..`."""
    if len(text) > MAX_NAME or not _CHUNK.fullmatch(text) or text in {".", ".."}:
        raise invalid("", "a name of letters, digits and _ . -, without /", text)
    return text


@lru_cache(4096)
def check_stream(text: str) -> str:
    """Return `text` when it is the name of a stream: `site/node/sensor`."""
    if len(text) > MAX_NAME or not _STREAM.fullmatch(text):
        raise invalid("", "a stream as site/node/sensor, each of letters, digits and _ . -", text)
    parts = text.split("/")
    if parts[0] in RESERVED or not {".", ".."}.isdisjoint(parts):
        raise invalid("", "a stream whose site is not owner or service and whose parts are not . or ..", text)
    return text


def _epoch(value: Any) -> Any:
    if isinstance(value, str) and re.fullmatch(r"[0-9a-fA-F]{32}", value):
        return bytes.fromhex(value)
    if not isinstance(value, bytes) or len(value) != _EPOCH:
        raise invalid("", "16 bytes (JSON: 32 hexadecimal digits)", value)
    return value


def _plain(value: Any, path: str = "", depth: int = 0) -> Any:
    """Return a value that is made of what JSON can say: 64-bit integers, finite numbers, texts, lists, maps."""
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, int) and -_INT64 - 1 <= value <= _INT64:
        return value
    if isinstance(value, float) and math.isfinite(value):
        return value
    if isinstance(value, str) and not _SURROGATE.search(value):
        return value
    if depth < _DEPTH and isinstance(value, list | tuple):
        return [_plain(item, f"{path}[{i}]", depth + 1) for i, item in enumerate(value)]
    if depth < _DEPTH and isinstance(value, dict) and all(isinstance(key, str) for key in value):
        return {_plain(key, path): _plain(item, _inside(path, key), depth + 1) for key, item in value.items()}
    raise invalid(path, "a plain value: null, boolean, 64-bit integer, finite number, text, list or map", value)


def _inside(path: str, key: str) -> str:
    return cut(f"{path}.{ascii(key)[1:-1]}".removeprefix("."))


@lru_cache(64)
def check_labels(labels: tuple[str, ...]) -> tuple[str, ...]:
    """Return `labels` when all are printable and differ from each other."""
    for i, label in enumerate(labels):
        if not label.isprintable():
            raise invalid(f"[{i}]", "a label of printable characters", label)
        if label in labels[:i]:
            raise invalid(f"[{i}]", "labels that differ from each other", label)
    return labels


def check_horizons(horizons: Reals) -> Reals:
    """Return `horizons` when they ascend."""
    if at := first_descent(horizons):
        raise invalid(f"[{at}]", f"a number above {horizons[at - 1]:g}, in ascending order", horizons[at])
    return horizons


Flag = Annotated[bool, Field(strict=True)]
Count = Annotated[int, Field(strict=True, ge=0, le=_INT64)]
Stamp = Annotated[int, Field(strict=True, ge=0, le=_INT64)]
NonNegative = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0)]
Text = Annotated[str, Field(strict=True, max_length=MAX_TEXT)]
Word = Annotated[str, Field(strict=True, min_length=1, max_length=MAX_NAME)]
Stream = Annotated[
    str,
    Field(strict=True, max_length=MAX_NAME),
    AfterValidator(check_stream),
    WithJsonSchema({"type": "string", "maxLength": MAX_NAME, "pattern": f"^{CHUNK}/{CHUNK}/{CHUNK}$"}),
]
Name = Annotated[
    str,
    Field(strict=True, max_length=MAX_NAME),
    AfterValidator(check_chunk),
    WithJsonSchema({"type": "string", "maxLength": MAX_NAME, "pattern": f"^{CHUNK}$"}),
]
SessionId = Annotated[str, Field(strict=True, pattern="^[0-9a-f]{32}$")]
Epoch = Annotated[
    bytes,
    BeforeValidator(_epoch),
    PlainSerializer(bytes.hex, return_type=str, when_used="json"),
    WithJsonSchema({"type": "string", "pattern": "^[0-9a-fA-F]{32}$"}),
]
Plain = Annotated[dict[str, Any], AfterValidator(_plain)]
Horizons = Annotated[Reals, Array("f8", ("H",), 0, 30, above=True), AfterValidator(check_horizons)]
Labels = Annotated[
    tuple[Annotated[str, Field(strict=True, min_length=1, max_length=64)], ...],
    Field(max_length=256, fail_fast=True),
    AfterValidator(check_labels),
]
