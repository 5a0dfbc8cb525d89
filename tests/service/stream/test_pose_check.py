"""Poses that no sensor can have: refused with the reason, until they are many that agree."""

import re
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from optipmb_schemas import Detections, Pose, Relocation
from optipmb_service.session.checkpoint import state_bytes
from optipmb_service.session.outputs import Output
from optipmb_service.session.policy import Policy
from optipmb_service.session.session import Session
from router import Sensor
from sessions import begun, chained, problems, tracks

import optipmb

NUSCENES = optipmb.load_profile("nuscenes")
SENSOR = Sensor()
POLICY = Policy()


def frame(seq: int, x: float) -> Detections:
    pose = Pose(translation=np.array([x, 0.0, 0.0]), quaternion=np.array([1.0, 0, 0, 0]))
    center = SENSOR.detections(seq).center
    return SENSOR.detections(seq, frame="sensor", pose=pose, center=center)


def feed(one: Session, places: dict[int, float]) -> list[Output]:
    return [output for seq, x in places.items() for output in one.on_detections(frame(seq, x), 0)]


def session(**changes: Any) -> Session:
    return Session(SENSOR.stream, NUSCENES, **changes)


def test_a_jump_of_the_pose_is_refused() -> None:
    """A frame a hundred metres off is refused with its position, counted, and gives birth to nothing."""
    one = session()
    feed(one, {seq: seq * 1.0 for seq in range(5)})
    density = one.density
    outputs = feed(one, {5: 105.0})
    assert [(p.code, p.path, p.seq) for p in problems(outputs)] == [("astray", "pose.translation", 5)]
    assert "105.0" in problems(outputs)[0].received
    assert tracks(outputs) == []
    assert one.density is density
    assert one.counters.refused == 1
    assert [(m.seq, m.gap) for m in tracks(feed(one, {6: 6.0}))] == [(6, 1)]


def test_a_sensor_that_stays_elsewhere_begins_anew() -> None:
    """When frames in a row agree on the new place, the last of them begins a new life there; ids go on."""
    one = session()
    before = tracks(feed(one, dict.fromkeys(range(4), 0.0)))[-1]
    outputs = feed(one, dict.fromkeys(range(4, 10), 500.0))
    codes = [problem.code for problem in problems(outputs)]
    assert codes == ["astray"] * (POLICY.astray_frames - 1) + ["restarted"]
    assert begun(outputs) == ["pose"]
    after = tracks(outputs)
    assert [message.seq for message in after] == [4 + POLICY.astray_frames - 1, 4 + POLICY.astray_frames]
    assert after[-1].session != before.session
    assert min(after[-1].id) > max(before.id)


def test_poses_that_do_not_agree_never_begin_anything() -> None:
    """A localisation that throws the sensor about is refused for as long as it does."""
    one = session()
    feed(one, {0: 0.0})
    outputs = feed(one, {seq: 500.0 * seq for seq in range(1, 20)})
    assert begun(outputs) == []
    assert len(problems(outputs)) == 19


def test_silence_gives_a_sensor_time_to_move() -> None:
    """What can be reached in the time that passed is no jump; without the check any pose is taken."""
    one = session()
    feed(one, {0: 0.0})
    assert len(tracks(feed(one, {20: 150.0}))) == 1
    free = session(policy=Policy(max_speed=0))
    assert len(tracks(feed(free, {0: 0.0, 1: 10_000.0}))) == 2


@settings(max_examples=20, deadline=None)
@given(st.permutations(range(8)), st.sets(st.integers(1, 7), max_size=6))
def test_refusals_do_not_depend_on_arrival(order: list[int], far: set[int]) -> None:
    """Frames off the path follow from the frames in order, for any order of arrival."""
    places = {seq: 300.0 if seq in far else 0.0 for seq in range(8)}
    one, other = session(tracker=chained), session(tracker=chained)
    feed(one, {seq: places[seq] for seq in order})
    feed(other, places)
    assert state_bytes(one.snapshot()) == state_bytes(other.snapshot())


def shifted(seq: int, motion: optipmb.Relocation | None, turn: float = 0.02) -> Detections:
    """A frame of a sensor that drives along a bend, in the world after an unannounced motion."""
    yaw = turn * seq
    pose = optipmb.Pose(
        np.array([50.0 + seq, 0.02 * seq * seq, 1.8]), np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])
    )
    pose = pose if motion is None else motion.pose(pose)
    return SENSOR.detections(
        seq, frame="sensor", pose=Pose(translation=pose.translation, quaternion=pose.quaternion), objects=0
    )


def test_a_jump_within_reach_is_reported_once() -> None:
    """The problem has the motion, by which the jump could have been announced; the frames are tracked."""
    motion = optipmb.Relocation(3.0, -1.0, 0.5, 0.04)
    messages = [shifted(seq, motion if seq >= 10 else None) for seq in range(20)]
    one = session()
    outputs = [output for message in messages for output in one.on_detections(message, 0)]
    found = problems(outputs)
    assert [(problem.code, problem.path, problem.seq) for problem in found] == [("world_jump", "pose", 10)]
    numbers = [float(number) for number in re.findall(r"-?\d+\.\d+", found[0].received)]
    assert numbers[2:] == pytest.approx(motion, abs=0.2)
    assert one.counters.frames == 20
    off = session(policy=Policy(jumps="off"))
    assert not problems(output for message in messages for output in off.on_detections(message, 0))


def test_an_announced_jump_and_a_bend_are_none() -> None:
    """Neither a relocation, nor braking and turning as vehicles do, nor frames that are late or missing."""
    motion = optipmb.Relocation(30.0, -1.0, 0.5, 1.0)
    said = Relocation(world=1, translation=np.array(motion[:3]), quaternion=np.array([np.cos(0.5), 0, 0, np.sin(0.5)]))
    one = session()
    order = [0, 1, 2, 4, 3, 5, 9, 10, 12, 11, 13, 20, 21]
    frames = [shifted(seq, motion if seq >= 10 else None) for seq in order]
    said_frames = [frame.model_copy(update={"relocation": said if frame.seq >= 10 else None}) for frame in frames]
    assert not problems(output for frame in said_frames for output in one.on_detections(frame, 0))
