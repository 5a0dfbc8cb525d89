"""Frames of detections in JSON: one object per detection, or the columns of `Detections`.

A document becomes a valid `Detections`, or an error with the path in the sender's document. Numbers and
stamps that it does not give are left to the edge.
"""

from __future__ import annotations

import re
import time
from codecs import BOM_UTF8
from datetime import datetime
from fnmatch import fnmatchcase
from functools import cache
from math import atan2, hypot, nan, pi, sqrt
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

import msgspec
import numpy as np
import optipmb_schemas as schemas
from optipmb_client.errors import ClientError
from optipmb_schemas import codec
from optipmb_schemas.errors import invalid, show
from optipmb_schemas.json_form import EdgeDetections, EdgeObject

from optipmb_service.edges.mapping import PayloadMapping, mapping_of, other_value
from optipmb_service.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from optipmb import Georeference, GroundCamera
    from optipmb_service.settings import Settings

MOST_FRAMES: Final = 256
"""Frames of an array."""

MOST_SEPARATE: Final = 256
"""Objects of a frame that says nothing of others: each costs a step of the tracker."""

DIGITS: Final = 20
UNKNOWN: Final = (nan, nan, nan)
PLACES: Final = ("position", "lat and lon", "box", "foot")
MODEL: Final = ("frame", "pose", "field_of_view", "relocation", "embedding_model")
"""Fields of a frame with the names and values of `Detections`."""

HEADER: Final = ("stream", "time", "stamp_ns", "seq", "key")
"""Fields of a frame that a document with columns has in the same form."""

SEPARATE: Final = ("epoch", "field_of_view")
"""Fields of a frame that cannot hold for each of its objects alone."""

COLUMNS: Final = ("label", "center", "size", "yaw", "score", "velocity", "position_covariance", "embedding")
STEP_NS: Final = 1000
"""Least distance of two stamps that are not the sender's own."""

BESIDE: Final = (2.0, 0.02, 3.0)
"""How far a separate object is looked at: to each side in m, and at least in rad; in range in m."""

NOWHERE: Final = schemas.FieldOfView(
    azimuth=np.array([-pi, pi]), elevation=np.array([-0.5 * pi, 0.5 * pi]), range=np.array([9e8, 1e9])
)
"""The field of view of a frame without objects that says nothing."""

_TIME: Final = re.compile(
    r"([0-9]{4}-[0-9]{2}-[0-9]{2}[T ][0-9]{2}:[0-9]{2}:[0-9]{2})(?:[.,]([0-9]+))?(Z|[+-][0-9:]{4,5})"
)
_ELEMENT: Final = re.compile(r"(\w+)\[(\d+)\](.*)")
_NAMES: Final = {"center": "position", "label": "class"}
"""Fields of objects by the columns of `Detections`."""

_KINDS: Final = {"float": "a number", "int": "an integer", "str": "a text", "array": "a list", "object": "a map"}
"""Types of JSON by their names in errors of msgspec."""

_MEANT: Final = {
    **dict.fromkeys(("label", "name", "type", "category", "category_id", "class_name", "cls"), "class"),
    **dict.fromkeys(("bbox", "bbox_2d", "box2d", "xyxy"), "box"),
    **dict.fromkeys(("x", "center", "centre", "location", "translation"), "position"),
    **dict.fromkeys(("latitude", "longitude"), "lat with lon"),
    **dict.fromkeys(("timestamp", "t", "ts", "stamp", "datetime"), "time or stamp_ns"),
    **dict.fromkeys(("detections", "predictions", "boxes", "tracks"), "objects"),
}
"""Names that other senders give fields, and ours: for errors alone."""

_frames: Final = msgspec.json.Decoder(list[msgspec.Raw])
_frame: Final = msgspec.json.Decoder(EdgeDetections)


