"""The body of a checkpoint, of each version that a service has written, as a checkpoint.

Whatever the body is, reading it ends with a checkpoint whose parts fit together, or with an error of the messages or of
the tracker, which the codec turns into its own.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import optipmb_schemas as schemas

import optipmb
from optipmb_service.session import convert
from optipmb_service.session.checkpoint import Checkpoint
from optipmb_service.session.document import Document
from optipmb_service.session.seen_numbers import EPOCHS, WINDOW, SeenNumbers
from optipmb_service.session.state import FilterState, FrameCounts, PoseHistory, Recorded, SensorState
from optipmb_service.session.timeline import Cursor, FrameId
from optipmb_service.session.values import MAX_CLOUD_WAIT_NS, MAX_COUNT, MAX_ERROR, MAX_LABELS, MAX_SENSORS, Deliveries

if TYPE_CHECKING:
    from collections.abc import Callable

MAX_SOFTWARE: Final = 100
MAX_STREAM: Final = 512
"""Characters of the name of a stream, at least."""
FUSED: Final = 3
"""The version since which a session may have several sensors."""
PACKED: Final = 4
"""The version since which a profile is bytes, which sessions with the same one need not make again."""
WORDS: Final = 5
"""The version since which a density is the bytes of its arrays; before it had a block for each column."""
MAX_LABEL: Final = 64
"""Characters of a class name, as messages take it."""


def _read_1(body: Document) -> Checkpoint:
    """Read version 1, whose densities do not say which way objects face and whether their tracks are confirmed.

    These begin as those of a new object. Its parameters say by class whether the sign of a heading can be trusted,
    which nothing asks any more.
    """
    classes = body.document("parameters").map("classes")
    for name, table in classes.items():
        if not isinstance(table, dict):
            raise body.wrong(f"parameters.classes.{name}", "a map", type(table).__name__)
        table.pop("heading_sign_reliable", None)
    return _read(body, 1)


def _read_2(body: Document) -> Checkpoint:
    """Read version 2, whose sessions have one sensor, without a name."""
    return _read(body, 2)


def _read_3(body: Document) -> Checkpoint:
    """Read version 3, whose profile is a map like others."""
    return _read(body, 3)


def _read_4(body: Document) -> Checkpoint:
    """Read version 4, whose densities have a block for each column."""
    return _read(body, 4)


def _read_5(body: Document) -> Checkpoint:
    return _read(body, 5)


def _read(body: Document, version_: int) -> Checkpoint:
    stream = body.stream("stream")
    profile = body.map("parameters") if version_ < PACKED else Document.of(body.binary("parameters")).fields
    parameters = optipmb.parse_parameters(profile)
    schemas.SessionParameters(profile=parameters.name)  # as messages take it
    fused = version_ >= FUSED and body.flag("fused")
    base = _read_state(body.document("base"), stream, parameters, version_)
    window = tuple(_read_recorded(one, None if fused else stream, parameters) for one in body.documents("window"))
    head = _read_state(body.document("head"), stream, parameters, version_) if window else base
    if version_ < FUSED:
        newest_ns = body.optional("newest_cloud_ns", body.whole)
        quarantine, newest_cloud_ns = {"": body.text("quarantine", MAX_ERROR)}, {"": newest_ns}
    else:
        errors, newest = body.rows("quarantine", 2), body.rows("newest_cloud_ns", 2)
        quarantine = {_read_sensor(row): row.text("1", MAX_ERROR) for row in errors}
        newest_cloud_ns = {_read_sensor(row): row.whole("1") for row in newest}
    checkpoint = Checkpoint(
        stream=stream,
        parameters=parameters,
        fused=fused,
        cloud_wait_ns=body.optional("cloud_wait_ns", lambda name: body.whole(name, high=MAX_CLOUD_WAIT_NS)),
        quarantine={name: error for name, error in quarantine.items() if error},
        seen=_read_epochs(body, version_),
        base=base,
        window=window,
        head=head,
        deliveries=Deliveries(**body.document("deliveries").counts(Deliveries.__slots__)),
        newest_cloud_ns={name: stamp for name, stamp in newest_cloud_ns.items() if stamp is not None},
        run=body.count("run"),
        software=body.text("software", MAX_SOFTWARE),
    )
    if len({one.frame_id for one in window}) != len(window):
        raise body.wrong("window", "every frame once", "one again")
    names = {*head.sensors, *base.sensors, *checkpoint.seen, *quarantine, *newest_cloud_ns}
    if any(bool(name) != fused for name in names) or (fused and base.last and base.last.sensor not in base.sensors):
        raise body.wrong("sensors", "the streams of its sensors, or none for its own", "others")
    return checkpoint


def _read_sensor(row: Document, name: str = "0") -> str:
    """Return the name of a sensor; empty for the only one of a stream's own session."""
    return row.stream(name) if row.text(name, MAX_STREAM) else ""


