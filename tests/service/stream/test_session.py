"""A session as a function of its messages: order, clouds, restarts, failures, commands."""

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import sessions
from optipmb_schemas import PATHS
from optipmb_service.session.checkpoint import decode_checkpoint, encode_checkpoint
from optipmb_service.session.identity import Incarnation
from optipmb_service.session.outputs import CommandRefusedError, Output
from optipmb_service.session.policy import Policy
from optipmb_service.session.session import Session
from router import SECOND, Sensor, plain
from sessions import begun, problems, tracks

import optipmb

NUSCENES = optipmb.load_profile("nuscenes")
WAIT_NS = Policy().cloud_wait_ns
SENSOR = Sensor()
LOST = 10


def session(**changes: Any) -> Session:
    return Session(SENSOR.stream, NUSCENES, instance="test", **changes)


def feed(one: Session, seqs: Any, sensor: Sensor = SENSOR, **changes: Any) -> list[Output]:
    return sessions.feed(one, seqs, sensor, **changes)


def test_tracks_say_what_made_them() -> None:
    """Tracks carry the header of their frame, the profile, and indices into the sender's own arrays."""
    message = tracks(feed(session(), range(5)))[-1]
    sent = SENSOR.detections(4)
    assert (message.stream, message.epoch, message.seq, message.stamp_ns) == (
        sent.stream,
        sent.epoch,
        4,
        sent.stamp_ns,
    )
    assert (message.profile, message.labels) == ("nuscenes", NUSCENES.labels)
    assert message.labels[message.label[0]] == "car"
    assert not message.cloud_used
    assert len(message.id) == 3
    found = sent.center[message.detection]
    assert np.abs(message.center - found).max() < 0.5


def test_duplicates_change_nothing() -> None:
    """Frames that come again are counted and leave density and output as they were."""
    one, other = session(), session()
    expected = tracks(feed(one, range(6)))
    got = tracks(feed(other, [0, 1, 1, 2, 0, 3, 4, 4, 4, 5]))
    assert [plain(a) for a in expected] == [plain(b) for b in got]
    assert other.counters.duplicates == 4


def test_gaps_are_counted_and_published() -> None:
    """The tracks after lost frames say how many are missing."""
    one = session()
    assert [message.gap for message in tracks(feed(one, [3, 4, 8, 9, 11]))] == [0, 0, 3, 0, 1]
    assert one.state().gaps == 4


def test_a_restarted_publisher_continues() -> None:
    """Frames of a new epoch that go on in time keep the session and its track ids."""
    one = session()
    before = tracks(feed(one, range(5)))[-1]
    again = replace(SENSOR, epoch=b"b" * 16, start_s=SENSOR.start_s + 0.5)
    after = tracks([*one.on_detections(again.detections(0, center=SENSOR.detections(5).center), 0)])[0]
    assert after.session == before.session
    assert list(after.id) == list(before.id)
    assert one.counters.new_epochs == 1


@pytest.mark.parametrize("shift_s", [-3600.0, -0.5, 3600.0])
def test_a_jump_begins_a_new_session_without_reusing_ids(shift_s: float) -> None:
    """A replay or a reset clock starts over: new session id, higher track ids."""
    one = session()
    before = tracks(feed(one, range(5)))[-1]
    again = replace(SENSOR, epoch=b"b" * 16, start_s=SENSOR.start_s + shift_s)
    outputs = feed(one, range(5), again)
    after = tracks(outputs)
    assert begun(outputs) == ["publisher"]
    assert {message.session for message in after} != {before.session}
    assert len({message.session for message in after}) == 1
    assert min(after[-1].id) > max(before.id)
    assert one.state().session == after[-1].session


def test_session_ids_depend_on_where_a_session_began() -> None:
    """A service that was restarted and joins later does not give a new session an id that was used."""
    assert tracks(feed(session(), [0]))[0].session == tracks(feed(session(), [0]))[0].session
    assert tracks(feed(session(), [0]))[0].session != tracks(feed(session(), [1]))[0].session
    assert (
        tracks(feed(session(), [0]))[0].session != tracks(feed(session(incarnation=Incarnation(1, 1)), [0]))[0].session
    )


def test_session_ids_depend_on_how_tracks_are_joined() -> None:
    """Sessions of one stream have the same id only where they have the same settings of joining."""
    ways = [None, optipmb.Rejoin(), optipmb.Rejoin(gap_s=5.0), optipmb.Rejoin(embedding_model="reid-7")]
    ids = [tracks(feed(session(policy=Policy(rejoin=how)), [0]))[0].session for how in [*ways, *ways]]
    assert ids[:4] == ids[4:]
    assert len(set(ids)) == 4