class JsonFrame(NamedTuple):
    """A frame of a sender.

    Attributes:
        message: its detections; numbers and stamp are placeholders where the sender gives none.
        is_numbered: whether the sender gives `epoch` and `seq`.
        is_stamped: whether it gives a stamp.
        key: by which it knows the frame again; empty: it gives none.
        arrived_ns: when it was read, ns since 1970.
    """

    message: schemas.Detections
    is_numbered: bool
    is_stamped: bool
    key: str
    arrived_ns: int


def separate(frame: JsonFrame) -> Iterator[JsonFrame]:
    """Yield a frame for each object of one that says nothing of other objects; one that looks nowhere without any.

    The field of view of each holds the object alone, 2 m to both sides and at least 3 m and three standard deviations
    in range. Stamps are 1 us apart.
    """
    message = frame.message
    places = np.nan_to_num(message.center)
    if message.frame == "world" and message.pose is not None:
        from optipmb import Pose  # noqa: PLC0415 - the tracker, which a router does not load

        pose = Pose(message.pose.translation, message.pose.quaternion)
        places = (places - pose.translation) @ pose.rotation
    if not len(places):
        yield frame._replace(message=message.model_copy(update={"field_of_view": NOWHERE}))
    spread = message.position_covariance
    variances = np.full(len(places), nan) if spread is None else spread[:, 0, 0] + spread[:, 1, 1]
    attributes: dict[int, list[schemas.Attribute]] = {}
    for one in message.attributes or ():
        attributes.setdefault(one.row, []).append(one.model_copy(update={"row": 0}))
    for at, (place, variance) in enumerate(zip(places.tolist(), variances.tolist(), strict=True)):
        values: dict[str, Any] = {
            name: column[at : at + 1] for name in COLUMNS if (column := getattr(message, name)) is not None
        }
        values |= {"field_of_view": _beside(place, variance), "stamp_ns": message.stamp_ns + at * STEP_NS}
        values["attributes"] = tuple(attributes.get(at, ())) or None
        yield frame._replace(message=message.model_copy(update=values))


def _beside(place: list[float], variance: float) -> schemas.FieldOfView:
    """Return a field of view that holds a place, from the sensor, whose variance in m^2 may be unknown."""
    (x, y, _), (aside, angle, deep) = place, BESIDE
    middle, width = atan2(y, x), min(pi, max(angle, aside / max(hypot(x, y), angle)))
    distance, deep = hypot(*place), max(deep, 3.0 * sqrt(variance))
    return NOWHERE.model_copy(
        update={
            "azimuth": np.array([middle - width, middle + width]),
            "range": np.array([max(0.0, distance - deep), distance + deep]),
        }
    )


