"""Messages of a stream: detections and points towards the service, tracks and, when asked for, densities back.

World frame: fixed, right-handed, z up; metres, seconds, radians. Yaw is counter-clockwise from x. The centre of a box
is its geometric centre; its size is length, width, height. Stamps are nanoseconds of the sensor's time. The fields are
described here and nowhere else: the JSON Schemas and the tables of the documentation are made from these descriptions.
"""

import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain
from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, Field

from optipmb_schemas.arrays import Array, Integers, Numeric, Reals, Singles, first_descent, unit_quaternion
from optipmb_schemas.errors import MessageError, invalid, shape_text
from optipmb_schemas.model import (
    Count,
    Epoch,
    Flag,
    Horizons,
    Labels,
    Message,
    Name,
    NonNegative,
    SessionId,
    Stamp,
    Stream,
    Word,
)

Real = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Counts = Annotated[tuple[Count, ...], Field(max_length=256)]
FAR = 1e8
"""Largest coordinate in metres: beyond every map projection, small enough that no square overflows."""
INT64 = 2**63 - 1
FULL = 2.0 * math.pi
TURN = FULL + 1e-6
QUARTER = 0.25 * FULL + 1e-6
"""Limits of angles; float32 rounds them up."""
UPRIGHT = 1e-3
"""Largest tilt of a relocation, rad."""
NARROWEST = 1e-3
"""Least width of a field of view, rad."""
LEAST_VARIANCE = 1e-8
"""Least variance of a position along any axis, m^2."""
ROUNDING = 8 * sys.float_info.epsilon
"""Share of the sum of variances by which one of them may be beyond its limit: errors of computation are smaller."""
EMBEDDING: Final = (2, 512)
"""Least and most numbers of a vector of appearance."""
BRIEF: Final = 32
"""Longest name or text of an attribute, bytes."""
MOST_ATTRIBUTES: Final = 8
"""Attributes of an object."""
SHORTEST = 1e-6
"""Least length of one."""
SYMMETRY = 1e-6
"""Share of the largest variance by which opposite entries of a covariance may differ, as in float32."""


class Pose(Message):
    """Pose of the sensor: takes points of the sensor frame to the world frame (rotate first, then translate)."""

    translation: Annotated[Reals, Array("f8", (3,), -FAR, FAR)] = Field(
        description="Position of the sensor in the world frame: x, y, z in metres."
    )
    quaternion: Annotated[Reals, Array("f8", (4,), -1.001, 1.001), AfterValidator(unit_quaternion)] = Field(
        description="Rotation from the sensor frame to the world frame: w, x, y, z; its norm within 0.001 of one."
    )


class FieldOfView(Message):
    """Where the sensor detects objects, in its own axes (x forward, y left, z up); each field is an interval."""

    azimuth: Annotated[Reals, Array("f8", (2,), -TURN, TURN)] = Field(
        description="The sector counter-clockwise from the first angle to the second, radians from x; [-pi, pi]: the "
        "full circle."
    )
    elevation: Annotated[Reals, Array("f8", (2,), -QUARTER, QUARTER)] = Field(
        description="Radians above the xy plane; [-pi/2, pi/2]: no limit."
    )
    range: Annotated[Reals, Array("f8", (2,), 0, 1e9)] = Field(description="Distance from the sensor in metres.")

    def check(self) -> None:
        """No interval is empty, and none is wider than a turn."""
        begin, end = self.azimuth.tolist()
        if not NARROWEST <= (end - begin if end >= begin else end - begin + FULL) <= FULL + NARROWEST:
            raise invalid("azimuth", f"a sector of {NARROWEST:g} rad to a full turn", self.azimuth.tolist())
        for name, least in (("elevation", NARROWEST), ("range", 0.0)):
            begin, end = getattr(self, name).tolist()
            if not (end - begin >= least and end > begin):
                raise invalid(name, "an end above the beginning", [begin, end])