@pytest.mark.parametrize("wait_ns", [WAIT_NS, 0])
def test_a_cloud_before_its_frame_is_used_at_once(wait_ns: int) -> None:
    """A frame whose cloud is there does not wait, and has the cloud where none is waited for."""
    one = session(policy=Policy(cloud_wait_ns=wait_ns))
    one.on_points(SENSOR.points(0), 0)
    message = tracks(one.on_detections(SENSOR.detections(0, has_points=True if wait_ns else None), 0))[0]
    assert message.cloud_used
    assert (one.counters.clouds_used, one.deadline_ns) == (1, None)


def test_a_frame_waits_for_its_cloud() -> None:
    """A frame with has_points waits and goes when its cloud comes, in time."""
    one = session()
    assert tracks(one.on_detections(SENSOR.detections(0, has_points=True), 5)) == []
    assert one.deadline_ns == 5 + WAIT_NS
    assert tracks(one.on_tick(4 + WAIT_NS)) == []
    message = tracks(one.on_points(SENSOR.points(0), 4 + WAIT_NS))[0]
    assert message.cloud_used
    assert one.counters.clouds_missed == 0
    assert one.deadline_ns is None


def test_a_cloud_that_never_comes_delays_by_the_wait_only() -> None:
    """At the deadline the frame goes on without and says so; the cloud coming later is not used."""
    one = session()
    one.on_detections(SENSOR.detections(0, has_points=True), 0)
    message = tracks(one.on_tick(WAIT_NS))[0]
    assert not message.cloud_used
    assert (one.counters.clouds_used, one.counters.clouds_missed) == (0, 1)
    assert one.on_points(SENSOR.points(0), WAIT_NS + 1) == []


def test_a_frame_that_says_nothing_waits_only_where_clouds_come() -> None:
    """Without has_points, a frame waits if the stream has sent a cloud lately; with False never."""
    one = session()
    assert len(tracks(feed(one, [0]))) == 1
    one.on_points(SENSOR.points(0), 0)
    assert tracks(feed(one, [1])) == []
    assert len(tracks(one.on_tick(WAIT_NS))) == 1
    assert len(tracks(feed(one, [2], has_points=False))) == 1
    assert len(tracks(feed(one, [30]))) == 1


def test_frames_keep_their_order_while_one_waits() -> None:
    """A frame that needs no cloud does not overtake one that waits; both go when the first one's cloud comes."""
    one = session()
    assert feed(one, [0], has_points=True) == []
    assert feed(one, [1], has_points=False) == []
    assert one.state().queue == 2
    assert [message.seq for message in tracks(one.on_points(SENSOR.points(0), 1))] == [0, 1]