class FrameReader:
    """Reads the frames of JSON senders by the settings.

    Args:
        settings: limits, places of sites, and inputs.

    Raises:
        ClientError: a calibration cannot be used.
    """

    def __init__(self, settings: Settings) -> None:
        self._limits = settings.limits.limits()
        self._sites = settings.sites
        self.rules = settings.input_of
        self._place = cache(self._place_of)
        self._mappings = {pattern: mapping_of(one) for pattern, one in settings.inputs.items()}
        self._cameras = {
            one.camera: _calibration(f"inputs.{pattern}.camera", one.camera)
            for pattern, one in settings.inputs.items()
            if one.camera is not None
        }

    def split(self, payload: bytes, stream: str) -> tuple[list[bytes], bool]:
        """Return the frames of a document, and whether it is an array of them, as a maker's payload never is.

        Raises:
            MessageError: it is none, or has too many.
        """
        payload = payload.removeprefix(BOM_UTF8)
        if payload.lstrip(b" \t\r\n")[:1] != b"[" or self._mapping(stream) is not None:
            return [payload], False
        try:
            frames = [bytes(one) for one in _frames.decode(payload)]
        except (ValueError, msgspec.DecodeError, RecursionError) as error:
            raise _malformed(error, payload) from None
        if not 1 <= len(frames) <= MOST_FRAMES:
            expected = f"an array of 1 to {MOST_FRAMES} frames"
            raise schemas.MessageError("too_large" if frames else "invalid_value", "", expected, str(len(frames)))
        return frames, True

    def read(self, payload: bytes, stream: str = "") -> JsonFrame:
        """Return the frame of a document.

        Args:
            payload: the document.
            stream: what the address says; empty: nothing, and the document is ours.

        Raises:
            MessageError: it is not valid, with the path in the document.
        """
        most = self._limits.max_json_bytes
        if len(payload) > most:
            raise schemas.MessageError("too_large", "", f"at most {most} bytes of JSON", f"{len(payload)} bytes")
        payload = payload.removeprefix(BOM_UTF8)
        only = self.rules(stream).only
        if (other := other_value(payload, only)) is not None:
            path, received = other
            raise invalid(path, f"{show(only[path])}, by `only` in `inputs`", received)
        mapping = self._mapping(stream)
        try:
            if mapping is not None:
                return self._mapped(msgspec.json.decode(payload), stream, mapping)
            return self._made(_frame.decode(payload), stream)
        except msgspec.ValidationError as error:
            fields = codec.read_json_map(payload, self._limits, "a frame")
            if fields.keys() & {"center", "label"}:
                return self._columns(fields, stream)
            raise _invalid(error, fields) from None
        except schemas.MessageError as error:
            at = _ELEMENT.fullmatch(error.path) if mapping is None and error.received == "none" else None
            if at and at[1] == "objects":  # it says no place
                received = _calls(msgspec.json.decode(payload)["objects"][int(at[2])], error.received)
                raise schemas.MessageError(error.code, error.path, error.expected, received) from None
            raise
        except (ValueError, msgspec.DecodeError, RecursionError) as error:
            raise _malformed(error, payload) from None

    def _mapping(self, stream: str) -> PayloadMapping | None:
        return next((one for pattern, one in self._mappings.items() if fnmatchcase(stream, pattern)), None)

    def _mapped(self, payload: Any, stream: str, mapping: PayloadMapping) -> JsonFrame:
        frame, places = mapping.frame(payload)
        try:
            return self._made(msgspec.convert(frame, EdgeDetections), stream, mapping.box_unit)
        except msgspec.ValidationError as error:
            raise mapping.renamed(_invalid(error, frame), places) from None
        except schemas.MessageError as error:
            raise mapping.renamed(error, places) from None

    def _made(self, frame: EdgeDetections, stream: str, box_unit: str = "px") -> JsonFrame:
        values = ((name, getattr(frame, name)) for name in EdgeDetections.__struct_fields__)
        given = {name: value for name, value in values if value is not None}
        header = _header(given, stream)
        fields: dict[str, Any] = {name: given[name] for name in MODEL if name in given}
        rows: Sequence[int] = range(len(frame.objects))
        fields |= self._objects(frame.objects, header["stream"], frame.frame)
        if frame.objects and (frame.objects[0].box is not None or frame.objects[0].foot is not None):
            rows = self._on_ground(frame.objects, header["stream"], fields, box_unit)
        elif not frame.objects:
            self._see(fields, self._camera(header["stream"]))
        try:
            message = schemas.Detections(**header, **fields)
        except schemas.MessageError as error:
            raise _of_object(error, frame.objects, fields, rows) from None
        return self._framed(message, given)

    def _columns(self, fields: dict[str, Any], stream: str) -> JsonFrame:
        """Return the frame of a document with columns."""
        if "objects" in fields:
            raise schemas.MessageError("invalid_value", "objects", "objects or columns", "both")
        try:
            msgspec.convert({name: fields.get(name) for name in HEADER} | {"objects": []}, EdgeDetections)
        except msgspec.ValidationError as error:
            raise _invalid(error, fields) from None
        given = {name: value for name, value in fields.items() if value is not None}
        return self._framed(codec.build(fields | _header(given, stream), schemas.Detections, self._limits), given)

    def _framed(self, message: schemas.Detections, given: Mapping[str, Any]) -> JsonFrame:
        rules = self.rules(message.stream)
        if not rules.is_complete and (name := next((one for one in SEPARATE if one in given), "")):
            expected = "none, for each object becomes a frame by `complete` in `inputs`"
            raise schemas.MessageError("invalid_value", name, expected, "one")
        if not rules.is_complete and len(message.label) > MOST_SEPARATE:
            expected = f"at most {MOST_SEPARATE} objects, each of which becomes a frame by `complete` in `inputs`"
            raise schemas.MessageError("too_large", "objects", expected, str(len(message.label)))
        if classes := rules.classes:
            names = [classes.get(name, name) for name in message.labels]
            labels = tuple(dict.fromkeys(names))
            numbers = np.array([labels.index(name) for name in names], np.int64)
            message = message.model_copy(update={"labels": labels, "label": numbers[message.label]})
        is_stamped = "time" in given or "stamp_ns" in given
        return JsonFrame(message, "epoch" in given, is_stamped, given.get("key", ""), time.time_ns())

    def _objects(self, objects: Sequence[EdgeObject], stream: str, frame: str) -> dict[str, Any]:
        """Return the columns of objects."""
        most = self._limits.max_detections
        if len(objects) > most:
            raise schemas.MessageError("too_large", "objects", f"at most {most} objects", f"{len(objects)} objects")
        names = [one.name for one in objects]
        labels = {name: number for number, name in enumerate(dict.fromkeys(names))}
        if len(labels) > self._limits.max_labels:
            expected = f"at most {self._limits.max_labels} classes"
            raise schemas.MessageError("too_large", "objects", expected, f"{len(labels)} classes")
        places = [_check(one, f"objects[{at}]") for at, one in enumerate(objects)]
        for at, place in enumerate(places):
            if place != places[0] and {place, places[0]} & set(PLACES[2:]):
                raise schemas.MessageError("invalid_value", f"objects[{at}]", f"{places[0]}, as before it", place)
        columns: dict[str, Any] = {
            "labels": tuple(labels),
            "label": np.array([labels[name] for name in names], np.int64),
            "score": np.array([_score(one) for one in objects], np.float64),
            "center": np.array([_position(one) for one in objects], np.float64).reshape(-1, 3),
            "yaw": _column([one.yaw for one in objects], nan),
            "size": _column([one.size and [nan if n is None else n for n in one.size] for one in objects], UNKNOWN),
            "velocity": _column([one.velocity for one in objects], UNKNOWN[:2]),
            "position_covariance": _column([one.position_covariance for one in objects], (UNKNOWN,) * 3),
            "embedding": _embeddings(objects),
            "attributes": _attributes(objects),
        }
        placed = [at for at, one in enumerate(objects) if one.lat is not None or one.heading is not None]
        if placed:
            self._move(objects, placed, columns, stream, frame)
        return {name: column for name, column in columns.items() if column is not None}

    def _camera(self, stream: str) -> GroundCamera | None:
        path = self.rules(stream).camera
        return None if path is None else self._cameras[path]

    def _on_ground(
        self, objects: Sequence[EdgeObject], stream: str, fields: dict[str, Any], box_unit: str
    ) -> Sequence[int]:
        """Replace pixels by places on the ground; return which objects have one."""
        from optipmb import FrameError  # noqa: PLC0415 - as above

        name = "foot" if objects[0].box is None else "box"
        if (camera := self._camera(stream)) is None:
            expected = "`camera` in `inputs` of the stream, for pixels"
            raise schemas.MessageError("invalid_value", f"objects[0].{name}", expected, "no calibration")
        if "position_covariance" in fields:
            at = next(at for at, one in enumerate(objects) if one.position_covariance is not None)
            path = f"objects[{at}].position_covariance"
            raise schemas.MessageError("invalid_value", path, "none beside pixels", "one")
        fields["frame"] = "world" if camera.mount == "fixed" else "sensor"
        pixels = np.array([getattr(one, name) for one in objects], np.float64)
        if box_unit == "image":
            pixels *= np.resize(np.array(camera.image, np.float64), pixels.shape[1])
        _check_pixels(pixels, camera.image, name)
        renamed = self.rules(stream).classes
        labels = [renamed.get(one.name, one.name) for one in objects]
        pose: Any = fields.get("pose")  # that there is one is all that it looks at
        given: dict[str, Any] = {name: pixels}
        try:
            found = camera.detections(label=labels, score=fields["score"], pose=pose, **given)
        except FrameError as error:
            match = re.fullmatch(r"\w+\[(\d+)\]", error.path)
            path = f"objects[{match[1]}].{name}" if match else "pose" if error.path == "pose" else "objects"
            is_missing = path == "pose" and pose is None
            code: Literal["missing_field", "invalid_value"] = "missing_field" if is_missing else "invalid_value"
            raise schemas.MessageError(code, path, error.expected, error.received) from None
        rows = found["row"]
        for column in ("label", "score", "yaw", "size", "velocity", "embedding"):
            if column in fields:
                fields[column] = fields[column][rows]
        if "attributes" in fields:
            fields["attributes"] = _attributes([objects[row] for row in rows.tolist()])
        fields |= {column: found[column] for column in ("center", "position_covariance")}
        self._see(fields, camera)
        return list(rows.tolist())

    @staticmethod
    def _see(fields: dict[str, Any], camera: GroundCamera | None) -> None:
        """Fill in the field of view of a fixed camera, if the frame says none."""
        if camera is None or camera.mount != "fixed" or fields.keys() & {"pose", "field_of_view"}:
            return
        view = camera.field_of_view
        if view is not None and view.pose is not None:
            fields["pose"] = {"translation": view.pose.translation, "quaternion": view.pose.quaternion}
            sides = ("azimuth", "elevation", "range")
            fields["field_of_view"] = {side: np.array(getattr(view, side), np.float64) for side in sides}

    def _move(
        self, objects: Sequence[EdgeObject], placed: list[int], columns: dict[str, Any], stream: str, frame: str
    ) -> None:
        """Fill in the centres and headings of objects that have latitudes or true headings."""
        first = f"objects[{placed[0]}].{'lat' if objects[placed[0]].lat is not None else 'heading'}"
        site = stream.partition("/")[0]
        if frame != "world":
            raise schemas.MessageError("invalid_value", first, "frame world, for which it is known", frame)
        if (place := self._place(site)) is None:
            raise schemas.MessageError("invalid_value", first, f"`sites` with {site}", "a site without a place")
        for at in placed:
            one = objects[at]
            if one.lat is not None:
                columns["center"][at] = place.to_world(one.lat, one.lon or 0.0, one.alt)
                if one.alt is None:
                    columns["center"][at][2] = nan
            if one.heading is not None:
                if columns["yaw"] is None:
                    columns["yaw"] = np.full(len(objects), nan)
                axis = place.to_geographic(np.nan_to_num(columns["center"][at])).heading[0]
                columns["yaw"][at] = np.radians((axis - one.heading + 180.0) % 360.0 - 180.0)

    def _place_of(self, site: str) -> Georeference | None:
        from optipmb import Georeference  # noqa: PLC0415 - the tracker, which a router does not load

        one = self._sites.get(site)
        return None if one is None else Georeference(one.origin, one.x_heading)


