"""Checkpoint of a session: its state between two frames as a value that never changes, as bytes, and back.

The bytes are a head and a body, one msgpack map. The head is the same in all formats: magic, number of the format, next
ids, the first 16 bytes of the SHA-256 digest of these and all that follows, and the numbers that are never used again,
a msgpack map with its length before it. So a release names a format that it cannot read, and goes on with the numbers.
Fields that are not described here are ignored. Equal checkpoints give equal bytes. Reading is total and bounded: it
returns a checkpoint whose parts fit together or raises `CheckpointError`.

What depends on how messages were delivered (duplicates, the revisions of corrected tracks, crashes) is kept, but is no
state: `state_bytes` leaves it out, so that two sessions that took the same frames can be compared.
"""

from __future__ import annotations

import hashlib
import struct
from dataclasses import dataclass, replace
from importlib.metadata import version
from typing import TYPE_CHECKING, Annotated, Any, Final, NamedTuple

import msgpack
import optipmb_schemas as schemas
from optipmb_schemas.codec import read_map
from optipmb_schemas.model import first_error
from pydantic import BaseModel, Field, ValidationError

import optipmb
from optipmb.world.zones import MOST, Event, Seen, ZoneState
from optipmb_service.session import convert
from optipmb_service.session.counts import MAX_COUNT, Count, Deliveries, FrameCounts, present
from optipmb_service.session.identity import Binary, Epoch, Incarnation, SensorName, Whole
from optipmb_service.session.policy import MAX_CLOUD_WAIT_NS, MAX_SENSORS
from optipmb_service.session.state import UNPLACED, FilterState, ProcessedFrame, SensorState
from optipmb_service.session.timeline import EPOCHS, WINDOW, FrameId, SeenNumbers
from optipmb_service.session.worlds import Worlds  # noqa: TC001 - pydantic reads the annotation

if TYPE_CHECKING:
    from collections.abc import Mapping

MAX_ERROR: Final = 400
"""Characters kept of an error."""

VERSION: Final = 5
MAGIC: Final = b"OPTIPMB\0"
DIGEST: Final = 16
_START: Final = MAGIC + VERSION.to_bytes(2, "big")
_IDS: Final = struct.Struct(">QQ")
"""Incarnations of the stream and next track id."""
_LENGTH: Final = struct.Struct(">I")
HEAD: Final = len(_START) + _IDS.size + DIGEST
"""Bytes up to the numbers."""
MAX_BYTES: Final = 2**28
MAX_PROFILES: Final = 64
"""Profiles whose form in checkpoints is remembered."""

ZONE_BYTES: Final = MOST // 8
_msgpack: Any = msgpack  # its type information is partial
_profiles: dict[int, tuple[optipmb.Parameters, bytes]] = {}
"""The profiles that were written last, by their ids."""


_SOFTWARE: Final = version("optipmb")


class CheckpointError(ValueError):
    """The bytes are no checkpoint that this service can read; the text says why.

    `incarnation` has the numbers that the session used, where the checkpoint is whole, and of another format or without
    a state; else None.
    """

    def __init__(self, text: str, incarnation: Incarnation | None = None) -> None:
        super().__init__(text)
        self.incarnation = incarnation


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """State of a session between two frames. Nothing in it changes any more.

    Attributes:
        stream: `site/node/sensor`, or the name of a fused session.
        parameters: the profile.
        fused: whether several sensors feed it.
        cloud_wait_ns: the wait for clouds that was asked for, None where the service's own holds.
        quarantine: the error for which frames of a sensor are refused, by sensor.
        seen: which frames came, by sensor.
        base: the state before the window.
        window: the frames of the window.
        head: the present state.
        deliveries: counts of frames that were not tracked, and of corrections.
        newest_cloud_ns: stamp of the cloud that arrived last, by sensor.
        run: see `Session.run`: the sum of the fences under which the session began and was restored.
        software: version of the service that wrote it.
    """

    stream: str
    parameters: optipmb.Parameters
    fused: bool
    cloud_wait_ns: int | None
    quarantine: Mapping[str, str]
    seen: Mapping[str, tuple[SeenNumbers, ...]]
    base: FilterState
    window: tuple[ProcessedFrame, ...]
    head: FilterState
    deliveries: Deliveries
    newest_cloud_ns: Mapping[str, int]
    run: int = 0
    software: str = _SOFTWARE

    @property
    def session(self) -> str:
        """Id of the present incarnation of the density."""
        return self.head.session

    @property
    def incarnation(self) -> Incarnation:
        """Numbers that a later session continues."""
        return self.head.incarnation(self.run)

    @property
    def young_ns(self) -> int | None:
        """First stamp of a fused session so near its beginning that there may be sensors it does not know yet."""
        stamps = [frame.frame_id.stamp_ns for frame in self.window if self.fused and self.base.last is None]
        return min(stamps, default=None)


