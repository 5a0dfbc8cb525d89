"""JSON of other makers as frames: where the objects of a payload are, and which of their fields are which of ours.

A path is names with dots between them, `[0]` for an element of a list, and in the path of the objects `[]` for each
element and `*` for each value of a map, or a list in its place.
"""

from __future__ import annotations

import math
import re
from codecs import BOM_UTF8
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final

import msgspec
import optipmb_schemas as schemas
from optipmb_schemas.errors import invalid

from optipmb_service.settings import MappingSettings

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from optipmb_service.settings import InputSettings

EACH: Final = "[]"
ANY: Final = "*"
CONSTANT: Final = "= "
KEY: Final = "@key"
FIELDS: Final = ("class", "score", "position", "size", "yaw", "velocity", "lat", "lon", "alt", "heading", "box", "foot")
CORNERS: Final = 4
UNITS: Final = {"s": 9, "ms": 6, "us": 3, "ns": 0}
"""Decimal digits between a unit of time and nanoseconds."""

LARGEST: Final = 1e300
"""Larger integers of JSON are no numbers of 64 bits; no sum and no product of others is infinite."""

_STEP: Final = re.compile(r"\[\d*\]|[^.\[\]]+")
_OBJECT: Final = re.compile(r"objects\[(\d+)\](?:\.(\w+)(?:\[(\d+)\])?)?.*")


FORMATS: Final[dict[str, dict[str, Any]]] = {
    "axis": {
        "objects": "frame.observations[]",
        "class": "class.type",
        "score": "class.score",
        "box": tuple(f"bounding_box.{side}" for side in ("left", "top", "right", "bottom")),
        "box_unit": "image",
        "time": "frame.timestamp",
    },
    "frigate": {
        "objects": "after",
        "class": "label",
        "score": "score",
        "box": "box",
        "time": "after.frame_time",
        "time_unit": "s",
        "leave_out": {"type": "end", "after.false_positive": True},
    },
    "scenescape": {
        "objects": "objects.*[]",
        "class": "category",
        "score": "confidence",
        "box": tuple(f"bounding_box_px.{side}" for side in ("x", "y", "width", "height")),
        "box_form": "xywh",
        "position": "translation",
        "size": "size",
        "lat": "lat_long_alt[0]",
        "lon": "lat_long_alt[1]",
        "alt": "lat_long_alt[2]",
        "time": "timestamp",
    },
}
"""Mappings of known makers: Axis' scene description, events of Frigate, and detections of SceneScape."""


def mapping_of(one: InputSettings) -> PayloadMapping | None:
    """Return how the payloads of an input are mapped; None: they are frames."""
    if one.format in FORMATS:
        return PayloadMapping(MappingSettings(**FORMATS[one.format]))
    return None if one.mapping is None else PayloadMapping(one.mapping)


def other_value(payload: bytes, only: Mapping[str, bool | int | str]) -> tuple[str, Any] | None:
    """Return the first path at which a payload has another value, and that; None too where it is no JSON at all."""
    try:
        document = msgspec.json.decode(payload.removeprefix(BOM_UTF8)) if only else None
    except (ValueError, msgspec.DecodeError, RecursionError):
        return None
    return next(((path, found) for path, value in only.items() if (found := _at(document, path)) != value), None)


