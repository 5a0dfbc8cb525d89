"""Clocks and identities of publishers over real Zenoh: faults are reported, and nothing is lost by them."""

import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from optipmb_schemas import Detections, Keys, Pose, Problem, ServiceStatus, SessionState, Tracks, decode
from optipmb_service.app.service import Service
from router import DEADLINE_S, SECOND, Node, Sensor, until
from routers import free_endpoint

KEYS = Keys()
SENSOR = Sensor()


def said(node: Node, code: str, stream: str = SENSOR.stream) -> list[Problem]:
    key = KEYS.problems(stream)
    found = [decode(payload, Problem) for at, payload, _ in node.problems_seen.items if at == key]
    return [one for one in found if one.code == code]


def state(node: Node) -> SessionState:
    return node.ask(KEYS.query(SENSOR.stream, "state"), SessionState)


def send(node: Node, stamps: Iterable[int], sensor: Sensor = SENSOR, first: int = 0) -> None:
    for seq, stamp_ns in enumerate(stamps, first):
        node.send(sensor.detections(seq, stamp_ns=stamp_ns))


@pytest.mark.parametrize("stamp_ns", [0, 1_700_000_000 * SECOND])
def test_a_clock_that_stands_still_is_reported(node: Node, stamp_ns: int) -> None:
    """Twenty frames with one stamp are a problem of their stream, and are tracked nevertheless."""
    send(node, [stamp_ns] * 20)
    problem = node.problem(SENSOR.stream, "clock")
    assert f"20 frames with the stamp {stamp_ns}: the clock does not advance" in problem.message
    assert problem.path == "stamp_ns"
    assert len(node.tracks(SENSOR.stream, 20)) == 20