def forgotten(checkpoint: Checkpoint) -> Checkpoint:
    """Return the checkpoint of a closed stream: its session after a reset, without its counts."""
    state = replace(checkpoint.head, counts=FrameCounts())
    seen = checkpoint.seen
    if checkpoint.fused:  # the next frames may have any clock
        state, seen = replace(state, last=None, sensors={}), {}
    return replace(checkpoint, seen=seen, base=state, head=state, window=(), deliveries=Deliveries())


def encode_checkpoint(checkpoint: Checkpoint) -> bytes:
    """Return the bytes of a checkpoint; equal ones give equal bytes."""
    return seal(_msgpack.packb(_body(checkpoint), default=_packed), checkpoint.incarnation)


def state_bytes(checkpoint: Checkpoint) -> bytes:
    """Return the bytes of what does not depend on how messages were delivered."""
    window = tuple(replace(one, revision=0) for one in checkpoint.window)
    bare = replace(checkpoint, window=window, deliveries=Deliveries(), newest_cloud_ns={}, run=0, software="")
    return encode_checkpoint(bare)


def digest_of(checkpoint: Checkpoint) -> str:
    """Return 32 hexadecimal digits, the digest of the state that later tracks depend on: no counts of messages."""
    return hashlib.blake2b(state_bytes(checkpoint), digest_size=DIGEST).hexdigest()


def decode_checkpoint(data: bytes) -> Checkpoint:
    """Return the checkpoint that bytes hold.

    Raises:
        CheckpointError: torn, changed, of another version, or not valid.
    """
    try:
        return _read(_open(data))
    except (schemas.MessageError, optipmb.OptipmbError) as error:
        raise CheckpointError(str(error)) from error


def seal(body: bytes, incarnation: Incarnation) -> bytes:
    """Return a body with the head that names its format, holds the numbers and guards it."""
    start = _START + _IDS.pack(incarnation.starts, incarnation.next_id)
    numbers = _msgpack.packb({"run": incarnation.run, "events": dict(sorted(incarnation.events.items()))})
    rest = b"".join((_LENGTH.pack(len(numbers)), numbers, body))
    return b"".join((start, _digest(start, rest), rest))


def numbers_in(data: bytes) -> Incarnation:
    """Return the numbers of a checkpoint of any format, or of its head alone.

    Raises:
        CheckpointError: torn or changed.
    """
    return _opened(data)[1]


def _open(data: bytes) -> bytes:
    version, incarnation, body = _opened(data)
    if version != VERSION:
        raise CheckpointError(_other_format(version), incarnation)
    if not body:
        raise CheckpointError("numbers alone: the state was larger than the store takes", incarnation)
    return body


def _other_format(version: int) -> str:
    return f"format {version}: expected {VERSION}, the only one of this release; start the release that wrote it"