class Relocation(Message):
    """Motion of the world frame: from the world before, what was at p is at R p + `translation`, R a turn about z."""

    world: Annotated[int, Field(strict=True, ge=1, le=2**31 - 1)] = Field(
        description="Number of the world frame of this message: 1 after the first motion, then 2, 3, without gaps."
    )
    translation: Annotated[Reals, Array("f8", (3,), -FAR, FAR)] = Field(description="Translation x, y, z in metres.")
    quaternion: Annotated[Reals, Array("f8", (4,), -1.001, 1.001), AfterValidator(unit_quaternion)] = Field(
        description="The turn R: w, x, y, z; its norm within 0.001 of one, tilted by at most 0.001 rad."
    )

    def check(self) -> None:
        """The world stays upright."""
        _, x, y, _ = self.quaternion.tolist()
        if (tilt := 2.0 * math.hypot(x, y)) > UPRIGHT:
            raise invalid("quaternion", f"a turn about z, tilted by at most {UPRIGHT:g} rad", tilt)


class Header(Message):
    """What every message of a stream starts with."""

    stream: Stream = Field(description="Name of the stream: `site/node/sensor`, each of letters, digits and `_ . -`.")
    epoch: Epoch = Field(
        description="16 bytes (JSON: 32 hexadecimal digits), random, new at every start of the publisher."
    )
    seq: Count = Field(
        description="Counts the messages of this type and stream within the epoch: 0, 1, 2, without gaps."
    )
    stamp_ns: Stamp = Field(description="Sensor time in nanoseconds, not negative, of any origin.")


class SensorMessage(Header):
    """Header of what a publisher sends: also says in which frame its coordinates are."""

    frame: Literal["world", "sensor"] = Field(description="Frame of all coordinates here.")
    pose: Pose | None = Field(
        default=None,
        description="World from sensor at `stamp_ns`. Required when `frame` is `sensor`.",
    )
    relocation: Relocation | None = Field(
        default=None,
        description="The last motion of the world frame, in every message after it. Absent: the world is that of the "
        "message before; of `Points`: that of their detections.",
    )

    def check(self) -> None:
        """A sensor frame needs its pose."""
        if self.frame == "sensor" and self.pose is None:
            raise MessageError("missing_field", "pose", "a pose, because frame is sensor", "nothing")


RADIANS: Final = ", radians (in JSON, `heading` takes degrees clockwise from north)"
"""Added to the range of headings."""


Brief = Annotated[str, Field(strict=True, min_length=1, max_length=32)]


class Attribute(Message):
    """A text that says something of an object, as its plate or its colour."""

    row: Count = Field(description="Row of the object in the arrays; of `Events`: of the event.")
    name: Brief = Field(description="What the text says, as `plate`: at most 32 bytes.")
    text: Brief = Field(description="The text, at most 32 bytes.")
    score: Annotated[float, Field(strict=True, gt=0, le=1)] = Field(
        default=1.0, description="Confidence of a detection in it; of a track its share of the evidence for `name`."
    )

    def check(self) -> None:
        """Names and texts are short, also where their characters take several bytes."""
        for name in ("name", "text"):
            if len(getattr(self, name).encode()) > BRIEF or "\0" in getattr(self, name):
                raise invalid(name, f"a text of at most {BRIEF} bytes", getattr(self, name))


def attributes_of_rows(attributes: tuple[Attribute, ...] | None, rows: Iterable[int]) -> tuple[Attribute, ...] | None:
    """Return the attributes of the chosen rows, with the places of these; None where there are none."""
    place = {row: at for at, row in enumerate(rows)}
    chosen = (one for one in attributes or () if one.row in place)
    return tuple(one.model_copy(update={"row": place[one.row]}) for one in chosen) or None


def attributes_by_name(found: Mapping[str, tuple[Sequence[str], Reals]], rows: int) -> tuple[Attribute, ...]:
    """Return the attributes of rows, given by name their texts, "" where unknown, and their scores."""
    return tuple(
        Attribute.trusted({"row": row, "name": name, "text": texts[row], "score": float(score[row])})
        for row in range(rows)
        for name, (texts, score) in found.items()
        if texts[row]
    )