def test_a_reset_takes_no_longer_than_it_may(monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames that are held go before it while there is time; those left are refused, and taken when they come again."""
    monkeypatch.setattr("optipmb_service.session.session.FLUSH_NS", 0)
    one = session()
    feed(one, range(20), has_points=True)
    outputs = one.reset()
    assert len(tracks(outputs)) == 1
    found = problems(outputs)
    assert [(one.code, one.seq, one.count) for one in found] == [("overload", 1, 19)]
    assert (one.held, one.counters.refused) == (0, 19)
    assert len(tracks(feed(one, range(1, 20), has_points=False))) == 19


def test_frames_that_overtook_each_other_while_held_are_put_in_order() -> None:
    """While nothing is processed yet, order of arrival does not matter."""
    one, other = session(), session()
    feed(one, [1, 0, 2], has_points=True)
    feed(other, [0, 1, 2], has_points=True)
    ours, theirs = tracks(one.on_tick(WAIT_NS)), tracks(other.on_tick(WAIT_NS))
    assert [plain(a) for a in ours] == [plain(b) for b in theirs]


def test_the_clouds_of_a_stopped_publisher_are_not_used() -> None:
    """A cloud left over from a replay is not taken for the next replay's cloud of the same stamp."""
    one = session()
    feed(one, range(3))
    one.on_points(SENSOR.points(1), 0)
    again = replace(SENSOR, epoch=b"b" * 16)
    got = tracks([*feed(one, [0, 1], again, has_points=True), *one.on_tick(WAIT_NS)])
    assert [message.cloud_used for message in got] == [False, False]


def test_clouds_are_bounded() -> None:
    """Clouds without frames do not gather: the oldest go."""
    one = session(policy=Policy(clouds=4))
    for seq in range(10):
        one.on_points(SENSOR.points(seq), 0)
    got = tracks(feed(one, [5, 6], has_points=True) + one.on_tick(WAIT_NS))
    assert [message.cloud_used for message in got] == [False, True]


def test_one_lost_cloud_costs_one_frame_its_cloud() -> None:
    """Where the wait is longer than the clouds kept, one lost cloud does not push those off that come behind it.

    Twenty frames a second, a wait of a second, eight clouds kept: every frame but one is tracked with its cloud.
    """
    one = session(policy=Policy(clouds=8, cloud_wait_ns=SECOND))
    got = []
    for seq in range(100):
        now_ns = seq * SECOND // 20
        got += one.on_tick(now_ns)
        if seq != LOST:
            got += one.on_points(SENSOR.points(seq), now_ns)
        got += one.on_detections(SENSOR.detections(seq, has_points=True), now_ns)
    used = {message.seq: message.cloud_used for message in tracks([*got, *one.flush()])}
    assert used == {seq: seq != LOST for seq in range(100)}


def test_frames_of_a_cache_wait_for_their_clouds() -> None:
    """After a restart hundreds of frames come from a publisher's cache before its clouds do: each gets its own."""
    one = session(policy=Policy(cloud_wait_ns=30 * SECOND))
    outputs = [one.on_detections(SENSOR.detections(seq, has_points=True), seq) for seq in range(200)]
    assert not any(tracks(some) for some in outputs)
    got = [message for seq in range(200) for message in tracks(one.on_points(SENSOR.points(seq), SECOND))]
    assert [(message.seq, message.cloud_used) for message in got] == [(seq, True) for seq in range(200)]


def test_unknown_classes_are_left_out_and_told_once() -> None:
    """Objects of classes the profile lacks are counted in every frame and reported once per session and class."""
    one = session()
    labels = ("car", "dog", "cat", "unused")
    outputs = feed(one, range(3), labels=labels, label=np.array([0, 1, 2]))
    assert [message.ignored for message in tracks(outputs)] == [2, 2, 2]
    assert [(p.code, p.received, p.count) for p in problems(outputs)] == [
        ("unknown_class", "'dog'", 1),
        ("unknown_class", "'cat'", 1),
    ]
    assert len(problems(one.reset() and feed(one, [3], labels=labels, label=np.array([0, 1, 2])))) == 2


def test_of_endless_unknown_classes_so_many_are_told_as_are_remembered() -> None:
    """256, however they come; all of their objects are counted as ignored."""
    one = session()
    outputs: list[Output] = []
    for seq in range(3):
        labels = tuple(f"thing-{seq}-{k}" for k in range(100))
        outputs += feed(one, [seq], labels=labels, label=np.arange(100), objects=100)
    assert [message.ignored for message in tracks(outputs)] == [100] * 3
    assert len({p.received for p in problems(outputs) if p.code == "unknown_class"}) == len(problems(outputs)) == 256


def test_a_score_filter_that_removes_most_of_a_class_is_reported_once() -> None:
    """The class whose scores lie below the filter of the profile is reported with its share, and no other class."""
    one, scores = session(), np.array([0.001, 0.9, 0.001])
    outputs = feed(one, range(600), labels=("car", "pedestrian"), label=np.array([0, 1, 0]), score=scores)
    (problem,) = [one for one in problems(outputs) if one.code == "score_filter"]
    assert problem.path == "car.score"
    assert problem.received == "100 of 100 below 0.246"
    assert not problems(feed(session(), range(500), score=np.full(3, 0.9)))


def test_an_estimated_motion_of_the_sensor_is_reported_once() -> None:
    """A sensor that drives past parked cars and sends no poses is reported, one that stands is not."""
    rng = np.random.default_rng(5)
    cars, yaw = rng.uniform((0.0, -25.0), (300.0, 25.0), (60, 2)), np.resize([0.0, np.pi, 0.5 * np.pi], 60)

    def reported(speed: float) -> list[tuple[str, str]]:
        one, outputs, noise = Session(SENSOR.stream, optipmb.load_profile("generic")), [], np.random.default_rng(0)
        for seq in range(60):
            places = cars - np.array([speed * 0.1 * seq, 0.0])
            seen = np.flatnonzero(np.hypot(*places.T) < 50.0)
            count = len(seen)
            center = np.column_stack((places[seen] + noise.normal(0.0, 0.1, (count, 2)), np.zeros(count)))
            size, score = np.tile([4.5, 1.9, 1.6], (count, 1)), np.full(count, 0.9)
            boxes = {"center": center, "size": size, "yaw": yaw[seen], "score": score, "label": np.zeros(count, int)}
            outputs += feed(one, [seq], stamp_ns=SECOND + seq * SECOND // 10, labels=("car",), velocity=None, **boxes)
        return [(problem.code, problem.path) for problem in problems(outputs)]

    assert reported(10.0) == [("no_pose", "pose")]
    assert reported(0.0) == []


def test_velocities_that_contradict_the_boxes_are_reported_once() -> None:
    """Ten cars whose velocities have the other sign are reported; with velocities over ground they are not."""
    places, speeds = np.column_stack((np.zeros(10), 8.0 * np.arange(10), np.zeros(10))), np.arange(6.0, 16.0)

    def reported(factor: float) -> list[tuple[str, str]]:
        one, outputs = session(), []
        for seq in range(150):
            center = places + np.outer(0.1 * seq * speeds, [1.0, 0.0, 0.0])
            velocity = np.column_stack((factor * speeds, np.zeros(10)))
            given = {"objects": 10, "center": center, "velocity": velocity, "label": np.zeros(10, int)}
            outputs += feed(one, [seq], stamp_ns=SECOND + seq * SECOND // 10, labels=("car",), **given)
        return [(problem.code, problem.path) for problem in problems(outputs)]

    assert reported(-1.0) == [("velocity", "velocity")]
    assert reported(1.0) == []


def test_other_names_of_a_class_are_tracked() -> None:
    """A stream that says `vehicle.car` has the tracks of one that says `car`, and no problem."""
    said, alike = (
        feed(session(), range(5), labels=labels, label=np.zeros(3, np.int64)) for labels in (("car",), ("vehicle.car",))
    )
    assert not problems(alike)
    for one, other in zip(tracks(said), tracks(alike), strict=True):
        np.testing.assert_array_equal(one.center, other.center)
        assert (one.labels, len(one.id)) == (other.labels, len(other.id))


def test_the_state_counts_the_tracks_that_are_shown() -> None:
    """One of three objects has a low score: its track is published, not confirmed, and not counted."""
    one = session()
    (published,) = tracks(feed(one, [0], score=np.array([0.9, 0.9, 0.35])))
    assert published.confirmed is not None
    assert (len(published.id), one.state().tracks) == (3, published.confirmed.sum()) == (3, 2)


def test_reset_forgets_tracks_but_not_frames() -> None:
    """After a reset there are no tracks, ids go on, and frames seen before stay duplicates."""
    one = session()
    before = tracks(feed(one, range(5)))[-1]
    assert begun(one.reset()) == ["reset"]
    state = one.state()
    assert (state.bernoullis, state.tracks) == (0, 0)
    assert state.session != before.session
    assert feed(one, [4]) == []
    after = tracks(feed(one, range(5, 9)))[-1]
    assert after.session == state.session
    assert min(after.id) > max(before.id)


def test_a_reset_processes_what_was_held() -> None:
    """Frames received before a reset belong to the session before it."""
    one = session()
    feed(one, [0])
    old = one.session
    feed(one, [1], has_points=True)
    assert [message.session for message in tracks(one.reset())] == [old]


def test_parameters_change_only_before_frames_or_with_a_restart() -> None:
    """Another profile is refused while frames depend on the old one; the same profile and the wait are not."""
    kitti = optipmb.load_profile("kitti")
    one = session()
    one.configure(kitti, 0.5, restart=False)
    assert (one.parameters.name, one.cloud_wait_s) == ("kitti", 0.5)
    one.configure(NUSCENES, None, restart=False)
    feed(one, range(3))
    with pytest.raises(CommandRefusedError, match="profile"):
        one.configure(kitti, 0.7, restart=False)
    assert (one.parameters.name, one.cloud_wait_s) == ("nuscenes", 0.5)
    one.configure(NUSCENES, 0.2, restart=False)
    assert one.cloud_wait_s == 0.2
    old = one.session
    assert begun(one.configure(kitti, None, restart=True)) == ["parameters"]
    assert one.session != old
    assert tracks(feed(one, [3]))[0].labels == kitti.labels


def test_horizons_add_paths_and_change_nothing_else() -> None:
    """Asked for in a running session, tracks carry predicted paths from the next frame on until they are asked not to.

    Session, density and all other fields stay as they are; corrections and a restored session have the paths too.
    """
    one, other = session(), session()
    expected = tracks(feed(other, range(8)))
    got = tracks(feed(one, range(3)))
    assert one.configure(None, None, [0.5, 2.0], restart=False) == []
    got += tracks(feed(one, [3]))
    one = Session.restore(decode_checkpoint(encode_checkpoint(one.snapshot())), 0, instance="test")
    got += tracks(feed(one, [4, 6]) + one.recovered(0))
    corrected = tracks(feed(one, [5]))
    assert [message.seq for message in corrected] == [5, 6]
    one.configure(None, None, [], restart=False)
    got = [*got[:5], *corrected, *tracks(feed(one, [7]))]
    for before, after in zip(expected, got, strict=True):
        bare = after.model_copy(update=dict.fromkeys(PATHS))
        assert plain(bare.model_copy(update={"revision": 0})) == plain(before)
        assert (after.horizons is not None) == (3 <= after.seq <= 6)
    last = got[6]
    assert last.horizons is not None
    assert last.horizons.tolist() == [0.5, 2.0]
    assert last.path_position is not None
    assert last.path_position.shape == (len(last.id), 2, 2)
    assert len(last.id)


def test_a_profile_brings_its_own_horizons() -> None:
    """Setting a profile sets its horizons; the same profile with other horizons needs no restart."""
    asking = NUSCENES.model_copy(update={"horizons": (1.0,)})
    one = session()
    feed(one, range(2))
    one.configure(asking, None, restart=False)
    assert one.parameters.horizons == (1.0,)
    one.configure(asking, None, [3.0], restart=False)
    assert one.parameters.horizons == (3.0,)
    one.configure(NUSCENES, None, restart=False)
    assert one.parameters.horizons == ()
    with pytest.raises(CommandRefusedError, match="profile"):
        one.configure(optipmb.load_profile("kitti"), None, [1.0], restart=False)
    assert one.parameters == NUSCENES


def test_state_counts() -> None:
    """The state adds up what happened."""
    one = session()
    assert one.state().state == "new"
    feed(one, [0, 1, 1, 20, 22, 21, 40, 5])
    state = one.state(shed=2, queue=3)
    assert (state.state, state.frames, state.duplicates, state.late, state.gaps) == ("running", 6, 1, 1, 35)
    assert (state.inserted, state.corrected) == (1, 1)
    assert (state.seq, state.stamp_ns, state.epoch) == (40, SENSOR.stamp_ns(40), SENSOR.epoch)
    assert (state.shed, state.queue) == (2, 3)
    assert state.next_id > 0


def test_a_stamp_ahead_ends_no_track() -> None:
    """One stamp six seconds ahead, twice: both frames are refused with a problem, and the tracks go on."""
    one = session()
    before = tracks(feed(one, range(5)))[-1]
    for seq in (5, 7):
        ahead = one.on_detections(SENSOR.detections(seq, stamp_ns=SENSOR.stamp_ns(seq) + 6 * SECOND), 0)
        assert ([problem.code for problem in problems(ahead)], tracks(ahead)) == (["time_jump"], [])
        after = tracks(feed(one, [seq + 1]))[0]
        assert (after.session, list(after.id)) == (before.session, list(before.id))
    assert (one.counters.refused, one.counters.new_epochs) == (2, 0)


@pytest.mark.parametrize(("shift_s", "apart"), [(-3600.0, r"3599\.\d0 s before"), (864_000.0, "10 days after")])
def test_a_jump_that_frames_agree_on_is_reported(shift_s: float, apart: str) -> None:
    """Three frames in a row far ahead or back begin a new session, a problem of its own kind, told in a sentence."""
    one = session()
    feed(one, range(5))
    outputs = feed(one, range(5, 9), replace(SENSOR, start_s=SENSOR.start_s + shift_s))
    said = problems(outputs)
    assert [problem.code for problem in said] == ["time_jump", "time_jump", "restarted"]
    assert re.match(
        f"Frame 5: its stamp is {apart} the newest one; expected a stamp near the one before", said[0].message
    )
    assert re.match(
        f"Frame 7: tracks begin anew, because stamps jumped; it is {apart} the newest one", said[-1].message
    )
    assert (begun(outputs), len(tracks(outputs))) == (["jump"], 2)