class PayloadMapping:
    """Frames of payloads by the settings of an input.

    Attributes:
        box_unit: of boxes and feet.

    Args:
        settings: paths and units.
    """

    def __init__(self, settings: MappingSettings) -> None:
        self.box_unit = settings.box_unit
        self._settings = settings
        self._paths: dict[str, Any] = {
            name: path for name in FIELDS if (path := getattr(settings, "name" if name == "class" else name))
        }

    @cached_property
    def _objects(self) -> list[str]:
        return _STEP.findall(self._settings.objects)

    def frame(self, payload: Any) -> tuple[dict[str, Any], list[str]]:
        """Return the frame of a payload, and the path of each object there.

        Raises:
            MessageError: it has no objects where they should be, or no time.
        """
        is_left_out = any(_at(payload, path) == value for path, value in self._settings.leave_out.items())
        found = [] if is_left_out else list(_elements(payload, self._objects))
        frame: dict[str, Any] = {"objects": [self._object(value, key) for value, _, key in found]}
        frame["frame"] = self._settings.frame
        if self._settings.pose is not None:
            frame["pose"] = self._settings.pose
        if self._settings.time:
            frame |= self._time(_at(payload, self._settings.time))
        return frame, [path for _, path, _ in found]

    def renamed(self, error: schemas.MessageError, places: list[str]) -> schemas.MessageError:
        """Return an error of a frame with its path in the payload."""
        path = error.path
        if path in {"time", "stamp_ns"} and self._settings.time:
            path = self._settings.time
        elif match := _OBJECT.fullmatch(path):
            number, name, at = match.groups()
            given = self._paths.get("score" if name == "confidence" else name or "", "")
            if isinstance(given, tuple):
                given = given[int(at)] if at and int(at) < len(given) else given[0]
            is_path = given and not given.startswith((CONSTANT, KEY))
            path = (
                f"{places[int(number)]}{'.' if is_path and not given.startswith('[') else ''}{given if is_path else ''}"
            )
        return schemas.MessageError(error.code, path, error.expected, error.received)

    def _object(self, value: Any, key: str) -> dict[str, Any]:
        settings = self._settings
        made: dict[str, Any] = {}
        for name, path in self._paths.items():
            if isinstance(path, tuple):
                parts = [_at(value, one) for one in path]
                made[name] = None if all(part is None for part in parts) else parts
            elif path == KEY:
                made[name] = key
            else:
                made[name] = path[len(CONSTANT) :] if path.startswith(CONSTANT) else _at(value, path)
        if made.get("class") is None:
            made.pop("class", None)
        if settings.score_scale != 1.0 and _is_number(made.get("score")):
            made["score"] *= settings.score_scale
        if settings.angle_unit == "deg" and _is_number(made.get("yaw")):
            made["yaw"] = math.radians(made["yaw"])
        box, form = made.get("box"), settings.box_form
        if form != "xyxy" and isinstance(box, list) and len(box) == CORNERS and all(map(_is_number, box)):
            x, y, width, height = box
            if form == "cxcywh":
                x, y = x - 0.5 * width, y - 0.5 * height
            made["box"] = [x, y, x + width, y + height]
        return made

    def _time(self, value: Any) -> dict[str, Any]:
        settings = self._settings
        if value is None:
            raise schemas.MessageError("missing_field", settings.time, "a time", "nothing")
        if settings.time_unit == "iso":
            has_zone = isinstance(value, str) and re.search(r"(Z|[+-][0-9:]{4,5})$", value) is not None
            return {"time": value if has_zone or not isinstance(value, str) else value + settings.time_zone}
        if not _is_number(value) or not 0 <= value < 2.0**63:
            raise invalid(settings.time, f"a time in {settings.time_unit}", value)
        digits = UNITS[settings.time_unit]
        return {"stamp_ns": value * 10**digits if isinstance(value, int) else round(value * 10.0**digits)}


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < LARGEST


def _elements(value: Any, steps: list[str], path: str = "", key: str = "") -> Iterator[tuple[Any, str, str]]:
    """Yield the values at a path of objects, each with its own path and the key that `*` stood for.

    Raises:
        MessageError: the path leads nowhere.
    """
    if not steps:
        yield value, path, key
        return
    step, rest = steps[0], steps[1:]
    if step.startswith("["):
        if not isinstance(value, list):
            raise invalid(path, "a list", value)
        for number in range(len(value)) if step == EACH else [int(step[1:-1])]:
            if number >= len(value):
                raise schemas.MessageError("missing_field", f"{path}[{number}]", "a value", "nothing")
            yield from _elements(value[number], rest, f"{path}[{number}]", key)
        return
    if step == ANY and isinstance(value, list) and rest[:1] == [EACH]:  # a list of what a map has by keys
        yield from _elements(value, rest, path, key)
        return
    if not isinstance(value, dict):
        raise invalid(path, "a map", value)
    if step != ANY and step not in value:
        raise schemas.MessageError("missing_field", f"{path}.{step}".removeprefix("."), "a value", "nothing")
    for name in value if step == ANY else [step]:
        yield from _elements(value[name], rest, f"{path}.{name}".removeprefix("."), name if step == ANY else key)


def _at(value: Any, path: str) -> Any:
    """Return the value at a path; None where it leads nowhere."""
    for step in _STEP.findall(path):
        if step.startswith("["):
            number = int(step[1:-1])
            value = value[number] if isinstance(value, list) and number < len(value) else None
        else:
            value = value.get(step) if isinstance(value, dict) else None
    return value