def _calibration(setting: str, path: Path) -> GroundCamera:
    from optipmb import GroundCamera, ParameterError  # noqa: PLC0415 - the tracker, which a router does not load

    try:
        return GroundCamera.read(path)
    except ParameterError as error:
        raise ClientError(f"setting {setting}: {error}") from error


def _header(given: Mapping[str, Any], stream: str) -> dict[str, Any]:
    """Return the header of a frame, with placeholders for fields that it lacks."""
    named = given.get("stream", stream)
    if stream and named != stream:
        raise invalid("stream", stream, named)
    if not named:
        raise schemas.MessageError("missing_field", "stream", "a stream, as site/node/sensor", "nothing")
    if ("epoch" in given) != ("seq" in given):
        absent = "seq" if "epoch" in given else "epoch"
        raise schemas.MessageError("missing_field", absent, "both of epoch and seq, or neither", "one of them")
    if "time" in given and "stamp_ns" in given:
        raise schemas.MessageError("invalid_value", "stamp_ns", "time or stamp_ns", "both")
    stamp_ns = _time(given["time"]) if "time" in given else _integer("stamp_ns", given.get("stamp_ns", 0))
    seq = _integer("seq", given.get("seq", 0))
    return {"stream": named, "epoch": given.get("epoch", bytes(16)), "seq": seq, "stamp_ns": stamp_ns}


