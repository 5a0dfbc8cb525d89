"""Late, repeated and disordered messages: the session ends where it would have ended had all come once and in order."""

import re
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from optipmb_service.session.checkpoint import decode_checkpoint, encode_checkpoint, state_bytes
from optipmb_service.session.outputs import Output
from optipmb_service.session.policy import Policy
from optipmb_service.session.session import Session
from router import SECOND, Sensor
from sessions import Merged, begun, chained, feed, problems, tracks

import optipmb

NUSCENES = optipmb.load_profile("nuscenes")
SENSOR = Sensor()
WAIT_NS = Policy().cloud_wait_ns


def session(**changes: Any) -> Session:
    return Session(SENSOR.stream, NUSCENES, **changes)


def ends(seqs: Any, **changes: Any) -> tuple[bytes, dict[tuple[bytes, int], bytes], Session]:
    """The state and the merged tracks after frames in some order."""
    one, merged = session(**changes), Merged()
    merged.take(feed(one, seqs, SENSOR))
    return state_bytes(one.snapshot()), merged.plain(), one


@settings(max_examples=30, deadline=None)
@given(st.permutations(range(9)))
def test_any_order_inside_the_window_is_the_order(order: list[int]) -> None:
    """For any order of arrival, also of the first frame, state and tracks equal the order of the stamps."""
    state, merged, _ = ends(order)
    expected, in_order, _ = ends(range(9))
    assert state == expected
    assert merged == in_order


def test_late_frames_and_a_restore_keep_the_counts_of_scores() -> None:
    """A profile that calibrates scores itself ends with the bytes of the order of the stamps, through a crash too."""
    in_order = Session(SENSOR.stream, optipmb.load_profile("generic"))
    feed(in_order, range(40), SENSOR)
    one = Session(SENSOR.stream, optipmb.load_profile("generic"))
    feed(one, [0, 3, 1, 2, *range(4, 18), 20, 19, 18], SENSOR)
    one = Session.restore(decode_checkpoint(encode_checkpoint(one.snapshot())), 0)
    feed(one, [22, 21, *range(24, 40), 23], SENSOR)
    one.flush()
    density = one.density
    assert density.self_calibration is not None
    assert density.self_calibration.classes.sum() > 0.0
    assert state_bytes(one.snapshot()) == state_bytes(in_order.snapshot())


def test_corrected_tracks_have_a_higher_revision() -> None:
    """A late frame is published for the first time, later frames are published again; the gap before them closes."""
    one = session()
    first = tracks(feed(one, [0, 1, 3, 4], SENSOR))
    assert [(m.seq, m.revision, m.gap) for m in first] == [(0, 0, 0), (1, 0, 0), (3, 0, 1), (4, 0, 0)]
    again = tracks(feed(one, [2], SENSOR))
    assert [(m.seq, m.revision, m.gap) for m in again] == [(2, 0, 0), (3, 1, 0), (4, 1, 0)]
    assert one.counters.gaps == 0
    assert (one.counters.inserted, one.counters.corrected) == (1, 2)


def test_later_than_the_window_is_late() -> None:
    """A frame behind the window is refused with a problem, counted, and changes nothing."""
    one = session()
    feed(one, [*range(5), *range(6, 30)], SENSOR)
    before = state_bytes(one.snapshot())
    (problem,) = problems(feed(one, [5], SENSOR))
    assert (problem.code, problem.seq, problem.path) == ("late", 5, "stamp_ns")
    assert re.fullmatch(r"Frame 5: it came too late, \d\.\d+ s before the newest one\.", problem.message)
    assert state_bytes(one.snapshot()) == before
    assert one.counters.late == 1