class Detections(SensorMessage):
    """The detected objects of one frame, M of them (M may be 0). One row of every array is one object."""

    __slots__ = ("encoded",)  # what `encode` gives for it, if it came as these bytes; a changed copy has none

    labels: Labels = Field(description="Names of the classes, as `car`; all different.")
    label: Annotated[Integers, Array("i8", ("M",), 0, 255)] = Field(
        description="Class of each object as an index into `labels`, from 0."
    )
    center: Annotated[Reals, Array("f8", ("M", 3), -FAR, FAR, unknown="last")] = Field(
        description="Geometric centres of the boxes: x, y, z in metres, in `frame`. A z of NaN (JSON: null) is unknown."
    )
    size: Annotated[Reals, Array("f8", ("M", 3), 0, 1e4, above=True, unknown="number")] | None = Field(
        default=None,
        description="Length (along the heading), width, height in metres. A number of NaN (JSON: null) is unknown. "
        "Absent: all are.",
    )
    yaw: Annotated[Reals, Array("f8", ("M",), -6.4, 6.4, unknown="number", hint=RADIANS)] | None = Field(
        default=None,
        description="Heading in radians, counter-clockwise about z from the x axis of `frame`. NaN (JSON: null): "
        "unknown for this object. Absent: for all.",
    )
    score: Annotated[Reals, Array("f8", ("M",), 0, 1)] = Field(
        description="Confidence of the detector; not a logit. An object of score 0 is left out and counted in "
        "`Tracks.ignored`."
    )
    velocity: Annotated[Reals, Array("f8", ("M", 2), -1e3, 1e3, unknown="row")] | None = Field(
        default=None,
        description="Velocity over ground in m/s along the x and y axes of `frame`. A row of two NaN (JSON: null): "
        "unknown for this object. Absent: for all.",
    )
    has_points: Flag | None = Field(
        default=None,
        description="Whether a `Points` message of the same stamp was or will be published. Absent: the service judges "
        "from what the stream has sent so far.",
    )
    field_of_view: FieldOfView | None = Field(
        default=None,
        description="Where the sensor detects objects, in the axes of `pose` (without a pose those of the world). "
        "Absent: everywhere.",
    )

    position_covariance: Annotated[Reals, Array("f8", ("M", 3, 3), -1e8, 1e8, unknown="row")] | None = Field(
        default=None,
        description="Covariance of the errors of each centre's x, y and z in m^2, along the axes of `frame`: "
        "symmetric, the variance along every axis from 1e-8 to 1e8. A matrix of NaN (JSON: null) is an object for "
        "which the profile's noise holds. Absent: it holds for all.",
    )
    embedding: Annotated[Singles, Array("f4", ("M", "E"), -1e9, 1e9, unknown="row")] | None = Field(
        default=None,
        description="Appearance of each object as a vector of E numbers, from 2 to 512, of any length from 1e-6 on. A "
        "row of NaN (JSON: null) is unknown. Absent: all are.",
    )
    embedding_model: Annotated[str, Field(strict=True, min_length=1, max_length=64)] | None = Field(
        default=None,
        description="Model and version that `embedding` is of, as `reid-7`; required with it. Only vectors of one "
        "model are compared.",
    )
    attributes: tuple[Attribute, ...] | None = Field(
        default=None,
        max_length=100_000,
        description="Texts that are known of the objects: at most 8 of each, with different names.",
    )

    def check(self) -> None:
        """Every label must be in the list, every covariance and every vector must be one."""
        super().check()
        _check_attributes(self.attributes or (), len(self.label))
        _check_labels(self.label, self.labels)
        if self.position_covariance is not None:
            _check_covariances(self.position_covariance)
        if self.embedding is not None:
            self.__dict__["embedding"] = _check_embeddings(self.embedding, self.embedding_model)


class Points(SensorMessage):
    """One point cloud of the sensor. Its `seq` counts clouds, apart from the detections."""

    xyz: Annotated[Singles, Array("f4", ("P", 3), -FAR, FAR, wider=True)] = Field(
        description="Points x, y, z in metres, in `frame`, without those that have no return. Further columns (up to "
        "64) are dropped."
    )