def _integer(name: str, value: int | str) -> int:
    if isinstance(value, int):
        return value
    if value.isascii() and value.isdigit() and len(value) < DIGITS:
        return int(value)
    raise invalid(name, "an integer, or its digits as text", value)


def _time(text: str) -> int:
    """Return the nanoseconds since 1970 of an ISO 8601 text.

    Raises:
        MessageError: it is none, or says no zone.
    """
    expected = "ISO 8601 from 1970 to 2261 with Z or an offset, as 2026-11-27T08:00:00.100Z"
    if (match := _TIME.fullmatch(text)) is None:
        raise invalid("time", expected, text)
    day, fraction, zone = match.groups()
    try:
        seconds = int(datetime.fromisoformat(f"{day}{'+00:00' if zone == 'Z' else zone}").timestamp())
    except ValueError:
        seconds = -1
    if not 0 <= seconds < 2**63 // SECOND:
        raise invalid("time", expected, text)
    return seconds * SECOND + int((fraction or "0")[:9].ljust(9, "0"))


def _check(one: EdgeObject, path: str) -> str:
    """Return how an object says its place; refuse one whose place, score or heading is missing or said twice."""
    places = (one.position, one.lat if one.lat is not None else one.lon, one.box, one.foot)
    said = [name for name, place in zip(PLACES, places, strict=True) if place is not None]
    if len(said) != 1:
        raise schemas.MessageError("invalid_value", path, f"one of {', '.join(PLACES)}", " and ".join(said) or "none")
    if (one.lat is None) != (one.lon is None):
        raise schemas.MessageError(
            "missing_field", f"{path}.{'lat' if one.lat is None else 'lon'}", "a number", "nothing"
        )
    for name, other in (("score", "confidence"), ("yaw", "heading")):
        if getattr(one, name) is not None and getattr(one, other) is not None:
            raise schemas.MessageError("invalid_value", f"{path}.{other}", f"{name} or {other}", "both")
    return said[0]


