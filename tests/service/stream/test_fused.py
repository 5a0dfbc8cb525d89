"""Several sensors feed one session by turns: the results depend on their frames alone, and none harms another."""

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from fusing import FRONT, FUSED, REAR, SIDE, drive
from hypothesis import given, settings
from hypothesis import strategies as st
from optipmb_schemas import Detections, Pose
from optipmb_service.session.checkpoint import decode_checkpoint, encode_checkpoint, state_bytes
from optipmb_service.session.policy import MAX_SENSORS, Policy
from optipmb_service.session.session import Session
from router import SECOND, Sensor
from sessions import Failing, Merged, begun, chained, delayed, feed, problems, tracks

import optipmb

NUSCENES = optipmb.load_profile("nuscenes")


def fused(policy: Policy | None = None, **options: Any) -> Session:
    """A session of several sensors with a hashing tracker. It waits for nothing at its beginning."""
    policy = policy or Policy(recovery_wait_ns=0)
    return Session(FUSED, NUSCENES, policy, fused=True, **{"tracker": chained, **options})


def in_order(count: int = 6) -> list[Detections]:
    """Frames of three sensors by stamp; the publisher of one of them restarts in between."""
    again = delayed(replace(REAR, epoch=b"R" * 16), 0.1 * count)
    frames = [sensor.detections(seq) for sensor in (FRONT, REAR, SIDE) for seq in range(count)]
    frames += [again.detections(seq) for seq in range(count // 2)]
    return sorted(frames, key=lambda one: (one.stamp_ns, one.stream, one.seq))


def given_to(session: Session, frames: list[Detections]) -> list[Any]:
    return [output for frame in frames for output in session.on_detections(frame, 0)]


IN_ORDER = in_order()


@settings(max_examples=30, deadline=None)
@given(st.permutations(range(len(IN_ORDER))), st.integers(0, len(IN_ORDER)))
def test_any_interleaving_gives_the_state_of_frames_in_order(order: list[int], cut: int) -> None:
    """Tracks and state are the same bytes for any order of frames, and over a restart in between."""
    epochs = [IN_ORDER[at].epoch for at in order]
    first, later = epochs.index(REAR.epoch), epochs.index(b"R" * 16)
    if later < first:  # the order of arrival decides which publisher is the later one
        order[first], order[later] = order[later], order[first]
    one, other, merged, again = fused(), fused(), Merged(), Merged()
    merged.take(given_to(one, IN_ORDER))
    again.take(given_to(other, [IN_ORDER[at] for at in order[:cut]]))
    other = Session.restore(decode_checkpoint(encode_checkpoint(other.snapshot())), 0, tracker=chained)
    again.take(given_to(other, [IN_ORDER[at] for at in order[cut:]]), other.run)
    again.take(other.recovered(0), other.run)
    assert state_bytes(one.snapshot()) == state_bytes(other.snapshot())
    assert merged.plain() == again.plain()
    assert len(merged.newest) == len(IN_ORDER)


def test_tracks_name_the_session_and_the_sensor() -> None:
    """The stream belongs to the session, the sensor to the frame; equal stamps are ordered by sensor name."""
    one = fused()
    found = tracks(given_to(one, [SIDE.detections(0), REAR.detections(0), FRONT.detections(0)]))
    assert {m.stream for m in found} == {FUSED}
    assert [(m.sensor, m.epoch, m.revision) for m in found[-3:]] == [
        (FRONT.stream, FRONT.epoch, 0),
        (SIDE.stream, SIDE.epoch, 1),
        (REAR.stream, REAR.epoch, 1),
    ]


def test_gaps_and_duplicates_are_those_of_each_sensor() -> None:
    """Sequence numbers are counted by sensor, though publishers of one program may share an epoch."""
    one, side = fused(), replace(SIDE, epoch=FRONT.epoch)
    found = tracks(given_to(one, [FRONT.detections(0), side.detections(0), FRONT.detections(3), side.detections(1)]))
    assert [(m.sensor, m.seq, m.gap) for m in found if not m.revision] == [
        (FRONT.stream, 0, 0),
        (side.stream, 0, 0),
        (FRONT.stream, 3, 2),
        (side.stream, 1, 0),
    ]
    assert not given_to(one, [side.detections(1)])
    assert (one.counters.duplicates, one.counters.gaps) == (1, 2)


def test_a_sensor_that_starts_anew_ends_no_tracks() -> None:
    """Neither soon, nor after longer than the gap limit, nor with stamps of before, of which only these are refused."""
    one, policy = fused(), Policy()
    given_to(one, [FRONT.detections(0), REAR.detections(0)])
    session, away = one.session, policy.gap_limit_ns // SECOND + 2
    feed(one, range(1, away * 10), FRONT)
    again = delayed(replace(REAR, epoch=b"R" * 16), away - 0.3)
    assert [m.sensor for m in tracks(feed(one, [0], again)) if not m.revision] == [REAR.stream]
    third = delayed(again, -0.15)
    outputs = feed(one, range(3), replace(third, epoch=b"3" * 16))
    assert [(p.code, p.stream) for p in problems(outputs)] == [("late", REAR.stream)] * 2
    assert [m.seq for m in tracks(outputs) if m.sensor == REAR.stream] == [2]
    assert one.session == session
    assert one.counters.new_epochs == 2
    late = problems(given_to(one, [replace(again, epoch=b"R" * 16).detections(3)]))
    assert [(p.code, p.stream) for p in late] == [("duplicate_epoch", REAR.stream)]


def test_no_sensor_waits_for_another() -> None:
    """Neither for one that is silent, nor for one whose frame is held for its cloud."""
    one = fused()
    assert len(tracks(feed(one, range(3), FRONT))) == 3
    assert not feed(one, [0], REAR, has_points=True)
    assert one.state().queue == 1
    assert len(tracks(feed(one, [3], FRONT))) == 1
    found = tracks(one.on_tick(SECOND))
    assert [(m.sensor, m.seq, m.revision) for m in found] == [
        (REAR.stream, 0, 0),
        (FRONT.stream, 1, 1),
        (FRONT.stream, 2, 1),
        (FRONT.stream, 3, 1),
    ]


def test_a_cloud_is_that_of_its_sensor() -> None:
    """Clouds of other sensors at the same time are of no use, and a late one is put in where it belongs."""
    one = fused(Policy(late_clouds=True, recovery_wait_ns=0))
    one.on_points(SIDE.points(0, epoch=b"c" * 16), 0)
    assert not feed(one, [0], FRONT, has_points=True)
    assert [m.cloud_used for m in tracks(feed(one, [0], SIDE, has_points=True))] == [True]
    given_to(one, [FRONT.detections(1), SIDE.detections(1, has_points=None)])
    one.on_tick(SECOND)
    outputs = one.on_points(FRONT.points(1, epoch=b"c" * 16), SECOND)
    assert [(m.sensor, m.cloud_used) for m in tracks(outputs)] == [(FRONT.stream, True), (SIDE.stream, False)]


def test_one_wrong_clock_is_refused_and_all_of_them_are_believed() -> None:
    """A sensor hours ahead harms no other one, however long it sends; when most are there, the session restarts."""
    one, wrong = fused(), delayed(REAR, 3600.0)
    given_to(one, [FRONT.detections(0), SIDE.detections(0), REAR.detections(0)])
    session = one.session
    for seq in range(1, 100):
        found = tracks(given_to(one, [FRONT.detections(seq), SIDE.detections(seq)]))
        assert [m.sensor for m in found] == [FRONT.stream, SIDE.stream]
        assert [(p.code, p.stream) for p in problems(feed(one, [seq], wrong))] == [("time_jump", REAR.stream)]
    assert one.session == session
    outputs = feed(one, range(100, 103), delayed(FRONT, 3600.0))
    assert begun(outputs) == ["jump"]
    assert [(p.code, p.stream) for p in problems(outputs)][-1] == ("restarted", FRONT.stream)
    assert one.session != session
    assert all(tracks(feed(one, [seq], delayed(sensor, 3600.0))) for sensor in (FRONT, REAR, SIDE) for seq in (103,))


STEPS = [-20.0, -4.95, -1.2, 0.5, 1.05, 1.2, 2.5, 4.95, 5.05, 20.0]


@pytest.mark.parametrize("step_s", STEPS)
@pytest.mark.parametrize("sensors", [2, 3, 5])
def test_the_clock_of_a_session_follows_most_sensors(sensors: int, step_s: float) -> None:
    """At any step of one clock the others lose no frame, and the one is refused and named unless it fits in."""
    streams = [Sensor(f"site/node/s{k}", bytes([k]) * 16, start_s=10_000.0 + 0.03 * k) for k in range(sensors)]
    odd = streams[int(10 * step_s) % sensors]
    one, outputs = fused(), list[Any]()
    for seq in range(50):
        for sensor in streams:
            moved = delayed(sensor, step_s) if sensor is odd and seq >= 10 else sensor
            outputs += one.on_detections(moved.detections(seq), round(seq * SECOND / 10))
    tracked = Counter(m.sensor for m in tracks(outputs) if not m.revision)
    own = tracked.pop(odd.stream)
    assert tracked == {sensor.stream: 50 for sensor in streams if sensor is not odd}
    assert own == 50 - len(problems(outputs))
    assert {p.stream for p in problems(outputs)} == ({odd.stream} if own < 50 else set())
    assert own == 50 if abs(step_s) < 1 else own <= 11 or abs(step_s) < 1.1  # one may lie before all others
    assert set(begun(outputs)) == {"first"}


def test_a_pause_of_all_sensors_loses_nothing() -> None:
    """All frames after a gap are tracked in one session: when most sensors are back, or when no other one comes."""
    for back in ((FRONT, SIDE, REAR), (FRONT,)):
        one = fused()
        outputs = given_to(one, [sensor.detections(seq) for seq in range(10) for sensor in (FRONT, SIDE, REAR)])
        outputs += given_to(one, [sensor.detections(seq) for seq in range(40, 50) for sensor in back])
        outputs += one.on_tick(SECOND)
        assert len([m for m in tracks(outputs) if not m.revision]) == 30 + 10 * len(back)
        assert not problems(outputs)
        assert begun(outputs) == ["first"]


@pytest.mark.parametrize(("wait_s", "refused"), [(0.5, REAR.stream), (1.5, FRONT.stream)])
def test_a_sensor_ahead_of_one_that_pauses_waits_as_long_as_a_frame_may_be_late(wait_s: float, refused: str) -> None:
    """It is refused if the other one comes back on the old clock meanwhile; else that one is late."""
    one, outputs = fused(), list[Any]()
    given_to(one, [sensor.detections(seq) for seq in range(10) for sensor in (FRONT, REAR)])
    paused = round(10 * wait_s)
    for k in range(30):
        outputs += one.on_detections(delayed(REAR, 2.0).detections(10 + k), k * SECOND // 10)
        outputs += one.on_tick(k * SECOND // 10)
        if k >= paused:
            outputs += one.on_detections(FRONT.detections(10 + k - paused), k * SECOND // 10)
    assert {p.stream for p in problems(outputs)} == {refused}
    assert {m.sensor for m in tracks(outputs)} == {FRONT.stream, REAR.stream} - {refused}


@pytest.mark.parametrize("drifts", [True, False])
def test_a_clock_that_drifts_ahead_is_left_behind(*, drifts: bool) -> None:
    """Most sensors get their session back within the gap limit, whether one drifts away or began ahead."""
    one, policy, outputs = fused(), Policy(), list[Any]()
    for seq in range(200):
        ahead_s = min(2.0, 0.05 * seq) if drifts else 2.0
        now_ns = round(seq * SECOND / 10)
        for sensor in (delayed(REAR, ahead_s), FRONT, SIDE):
            outputs += one.on_detections(sensor.detections(seq), now_ns)
    assert begun(outputs).count("jump") == 1
    last = [m.sensor for m in tracks(outputs) if m.seq >= 190]
    assert Counter(last) == {FRONT.stream: 10, SIDE.stream: 10}
    lost = 200 - len([m for m in tracks(outputs) if m.sensor == FRONT.stream and not m.revision])
    assert lost <= 10 * policy.gap_limit_ns / SECOND + 2
    assert {p.stream for p in problems(outputs)[-10:]} == {REAR.stream}


def test_a_clock_that_nobody_moves_is_left() -> None:
    """Where the others are silent, a sensor whose stamps jumped is believed after the gap limit of its own time."""
    one, later = fused(), delayed(REAR, -3600.0)
    given_to(one, [FRONT.detections(0), REAR.detections(0)])
    outputs = feed(one, range(1, 60), later)
    refused = [p for p in problems(outputs) if p.code == "time_jump"]
    assert 50 <= len(refused) <= 52
    assert begun(outputs) == ["jump"]
    restored = Session.restore(decode_checkpoint(encode_checkpoint(one.snapshot())), 0, tracker=chained)
    assert len(tracks([*feed(restored, range(60, 63), later), *restored.recovered(0)])) == 3


def test_a_pose_is_believed_when_all_sensors_say_the_same() -> None:
    """One sensor reported elsewhere is refused; when the whole vehicle has moved, the session restarts once."""

    def at(sensor: Sensor, seq: int, x: float) -> Detections:
        return sensor.detections(seq, pose=Pose(translation=np.array([x, 0, 0]), quaternion=np.array([1.0, 0, 0, 0])))

    one = fused()
    given_to(one, [at(FRONT, 0, 0.0), at(REAR, 0, 0.0)])
    for seq in range(1, 20):
        outputs = given_to(one, [at(FRONT, seq, 0.0), at(REAR, seq, 1e5)])
        assert [(p.code, p.stream) for p in problems(outputs)] == [("astray", REAR.stream)]
        assert [m.sensor for m in tracks(outputs)] == [FRONT.stream]
    outputs = [output for seq in range(20, 30) for output in given_to(one, [at(FRONT, seq, 1e5), at(REAR, seq, 1e5)])]
    assert begun(outputs) == ["pose"]
    assert [m.sensor for m in tracks(outputs)][-4:] == [FRONT.stream, REAR.stream] * 2


def test_a_step_that_fails_quarantines_its_sensor() -> None:
    """The others go on with the same density; the sensor comes back when its publisher restarts."""
    one = fused(tracker=Failing)
    given_to(one, [FRONT.detections(0), REAR.detections(0)])
    session = one.session
    outputs = given_to(one, [REAR.detections(1, objects=7), FRONT.detections(1), REAR.detections(2)])
    assert [(p.code, p.stream) for p in problems(outputs)] == [("internal", REAR.stream), ("quarantined", REAR.stream)]
    assert [m.sensor for m in tracks(outputs)] == [FRONT.stream]
    assert one.state().state == "running"
    one = Session.restore(decode_checkpoint(encode_checkpoint(one.snapshot())), 0, tracker=Failing)
    one.recovered(0)
    assert [p.code for p in problems(feed(one, [3], REAR))] == ["quarantined"]
    assert tracks(feed(one, [4], delayed(replace(REAR, epoch=b"R" * 16), 0.1)))
    assert one.session == session


def test_a_session_takes_so_many_sensors() -> None:
    """One more is refused on its own stream."""
    one = fused()
    for number in range(MAX_SENSORS):
        feed(one, [0], replace(FRONT, stream=f"site/node/s{number}"))
    outputs = feed(one, [0], replace(FRONT, stream="site/node/more"))
    assert [(p.code, p.stream) for p in problems(outputs)] == [("refused", "site/node/more")]
    assert len(one.density.bernoulli) == 1


def test_a_sensor_that_is_silent_makes_room_for_another() -> None:
    """Sensor names may come and go for ever: beyond the limit of a session, the longest silent ones are forgotten.

    So it goes on when it was written down and restored in between.
    """
    one = fused(policy := Policy(recovery_wait_ns=0, rewind_ns=4 * SECOND))
    names = [f"site/node/s{number}" for number in range(6 * 30)]
    for number, name in enumerate(names):
        passed_s = 3.0 * (number // 30) + 0.01 * (number % 30)
        assert len(tracks(feed(one, [0], delayed(replace(FRONT, stream=name), passed_s)))) == 1
        if number % 30 == 29:
            assert len(tracks(feed(one, [number], delayed(FRONT, passed_s - 0.1 * number + 0.001)))) == 1
            one = Session.restore(decode_checkpoint(encode_checkpoint(one.snapshot())), 0, policy, tracker=chained)
            one.recovered(0)
    for kept in (one.sensors, one._window.head.sensors, one._timeline.seen):
        assert len(kept) == MAX_SENSORS
        assert names[-1] in kept
        assert FRONT.stream in kept


def test_what_is_remembered_of_sensors_is_bounded() -> None:
    """Names may come, go and come again without a restart, too; one in between changes neither state nor tracks."""
    one, other, merged, again = fused(), fused(), Merged(), Merged()
    for seq in range(400):  # twenty of them were heard lately, and each comes again when it is forgotten
        frame = replace(FRONT, stream=f"site/node/s{seq * 7 % 150}").detections(seq)
        merged.take(given_to(one, [frame]))
        if seq % 90 == 0:
            other = Session.restore(decode_checkpoint(encode_checkpoint(other.snapshot())), 0, tracker=chained)
            other.recovered(0)
        again.take(given_to(other, [frame]), other.run)
    assert len(one._timeline.seen) == MAX_SENSORS
    assert len(one._timeline.clock) == MAX_SENSORS
    assert state_bytes(one.snapshot()) == state_bytes(other.snapshot())
    assert merged.plain() == again.plain()


class Tired(optipmb.Tracker):
    def step(self, density: optipmb.Density, frame: optipmb.Frame) -> optipmb.StepResult:
        if len(frame.score) == 7:
            raise optipmb.EffortError("pairs", "at most 7", "8")
        return super().step(density, frame)


def test_a_jump_stays_believed_when_its_first_frame_is_refused() -> None:
    """The frame with which all agree needs too much computing: also after a restart the new clock is the session's."""
    one, later = fused(tracker=Tired), delayed(FRONT, 3600.0)
    feed(one, [0], FRONT)
    assert [p.code for p in problems(feed(one, range(100, 103), later, objects=7))][-1] == "overload"
    restored = Session.restore(decode_checkpoint(encode_checkpoint(one.snapshot())), 0, tracker=Tired)
    restored.recovered(0)
    for session in (one, restored):
        outputs = feed(session, [103], later)
        assert (begun(outputs), len(tracks(outputs))) == (["jump"], 1)
    assert state_bytes(restored.snapshot()) == state_bytes(one.snapshot())


def test_after_a_restart_the_caches_of_all_sensors_are_waited_for() -> None:
    """One cache may come before another, each longer than the window: nothing is late."""
    policy = Policy(rewind_ns=SECOND // 2)
    first = replace(policy, recovery_wait_ns=0)
    one, other, merged, again = fused(first), fused(first), Merged(), Merged()
    frames = in_order(40)
    merged.take(given_to(one, frames))
    again.take(given_to(other, frames[:20]))
    other = Session.restore(decode_checkpoint(encode_checkpoint(other.snapshot())), 0, policy, tracker=chained)
    rest = sorted(frames[18:], key=lambda frame: frame.stream)
    again.take(given_to(other, rest), other.run)
    again.take(other.recovered(0), other.run)
    assert other.counters.late == 0
    assert merged.plain() == again.plain()
    assert state_bytes(one.snapshot()) == state_bytes(other.snapshot())


def test_when_a_session_begins_the_caches_of_all_sensors_are_waited_for() -> None:
    """Frames faster than real time are held until the wait is over; punctual frames are not."""
    one, merged, frames = Session(FUSED, NUSCENES, fused=True, tracker=chained), Merged(), in_order(40)
    other, again = fused(), Merged()
    merged.take(given_to(one, sorted(frames, key=lambda frame: frame.stream)))
    assert len(merged.newest) < len(frames)
    merged.take(one.on_tick(2 * SECOND))
    again.take(given_to(other, frames))
    assert one.counters.late == 0
    assert merged.plain() == again.plain()
    live = Session(FUSED, NUSCENES, fused=True, tracker=chained)
    for frame in frames:
        now_ns = frame.stamp_ns - frames[0].stamp_ns
        assert tracks(live.on_detections(frame, now_ns))
    assert state_bytes(live.snapshot()) == state_bytes(other.snapshot())


def test_a_cache_that_is_handed_over_slowly_leaves_room_for_another() -> None:
    """Two seconds of one sensor come within 0.3 s; frames of another one, which began earlier, are not late."""
    one, frames = fused(Policy()), drive(40)
    other, merged, again = fused(), Merged(), Merged()
    rear, front = ([frame for frame in frames if frame.stream == sensor.stream] for sensor in (REAR, FRONT))
    assert front[0].stamp_ns < rear[0].stamp_ns
    for frame in rear[:20]:
        merged.take(one.on_detections(frame, 15_000_000 * frame.seq))
    for frame in front + rear[20:]:
        merged.take(one.on_detections(frame, 300_000_000))
    merged.take(one.recovered(400_000_000))
    again.take(given_to(other, frames))
    assert one.counters.late == 0
    assert merged.plain() == again.plain()


def test_a_silent_sensor_holds_up_nobody_for_longer_than_the_wait_for_recovery() -> None:
    """After a restart a sensor that does not come back is waited for as long as missing frames are."""
    one = fused()
    given_to(one, [FRONT.detections(0), REAR.detections(0)])
    one = Session.restore(decode_checkpoint(encode_checkpoint(one.snapshot())), 0, tracker=chained)
    assert not feed(one, range(1, 4), FRONT)
    assert one.deadline_ns == 2 * SECOND
    assert [m.seq for m in tracks(one.on_tick(2 * SECOND))] == [1, 2, 3]
    assert not one.arrivals.waiting


@pytest.mark.parametrize("close", [False, True])
def test_a_session_that_was_closed_takes_any_clock(close: bool) -> None:  # noqa: FBT001 - pytest's way
    """A recording is played again: after a session was closed its first frames are tracked, else refused."""
    one = fused()
    given_to(one, IN_ORDER)
    if close:
        from optipmb_service.session.checkpoint import forgotten  # noqa: PLC0415 - of the closing alone

        one.reset()
        one = Session.restore(forgotten(one.snapshot()), 0, tracker=chained)
    outputs = feed(one, range(2), delayed(replace(FRONT, epoch=b"2" * 16), -100.0))
    assert (len(tracks(outputs)), len(problems(outputs))) == ((2, 0) if close else (0, 2))


# With the tracker


def test_a_car_keeps_its_id_from_one_sensor_to_another() -> None:
    """From the front sensor's view through a gap into the rear sensor's, though each sees nothing for long."""
    one = fused(tracker=optipmb.Tracker)
    found = tracks(given_to(one, drive()))
    seen = {name: {int(i) for m in found if m.sensor == name for i in m.id} for name in (FRONT.stream, REAR.stream)}
    assert seen[FRONT.stream] == seen[REAR.stream] == {1}
    by = {m.sensor for m in found if (m.detection >= 0).any()}
    assert by == {FRONT.stream, REAR.stream}
    assert len(found[-1].id) == 1
