"""The state of a session as bytes and back: whole or not at all.

The bytes are a head (magic, version, BLAKE2b digest of version and body) and a body, one msgpack map. Equal checkpoints
give equal bytes. Reading is total and bounded: it returns a checkpoint or raises `CheckpointError`, and the digest is
compared before anything else is looked at. A service reads the versions that earlier ones wrote, and refuses later ones
by number.

What depends on how messages were delivered (duplicates, the revisions of corrected tracks, crashes) is kept, but is no
state: `state_bytes` leaves it out, so that two sessions that took the same frames can be compared.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, Final

import msgpack
import optipmb_schemas as schemas

import optipmb
from optipmb_service.session import convert
from optipmb_service.session.document import Document
from optipmb_service.session.state import FilterState, FrameCounts, PoseHistory, SensorState
from optipmb_service.session.timeline import EPOCHS, WINDOW, Cursor, FrameId, SeenNumbers
from optipmb_service.session.values import MAX_CLOUD_WAIT_NS, MAX_COUNT, MAX_ERROR, MAX_LABELS, MAX_SENSORS, Deliveries

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

VERSION: Final = 3
MAGIC: Final = b"OPTIPMB\0"
DIGEST: Final = 16
HEAD: Final = len(MAGIC) + 2 + DIGEST
MAX_BYTES: Final = 2**28
MAX_SOFTWARE: Final = 100
MAX_PROFILES: Final = 64
"""Profiles whose form in checkpoints is remembered."""
MAX_STREAM: Final = 512
"""Characters of the name of a stream, at least."""
FUSED: Final = 3
"""The version since which a session may have several sensors."""
MAX_LABEL: Final = 64
"""Characters of a class name, as messages take it."""

_msgpack: Any = msgpack  # its type information is partial
_SOFTWARE: Final = version("optipmb")
_profiles: dict[int, tuple[optipmb.Parameters, dict[str, Any]]] = {}
"""The profiles that were written last, by their ids."""


class CheckpointError(ValueError):
    """The bytes are no checkpoint that this service can read; the text says why."""


@dataclass(frozen=True, slots=True)
class Recorded:
    """A frame of the window.

    Attributes:
        message: its detections.
        points: its cloud.
        missed: whether it waited for a cloud in vain.
        revision: of the tracks that were published last for it.
        packed: both as bytes, as soon as they were made.
    """

    message: schemas.Detections
    points: schemas.Points | None
    missed: bool
    revision: int
    packed: dict[str, bytes] = field(default_factory=dict, compare=False)


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """What a session is made of, between two frames. Nothing in it changes any more.

    Attributes:
        stream: `site/node/sensor`; that of the tracks, where several sensors feed the session.
        parameters: the profile.
        fused: whether several sensors feed it.
        cloud_wait_ns: the wait for clouds that was asked for, None where the service's own holds.
        quarantine: the error for which frames of a sensor are refused, by sensor.
        seen: which frames came, by sensor.
        base: the state before the window.
        window: the frames of the window.
        head: the present state.
        deliveries: what was not tracked, and what was corrected.
        newest_cloud_ns: stamp of the cloud that arrived last, by sensor.
        run: how often the session was taken up again.
        software: version of the service that wrote it.
    """

    stream: str
    parameters: optipmb.Parameters
    fused: bool
    cloud_wait_ns: int | None
    quarantine: Mapping[str, str]
    seen: Mapping[str, tuple[SeenNumbers, ...]]
    base: FilterState
    window: tuple[Recorded, ...]
    head: FilterState
    deliveries: Deliveries
    newest_cloud_ns: Mapping[str, int]
    run: int = 0
    software: str = _SOFTWARE

    @property
    def session(self) -> str:
        """The id of the present life of the density."""
        return self.head.session

    def frame_id(self, one: Recorded) -> FrameId:
        """Return which frame one of the window is."""
        message = one.message
        return FrameId(message.epoch, message.seq, message.stamp_ns, message.stream if self.fused else "")


def encode_checkpoint(checkpoint: Checkpoint) -> bytes:
    """Return the bytes of a checkpoint; equal ones give equal bytes."""
    return seal(_msgpack.packb(_body(checkpoint)))


def state_bytes(checkpoint: Checkpoint) -> bytes:
    """Return the bytes of what does not depend on how messages were delivered."""
    window = tuple(replace(one, revision=0) for one in checkpoint.window)
    bare = replace(checkpoint, window=window, deliveries=Deliveries(), newest_cloud_ns={}, run=0, software="")
    return encode_checkpoint(bare)


def decode_checkpoint(data: bytes) -> Checkpoint:
    """Return the checkpoint that bytes hold.

    Raises:
        CheckpointError: torn, changed, of a later version, or not valid.
    """
    version_, body = _open(data)
    try:
        return _READERS[version_](Document.of(body))
    except (schemas.MessageError, optipmb.OptipmbError) as error:
        raise CheckpointError(str(error)) from error


def seal(body: bytes) -> bytes:
    """Return a body with the head that names its version and guards it."""
    return b"".join((MAGIC, VERSION.to_bytes(2, "big"), _digest(VERSION, body), body))


def _open(data: bytes) -> tuple[int, bytes]:
    if len(data) < HEAD or data[: len(MAGIC)] != MAGIC:
        raise CheckpointError("no checkpoint: its first bytes are others")
    if len(data) > MAX_BYTES:
        raise CheckpointError(f"{len(data)} bytes: more than a checkpoint has")
    version_ = int.from_bytes(data[len(MAGIC) : len(MAGIC) + 2], "big")
    if version_ > VERSION:
        raise CheckpointError(f"version {version_}: from a newer service; this one reads versions up to {VERSION}")
    if version_ not in _READERS:
        raise CheckpointError(f"version {version_}: there is none such")
    body = data[HEAD:]
    if data[len(MAGIC) + 2 : HEAD] != _digest(version_, body):
        raise CheckpointError("torn or changed: the digest is that of other bytes")
    return version_, body


def _digest(version_: int, body: bytes) -> bytes:
    digest = hashlib.blake2b(version_.to_bytes(2, "big"), digest_size=DIGEST, person=b"optipmb-check")
    digest.update(body)
    return digest.digest()


# Writing


def _body(checkpoint: Checkpoint) -> dict[str, Any]:
    parameters = _dumped(checkpoint.parameters)
    # Most sessions of a store have one of a few profiles; the order of the classes is that of their indices.
    return {
        "software": checkpoint.software,
        "stream": checkpoint.stream,
        "parameters": parameters,
        "fused": checkpoint.fused,
        "cloud_wait_ns": checkpoint.cloud_wait_ns,
        "quarantine": [list(one) for one in sorted(checkpoint.quarantine.items())],
        "epochs": [
            [name, seen.epoch, seen.highest, _mask(seen.mask)]
            for name, epochs in sorted(checkpoint.seen.items())
            for seen in epochs
        ],
        "base": _state(checkpoint.base),
        "window": [
            {
                "detections": _packed(one, "detections", one.message),
                "points": None if one.points is None else _packed(one, "points", one.points),
                "missed": one.missed,
                "revision": one.revision,
            }
            for one in checkpoint.window
        ],
        # Without a window the present is its beginning.
        "head": _state(checkpoint.head) if checkpoint.window else None,
        "deliveries": _table(checkpoint.deliveries),
        "newest_cloud_ns": [list(one) for one in sorted(checkpoint.newest_cloud_ns.items())],
        "run": checkpoint.run,
    }


def _dumped(parameters: optipmb.Parameters) -> dict[str, Any]:
    """Return a profile as maps and numbers; sessions write the same one every second."""
    known = _profiles.get(id(parameters))
    if known is None or known[0] is not parameters:
        if len(_profiles) >= MAX_PROFILES:
            _profiles.clear()
        known = _profiles[id(parameters)] = parameters, parameters.model_dump(mode="json")
    return known[1]


def _table(values: FrameCounts | PoseHistory | Deliveries) -> dict[str, Any]:
    return {name: getattr(values, name) for name in values.__slots__}


def _packed(one: Recorded, name: str, message: schemas.Message) -> bytes:
    packed = one.packed.get(name)
    if packed is None:
        packed = one.packed[name] = schemas.encode(message)
    return packed


def _mask(mask: int) -> bytes:
    return mask.to_bytes((mask.bit_length() + 7) // 8, "big")


def _state(state: FilterState) -> dict[str, Any]:
    density, last = state.density, state.last
    return {
        "stamp_ns": density.stamp_ns,
        "next_id": density.next_id,
        "density": schemas.pack_columns(optipmb.columns_of(density)),
        "session": state.session,
        "starts": state.starts,
        "generation": state.generation,
        "last": None if last is None else [last.epoch, last.seq, last.stamp_ns, last.sensor],
        "tracks": state.tracks,
        "counts": _table(state.counts),
        "sensors": [{"sensor": name, **_sensor(one)} for name, one in sorted(state.sensors.items())],
    }


def _sensor(one: SensorState) -> dict[str, Any]:
    cursor = one.cursor
    return {
        "course": [cursor.epoch, cursor.seq, cursor.era, cursor.generation, cursor.newest_ns, cursor.floor_ns],
        "jumped": [cursor.jumped, cursor.jumped_ns],
        "tracked": None if one.tracked is None else list(one.tracked),
        "reported": sorted(one.reported),
        "whereabouts": _table(one.pose_history),
    }


# Reading


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
    return _read(body, 3)


def _read(body: Document, version_: int) -> Checkpoint:
    stream = body.stream("stream")
    parameters = optipmb.parse_parameters(body.map("parameters"))
    schemas.SessionParameters(profile=parameters.name)  # as messages take it
    fused = version_ >= FUSED and body.flag("fused")
    base = _read_state(body.document("base"), stream, parameters, version_)
    window = tuple(_read_recorded(one, None if fused else stream) for one in body.documents("window"))
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
    if len({checkpoint.frame_id(one) for one in window}) != len(window):
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


def _read_recorded(one: Document, stream: str | None) -> Recorded:
    """Read a frame of the window, of one stream or, without its name, of the stream that it says."""
    points = one.optional("points", one.binary)
    message = schemas.decode(one.binary("detections"), schemas.Detections, limits=schemas.STORED)
    cloud = None if points is None else schemas.decode(points, schemas.Points, limits=schemas.STORED)
    stream = message.stream if stream is None else stream
    if message.stream != stream:
        raise one.wrong("detections", f"a frame of {stream}", f"one of {message.stream}")
    if cloud is not None:
        if (cloud.stream, cloud.stamp_ns) != (stream, message.stamp_ns):
            raise one.wrong("points", f"the cloud of {stream} at {message.stamp_ns}", f"that of {cloud.stamp_ns}")
        convert.cloud_of(cloud)
    return Recorded(message, cloud, one.flag("missed"), one.count("revision"))


def _read_state(one: Document, stream: str, parameters: optipmb.Parameters, version_: int) -> FilterState:
    columns = schemas.read_columns(one.map("density"))
    stamp_ns, next_id = one.whole("stamp_ns", low=-1), one.whole("next_id", high=MAX_COUNT)
    density = optipmb.density_of(stamp_ns, next_id, columns, parameters.labels, earlier=version_ == 1)
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
        counts=FrameCounts(**one.document("counts").counts(FrameCounts.__slots__)),
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


_READERS: Final[dict[int, Callable[[Document], Checkpoint]]] = {1: _read_1, 2: _read_2, 3: _read_3}


def digest_of(checkpoint: Checkpoint) -> str:
    """Return 32 hexadecimal digits over all that later tracks depend on, which counts of messages are no part of."""
    return hashlib.blake2b(state_bytes(checkpoint), digest_size=DIGEST).hexdigest()


def forgotten(checkpoint: Checkpoint) -> Checkpoint:
    """Return a checkpoint of a session that was reset, without its counts: what remains of a stream that was closed."""
    state = replace(checkpoint.head, counts=FrameCounts())
    seen = checkpoint.seen
    if checkpoint.fused:  # the next frames may have any clock
        state, seen = replace(state, last=None, sensors={}), {}
    return replace(checkpoint, seen=seen, base=state, head=state, window=(), deliveries=Deliveries())