class Delivery(Message):
    """How one publication of the tracks came about. The only part that differs when the same tracks are sent again."""

    instance: Name = Field(description="Instance that published.")
    received_ns: Stamp = Field(description="Arrival of the detections by the service's clock, ns since 1970 UTC.")
    published_ns: Stamp = Field(description="Hand-over of the tracks to Zenoh, same clock.")
    queue_ms: NonNegative = Field(description="Milliseconds spent waiting for the tracking thread and the cloud.")
    decode_ms: NonNegative = Field(description="Milliseconds spent decoding.")
    step_ms: NonNegative = Field(description="Milliseconds spent in the tracker.")
    run: Count = Field(
        default=0,
        description="Grows whenever a process begins to track the stream or goes on with it. Tracks of a later run "
        "replace those of an earlier one for the same `epoch` and `seq`, whatever their revisions.",
    )
    final_session: SessionId | None = Field(
        default=None,
        description="In `Events`: messages of this session with a `stamp_ns` below `final_ns`, and of all sessions "
        "before it, do not change any more.",
    )
    final_ns: Stamp | None = Field(default=None, description="In `Events`: see `final_session`.")


class ResultMessage(Header):
    """Header of the service's results for a frame; `epoch`, `seq` and `stamp_ns` repeat the detections."""

    sensor: Stream | None = Field(
        default=None,
        description="Stream of the detections, and of `epoch` and `seq`. Absent: it is `stream`.",
    )
    session: SessionId = Field(
        description="32 hexadecimal digits. When it changes, earlier tracks have ended, except those whose ids return."
    )
    revision: Count = Field(
        default=0,
        description="Higher than 0: replaces, after a late frame, what was published for the same `session`, `epoch` "
        "and `seq`.",
    )


