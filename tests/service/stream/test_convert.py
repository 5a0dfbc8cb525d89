"""Messages that were checked once become frames without a second check: the same frames, and the same refusals."""

from dataclasses import fields
from typing import Any

import numpy as np
import optipmb_schemas as schemas
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from optipmb_service.session import convert

import optipmb

PROFILE = optipmb.load_profile("nuscenes")
LABELS = ("car", "tram", "vehicle.bus.rigid", "dog")
HEADER = {"stream": "a/b/c", "epoch": bytes(16), "seq": 2**20, "stamp_ns": 10**18}
RANGES = {name: (one.low, one.high) for name, one in schemas.Detections.arrays.items()}
POSES = (
    None,
    ([0.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0]),
    ([10.0, -20.0, 1.5], [0.6, 0.0, 0.0, 0.8]),
    ([1e8, 0.0, 0.0], [0.8, 0.1, -0.2, np.sqrt(0.31)]),
)
SPREADS = (np.full((3, 3), np.nan), np.diag([1e8, 1e-8, 1.0]), np.diag([0.5, 0.25, 1.0]) + 0.1)


@st.composite
def messages(draw: st.DrawFn) -> schemas.Detections:
    """Valid messages, many of their numbers at the ends of the ranges."""
    count = draw(st.integers(0, 4))

    def column(name: str, *shape: int) -> Any:
        low, high = RANGES[name]
        ends = st.sampled_from([low or 5e-324 if name == "size" else low, high, 0.5])
        return draw(arrays(np.float64, (count, *shape), elements=ends))

    pose = draw(st.sampled_from(POSES))
    velocity = column("velocity", 2)
    velocity[draw(arrays(bool, count))] = np.nan
    center, size, yaw = column("center", 3), column("size", 3), column("yaw")
    center[draw(arrays(bool, count)), 2] = np.nan
    size[draw(arrays(bool, (count, 3)))] = np.nan
    yaw[draw(arrays(bool, count))] = np.nan
    spread = [draw(st.sampled_from(SPREADS)) for _ in range(count)]
    view = schemas.FieldOfView(azimuth=[-1.0, 1.0], elevation=[-0.5, 0.5], range=[0.0, 50.0])
    return schemas.Detections(
        **HEADER,
        frame=draw(st.sampled_from(["world", "sensor"])) if pose else "world",
        pose=schemas.Pose(translation=pose[0], quaternion=pose[1]) if pose else None,
        labels=LABELS,
        label=draw(arrays(np.int64, count, elements=st.integers(0, len(LABELS) - 1))),
        center=center / draw(st.sampled_from([1.0, 1e6])),
        size=draw(st.sampled_from([None, size])),
        yaw=draw(st.sampled_from([None, yaw])),
        score=column("score"),
        velocity=draw(st.sampled_from([None, velocity])),
        field_of_view=draw(st.sampled_from([None, view])),
        position_covariance=draw(st.sampled_from([None, np.array(spread).reshape(count, 3, 3)])),
    )


def made(function: Any, *arguments: Any, **named: Any) -> Any:
    """Return all values of a frame and the number of omitted objects, or the error."""
    try:
        frame, left_out = function(*arguments, **named)
    except optipmb.FrameError as error:
        return error.args
    values = [getattr(frame, field.name) for field in fields(frame)]
    for value in values:
        if isinstance(value, np.ndarray):
            assert value.flags.c_contiguous
            assert value.flags.aligned
            assert not value.flags.writeable
    return left_out, [
        (one.dtype, one.shape, one.tobytes()) if isinstance(one, np.ndarray) else repr(one) for one in values
    ]


@settings(deadline=None, max_examples=150)  # the first call compiles
@given(message=messages(), sent=st.booleans())
def test_a_checked_message_is_the_frame_that_make_frame_makes_of_it(*, message: schemas.Detections, sent: bool) -> None:
    """Whether it was constructed or decoded: every array the same to the last bit, and read-only, or the same error."""
    if sent:
        message = schemas.decode(schemas.encode(message), schemas.Detections)
    columns = {name: getattr(message, name) for name in (*message.arrays, "stamp_ns", "labels")}
    pose = message.pose and optipmb.Pose(message.pose.translation, message.pose.quaternion)
    columns["field_of_view"] = optipmb.FieldOfView.of(message.field_of_view, pose)
    wanted = made(optipmb.make_frame, PROFILE, pose=pose if message.frame == "sensor" else None, **columns)
    assert made(convert.frame_of, PROFILE, message) == wanted