def _read_epochs(body: Document, version_: int) -> dict[str, tuple[SeenNumbers, ...]]:
    rows = body.rows("epochs", 3 if version_ < FUSED else 4)
    seen: dict[str, tuple[SeenNumbers, ...]] = {}
    for row in rows:
        name, first = ("", 0) if version_ < FUSED else (_read_sensor(row), 1)
        seen[name] = (*seen.get(name, ()), _read_seen(row, first))
    for epochs in seen.values():
        if len(epochs) > EPOCHS or len({one.epoch for one in epochs}) != len(epochs):
            raise body.wrong("epochs", f"at most {EPOCHS} epochs, each once", f"{len(epochs)}")
    return seen


def _read_seen(row: Document, first: int) -> SeenNumbers:
    epoch, number, bits = (str(first + at) for at in range(3))
    highest, mask = row.whole(number), int.from_bytes(row.binary(bits), "big")
    if not mask & 1 or mask.bit_length() > min(WINDOW, highest + 1):
        raise row.wrong(bits, f"which of the {WINDOW} numbers up to {highest} came, with itself", "another mask")
    return SeenNumbers(row.epoch(epoch), highest, mask)


def _read_recorded(one: Document, stream: str | None, parameters: optipmb.Parameters) -> Recorded:
    """Read a frame of the window, of one stream or, without its name, of the stream that it says."""
    points = one.optional("points", one.binary)
    message = schemas.decode(one.binary("detections"), schemas.Detections, limits=schemas.STORED)
    cloud = None if points is None else schemas.decode(points, schemas.Points, limits=schemas.STORED)
    frame_id = FrameId(message.epoch, message.seq, message.stamp_ns, message.stream if stream is None else "")
    stream = message.stream if stream is None else stream
    if message.stream != stream:
        raise one.wrong("detections", f"a frame of {stream}", f"one of {message.stream}")
    if cloud is not None:
        if (cloud.stream, cloud.stamp_ns) != (stream, message.stamp_ns):
            raise one.wrong("points", f"the cloud of {stream} at {message.stamp_ns}", f"that of {cloud.stamp_ns}")
        convert.cloud_of(cloud)
    convert.frame_of(parameters, message)  # the tracker takes it
    return Recorded(frame_id, schemas.encoded(message), cloud, one.flag("missed"), one.count("revision"), [])


def _read_state(one: Document, stream: str, parameters: optipmb.Parameters, version_: int) -> FilterState:
    stored, labels = one.map("density"), parameters.labels
    columns = optipmb.columns_in(stored, len(labels)) if version_ >= WORDS else schemas.read_columns(stored)
    stamp_ns, next_id = one.whole("stamp_ns", low=-1), one.whole("next_id", high=MAX_COUNT)
    density = optipmb.density_of(stamp_ns, next_id, columns, labels, earlier=version_ == 1)
    session = one.identity("session")
    convert.density_of(density, stream=stream, session=session, parameters=parameters)  # it can be asked for
    if version_ < FUSED:
        last = None if one.absent("last") else one.row("last", 3)
        sensors = {"": _read_sensor_state(one)}
    else:
        last, rows = None if one.absent("last") else one.row("last", 4), one.documents("sensors")
        sensors = {_read_sensor(row, "sensor"): _read_sensor_state(row) for row in rows}
        if len(rows) > MAX_SENSORS or len(rows) > len(sensors):
            raise one.wrong("sensors", f"at most {MAX_SENSORS}, each once", f"{len(rows)}")
    of = "" if last is None or version_ < FUSED else _read_sensor(last, "3")
    return FilterState(
        density=density,
        session=session,
        starts=one.count("starts"),
        generation=one.count("generation"),
        last=None if last is None else FrameId(last.epoch("0"), last.whole("1"), last.whole("2"), of),
        tracks=one.whole("tracks"),
        counts=FrameCounts(**one.document("counts").counts(FrameCounts.__match_args__)),
        sensors=sensors,
    )


def _read_sensor_state(one: Document) -> SensorState:
    cursor = one.row("course", 6)
    jumped = None if one.absent("jumped") else one.row("jumped", 2)  # an earlier version had none
    tracked = None if one.absent("tracked") else one.row("tracked", 2)
    where = one.document("whereabouts")
    return SensorState(
        cursor=Cursor(
            cursor.optional("0", cursor.epoch),
            cursor.whole("1"),
            cursor.count("2"),
            cursor.count("3"),
            cursor.whole("4"),
            cursor.optional("5", cursor.whole),
            0 if jumped is None else jumped.count("0"),
            0 if jumped is None else jumped.whole("1"),
        ),
        tracked=None if tracked is None else (tracked.epoch("0"), tracked.whole("1")),
        reported=frozenset(one.texts("reported", MAX_LABELS, MAX_LABEL)),
        pose_history=PoseHistory(
            stamp_ns=where.optional("stamp_ns", where.whole),
            position=where.position("position"),
            astray=where.count("astray"),
            astray_ns=where.whole("astray_ns"),
            astray_position=where.position("astray_position"),
        ),
    )


READERS: Final[dict[int, Callable[[Document], Checkpoint]]] = {
    1: _read_1,
    2: _read_2,
    3: _read_3,
    4: _read_4,
    5: _read_5,
}
"""What reads the body of each version."""