class Tracks(ResultMessage):
    """The tracks of one frame, N of them, ordered by id. `epoch`, `seq` and `stamp_ns` repeat the detections."""

    profile: Name = Field(description="Name of the parameters in force.")
    cloud_used: Flag = Field(description="Whether the frame was tracked with a cloud.")
    gap: Count = Field(default=0, description="Frames known to be missing directly before this one.")
    ignored: Count = Field(default=0, description="Detections left out: class not in the profile, or score 0.")
    world: Count | None = Field(
        default=None, description="Number of the world frame, which grows with each `relocation`. Absent: 0."
    )
    labels: Labels = Field(description="Names of the classes that `label` counts.")
    predicted_to_ns: Stamp | None = Field(
        default=None,
        description="Time of the states in output at a fixed rate, by the clock of `stamp_ns`; `detection` is -1 where "
        "it is later. Absent: `stamp_ns`.",
    )
    id: Annotated[Integers, Array("i8", ("N",), 0, INT64)] = Field(
        description="Identity: unique in the stream, never used again. Ascending."
    )
    label: Annotated[Integers, Array("i8", ("N",), 0, 255)] = Field(description="Class, an index into `labels`.")
    center: Annotated[Reals, Array("f8", ("N", 3), -FAR * 10, FAR * 10)] = Field(
        description="Geometric centres of the boxes: x, y, z in metres, world frame."
    )
    size: Annotated[Reals, Array("f8", ("N", 3), 0, 1e5, above=True)] = Field(
        description="Length, width, height in metres."
    )
    yaw: Annotated[Reals, Array("f8", ("N",), -1e5, 1e5)] = Field(
        description="Heading in radians, counter-clockwise about z from x of the world frame."
    )
    heading_confidence: Annotated[Reals, Array("f8", ("N",), 0, 1)] | None = Field(
        default=None,
        description="Probability that the object faces along `yaw` and not the other way; 1 where the profile does not "
        "follow it.",
    )
    velocity: Annotated[Reals, Array("f8", ("N", 2), -1e5, 1e5)] = Field(
        description="Velocity in m/s along x and y of the world frame."
    )
    yaw_rate: Annotated[Reals, Array("f8", ("N",), -1e5, 1e5)] = Field(description="Turn rate in rad/s.")
    acceleration: Annotated[Reals, Array("f8", ("N",), -1e5, 1e5)] = Field(
        description="Acceleration along the heading in m/s^2."
    )
    existence: Annotated[Reals, Array("f8", ("N",), 0, 1)] = Field(description="Probability that the object exists.")
    score: Annotated[Reals, Array("f8", ("N",), 0, 1)] = Field(description="Confidence of the track.")
    covariance: Annotated[Reals, Array("f8", ("N", 6, 6), -1e30, 1e30)] = Field(
        description="Covariance of [x, y, speed, heading, turn rate, acceleration], in the units above."
    )
    age: Annotated[Reals, Array("f8", ("N",), 0, 1e12)] = Field(description="Seconds since its first detection.")
    time_since_detection: Annotated[Reals, Array("f8", ("N",), 0, 1e12)] = Field(
        description="Seconds since its last detection."
    )
    detection: Annotated[Integers, Array("i8", ("N",), -1, INT64)] = Field(
        description="Row of its detection in the `Detections` of this frame; -1: none."
    )
    confirmed: Annotated[Integers, Array("i8", ("N",), 0, 1)] | None = Field(
        default=None,
        description="1: the existence reached a threshold of the profile and has not fallen below a lower one since; "
        "0: the track may be of nothing.",
    )
    measured: Annotated[Integers, Array("i8", ("N",), 0, 7)] | None = Field(
        default=None,
        description="What is known of the object, from detections or, the heading, from its motion: 1 the heading, 2 "
        "the size, 4 the height, added up. The rest of `yaw`, `size` and z stand in for it: size by the profile. "
        "Absent: everything of all.",
    )
    class_probability: Annotated[Singles, Array("f4", ("N", "C"), 0, 1)] | None = Field(
        default=None,
        description="Probability of each class of `labels`; `label` changes with it. Absent: the profile has no groups "
        "of classes, and a track keeps its class.",
    )
    object: Annotated[Integers, Array("i8", ("N",), -1, INT64)] | None = Field(
        default=None,
        description="Id of the first track of the object, which may have had others before. Equal to `id`: a new "
        "object. -1: not decided; who counts objects leaves it out. Absent, as is the next: tracks are not joined.",
    )
    object_probability: Annotated[Singles, Array("f4", ("N",), 0, 1)] | None = Field(
        default=None, description="That all joins of the object are right: their product. 1 without a join."
    )
    attributes: tuple[Attribute, ...] | None = Field(
        default=None,
        max_length=100_000,
        description="Of each attribute of an object the text with most evidence, over all its detections and gaps. "
        "Absent: no detection has brought any.",
    )
    horizons: Horizons | None = Field(
        default=None,
        description="Times of the predicted paths after `stamp_ns`, s, ascending. Absent, as are the next three: the "
        "session has none.",
    )
    path_position: Annotated[Reals, Array("f8", ("N", "H", 2), -FAR * 1e4, FAR * 1e4)] | None = Field(
        default=None, description="Predicted x and y of the centres: metres, world frame."
    )
    path_yaw: Annotated[Singles, Array("f4", ("N", "H"), -1e5, 1e5)] | None = Field(
        default=None, description="Predicted headings, as `yaw`."
    )
    path_covariance: Annotated[Singles, Array("f4", ("N", "H", 2, 2), -1e30, 1e30)] | None = Field(
        default=None, description="Covariance of the predicted x and y, m^2."
    )
    relocation: Relocation | None = Field(
        default=None, description="Motion of the world frame between the frame before and this one."
    )
    delivery: Delivery | None = Field(default=None, description="How this publication came about.")

    def check(self) -> None:
        """Labels must be in the list, ids ascending, the fields of paths there together, C classes in `labels`."""
        super().check()
        _check_labels(self.label, self.labels)
        _check_attributes(self.attributes or (), len(self.id))
        probability, classes = self.class_probability, len(self.labels)
        if probability is not None and probability.shape[1] != classes:
            if len(probability):
                expected = f"{classes} columns, as many as `labels`"
                raise MessageError(
                    "invalid_value", "class_probability", expected, f"shape {shape_text(probability.shape)}"
                )
            # Lists of no rows cannot say how long they are.
            self.__dict__["class_probability"] = probability.reshape((0, classes))
        if at := first_descent(self.id):
            raise invalid(f"id[{at}]", f"an id above {self.id[at - 1]}, in ascending order", self.id[at])
        absent = [name for name in PATHS if getattr(self, name) is None]
        if absent and len(absent) < len(PATHS):
            raise MessageError("missing_field", absent[0], f"a value beside {', '.join(PATHS)}", "nothing")


