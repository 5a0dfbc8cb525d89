"""Output at a fixed rate: tracks predicted to now by `predict_tracks`, while frames come, from the owner alone."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fusing import FRONT, FUSED, REAR
from optipmb_schemas import Detections, Problem, Tracks, decode
from optipmb_service.app.configuration import load
from optipmb_service.session.checkpoint import encode_checkpoint
from optipmb_service.streams import outbox, parts, sensor_meters, sources, stream
from optipmb_service.streams.profiles import Profiles
from optipmb_service.streams.stream import Stream
from registries import Around, packet_of, streams_of
from router import SECOND, Sensor

import optipmb
from optipmb.learning.hindsight import with_hindsight

MS = 1_000_000
SENSOR = Sensor()
PROFILE = optipmb.load_profile("nuscenes")
LATENCY_NS = 30 * MS
RATE = {"rate_hz": 20}


class Process(Around):
    """The streams of a process with its own clock, and their publications, each with its time.

    Args:
        outputs: the settings of all streams.
        wall_ns: what the system's time is ahead of the monotonic one.
    """

    def __init__(self, outputs: dict[str, Any], wall_ns: int = 0, **settings: Any) -> None:
        super().__init__()
        self.now_ns = 0
        self.wall_ns = wall_ns
        self.owns = True
        self.tracks: list[Tracks] = []
        self.now: list[tuple[int, bytes]] = []
        self.problems: list[Problem] = []
        self._armed: list[tuple[int, Callable[[], None]]] = []
        given = {"outputs": {"*/*/*": outputs} if outputs else {}, "recovery_wait_s": 0.0, **settings}
        self.streams = streams_of(self, tracker=optipmb.Tracker, reporter=self, arm=self._arm, **given)

    def _arm(self, wake: Callable[[], None], at_ns: int) -> None:
        self._armed.append((at_ns, wake))

    def monotonic_ns(self) -> int:
        """Return the monotonic time; it passes by `until` alone."""
        return self.now_ns

    perf_counter_ns = thread_time_ns = monotonic_ns

    def time_ns(self) -> int:
        return self.now_ns + self.wall_ns

    def until(self, now_ns: int) -> None:
        """Let time pass up to a moment, and wake who asked for a time before."""
        while self._armed and (first := min(self._armed, key=lambda one: one[0]))[0] < now_ns:
            self._armed.remove(first)
            self.now_ns = max(self.now_ns, first[0])
            first[1]()
            self.run()
        self.now_ns = now_ns

    def frame(self, message: Detections, at_ns: int | None = None) -> None:
        """Have a frame arrive, by default some time after its stamp."""
        self.until(message.stamp_ns + LATENCY_NS - self.wall_ns if at_ns is None else at_ns)
        arrived = replace(packet_of(message), wall_ns=self.time_ns(), now_ns=self.now_ns)
        self.streams.receive(arrived)
        self.run()

    def may_write(self, *_: object) -> bool:
        return self.owns

    def publish(self, payload: bytes, *_: object) -> None:
        self.tracks.append(decode(payload, Tracks))

    def publish_now(self, payload: bytes) -> None:
        self.now.append((self.now_ns, payload))

    def report(self, problem: Problem, _: int) -> None:
        self.problems.append(problem)

    def predicted(self) -> list[Tracks]:
        return [decode(payload, Tracks) for _, payload in self.now]


@pytest.fixture
def process(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Process]:
    """Make processes whose streams go by their clock."""

    def make(outputs: dict[str, Any], wall_ns: int = 0, **settings: Any) -> Process:
        made = Process(outputs, wall_ns or SENSOR.stamp_ns(0), **settings)
        for module in (outbox, parts, sensor_meters, sources, stream):
            monkeypatch.setattr(module, "time", made)
        return made

    return make


def columns(message: Tracks) -> dict[str, Any]:
    found = {name: np.array(getattr(message, name)) for name in optipmb.Tracks.described}
    return found | {"confirmed": found["confirmed"].astype(bool)}


def check(predicted: Tracks, tracks: Tracks) -> float:
    """Compare a message with the prediction of the tracks of its frame by the library; return for how long, s."""
    assert predicted.predicted_to_ns is not None
    ahead_s = (predicted.predicted_to_ns - tracks.stamp_ns) * 1e-9
    given = columns(tracks)
    paths = optipmb.predict_tracks(optipmb.Tracks(**given), [ahead_s], PROFILE)
    x, y, speed, yaw, yaw_rate, acceleration = paths.mean[:, 0].T
    survival = np.array([PROFILE.classes[tracks.labels[label]].survival for label in tracks.label])
    given |= {
        "center": np.column_stack((x, y, given["center"][:, 2])),
        "velocity": np.column_stack((speed * np.cos(yaw), speed * np.sin(yaw))),
        "yaw": yaw,
        "yaw_rate": yaw_rate,
        "acceleration": acceleration,
        "covariance": paths.covariance[:, 0],
        "existence": given["existence"] * survival ** (ahead_s / PROFILE.nominal_period),
        "age": given["age"] + ahead_s,
        "time_since_detection": given["time_since_detection"] + ahead_s,
        "detection": np.full(len(tracks.id), -1),
    }
    for name, column in columns(predicted).items():
        assert column.tobytes() == np.ascontiguousarray(given[name]).tobytes(), name
    described = set(Tracks.names) - set(Tracks.arrays) - {"predicted_to_ns", "delivery"}
    assert {name: getattr(predicted, name) for name in described} == {name: getattr(tracks, name) for name in described}
    return ahead_s


def test_tracks_are_those_of_the_library_predicted_to_the_present(process: Callable[..., Process]) -> None:
    """Of frames at 10 Hz, 20 outputs a second of the newest tracks, byte for byte, and boxes move on between frames."""
    one = process(RATE)
    for seq in range(21):
        one.frame(SENSOR.detections(seq))
    times = np.array([at for at, _ in one.now])
    assert len(times) == 2 * 20 + 1
    assert set(np.diff(times)) == {50 * MS}
    found = [(predicted.seq, round(check(predicted, one.tracks[predicted.seq]), 6)) for predicted in one.predicted()]
    assert found[:4] == [(0, 0.03), (0, 0.08), (1, 0.03), (1, 0.08)]
    assert len(one.tracks) == 21
    assert not one.problems


def test_tracks_are_predicted_to_the_present_less_the_delay(process: Callable[..., Process]) -> None:
    """States of 20 ms ago; where that is before the stamp, the states of the frame, with their detections."""
    one = process(RATE | {"delay_s": 0.04})
    for seq in range(4):
        one.frame(SENSOR.detections(seq))
    as_is, later = one.predicted()[-1], one.predicted()[-2]
    assert later.predicted_to_ns == SENSOR.stamp_ns(2) + 40 * MS
    assert check(later, one.tracks[2]) == pytest.approx(0.04)
    assert as_is.predicted_to_ns == as_is.stamp_ns == SENSOR.stamp_ns(3)
    same = {"predicted_to_ns": None, "delivery": None}
    assert as_is.model_copy(update=same) == one.tracks[3].model_copy(update=same)
    assert max(as_is.detection) >= 0


def test_with_a_delay_frames_since_tell_which_tracks_exist(process: Callable[..., Process]) -> None:
    """Frames of half a second ago as they were, with existence and `confirmed` by the frames that have come since."""
    one = process(RATE | {"delay_s": 0.5})
    for seq in range(12):
        one.frame(SENSOR.detections(seq, score=np.full(3, 0.3 if seq % 3 else 0.9)))
    assert one.now[0][0] >= SECOND // 2, "of a time before the first frame nothing is sent"
    changed = 0
    for at_ns, payload in one.now:
        message, wall_ns = decode(payload, Tracks), at_ns + one.wall_ns
        own = columns(one.tracks[message.seq])
        assert 400 * MS <= wall_ns - message.stamp_ns <= 500 * MS
        since = [each for each in one.tracks[message.seq + 1 :] if each.stamp_ns + LATENCY_NS <= wall_ns]
        wanted = own | with_hindsight([one.tracks[message.seq], *since], PROFILE)[0]
        assert all(column.tobytes() == wanted[name].tobytes() for name, column in columns(message).items())
        changed += wanted["existence"].tobytes() != own["existence"].tobytes()
    assert changed > 1


def test_after_a_kill_an_output_with_a_delay_goes_on_with_the_same_bytes(process: Callable[..., Process]) -> None:
    """From the checkpoint on, as soon as the delay has passed; before that nothing is sent, and nothing else."""
    outputs = RATE | {"delay_s": 0.3}
    messages = [SENSOR.detections(seq, score=np.full(3, 0.3 if seq % 3 else 0.9)) for seq in range(20)]
    whole = process(outputs)
    for message in messages:
        if message.seq == 8:
            whole.streams.keep_now()
        whole.frame(message)
    other = process(outputs)
    other.kept = dict(whole.kept)
    for message in messages[8:]:
        other.frame(message)
    bare = {"delivery": None}
    found = [one.model_copy(update=bare) for one in other.predicted()]
    assert len(found) > 10
    assert found == [one.model_copy(update=bare) for one in whole.predicted()][-len(found) :]


def test_stamps_ahead_of_the_clock_are_sent_as_they_are(process: Callable[..., Process]) -> None:
    """Nothing is predicted back."""
    one = process(RATE, SENSOR.stamp_ns(0) - SECOND // 5)
    for seq in range(3):
        one.frame(SENSOR.detections(seq), seq * SECOND // 10)
    assert [predicted.predicted_to_ns for predicted in one.predicted()] == [
        SENSOR.stamp_ns(seq) for seq in (0, 0, 1, 1, 2)
    ]


def test_a_late_frame_changes_the_next_output(process: Callable[..., Process]) -> None:
    """The corrected tracks of the newest frame are predicted, and nothing is sent again."""
    one = process(RATE | {"clock": "arrival"})
    for seq in (0, 1, 2, 4):
        one.frame(SENSOR.detections(seq))
    before = len(one.now)
    one.frame(SENSOR.detections(3), one.now_ns + 20 * MS)
    assert len(one.now) == before
    one.until(one.now_ns + 31 * MS)
    (predicted,) = one.predicted()[before:]
    assert (predicted.seq, predicted.revision) == (4, 1)
    assert predicted.predicted_to_ns == SENSOR.stamp_ns(4) + 50 * MS, "the newest stamp came 50 ms ago"
    check(predicted, one.tracks[-1])
    assert predicted.center.tobytes() != one.predicted()[before - 1].center.tobytes()


def test_of_two_sensors_the_newest_frame_counts(process: Callable[..., Process]) -> None:
    """By stamp, whichever arrived last."""
    one = process(RATE, fuse=("site/node/*",), wall_ns=FRONT.stamp_ns(0))
    newest = 0
    for seq in range(4):
        one.frame(FRONT.detections(seq))
        one.frame(REAR.detections(seq), one.now_ns + 60 * MS)  # with an older stamp than the frame before
    for predicted in one.predicted():
        assert predicted.stream == FUSED
        assert predicted.stamp_ns >= newest
        newest = predicted.stamp_ns
    behind = max(one.tracks, key=lambda tracks: (tracks.stamp_ns, tracks.sensor, tracks.revision))
    one.until(one.now_ns + 50 * MS)
    check(one.predicted()[-1], behind)


def test_a_silent_stream_has_no_output(process: Callable[..., Process]) -> None:
    """After `longest_s` boxes are neither frozen nor carried on; the next frame has output at once."""
    one = process(RATE | {"longest_s": 0.3})
    for seq in range(3):
        one.frame(SENSOR.detections(seq))
    one.until(2 * SECOND)
    last_ns, _ = one.now[-1]
    assert 0 <= SENSOR.stamp_ns(2) + 300 * MS - one.wall_ns - last_ns < 50 * MS
    one.frame(SENSOR.detections(30))
    assert one.now[-1][0] == one.now_ns > last_ns
    assert not one.problems


@pytest.mark.parametrize("clock", ["ahead", "set back"])
def test_a_silent_stream_has_no_output_whatever_the_clock(process: Callable[..., Process], clock: str) -> None:
    """Where stamps are ahead, and where the system's clock is set back, `longest_s` counts from the last arrival."""
    one = process(RATE | {"longest_s": 0.3})
    ahead_ns = 3600 * SECOND
    for seq in range(3):
        if clock == "ahead":
            one.wall_ns = SENSOR.stamp_ns(0) - ahead_ns
            one.frame(SENSOR.detections(seq), seq * SECOND // 10)
        else:
            one.frame(SENSOR.detections(seq))
    arrived_ns = one.now_ns
    if clock == "set back":
        one.wall_ns -= ahead_ns
    one.until(2 * SECOND)
    assert one.now
    assert one.now[-1][0] - arrived_ns <= 300 * MS


@pytest.mark.parametrize("away_s", [-1000.0, -1.0, 1.0, 1000.0])
def test_stamps_of_another_clock_are_a_problem(process: Callable[..., Process], away_s: float) -> None:
    """After 5 s, once; nothing is sent from then on, until stamps are right. By arrival such stamps are as good."""
    away_ns = round(away_s * SECOND)
    one = process(RATE, SENSOR.stamp_ns(0) - away_ns)
    for seq in range(80):
        one.frame(SENSOR.detections(seq), seq * SECOND // 10)
        assert len(one.problems) == (seq >= 50)
    assert [problem.code for problem in one.problems] == ["clock"]
    assert one.problems[0].received == f"{abs(away_s):.3f} s {'ahead' if away_s > 0 else 'behind'}"
    assert all(at < 5 * SECOND for at, _ in one.now)
    one.wall_ns += away_ns
    one.frame(SENSOR.detections(80), 8 * SECOND)
    assert one.now[-1][0] == 8 * SECOND

    other = process(RATE | {"clock": "arrival"}, SENSOR.stamp_ns(0) - away_ns)
    for seq in range(20):
        other.frame(SENSOR.detections(seq), seq * SECOND // 10)
    assert len(other.now) == 39
    assert [check(predicted, other.tracks[predicted.seq]) for predicted in other.predicted()[1::2]] == [0.05] * 19


def test_only_the_owner_sends(process: Callable[..., Process]) -> None:
    """Neither without the write lease nor after the stream was lost; with the lease again it goes on."""
    one = process(RATE | {"longest_s": 30})
    one.frame(SENSOR.detections(0))
    one.owns = False
    one.until(SECOND)
    assert len(one.now) == 1
    one.owns = True
    one.streams.resume()
    one.run()
    one.until(2 * SECOND)
    assert len(one.now) == 22
    monkey: Any = one
    monkey.holds = lambda _: False
    monkey.fence = lambda _: None
    one.streams.command(SENSOR.stream, Stream.on_lost, urgent=True)
    one.run()
    assert [problem.code for problem in one.problems] == ["superseded"]
    one.until(3 * SECOND)
    assert len(one.now) == 22


def test_a_reset_ends_the_output_until_the_next_frame(process: Callable[..., Process]) -> None:
    """Tracks of a discarded density are not predicted."""
    one = process(RATE)
    one.frame(SENSOR.detections(0))
    one.streams.command(SENSOR.stream, lambda stream: stream.deliver(stream.session.reset()), urgent=True)  # type: ignore[union-attr]  # it has one
    one.run()
    before = len(one.now)
    one.until(one.now_ns + 90 * MS)
    assert len(one.now) == before
    one.frame(SENSOR.detections(2))
    assert one.predicted()[-1].session == one.tracks[-1].session != one.tracks[0].session


def test_tracks_and_checkpoints_are_those_without_outputs(process: Callable[..., Process]) -> None:
    """Byte for byte, and the states at the stamp of the next frame equal the tracker's own prediction."""
    asking = optipmb.parse_parameters(PROFILE.model_dump() | {"horizons": [0.1]})
    made = []
    for outputs in ({"rate_hz": 10}, {}):
        one = process(outputs, profiles=Profiles("asking", (), {"asking": asking}))
        for seq in range(6):
            one.frame(SENSOR.detections(seq), None if seq else 0)
        one.streams.keep_now()
        made.append(one)
    one, other = made
    bare = {"delivery": None}
    assert [tracks.model_copy(update=bare) for tracks in one.tracks] == [
        tracks.model_copy(update=bare) for tracks in other.tracks
    ]
    assert encode_checkpoint(one.kept[SENSOR.stream]) == encode_checkpoint(other.kept[SENSOR.stream])
    assert not other.now
    for predicted, tracks in zip(one.predicted()[1:], one.tracks, strict=False):
        assert (predicted.seq, predicted.predicted_to_ns) == (tracks.seq, SENSOR.stamp_ns(tracks.seq + 1))
        assert tracks.path_position is not None
        assert tracks.path_yaw is not None
        assert predicted.center[:, :2].tobytes() == tracks.path_position[:, 0].tobytes()
        assert predicted.yaw.astype("f4").tobytes() == tracks.path_yaw[:, 0].tobytes()
        assert predicted.horizons is None


def test_the_first_pattern_that_matches_applies(tmp_path: Path) -> None:
    """In the order of the file."""
    file = tmp_path / "settings.toml"
    file.write_text('[outputs."garage/*/fused"]\nrate_hz = 5\n[outputs."garage/*/*"]\n')
    settings = load(file).settings
    found = [settings.output_of(name) for name in ("garage/a/fused", "garage/a/lidar", "yard/a/fused")]
    assert [one and one.rate_hz for one in found] == [5, 20, None]