@pytest.mark.parametrize(("unit", "per_second"), [("milliseconds", 10**3), ("microseconds", 10**6)])
def test_stamps_in_another_unit_are_reported(node: Node, unit: str, per_second: int) -> None:
    """Stamps that advance by thousands for a second that passes are called by their unit."""
    seq, ends = 0, time.monotonic() + DEADLINE_S
    while not said(node, "clock") and time.monotonic() < ends:
        node.send(SENSOR.detections(seq, stamp_ns=time.time_ns() * per_second // SECOND))
        seq += 1
        time.sleep(0.02)  # the stamps are of the true time
    assert {one.received.rpartition(": ")[2] for one in said(node, "clock")} == {f"stamps look like {unit}"}


@pytest.mark.parametrize("rate_hz", [0.25, 10, 200])
def test_a_recording_at_any_speed_is_not_reported(node: Node, rate_hz: float) -> None:
    """Stamps in nanoseconds that come as fast as they can be sent are no problem, however far apart they are."""
    send(node, (round(SECOND * (1000 + seq / rate_hz)) for seq in range(60)))
    node.tracks(SENSOR.stream, 60)
    assert said(node, "clock") == []


@pytest.mark.parametrize("frames", [30, 1100])
def test_numbers_that_begin_again_in_one_epoch_are_reported(node: Node, frames: int) -> None:
    """A publisher with a constant epoch that restarts at 0 is refused aloud, few frames or many after its start."""
    for first in range(0, frames, 100):  # no more than a queue takes
        send(node, map(SENSOR.stamp_ns, range(first, min(frames, first + 100))), first=first)
        node.tracks(SENSOR.stream, min(frames, first + 100))
    send(node, (SENSOR.stamp_ns(seq) for seq in range(frames, frames + 20)))
    problem = node.problem(SENSOR.stream, "duplicate_seq")
    assert problem.path == "seq"
    assert "a new epoch" in problem.expected
    until(lambda: state(node).refused == 20, "all are refused")
    assert (state(node).duplicates, state(node).late) == (0, 0)


def test_another_frame_with_the_number_of_one_that_came_is_reported(node: Node) -> None:
    """The stamp may be the same: what the frame contains is compared. A frame that is repeated is no problem."""
    node.send(*(SENSOR.detections(seq) for seq in range(20)), SENSOR.detections(3), SENSOR.detections(7, objects=2))
    assert node.problem(SENSOR.stream, "duplicate_seq").seq == 7
    assert [one.count for one in said(node, "duplicate_seq")] == [1]
    status = node.ask(KEYS.status("test"), ServiceStatus).sessions[0]
    assert (status.frames, status.duplicates, status.refused) == (20, 1, 1)


def test_a_repetition_after_a_restart_is_no_other_frame(
    start: Callable[..., tuple[Service, str]], tmp_path: Path
) -> None:
    """What a publisher's cache sends again to a service that was restarted is a duplicate, and no problem."""
    endpoint = free_endpoint()
    options: dict[str, Any] = {"store": str(tmp_path), "checkpoint_s": 0.1}
    for end in (20, 40):
        service, _ = start(listen=[endpoint], **options)
        with Node(endpoint) as node:
            node.send(*(SENSOR.detections(seq) for seq in range(end)))
            until(lambda node=node, end=end: state(node).seq == end - 1, "all are tracked")
            assert said(node, "duplicate_seq") == []
        service.stop()
    assert end == 40


@pytest.mark.parametrize("back_s", [1.2, 3.0, 4.9])
def test_a_clock_that_steps_back_ends_no_track(node: Node, back_s: float) -> None:
    """Of sixty frames two are refused, the restart is reported once, and every object keeps its id."""
    stamps = [SENSOR.stamp_ns(seq) - round(back_s * SECOND) * (seq >= 30) for seq in range(60)]
    send(node, stamps)
    received = node.tracks(SENSOR.stream, 58)
    assert [one.seq for one in received] == [*range(30), *range(32, 60)]
    assert {tuple(sorted(one.id.tolist())) for one in received[5:]} == {(1, 2, 3)}
    assert len({one.session for one in received}) == 2
    node.problem(SENSOR.stream, "restarted")  # it may come after the tracks
    assert [(one.received.partition(",")[0], one.count) for one in said(node, "restarted")] == [("clock", 1)]
    assert (state(node).frames, state(node).refused, state(node).late) == (58, 2, 0)


def test_a_recording_of_four_seconds_in_a_loop_is_tracked(node: Node) -> None:
    """Of two hundred frames two are refused at each of the four beginnings, though the sensor is elsewhere then."""
    for seq in range(200):
        pose = Pose(translation=np.array([3.0 * (seq % 40), 0, 0]), quaternion=np.array([1.0, 0, 0, 0]))
        node.send(SENSOR.detections(seq % 40, pose=pose, frame="sensor").model_copy(update={"seq": seq}))
    received = node.tracks(SENSOR.stream, 192)
    assert [one.seq % 40 for one in received[-38:]] == list(range(2, 40))
    ids = [set(one.id.tolist()) for one in received]
    assert not ids[39] & ids[-1]


def test_stamps_far_behind_that_are_few_change_nothing(node: Node) -> None:
    """Two frames in a row with stamps of two seconds ago are refused; the tracks go on in their session."""
    stamps = [SENSOR.stamp_ns(seq) - 2 * SECOND * (seq in {10, 11, 20}) for seq in range(30)]
    send(node, stamps)
    received = node.tracks(SENSOR.stream, 27)
    assert len({one.session for one in received}) == 1
    assert said(node, "restarted") == []


def test_sensors_of_one_session_step_back_together(start: Callable[..., tuple[Service, str]]) -> None:
    """A recording of two sensors in a loop is tracked again as soon as both are on the clock that stepped back."""
    _, endpoint = start(fuse=["site/*/lidar*"])
    sensors = [replace(SENSOR, stream=f"site/node/lidar-{one}", epoch=bytes([one]) * 16) for one in (1, 2)]
    with Node(endpoint) as node:
        for first in (0, 40, 80):
            for seq in range(first, first + 40):
                for shift_ns, sensor in enumerate(sensors):
                    node.send(sensor.detections(seq, stamp_ns=SENSOR.stamp_ns(seq - first) + shift_ns))
            expected = {(sensor.stream, seq) for sensor in sensors for seq in range(first + 20, first + 40)}

            def came(expected: set[tuple[str, int]] = expected) -> bool:
                items = node.tracks_seen.items
                tracks = [decode(one, Tracks) for at, one, _ in items if at == KEYS.tracks("site/node/fused")]
                return expected <= {(one.sensor or "", one.seq) for one in tracks}

            until(came, "the second half of the recording is tracked")


def stray(back_s: float = 0.0) -> Detections:
    """One frame of another publisher of the sensor's stream, sent between its frames 19 and 20."""
    at_ns = SENSOR.stamp_ns(19) + SECOND // 20 - round(back_s * SECOND)
    return replace(SENSOR, epoch=b"s" * 16).detections(0, stamp_ns=at_ns)


@pytest.mark.parametrize("back_s", [0.0, 0.5, -3600.0, 3600.0])
def test_one_stray_frame_locks_nobody_out(node: Node, back_s: float) -> None:
    """After a frame with another epoch and any stamp, the live publisher is tracked again in a second."""
    node.send(*map(SENSOR.detections, range(20)))
    node.tracks(SENSOR.stream, 20)
    node.send_plain(stray(back_s))
    node.tracks(SENSOR.stream, 21)
    node.send(*map(SENSOR.detections, range(20, 60)))
    received = node.tracks(SENSOR.stream, 21 + 30)[21:]
    assert [one.seq for one in received] == list(range(30, 60))
    problem = node.problem(SENSOR.stream, "duplicate_epoch")
    assert "stop one of the two" in problem.message
    assert "silent for 5 s" in problem.message
    assert problem.received == SENSOR.epoch.hex()
    if not back_s:
        assert set(received[-1].id.tolist()) == {1, 2, 3}


def test_a_stray_frame_locks_no_sensor_of_several_out(start: Callable[..., tuple[Service, str]]) -> None:
    """In a session of several sensors, too, the publisher that is alive is tracked again."""
    _, endpoint = start(fuse=["site/*/lidar*"], recovery_wait_s=0)
    with Node(endpoint) as node:
        node.send(*map(SENSOR.detections, range(20)))
        node.tracks("site/node/fused", 20)
        node.send_plain(stray())
        node.tracks("site/node/fused", 21)
        node.send(*map(SENSOR.detections, range(20, 60)))
        received = node.tracks("site/node/fused", 21 + 30)[21:]
    assert [one.seq for one in received] == list(range(30, 60))
    assert set(received[-1].id.tolist()) == {1, 2, 3}


def test_the_publisher_that_is_alive_is_tracked(node: Node) -> None:
    """A later publisher that ends gives the stream back to the earlier one, after `gap_limit_s` without a frame."""
    other = replace(SENSOR, epoch=b"o" * 16)
    node.send(*map(SENSOR.detections, range(10)))
    node.tracks(SENSOR.stream, 10)
    for seq in range(10, 20):
        node.send_plain(other.detections(seq - 10, stamp_ns=SENSOR.stamp_ns(seq)))
    node.tracks(SENSOR.stream, 20)
    node.send(*map(SENSOR.detections, range(20, 90)))
    received = node.tracks(SENSOR.stream, 20 + 20)
    assert [one.seq for one in received if one.epoch == other.epoch] == list(range(10))
    assert [one.seq for one in received[20:]] == list(range(70, 90))


def test_two_publishers_do_not_take_turns(node: Node) -> None:
    """While both send, the later one is tracked and the earlier one refused, whichever is faster."""
    other = replace(SENSOR, epoch=b"o" * 16)
    node.send(*map(SENSOR.detections, range(10)))
    for seq in range(10, 100):
        node.send_plain(SENSOR.detections(seq))
        if seq % 4 == 0:
            node.send_plain(other.detections(seq // 4, stamp_ns=SENSOR.stamp_ns(seq) + 1))
    until(lambda: state(node).received == 10 + 90 + 22, "all have come")
    assert state(node).new_epochs == 1
    assert len({one.session for one in node.tracks(SENSOR.stream, 10 + 2 + 22)}) == 1
