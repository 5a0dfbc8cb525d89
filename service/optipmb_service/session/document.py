"""Reading a map of our own making that may have been made by anybody: every value is asked for by name and kind.

All errors are `optipmb_schemas.MessageError` with the path of the value. Values that are not asked for are ignored, so
that a later version of the same major number may add some; whole numbers that are absent count as zero where a table of
them is read, so that it may count more.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import msgpack
import optipmb_schemas as schemas
from optipmb_schemas.errors import show
from optipmb_schemas.structure import check_msgpack

from optipmb_service.session.values import MAX_COUNT

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

_T = TypeVar("_T")
_msgpack: Any = msgpack  # its type information is partial

_IDENTITY = re.compile("[0-9a-f]{32}")

MOST = 2**63 - 1


@dataclass(frozen=True, slots=True)
class Document:
    """A map and where it stands."""

    fields: dict[Any, Any]
    path: str = ""

    @classmethod
    def of(cls, body: bytes) -> Document:
        """Return the map that msgpack bytes hold."""
        check_msgpack(body, schemas.STORED)
        try:
            fields = _msgpack.unpackb(body, strict_map_key=True)
        except ValueError as error:
            raise schemas.MessageError("malformed", "", "msgpack", type(error).__name__) from None
        if not isinstance(fields, dict):
            raise schemas.MessageError("malformed", "", "a map", type(fields).__name__)
        return cls(fields)

    def wrong(self, name: str, expected: str, received: str) -> schemas.MessageError:
        """Return the error about a value."""
        return schemas.MessageError("invalid_value", f"{self.path}{name}", expected, received[:80])

    def absent(self, name: str) -> bool:
        """Whether a value is not there, or is nothing."""
        return self.fields.get(name) is None

    def optional(self, name: str, read: Callable[[str], _T]) -> _T | None:
        """Read a value that may be absent."""
        return None if self.absent(name) else read(name)

    def whole(self, name: str, low: int = 0, high: int = MOST) -> int:
        """Return a whole number from `low` to `high`, without one to the largest of 64 bits."""
        value = self.fields.get(name)
        if type(value) is not int or not low <= value <= high:
            raise self.wrong(name, f"a whole number from {low} to {high}", show(value))
        return value

    def count(self, name: str) -> int:
        """Return a number of things, to which others will be added."""
        return self.whole(name, high=MAX_COUNT)

    def counts(self, names: Iterable[str]) -> dict[str, int]:
        """Return a table of counts; those that are absent are zero."""
        return {name: 0 if self.absent(name) else self.count(name) for name in names}

    def flag(self, name: str) -> bool:
        """Return true or false."""
        return self._kind(name, bool)

    def text(self, name: str, most: int) -> str:
        """Return a text of at most so many characters."""
        value = self._kind(name, str)
        if len(value) > most:
            raise self.wrong(name, f"at most {most} characters", f"{len(value)}")
        return value

    def texts(self, name: str, number: int, most: int) -> list[str]:
        """Return a list of at most so many texts of at most so many characters."""
        found = self._kind(name, list)
        if len(found) > number or not all(isinstance(one, str) and len(one) <= most for one in found):
            raise self.wrong(name, f"at most {number} texts of at most {most} characters", "others")
        return found

    def identity(self, name: str) -> str:
        """Return the id of a session."""
        value = self._kind(name, str)
        if not _IDENTITY.fullmatch(value):
            raise self.wrong(name, "32 hexadecimal digits", show(value))
        return value

    def binary(self, name: str) -> bytes:
        """Return bytes."""
        return self._kind(name, bytes)

    def epoch(self, name: str) -> bytes:
        """Return the sixteen bytes of a publisher epoch."""
        value = self.binary(name)
        if len(value) != 16:  # noqa: PLR2004 - as described
            raise self.wrong(name, "16 bytes", f"{len(value)}")
        return value

    def stream(self, name: str) -> str:
        """Return the name of a stream."""
        value = self._kind(name, str)
        schemas.Keys().tracks(value)
        return value

    def position(self, name: str) -> tuple[float, float, float]:
        """Return three finite numbers."""
        found = self._kind(name, list)
        if len(found) != 3 or not all(isinstance(one, float) and math.isfinite(one) for one in found):  # noqa: PLR2004 - x, y, z
            raise self.wrong(name, "three finite numbers", "others")
        return found[0], found[1], found[2]

    def map(self, name: str) -> dict[str, Any]:
        """Return a map as it is."""
        return self._kind(name, dict)

    def document(self, name: str) -> Document:
        """Return a map inside this one."""
        return Document(self.map(name), f"{self.path}{name}.")

    def documents(self, name: str) -> list[Document]:
        """Return a list of maps."""
        found = self._kind(name, list)
        if not all(isinstance(one, dict) for one in found):
            raise self.wrong(name, "maps", "others")
        return [Document(one, f"{self.path}{name}[{index}].") for index, one in enumerate(found)]

    def row(self, name: str, length: int) -> Document:
        """Return a list of so many values, named by their numbers."""
        found = self._kind(name, list)
        if len(found) != length:
            raise self.wrong(name, f"{length} values", f"{len(found)}")
        return Document({str(index): value for index, value in enumerate(found)}, f"{self.path}{name}.")

    def rows(self, name: str, length: int) -> list[Document]:
        """Return a list of such lists."""
        outer = Document(dict(enumerate(self._kind(name, list))), f"{self.path}{name}.")
        return [outer.row(index, length) for index in outer.fields]

    def _kind(self, name: Any, kind: type[_T]) -> _T:
        value = self.fields.get(name)
        if type(value) is not kind:
            raise self.wrong(str(name), f"a value of type {kind.__name__}", show(value))
        return value