@pytest.mark.parametrize("bound", [{"rewind_frames": 5}, {"rewind_bytes": 3000}, {"rewind_ns": SECOND // 2}])
def test_the_window_is_bounded(bound: dict[str, int]) -> None:
    """By frames, by bytes and by time: what a session keeps for going back does not grow with the stream."""
    one = session(policy=replace(Policy(rewind_ns=10 * SECOND), **bound))
    sizes = []
    for seq in range(60):
        feed(one, [seq], SENSOR)
        sizes.append(len(one.snapshot().window))
    assert 0 < sizes[-1] == sizes[20] <= 6


def test_equal_stamps_go_by_number() -> None:
    """Frames of one stamp are tracked in the order of their numbers, whichever came first."""
    stamp = SENSOR.stamp_ns(1)
    frames = [SENSOR.detections(0), *(SENSOR.detections(seq, stamp_ns=stamp) for seq in (1, 2, 3))]
    states = []
    for order in ([0, 1, 2, 3], [0, 3, 1, 2], [3, 2, 1, 0]):
        one = session()
        for index in order:
            one.on_detections(frames[index], 0)
        states.append(state_bytes(one.snapshot()))
    assert len(set(states)) == 1


def test_the_first_frame_may_come_late() -> None:
    """A frame before the first one of a life begins that life: the id is the one that it has in order."""
    one = session()
    assert begun(feed(one, [1, 2], SENSOR)) == ["first"]
    outputs = feed(one, [0], SENSOR)
    assert begun(outputs) == ["first"]
    expected = session()
    feed(expected, [0], SENSOR)
    assert one.session == expected.session
    assert {message.session for message in tracks(outputs)} == {expected.session}


@pytest.mark.parametrize("shift_s", [3600.0, -3600.0, -3.0, -1.7])
def test_disorder_across_a_jump_of_the_clock(shift_s: float) -> None:
    """Frames from both sides of a jump go to the lives that they belong to."""
    after = replace(SENSOR, start_s=SENSOR.start_s + shift_s)
    frames = [SENSOR.detections(seq) for seq in range(5)] + [after.detections(seq) for seq in range(5, 9)]
    states, outputs = [], []
    for order in (range(9), [0, 1, 2, 3, 5, 4, 6, 8, 7], [0, 2, 6, 3, 5, 1, 4, 8, 7]):
        one, merged = session(), Merged()
        for index in order:
            merged.take(one.on_detections(frames[index], 0))
        states.append(state_bytes(one.snapshot()))
        outputs.append(merged.plain())
    assert states[0] == states[1] == states[2]
    assert outputs[0] == outputs[1] == outputs[2]


def test_a_found_gap_is_no_jump() -> None:
    """Frames behind a gap longer than the limit begin a new life, and go back to the old one when the gap is filled."""
    policy = Policy(rewind_ns=10 * SECOND)
    one, other = session(policy=policy), session(policy=policy)
    apart = [SENSOR.detections(seq, stamp_ns=SENSOR.stamp_ns(0) + seq * 3 * SECOND) for seq in range(4)]
    for index in (0, 2, 3, 1):
        one.on_detections(apart[index], 0)
    for index in range(4):
        other.on_detections(apart[index], 0)
    assert other.counters.new_epochs == 0
    assert state_bytes(one.snapshot()) == state_bytes(other.snapshot())


def test_a_late_frame_finds_its_cloud() -> None:
    """The cloud of a frame that is late itself is kept for it, though later frames were tracked meanwhile."""
    one, other = session(), session()
    for seq in range(4):
        other.on_points(SENSOR.points(seq), 0)
        other.on_detections(SENSOR.detections(seq, has_points=True), 0)
        one.on_points(SENSOR.points(seq), 0)
        if seq != 1:
            one.on_detections(SENSOR.detections(seq, has_points=True), 0)
    got = one.on_detections(SENSOR.detections(1, has_points=True), 0)
    assert all(message.cloud_used for message in tracks(got))
    assert state_bytes(one.snapshot()) == state_bytes(other.snapshot())


def late_cloud(*, allowed: bool) -> tuple[Session, Session, list[Output]]:
    """A session whose cloud 1 comes after the wait, one with all clouds in time, and what the late cloud brought."""
    policy = Policy(late_clouds=allowed)
    one, other = session(policy=policy), session(policy=policy)
    for seq in range(4):
        other.on_points(SENSOR.points(seq), 0)
        other.on_detections(SENSOR.detections(seq, has_points=True), 0)
        if seq != 1:
            one.on_points(SENSOR.points(seq), 0)
        one.on_detections(SENSOR.detections(seq, has_points=True), 0)
        one.on_tick(WAIT_NS)
    return one, other, one.on_points(SENSOR.points(1), WAIT_NS)


def test_a_late_cloud_corrects_by_setting() -> None:
    """With `late_clouds`, a cloud received after its frame was tracked gives the same result as a punctual one."""
    one, other, outputs = late_cloud(allowed=True)
    assert [(m.seq, m.revision, m.cloud_used) for m in tracks(outputs)] == [(1, 1, True), (2, 1, True), (3, 1, True)]
    assert one.counters.clouds_missed == 0
    assert state_bytes(one.snapshot()) == state_bytes(other.snapshot())


def test_a_late_cloud_is_not_used_without_the_setting() -> None:
    """By default, frames tracked without a cloud stay so."""
    one, _, outputs = late_cloud(allowed=False)
    assert outputs == []
    assert (one.counters.clouds_used, one.counters.clouds_missed) == (3, 1)


@settings(max_examples=30, deadline=None)
@given(st.permutations([*range(8), *range(100, 108)]))
def test_clouds_and_frames_may_come_in_any_order(order: list[int]) -> None:
    """However clouds and the frames they belong to overtake each other within the wait, the same state comes out."""
    one, merged = session(tracker=chained), Merged()
    for item in order:
        if item < 100:
            merged.take(one.on_detections(SENSOR.detections(item, has_points=True), 0))
        else:
            merged.take(one.on_points(SENSOR.points(item - 100, count=5), 0))
    other, expected = session(tracker=chained), Merged()
    for seq in range(8):
        expected.take(other.on_points(SENSOR.points(seq, count=5), 0))
        expected.take(other.on_detections(SENSOR.detections(seq, has_points=True), 0))
    assert state_bytes(one.snapshot()) == state_bytes(other.snapshot())
    assert merged.plain() == expected.plain()


def test_a_reset_is_a_wall() -> None:
    """A frame from before a reset is late: forgotten frames do not come back."""
    one = session()
    feed(one, [0, 1, 3], SENSOR)
    one.reset()
    assert [p.code for p in problems(feed(one, [2], SENSOR))] == ["late"]
    assert len(one.density.bernoulli) == 0