PATHS: Final = ("horizons", "path_position", "path_yaw", "path_covariance")
"""Fields of `Tracks` with predicted paths."""


def path_fields(horizons: Reals, mean: Reals, covariance: Reals) -> dict[str, Numeric]:
    """Return the fields of `Tracks` with predicted paths.

    Args:
        horizons: (H,) times ahead, s.
        mean: (N, H, 6) states [x, y, speed, heading, turn rate, acceleration] at them.
        covariance: (N, H, 6, 6) of those.

    Raises:
        MessageError: they hold numbers that no message may.
    """
    values = (horizons, mean[:, :, :2], mean[:, :, 3], covariance[:, :, :2, :2])
    return _validated(dict(zip(PATHS, values, strict=True)))


def track_fields(**columns: Numeric | None) -> dict[str, Numeric]:
    """Return the further columns of `Tracks` that are not None, as fields.

    Raises:
        MessageError: they hold numbers that no message may.
    """
    return _validated({name: one for name, one in columns.items() if one is not None})


def _validated(values: Mapping[str, Numeric]) -> dict[str, Numeric]:
    fields = {}
    for name, value in values.items():
        try:
            fields[name] = Tracks.arrays[name].validate(value)
        except MessageError as error:
            raise error.under(name) from None
    return fields


class ZoneEvent(Message):
    """What a track did in a zone or at a line."""

    zone: Word = Field(description="Name of the zone or line in the settings.")
    kind: Literal["entered", "left", "stayed", "crossed"] = Field(description="What happened.")
    n: Count = Field(description="Counts the events of this zone and kind from 1, through restarts and takeovers.")
    id: Count = Field(description="The track.")
    label: Count = Field(description="Its class when it entered, for `crossed` now; an index into `labels`.")
    at_ns: Stamp = Field(
        description="When: interpolated at a border or line; for `lost` and `ended` the last time inside."
    )
    position: Annotated[tuple[Real, ...], Field(min_length=3, max_length=3)] = Field(
        description="Where: x, y, z in metres, world frame."
    )
    speed: Real = Field(description="Speed in m/s.")
    yaw: Real = Field(description="Heading in radians, as in `Tracks`.")
    how: Literal["crossed", "appeared", "lost", "ended"] | None = Field(
        default=None,
        description="Of `entered`: `crossed` the border or `appeared` inside. Of `left`: `crossed` the border, `lost`: "
        "no longer detected, or `ended` with the session.",
    )
    dwell_s: NonNegative | None = Field(default=None, description="Of `left` and `stayed`: seconds inside.")
    direction: Literal["left", "right"] | None = Field(
        default=None, description="Of `crossed`: to which side of the line, seen from its first point to its last."
    )
    object: Count | None = Field(
        default=None, description="Id of the first track of its object; absent where tracks are not joined over gaps."
    )


class ZoneCount(Message):
    """Counts of a zone or line, each a list with a number for every class of `labels`."""

    zone: Word = Field(description="Name of the zone or line in the settings.")
    inside: Counts = Field(description="Inside now: `entered` less `left`.")
    entered: Counts = Field(description="Have entered.")
    left: Counts = Field(description="Have left.")
    appeared: Counts = Field(description="Of those that entered, appeared inside.")
    lost: Counts = Field(description="Of those that left, were no longer detected.")
    to_left: Counts = Field(description="Crossings of the line to its left.")
    to_right: Counts = Field(description="Crossings of the line to its right.")
    distinct: Counts | None = Field(
        default=None, description="Objects that have entered; one that left, also one joined over a gap, counts once."
    )