def _opened(data: bytes) -> tuple[int, Incarnation, bytes]:
    if len(data) < HEAD or data[: len(MAGIC)] != MAGIC:
        raise CheckpointError("no checkpoint: its first bytes are others")
    if len(data) > MAX_BYTES:
        raise CheckpointError(f"{len(data)} bytes: more than a checkpoint has")
    start, rest = data[: HEAD - DIGEST], data[HEAD:]
    version = int.from_bytes(start[len(MAGIC) : len(_START)], "big")
    if data[HEAD - DIGEST : HEAD] != _digest(start, rest):
        torn = "torn or changed: the digest is that of other bytes"
        raise CheckpointError(torn if version == VERSION else f"{_other_format(version)}; {torn}")
    starts, next_id = (min(one, MAX_COUNT) for one in _IDS.unpack_from(start, len(_START)))
    length = int.from_bytes(rest[: _LENGTH.size], "big")
    numbers, body = rest[_LENGTH.size : _LENGTH.size + length], rest[_LENGTH.size + length :]
    try:
        known = _Numbers.model_validate(read_map(numbers, schemas.STORED))
    except (ValidationError, schemas.MessageError) as error:
        if version == VERSION:
            raise CheckpointError(f"numbers: {error}") from None
        known = _Numbers(run=0, events={})  # formats before 4 have none
    return version, Incarnation(starts, next_id, known.run, known.events), body


def _digest(start: bytes, body: bytes) -> bytes:
    # Processors have instructions for SHA-256: it takes a third of the time that BLAKE2b takes.
    digest = hashlib.sha256(start)
    digest.update(body)
    return digest.digest()[:DIGEST]


# Writing


def _body(checkpoint: Checkpoint) -> dict[str, Any]:
    return {
        "software": checkpoint.software,
        "stream": checkpoint.stream,
        "parameters": _packed_profile(checkpoint.parameters),
        "fused": checkpoint.fused,
        "cloud_wait_ns": checkpoint.cloud_wait_ns,
        "quarantine": dict(sorted(checkpoint.quarantine.items())),
        "epochs": dict(sorted(checkpoint.seen.items())),
        "base": checkpoint.base,
        "window": checkpoint.window,
        # Without a window the present is its beginning.
        "head": checkpoint.head if checkpoint.window else None,
        "deliveries": checkpoint.deliveries,
        "newest_cloud_ns": dict(sorted(checkpoint.newest_cloud_ns.items())),
        "run": checkpoint.run,
    }


