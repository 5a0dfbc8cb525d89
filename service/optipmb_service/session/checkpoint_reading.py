"""The body of a checkpoint as a checkpoint whose parts fit together.

Whatever the body is, reading it ends with a checkpoint, or with an error of the messages or of the tracker, which the
codec turns into its own. Fields that are not described here are ignored.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import optipmb_schemas as schemas
from optipmb_schemas.codec import read_map
from optipmb_schemas.model import first_error
from pydantic import BaseModel, Field, ValidationError

import optipmb
from optipmb_service.session import convert
from optipmb_service.session.checkpoint import Checkpoint
from optipmb_service.session.state import UNPLACED, FilterState, FrameCounts, ProcessedFrame, SensorState
from optipmb_service.session.timeline import EPOCHS, WINDOW, FrameId, SeenNumbers
from optipmb_service.session.values import (
    MAX_CLOUD_WAIT_NS,
    MAX_ERROR,
    MAX_SENSORS,
    Binary,
    Count,
    Deliveries,
    Epoch,
    SensorName,
    Whole,
)

Flag = Annotated[bool, Field(strict=True)]
Text = Annotated[str, Field(strict=True, max_length=MAX_ERROR)]


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


def read_body(data: bytes) -> Checkpoint:
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
    return FilterState(
        density=density,
        session=one.session,
        starts=one.starts,
        generation=one.generation,
        last=one.last,
        tracks=one.tracks,
        counts=one.counts,
        sensors=one.sensors,
    )