def _check_pixels(pixels: Any, image: tuple[int, int], name: str) -> None:
    """Refuse boxes and feet of another image: those with their middle outside of it, and shares of the image.

    Raises:
        MessageError: there are such.
    """
    expected = f"pixels in the image of {image[0]} x {image[1]}, as `image` of the calibration says"
    ends = pixels.reshape(len(pixels), -1, 2)
    middle = ends.mean(axis=1)
    outside = ((middle < 0.0) | (middle > image)).any(axis=1)
    if ((pixels >= 0.0) & (pixels <= 1.0)).all():
        expected += ', or `box_unit = "image"` in the mapping for shares of it'
        outside[:] = True
    if outside.any():
        row = int(np.argmax(outside))
        x, y = ends[row].max(axis=0)
        raise schemas.MessageError("invalid_value", f"objects[{row}].{name}", expected, f"up to {x:.6g} x {y:.6g}")


def _score(one: EdgeObject) -> float:
    score = one.confidence if one.score is None else one.score
    return 1.0 if score is None else score


def _position(one: EdgeObject) -> list[float]:
    if one.position is None:
        return list(UNKNOWN)
    return [*(nan if number is None else number for number in one.position), nan][:3]


def _column(values: list[Any], unknown: Any) -> Any:
    """Return an array of the values, None as unknown; None when all are."""
    if all(value is None for value in values):
        return None
    return np.array([unknown if value is None else value for value in values], np.float64)