def _packed(value: Any) -> Any:
    """Return a record as msgpack has it."""
    if isinstance(value, set | frozenset):
        return sorted(value)
    if isinstance(value, SeenNumbers):
        return value.epoch, value.highest, value.mask.to_bytes((value.mask.bit_length() + 7) // 8, "big")
    if isinstance(value, ProcessedFrame):
        if value.points is not None and not value.packed:
            value.packed.append(schemas.encode(value.points))
        points = value.packed[0] if value.packed else None
        return {"detections": value.detections, "points": points, "missed": value.missed, "revision": value.revision}
    table = {name: getattr(value, name) for name in value.__match_args__}
    if isinstance(value, ZoneState):
        return _packed_zones(value, table)
    if isinstance(value, FilterState):
        density, sensors = value.density, dict(sorted(value.sensors.items()))
        clock = {"stamp_ns": density.stamp_ns, "next_id": density.next_id}
        absent = {name for name in ("zones", "worlds") if table[name] is None}
        kept = {name: one for name, one in table.items() if name not in absent}
        return clock | kept | {"density": optipmb.bytes_of(density), "sensors": sensors}
    return present(table)


def _packed_zones(value: ZoneState, table: dict[str, Any]) -> dict[str, Any]:
    tracks = sorted(value.tracks.items())
    packed = [(number, one.known.to_bytes(ZONE_BYTES, "big"), _unsent(one)) for number, one in tracks]
    table |= {"objects": sorted(value.objects.items())}
    if not value.objects:
        del table["objects"]
    counts = {
        zone: {name: sorted(one.items()) for name, one in sorted(names.items())}
        for zone, names in sorted(value.counts.items())
    }
    return table | {"tracks": packed, "counts": counts, "numbers": dict(sorted(value.numbers.items()))}


def _unsent(seen: Seen) -> Seen:
    """Return a track without the zones that know it; events that were not sent have no object yet."""

    def event(one: Event) -> Any:
        return one[:-1]

    visits = {
        name: one if one.entered is None else one._replace(entered=event(one.entered))
        for name, one in seen.visits.items()
    }
    return seen._replace(known=0, visits=visits, held=tuple(map(event, seen.held)))


def _packed_profile(parameters: optipmb.Parameters) -> bytes:
    """Return a profile as bytes, classes in the order of their indices; sessions write the same few every second."""
    known = _profiles.get(id(parameters))
    if known is None or known[0] is not parameters:
        if len(_profiles) >= MAX_PROFILES:
            _profiles.clear()
        known = _profiles[id(parameters)] = parameters, _msgpack.packb(parameters.model_dump(mode="json"))
    return known[1]


# Reading

Flag = Annotated[bool, Field(strict=True)]
Text = Annotated[str, Field(strict=True, max_length=MAX_ERROR)]


class _Numbers(BaseModel):
    run: Count
    events: dict[str, Count]


class _Zones(BaseModel):
    tracks: tuple[tuple[Count, Annotated[bytes, Field(strict=True, max_length=ZONE_BYTES)], Seen], ...]
    counts: dict[str, dict[str, tuple[tuple[str, int], ...]]]
    numbers: dict[str, Count]
    zones: tuple[str, ...]
    session: str
    objects: tuple[tuple[Count, Count], ...] = ()

    def state(self) -> ZoneState:
        tracks = {number: one._replace(known=int.from_bytes(known, "big")) for number, known, one in self.tracks}
        counts = {zone: {name: dict(one) for name, one in by_name.items()} for zone, by_name in self.counts.items()}
        return ZoneState(tracks, counts, self.numbers, self.zones, self.session, dict(self.objects))


class _State(BaseModel):
    stamp_ns: Annotated[int, Field(strict=True, ge=-1, lt=2**63)]
    next_id: Count
    density: dict[str, Binary]
    session: Annotated[str, Field(strict=True, pattern="^[0-9a-f]{32}$")]
    starts: Count
    generation: Count
    last: FrameId | None
    tracks: Whole
    counts: FrameCounts
    sensors: Annotated[dict[SensorName, SensorState], Field(max_length=MAX_SENSORS)]
    zones: _Zones | None = None
    worlds: Worlds | None = None


class _Frame(BaseModel):
    detections: Binary
    points: Binary | None
    missed: Flag
    revision: Count


class _Seen(NamedTuple):
    epoch: Epoch
    highest: Whole
    mask: Annotated[bytes, Field(strict=True, max_length=WINDOW // 8)]


class _Body(BaseModel):
    software: Text
    stream: SensorName
    parameters: Binary
    fused: Flag
    cloud_wait_ns: Annotated[int, Field(strict=True, ge=0, le=MAX_CLOUD_WAIT_NS)] | None
    quarantine: dict[SensorName, Text]
    epochs: dict[SensorName, Annotated[tuple[_Seen, ...], Field(max_length=EPOCHS)]]
    base: _State
    window: tuple[_Frame, ...]
    head: _State | None
    deliveries: Deliveries
    newest_cloud_ns: dict[SensorName, Whole]
    run: Count


def _read(data: bytes) -> Checkpoint:
    """Return the checkpoint of a body.

    Raises:
        MessageError: the body has another form, or its parts do not fit together.
        OptipmbError: its profile or a density is not valid.
    """
    try:
        body = _Body.model_validate(read_map(data, schemas.STORED))
    except ValidationError as error:
        raise first_error(error) from None
    stream, fused = body.stream, body.fused
    parameters = optipmb.parse_parameters(read_map(body.parameters, schemas.STORED))
    schemas.SessionParameters(profile=parameters.name)  # as messages take it
    base = _state_of(body.base, stream, parameters)
    window = tuple(_frame_of(one, None if fused else stream, parameters) for one in body.window)
    head = base if body.head is None else _state_of(body.head, stream, parameters)
    if (body.head is None) != (not window):
        raise schemas.MessageError("invalid_value", "head", "a state, exactly where there is a window", "another")
    if len({one.frame_id for one in window}) != len(window):
        raise schemas.MessageError("invalid_value", "window", "every frame once", "one again")
    names = {*head.sensors, *base.sensors, *body.epochs, *body.quarantine, *body.newest_cloud_ns}
    if any(bool(name) != fused for name in names) or (fused and base.last and base.last.sensor not in base.sensors):
        expected = "the streams of its sensors, or none for its own"
        raise schemas.MessageError("invalid_value", "sensors", expected, "others")
    return Checkpoint(
        stream=stream,
        parameters=parameters,
        fused=fused,
        cloud_wait_ns=body.cloud_wait_ns,
        quarantine=body.quarantine,
        seen={name: _seen_of(epochs) for name, epochs in body.epochs.items()},
        base=base,
        window=window,
        head=head,
        deliveries=body.deliveries,
        newest_cloud_ns=body.newest_cloud_ns,
        run=body.run,
        software=body.software,
    )


def _seen_of(epochs: tuple[_Seen, ...]) -> tuple[SeenNumbers, ...]:
    seen = tuple(SeenNumbers(one.epoch, one.highest, int.from_bytes(one.mask, "big")) for one in epochs)
    if len({one.epoch for one in seen}) != len(seen):
        raise schemas.MessageError("invalid_value", "epochs", "each epoch once", "one again")
    for one in seen:
        if not one.mask & 1 or one.mask.bit_length() > one.highest + 1:
            expected = f"which of the {WINDOW} numbers up to {one.highest} came, with itself"
            raise schemas.MessageError("invalid_value", "epochs", expected, "another mask")
    return seen


def _frame_of(one: _Frame, stream: str | None, parameters: optipmb.Parameters) -> ProcessedFrame:
    """Return a frame of the window, of one stream or, without its name, of the stream that it says."""
    message = schemas.decode(one.detections, schemas.Detections, limits=schemas.STORED)
    cloud = None if one.points is None else schemas.decode(one.points, schemas.Points, limits=schemas.STORED)
    frame_id = FrameId(message.epoch, message.seq, message.stamp_ns, message.stream if stream is None else "")
    if stream not in {None, message.stream}:
        raise schemas.MessageError("invalid_value", "window", f"a frame of {stream}", f"one of {message.stream}")
    if cloud is not None:
        if (cloud.stream, cloud.stamp_ns) != (message.stream, message.stamp_ns):
            expected = f"the cloud of {message.stream} at {message.stamp_ns}"
            raise schemas.MessageError("invalid_value", "window", expected, f"that of {cloud.stamp_ns}")
        convert.cloud_of(cloud)
    convert.frame_of(parameters, message)  # the tracker takes it
    return ProcessedFrame(frame_id, schemas.encoded(message), cloud, one.missed, one.revision, [], UNPLACED)


def _state_of(one: _State, stream: str, parameters: optipmb.Parameters) -> FilterState:
    labels = parameters.labels
    density = optipmb.density_of(one.stamp_ns, one.next_id, optipmb.columns_in(one.density, len(labels)), labels)
    convert.density_of(density, stream=stream, session=one.session, parameters=parameters)  # it can be asked for
    others = {name: getattr(one, name) for name in FilterState.__match_args__ if name not in {"density", "zones"}}
    return FilterState(density=density, **others, zones=None if one.zones is None else one.zones.state())