class Events(ResultMessage):
    """Events of the zones and lines of a stream at one frame, and their counts."""

    labels: Labels = Field(description="Names of the classes that `label` counts.")
    events: tuple[ZoneEvent, ...] = Field(
        default=(), max_length=100_000, fail_fast=True, description="In order of `at_ns`, `zone` and `id`."
    )
    attributes: tuple[Attribute, ...] | None = Field(
        default=None, max_length=100_000, description="Attributes of the objects of the events, as in `Tracks`."
    )
    zones: tuple[ZoneCount, ...] | None = Field(
        default=None,
        max_length=256,
        description="Counts after this frame: at the first of each session and second of stamps, with every revision, "
        "and in replies to `q/zones`.",
    )
    delivery: Delivery | None = Field(default=None, description="How this publication came about.")

    def check(self) -> None:
        """Labels must be in the list, and every count have one number for each."""
        super().check()
        classes = len(self.labels)
        for at, event in enumerate(self.events):
            if event.label >= classes:
                raise invalid(f"events[{at}].label", f"an index into the {classes} labels", event.label)
        _check_attributes(self.attributes or (), len(self.events))
        for at, zone in enumerate(self.zones or ()):
            for name, value in zone.present():
                if name != "zone" and len(value) != classes:
                    raise invalid(f"zones[{at}].{name}", f"{classes} numbers, as many as `labels`", len(value))


class LinkedObject(Message):
    """An object of a session, and the id that it shares with objects of other sessions."""

    global_id: Epoch = Field(
        description="16 bytes (JSON: 32 hexadecimal digits): all objects with this id are one, in all streams."
    )
    stream: Stream = Field(description="Stream of the tracks.")
    session: SessionId = Field(description="Session of the tracks.")
    object: Count = Field(description="`object` of its tracks where that is known, else their `id`.")
    probability: Annotated[float, Field(strict=True, ge=0, le=1)] = Field(description="That its link is right.")
    kind: Literal["overlap", "passage", "appearance", "none"] = Field(
        description="How it is linked: in views that overlap, over a time between two views, or by that and vectors of "
        "appearance. `none`: its link was withdrawn, and no other object has this id."
    )
    ended: Flag = Field(description="Whether it is not tracked any more; its link stays.")


class Links(Message):
    """Which objects of several streams are one, put by `optipmb-service link`. Of an object the newest row holds."""

    area: Name = Field(description="Name of the area in the settings.")
    revision: Count = Field(description="Grows with every message of the area, through restarts.")
    stamp_ns: Stamp = Field(description="Time up to which the tracks are linked, by their stamps.")
    whole: Flag = Field(description="Whether these are all linked objects; else those that changed.")
    objects: tuple[LinkedObject, ...] = Field(
        default=(), max_length=100_000, fail_fast=True, description="Objects that are linked, or were."
    )


class Density(Message):
    """Reply of `q/density`: where the tracker expects objects that are not detected yet, one row per component.

    These are the Poisson components after the newest frame, N of them, with the values that the tracker holds.
    """

    stream: Stream = Field(description="Name of the stream.")
    session: SessionId = Field(description="32 hexadecimal digits, as in the tracks; all 0: without a session.")
    stamp_ns: Stamp | None = Field(default=None, description="Stamp of the newest frame. Absent: no frame yet.")
    labels: Labels = Field(description="Names of the classes that `label` counts.")
    label: Annotated[Integers, Array("i8", ("N",), 0, 255)] = Field(description="Class, an index into `labels`.")
    weight: Annotated[Reals, Array("f8", ("N",), 0, 1e30)] = Field(description="Expected number of objects.")
    mean: Annotated[Reals, Array("f8", ("N", 6), -1e30, 1e30)] = Field(
        description="Mean of [x, y, speed, heading, turn rate, acceleration]: world frame, metres, seconds, radians."
    )
    covariance: Annotated[Reals, Array("f8", ("N", 6, 6), -1e30, 1e30)] = Field(description="Covariance of the same.")
    z: Annotated[Reals, Array("f8", ("N",), -1e30, 1e30)] = Field(
        description="Height of the centre in metres, world frame."
    )
    track: Annotated[Integers, Array("i8", ("T",), 0, INT64)] | None = Field(
        default=None,
        description="Ids of the T tracks on which joining has decided. Absent, as are the next two: tracks are not "
        "joined.",
    )
    candidate: Annotated[Integers, Array("i8", ("T",), -1, INT64)] | None = Field(
        default=None, description="Earlier object that fitted each of them best; -1: none did."
    )
    candidate_probability: Annotated[Singles, Array("f4", ("T",), 0, 1, unknown="number")] | None = Field(
        default=None,
        description="That the track continues an earlier object; NaN (JSON: null): none fitted. Below "
        "`min_probability` of the settings it was not joined.",
    )

    def check(self) -> None:
        """Labels must be in the list."""
        super().check()
        _check_labels(self.label, self.labels)


