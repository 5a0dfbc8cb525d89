"""Worlds that move under a session, as publishers announce it: tracks, poses and zones move with them."""

import math
import random
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from fusing import FUSED
from optipmb_schemas import Detections, FieldOfView, Pose, Relocation, Tracks, decode, encode
from optipmb_service.session.checkpoint import decode_checkpoint, encode_checkpoint, state_bytes
from optipmb_service.session.outputs import Output, TrackedFrame
from optipmb_service.session.policy import Policy
from optipmb_service.session.session import Session
from real_data import kitti_root
from recorded import recording
from router import SECOND, Sensor
from sessions import Merged, begun, dumps, plain, problems, tracks

import optipmb
from optipmb.world.zones import Zone

SENSOR = Sensor()
PROFILE = optipmb.load_profile("nuscenes")
JUMP = optipmb.Relocation(10.0, -3.0, 0.5, math.radians(5.0))
BACK = optipmb.Relocation(-4.0, 20.0, -1.5, math.radians(-40.0))


def announced(motion: optipmb.Relocation, world: int = 1) -> Relocation:
    half = 0.5 * motion.theta
    turn = np.array([math.cos(half), 0.0, 0.0, math.sin(half)])
    return Relocation(world=world, translation=np.array(motion[:3]), quaternion=turn)


def moved(message: Detections, *motions: optipmb.Relocation) -> dict[str, Any]:
    fields = {name: getattr(message, name) for name in ("center", "yaw", "velocity", "pose")}
    for motion in motions:
        if message.pose is not None:
            pose = motion.pose(optipmb.Pose(fields["pose"].translation, fields["pose"].quaternion))
            fields["pose"] = Pose(translation=pose.translation, quaternion=pose.quaternion)
        if message.frame == "world":
            center = fields["center"]
            fields["center"] = np.column_stack((motion.points(center[:, :2]), center[:, 2] + motion.z))
            fields["yaw"] = fields["yaw"] + motion.theta
            fields["velocity"] = motion._replace(x=0.0, y=0.0).points(fields["velocity"])
    return fields


def relocated(message: Detections, *motions: optipmb.Relocation, said: bool = True) -> Detections:
    relocation = announced(motions[-1], len(motions)) if motions and said else None
    return message.model_copy(update=moved(message, *motions) | {"relocation": relocation})


def session(**changes: Any) -> Session:
    return Session(SENSOR.stream, PROFILE, **changes)


def feed(one: Session, messages: Iterable[Detections], now_ns: int = 0) -> list[Output]:
    return [output for message in messages for output in one.on_detections(message, now_ns)]


def jumping(count: int = 20, at: int = 10, *motions: optipmb.Relocation) -> list[Detections]:
    """Frames of which those from a number on are in another world."""
    motions = motions or (JUMP,)
    return [relocated(SENSOR.detections(seq), *(motions if seq >= at else ())) for seq in range(count)]