def _attributes(objects: Sequence[EdgeObject]) -> list[dict[str, Any]] | None:
    """Return the attributes of the objects as fields of messages; None when there are none."""
    found = []
    for row, one in enumerate(objects):
        for name, value in (one.attributes or {}).items():
            text, score = (value, 1.0) if isinstance(value, str) else value
            found.append({"row": row, "name": name, "text": text, "score": score})
    return found or None


def _embeddings(objects: Sequence[EdgeObject]) -> Any:
    """Return the vectors of the objects, which are of one length; None when there is none."""
    lengths = {at: len(one.embedding) for at, one in enumerate(objects) if one.embedding is not None}
    length = next(iter(lengths.values()), 0)
    for at, other in lengths.items():
        if other != length:
            raise invalid(f"objects[{at}].embedding", f"a list of {length}, as before it", objects[at].embedding)
    return _column([one.embedding for one in objects], (nan,) * length)


def _of_object(
    error: schemas.MessageError, objects: Sequence[EdgeObject], fields: Mapping[str, Any], rows: Sequence[int]
) -> schemas.MessageError:
    """Return an error of the columns with its path in the sender's document."""
    match = _ELEMENT.fullmatch(error.path)
    if match is None or match[1] not in fields or match[1] in MODEL:
        return error
    name, number, rest = match[1], int(match[2]), match[3]
    if name == "labels":
        name, label = "class", fields["labels"][number]
        number = next(at for at, each in enumerate(objects) if each.name == label)
    elif name == "attributes":
        number, rest = rows[fields[name][number]["row"]], ""
    else:
        number = rows[number]
    one = objects[number]
    name = _NAMES.get(name, name)
    if name == "position" and one.position is None:
        name, rest = "lat" if one.lat is not None else "foot" if one.box is None else "box", ""
    elif name == "score" and one.score is None:
        name = "confidence"
    received = "null" if error.received == "nan" else error.received
    return schemas.MessageError(error.code, f"objects[{number}].{name}{rest}", error.expected, received)


def _calls(fields: Any, received: str) -> str:
    """Return the text of the received value, with our name for a field that other senders call otherwise."""
    known = next((name for name in fields if name in _MEANT), None) if isinstance(fields, dict) else None
    return received if known is None else f"{received}; {known} is {_MEANT[known]} here"


def _malformed(error: Exception, payload: bytes) -> schemas.MessageError:
    text = "deeper nesting" if isinstance(error, RecursionError) else str(error).removeprefix("JSON is malformed: ")
    if "truncated" in text:
        text = f"one cut short after {len(payload)} bytes"
    return schemas.MessageError("malformed", "", "a JSON document in UTF-8", show(text)[1:-1])


def _invalid(error: msgspec.ValidationError, document: Any) -> schemas.MessageError:
    """Return an error of the types of fields as ours."""
    text, _, place = str(error).partition(" - at `$")
    path = place.rstrip("`").partition("[...]")[0].removeprefix(".")  # `[...]` is a value of a map of any names
    for part in re.findall(r"\w+", path):
        document = document[int(part) if part.isdigit() else part]
    if match := re.fullmatch(r"Object missing required field `(.*)`", text):
        meant = {name: None for name in document if _MEANT.get(name) == match[1]} or document
        received = _calls(meant, "nothing")
        return schemas.MessageError("missing_field", f"{path}.{match[1]}".removeprefix("."), "a value", received)
    if match := re.fullmatch(r"Object contains unknown field `(.*)`", text, re.DOTALL):
        expected = f"one of {', '.join(EdgeDetections.__struct_fields__)}"
        received = _calls({match[1]: None}, "another field")
        return schemas.MessageError("invalid_value", show(match[1])[1:-1], expected, received)
    expected = re.sub(r", got .*| \| null|`", "", text.removeprefix("Expected ")).replace(" | ", " or ")
    expected = re.sub(r"\w+", lambda word: _KINDS.get(word[0], word[0]), expected)
    if text.startswith("Invalid enum value"):
        expected = "world or sensor"
    elif text == "Number out of range":
        expected = "a number of 64 bits"
    return invalid(path, expected, document)