def _check_labels(label: Integers, labels: tuple[str, ...]) -> None:
    values = label.tolist()
    if values and (most := max(values)) >= len(labels):
        raise invalid(f"label[{values.index(most)}]", f"an index into the {len(labels)} labels", most)


def _check_attributes(attributes: tuple[Attribute, ...], rows: int) -> None:
    known: dict[int, set[str]] = {}
    for at, one in enumerate(attributes):
        names = known.setdefault(one.row, set())
        if one.row >= rows:
            raise invalid(f"attributes[{at}].row", f"one of the {rows} rows", one.row)
        if one.name in names:
            raise invalid(f"attributes[{at}].name", "different names for each row", one.name)
        names.add(one.name)
        if len(names) > MOST_ATTRIBUTES:
            raise invalid(f"attributes[{at}]", f"at most {MOST_ATTRIBUTES} of each row", len(names))


def _check_covariances(covariance: Reals) -> None:
    for at, good in enumerate(_are_covariances(covariance).tolist()):
        if not good and not all(map(math.isnan, chain.from_iterable(rows := covariance[at].tolist()))):
            expected = "a symmetric covariance with variances from 1e-8 to 1e8 along every axis, or NaN alone"
            raise invalid(f"position_covariance[{at}]", expected, rows)


def _check_embeddings(embedding: Singles, model: str | None) -> Singles:
    """Return the vectors; an empty list does not tell their length, so it is taken for the least one."""
    least, most = EMBEDDING
    if model is None:
        raise invalid("embedding_model", "the model and version of `embedding`", None)
    if not len(embedding):
        return embedding.reshape((0, least))
    if not least <= embedding.shape[1] <= most:
        expected = f"{least} to {most} numbers for each object"
        raise MessageError("invalid_value", "embedding", expected, f"shape {shape_text(embedding.shape)}")
    for at, square in enumerate((embedding * embedding).sum(axis=1).tolist()):
        if square < SHORTEST**2:
            raise invalid(f"embedding[{at}]", f"a vector of length {SHORTEST:g} or more", math.sqrt(square))
    return embedding


def _are_covariances(matrices: Reals) -> Any:
    """Return which matrices (M, 3, 3) are symmetric with their eigenvalues within the limits; NaN is in none."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = matrices.transpose(1, 2, 0)
    good = True
    for one, other in ((xy, yx), (xz, zx), (yz, zy)):
        gap = abs(one - other) / SYMMETRY
        good = good & ((gap <= xx) | (gap <= yy) | (gap <= zz))
    mixed = (0.5 * (xy + yx), 0.5 * (xz + zx), 0.5 * (yz + zy))
    rounding = ROUNDING * (xx + yy + zz)
    least, most = LEAST_VARIANCE - rounding, FAR + rounding
    good = good & _semidefinite(xx - least, yy - least, zz - least, *mixed)
    return good & _semidefinite(most - xx, most - yy, most - zz, *(-one for one in mixed))


def _semidefinite(xx: Any, yy: Any, zz: Any, xy: Any, xz: Any, yz: Any) -> Any:
    """Return whether no eigenvalue of a symmetric matrix is negative.

    Cholesky's steps without the divisions: its rounding errors are in proportion to the largest eigenvalue. Errors of
    a determinant as one sum are in proportion to its cube, and exceed the smallest eigenvalues of a long ellipsoid.
    """
    second, third, mixed = xx * yy - xy * xy, xx * zz - xz * xz, xx * yz - xy * xz
    return (xx > 0.0) & (second >= 0.0) & (third >= 0.0) & (second * third >= mixed * mixed)