def assert_moved(found: Sequence[Tracks], before: Sequence[Tracks], *motions: optipmb.Relocation) -> None:
    """Tracks equal another run in the moved world: ids and detections equal, numbers nearly."""
    assert len(found) == len(before)
    for one, other in zip(found, before, strict=True):
        assert one.session == other.session
        for name in ("seq", "gap"):
            assert getattr(one, name) == getattr(other, name)
        for name in ("id", "detection", "confirmed", "label"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
        center, yaw, velocity = other.center, other.yaw, other.velocity
        for motion in motions:
            center = np.column_stack((motion.points(center[:, :2]), center[:, 2] + motion.z))
            yaw, velocity = yaw + motion.theta, motion._replace(x=0.0, y=0.0).points(velocity)
        np.testing.assert_allclose(one.center, center, rtol=0, atol=1e-9)
        np.testing.assert_allclose(np.cos(one.yaw - yaw), 1.0, rtol=0, atol=1e-12)
        np.testing.assert_allclose(one.velocity, velocity, rtol=0, atol=1e-9)
        for name in ("existence", "score", "size", "yaw_rate", "age", "time_since_detection"):
            np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", ["0003", "0007", "0009", "0020"])
def test_recorded_tracks_live_through_jumps(name: str) -> None:
    """After a jump at every twentieth frame of a recording, all tracks of 1.2 s are those without the jump."""
    frames = [detections for detections, _ in recording("kitti", kitti_root(), "pointrcnn", name, "a/b/c", 300).frames]
    policy = Policy(cloud_wait_ns=0)
    one, jumps = Session("a/b/c", optipmb.load_profile("kitti"), policy), range(20, len(frames) - 12, 20)
    for seq, message in enumerate(frames):
        if seq in jumps:
            still, jumped = (Session.restore(one.snapshot(), 0, policy) for _ in range(2))
            expected, found = (
                tracks(feed(still, frames[seq : seq + 12])),
                tracks(feed(jumped, [relocated(later, JUMP) for later in frames[seq : seq + 12]])),
            )
            assert len(found) == 12
            assert_moved(found, expected, JUMP)
        feed(one, [message])
    assert len(jumps) > 2


def test_two_motions_are_their_product() -> None:
    """Tracks after two jumps equal the run without, moved by both; the tracks give the positions of the jumps."""
    messages = [*jumping(10), *jumping(15, 0)[10:], *jumping(25, 0, JUMP, BACK)[15:]]
    found = tracks(feed(session(), messages))
    assert [(one.seq, one.world, one.relocation) for one in found if one.relocation] == [
        (10, 1, announced(JUMP)),
        (15, 2, announced(BACK, 2)),
    ]
    expected = tracks(feed(session(), jumping(25, 25)))
    assert_moved(found[10:15], expected[10:15], JUMP)
    assert_moved(found[15:], expected[15:], JUMP, BACK)


@pytest.mark.parametrize("at", range(8, 13))
def test_a_takeover_around_the_jump_changes_nothing(at: int) -> None:
    """A member that goes on from a checkpoint before or after the jump, and gets the frames since, is the same."""
    one, merged, expected = session(), Merged(), Merged()
    messages = jumping()
    whole = session()
    expected.take(feed(whole, messages))
    merged.take(feed(one, messages[:at]))
    data = encode_checkpoint(one.snapshot())
    feed(one, messages[at : at + 2])
    two = Session.restore(decode_checkpoint(data), 0)
    merged.take(feed(two, messages[at:]), 1)
    assert merged.plain() == expected.plain()
    assert state_bytes(two.snapshot()) == state_bytes(whole.snapshot())


@pytest.mark.parametrize("seed", range(4))
def test_frames_may_come_late(seed: int) -> None:
    """Frames of the old and the new world in any order within the window, the first of the new one too: as in order."""
    messages, chance = jumping(30), random.Random(seed)
    order = sorted(range(30), key=lambda seq: seq + chance.uniform(0, 6))
    one, two, merged, expected = session(), session(), Merged(), Merged()
    expected.take(feed(two, messages))
    merged.take(feed(one, [messages[seq] for seq in order]))
    assert merged.plain() == expected.plain()
    assert state_bytes(one.snapshot()) == state_bytes(two.snapshot())


def test_the_loss_of_the_first_message_does_no_harm() -> None:
    """The next message of the world moves the tracks as the lost one would have."""
    found = tracks(feed(session(), [message for message in jumping() if message.seq not in {10, 11}]))
    still = tracks(feed(session(), [message for message in jumping(20, 20) if message.seq not in {10, 11}]))
    assert [one.seq for one in found if one.relocation] == [12]
    assert_moved(found[10:], still[10:], JUMP)


def test_messages_need_not_repeat_it() -> None:
    """A message without a relocation is of the world of the one before."""
    messages = [
        message if message.seq <= 12 else message.model_copy(update={"relocation": None}) for message in jumping()
    ]
    assert [plain(one) for one in tracks(feed(session(), messages))] == [
        plain(one) for one in tracks(feed(session(), jumping()))
    ]


def test_a_jump_of_the_pose_that_is_announced_is_none() -> None:
    """A sensor that is a kilometre off in the new world is not astray, and one that is not has not moved."""
    far = optipmb.Relocation(1000.0, 0.0, 0.0, 0.0)
    pose = Pose(translation=np.zeros(3), quaternion=np.array([1.0, 0.0, 0.0, 0.0]))
    messages = [SENSOR.detections(seq, frame="sensor", pose=pose) for seq in range(20)]
    found = feed(session(), [relocated(one, *([far] if one.seq >= 10 else [])) for one in messages])
    assert problems(found) == []
    assert_moved(tracks(found)[10:], tracks(feed(session(), messages))[10:], far)
    stays = feed(session(), [one.model_copy(update={"relocation": announced(far)}) for one in messages[:1]])
    assert problems(stays) == []
    outputs = feed(one := session(), messages[:10])
    outputs += feed(one, [messages[10].model_copy(update={"relocation": announced(far)})])
    assert [one.code for one in problems(outputs)] == ["astray"]


FAR = optipmb.Relocation(9e7, 9e7, 0.0, 0.0)


@pytest.mark.parametrize(("before", "motion", "world"), [((), BACK, 2), ((JUMP,), BACK, 3), ((FAR,), FAR, 2)])
def test_an_unknown_motion_restarts(
    before: tuple[optipmb.Relocation, ...], motion: optipmb.Relocation, world: int
) -> None:
    """A world number that skips one, and a motion off the Earth, begin a new session there, which goes on from it."""
    one = session()
    feed(one, jumping(10, 5 if before else 10, *before))
    there, again = (SENSOR.detections(seq, relocation=announced(motion, world)) for seq in (10, 11))
    outputs = feed(one, [there])
    assert begun(outputs) == ["world"]
    assert [(one.code, one.received.partition(",")[0]) for one in problems(outputs)] == [("restarted", "world")]
    assert [message.world for message in tracks(outputs)] == [world]
    assert begun(feed(one, [again])) == []


def test_a_world_that_goes_back_restarts() -> None:
    """An epoch whose numbers go back begins a new session."""
    one = session()
    feed(one, jumping(10, 5, JUMP, BACK)[5:])
    assert begun(feed(one, [relocated(SENSOR.detections(10), JUMP)])) == ["world"]


def test_a_restarted_publisher_counts_again() -> None:
    """Its first message is of the present world, and the next motion is the first of its epoch."""
    one = session()
    feed(one, [*jumping(10, 5), *jumping(20, 10, JUMP, BACK)[10:]])
    epoch = {"epoch": b"e" * 16}
    here = [
        relocated(SENSOR.detections(seq, **epoch), JUMP, BACK, said=False).model_copy(update={"seq": seq - 20})
        for seq in range(20, 25)
    ]
    there = [
        SENSOR.detections(seq, **epoch).model_copy(
            update=moved(SENSOR.detections(seq), JUMP, BACK, JUMP) | {"seq": seq - 20, "relocation": announced(JUMP)}
        )
        for seq in range(25, 30)
    ]
    outputs = feed(one, [*here, *there])
    assert begun(outputs) == []
    assert [message.world for message in tracks(outputs)] == [2] * 5 + [3] * 5
    expected = tracks(feed(session(), jumping(30, 30)))
    np.testing.assert_array_equal(tracks(outputs)[-1].id, expected[-1].id)


def test_a_publisher_may_restart_with_the_numbers_of_its_world() -> None:
    """A first message with the motion that led to the present world is of that world."""
    one = session()
    feed(one, jumping(10, 5))
    late = [one.model_copy(update={"epoch": b"e" * 16, "seq": one.seq - 10}) for one in jumping(15, 5)[10:]]
    outputs = feed(one, late)
    assert begun(outputs) == []
    assert [message.world for message in tracks(outputs)] == [1] * 5


@pytest.mark.parametrize("several", [False, True])
def test_any_numbers_leave_a_state_that_can_be_read(*, several: bool) -> None:
    """For any world numbers of publishers and epochs, tracks and checkpoint hold valid numbers."""
    chance = random.Random(4)
    one = Session(FUSED, PROFILE, fused=True, policy=Policy(recovery_wait_ns=0)) if several else session()
    for seq in range(200):
        which = chance.randrange(3)
        motion, world = chance.choice([JUMP, BACK]), chance.choice([1, 1, 2, 3, 4, 7, 2**31 - 1])
        message = SENSOR.detections(
            seq,
            stream=f"site/node/{which}" if several else SENSOR.stream,
            epoch=bytes([which + seq // 50 * several]) * 16,
            relocation=chance.choice([None, announced(motion, world)]),
        )
        outputs = one.on_detections(message, 0)
        assert not dumps(outputs)
        for tracked in tracks(outputs):
            assert decode(encode(tracked), Tracks) == tracked
        data = encode_checkpoint(one.snapshot())
        assert encode_checkpoint(decode_checkpoint(data)) == data
    assert one.counters.frames > 50


def test_another_motion_into_a_known_world_is_reported() -> None:
    """The first one holds."""
    one = session()
    feed(one, jumping(15))
    outputs = feed(one, [jumping()[15].model_copy(update={"relocation": announced(BACK)})])
    assert [(problem.code, problem.path) for problem in problems(outputs)] == [("invalid_value", "relocation")]
    assert [plain(message) for message in tracks(outputs)] == [
        plain(message) for message in tracks(feed(session(), jumping(16)))[15:]
    ]


def fused(switch: int, lag: int, motions: int = 1, frames: int = 20) -> list[Detections]:
    """Frames of two sensors that see the same cars; the second one switches worlds later, and has a view and a pose."""
    pose = Pose(translation=np.array([3.0, 1.0, 0.0]), quaternion=np.array([math.cos(0.2), 0.0, 0.0, math.sin(0.2)]))
    view = FieldOfView(azimuth=[-3.0, 3.0], elevation=[-1, 1], range=[0, 200])
    found = []
    for seq in range(frames):
        for name, late in (("front", 0), ("rear", lag)):
            message = SENSOR.detections(seq).model_copy(
                update={"stream": f"site/node/{name}", "stamp_ns": SENSOR.stamp_ns(seq) + (late > 0) * SECOND // 25}
            )
            if late:
                message = message.model_copy(update={"pose": pose, "field_of_view": view})
            steps = max(0, min(motions, seq - switch - late + 1))
            found.append(relocated(message, *([JUMP] * steps)))
    return found


@pytest.mark.parametrize("lag", [1, 3])
def test_a_sensor_that_switches_later_is_brought_forward(lag: int) -> None:
    """Frames of an older world update the moved tracks: as if all sensors had stayed."""
    one, two = (Session(FUSED, PROFILE, fused=True, policy=Policy(recovery_wait_ns=0)) for _ in range(2))
    outputs = feed(one, fused(10, lag, 2))
    found = tracks(outputs)
    assert problems(outputs) == []
    assert begun(outputs) == ["first"]
    expected = tracks(feed(two, fused(99, lag)))
    for at, (before, message) in enumerate(zip(expected, found, strict=True)):
        assert_moved([message], [before], *([JUMP] * (message.world or 0)))
        assert at < 20 or message.world
    worlds = [message.world or 0 for message in found]
    assert all(later >= earlier for earlier, later in pairwise(worlds))


def test_a_sensor_too_far_behind_is_refused() -> None:
    """Eight motions are kept: the frames of a sensor behind more are refused and reported, and the others go on."""
    one = Session(FUSED, PROFILE, fused=True, policy=Policy(recovery_wait_ns=0))
    outputs = feed(one, fused(5, 99, 10))
    assert begun(outputs) == ["first"]
    assert {(problem.code, problem.path) for problem in problems(outputs)} == {("invalid_value", "relocation.world")}
    assert {problem.stream for problem in problems(outputs)} == {"site/node/rear"}
    assert sum(message.sensor == "site/node/front" for message in tracks(outputs)) == 20
    assert sum(message.sensor == "site/node/rear" for message in tracks(outputs)) == 13


def test_nothing_crosses_a_line_by_a_motion() -> None:
    """A line between the old and the new world is not crossed; who comes to be inside a zone has appeared there."""
    line = Zone("gate", line=((8.0, -50.0), (8.0, 50.0)))
    yard = Zone("yard", polygon=((8.0, -50.0), (60.0, -50.0), (60.0, 50.0), (8.0, 50.0)), min_s=0.0)
    one = session(policy=Policy(zones=(line, yard)))
    outputs = feed(one, jumping(14, 10, JUMP._replace(theta=0.0)))
    events = [event for output in outputs if isinstance(output, TrackedFrame) for event in output.events]
    assert {(event.zone, event.kind, event.how) for event in events} == {("yard", "entered", "appeared")}
    assert len(events) == 3


def test_a_cloud_of_another_world_is_not_used() -> None:
    """Detections and cloud belong together where both are of one world, or one does not say."""
    for world, used in ((1, True), (2, False), (None, True)):
        one = session()
        relocation = None if world is None else announced(JUMP, world)
        one.on_points(SENSOR.points(0).model_copy(update={"relocation": relocation}), 0)
        message = SENSOR.detections(0, has_points=True, relocation=announced(JUMP))
        assert [message.cloud_used for message in tracks(one.on_detections(message, 0))] == [used]


def test_a_world_outlives_a_reset() -> None:
    """A reset discards the tracks, not the place."""
    one = session()
    feed(one, jumping(12))
    one.reset()
    outputs = feed(one, jumping(15)[12:])
    assert begun(outputs) == []
    assert [message.world for message in tracks(outputs)] == [1, 1, 1]
