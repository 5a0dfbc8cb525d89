"""A session saved and restored: nothing is lost, nothing partial is accepted."""

import hashlib
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import optipmb_schemas as schemas
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from optipmb_service.session.checkpoint import (
    DIGEST,
    HEAD,
    MAGIC,
    VERSION,
    Checkpoint,
    CheckpointError,
    decode_checkpoint,
    encode_checkpoint,
    numbers_in,
    seal,
    state_bytes,
)
from optipmb_service.session.identity import Incarnation
from optipmb_service.session.policy import Policy
from optipmb_service.session.session import Session
from router import SECOND, Sensor
from sessions import Merged, chained, feed, problems, tracks

import optipmb
from optipmb.world.zones import ZoneState

NUSCENES = optipmb.load_profile("nuscenes")
SENSOR = Sensor()
GOLDEN = Path(__file__).parent / "golden" / "checkpoint.bin"


def example(frames: int = 12) -> Session:
    """A session with everything in it: clouds, a gap, a correction, unknown classes, poses, a second epoch."""
    one = Session(SENSOR.stream, NUSCENES)
    for seq in (0, 1, 2, 5, 4, 7):
        one.on_points(SENSOR.points(seq, count=20), 0)
        pose = SENSOR.points(seq).pose
        labels = ("car", "dog")
        one.on_detections(SENSOR.detections(seq, labels=labels, label=np.array([0, 0, 1]), pose=pose), 0)
    again = replace(SENSOR, epoch=b"b" * 16, start_s=SENSOR.start_s + 0.8)
    feed(one, range(frames - 6), again)
    return one


def test_equal_sessions_give_equal_bytes() -> None:
    """Encoding is deterministic, and reading and writing again changes nothing."""
    data = encode_checkpoint(example().snapshot())
    assert data == encode_checkpoint(example().snapshot())
    checkpoint = decode_checkpoint(data)
    assert encode_checkpoint(checkpoint) == data
    restored = Session.restore(checkpoint, 0).snapshot()
    assert (restored.run, encode_checkpoint(replace(restored, run=0))) == (1, data)


def test_classes_keep_their_order() -> None:
    """The classes of a profile are numbered by their order in it, not by their names."""
    kitti = optipmb.load_profile("kitti")
    one = Session(SENSOR.stream, kitti)
    assert sorted(kitti.labels) != list(kitti.labels)
    assert decode_checkpoint(encode_checkpoint(one.snapshot())).parameters.labels == kitti.labels


def test_a_snapshot_does_not_change_any_more() -> None:
    """It is a value: what the session does later is not in it, though it is encoded later."""
    one = example()
    snapshot = one.snapshot()
    data = encode_checkpoint(snapshot)
    feed(one, range(6, 12), replace(SENSOR, epoch=b"b" * 16, start_s=SENSOR.start_s + 0.8))
    one.reset()
    assert encode_checkpoint(snapshot) == data


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 19), st.permutations(range(20, 26)))
def test_a_restored_session_goes_on_as_if_nothing_had_happened(cut: int, order: list[int]) -> None:
    """Tracks, ids and state after a restore equal the uninterrupted session, also for late frames."""
    one, merged = Session(SENSOR.stream, NUSCENES), Merged()
    merged.take(feed(one, range(cut + 1), SENSOR))
    two = Session.restore(decode_checkpoint(encode_checkpoint(one.snapshot())), 0)
    again = Merged()
    again.newest.update(merged.newest)
    for seq in [*range(cut + 1, 20), *order]:
        merged.take(feed(one, [seq], SENSOR))
        again.take(feed(two, [seq], SENSOR), two.run)
    again.take(two.recovered(0), two.run)
    assert state_bytes(one.snapshot()) == state_bytes(two.snapshot())
    assert merged.plain() == again.plain()


def test_fields_of_view_outlive_a_restore() -> None:
    """What no sensor looked at is kept with the density, and the frames of the window bring their views along."""
    behind = schemas.FieldOfView(azimuth=[2.5, -2.5], elevation=[-1, 1], range=[0, 100])
    one, other = Session(SENSOR.stream, NUSCENES), Session(SENSOR.stream, NUSCENES)
    for session in (one, other):
        feed(session, range(3), SENSOR)
    for seq in range(3, 9):
        one.on_detections(SENSOR.detections(seq, field_of_view=behind), 0)
        other.on_detections(SENSOR.detections(seq, field_of_view=behind), 0)
        other = Session.restore(decode_checkpoint(encode_checkpoint(other.snapshot())), 0)
        other.recovered(0)
    assert one.density.misses is not None
    assert state_bytes(one.snapshot()) == state_bytes(other.snapshot())


def test_scores_are_calibrated_once_also_over_a_restore() -> None:
    """The window keeps the received scores: tracks equal a session that received the calibrated scores."""
    document = NUSCENES.model_dump()
    document["classes"]["car"]["score_calibration"] = {"detector": [0.2, 0.4], "calibrated": [0.5, 0.8]}
    one, other = Session(SENSOR.stream, optipmb.parse_parameters(document)), Session(SENSOR.stream, NUSCENES)
    found, wanted = Merged(), Merged()
    for seq in (0, 1, 2, 4, 5, 3, 6):
        found.take([*one.on_detections(SENSOR.detections(seq, score=np.full(3, 0.3)), 0)], one.run)
        wanted.take(other.on_detections(SENSOR.detections(seq, score=np.full(3, 0.65)), 0))
        one = Session.restore(decode_checkpoint(encode_checkpoint(one.snapshot())), 0)
        found.take(one.recovered(0), one.run)
    told, expected = ([message for _, message in merged.newest.values()] for merged in (found, wanted))
    assert sum(len(message.id) for message in told) > 7
    for column in ("id", "score", "center", "existence", "covariance"):
        pairs = zip(told, expected, strict=True)
        assert all(np.array_equal(getattr(a, column), getattr(b, column)) for a, b in pairs), column


def test_what_is_learned_outlives_kills_and_moves() -> None:
    """A session that is restored after every third frame while it learns the noise ends as one that never was."""
    one, other = (Session(SENSOR.stream, optipmb.load_profile("generic")) for _ in range(2))
    learned = set()
    for seq in range(30):
        message = SENSOR.detections(seq, objects=6)
        one.on_detections(message, 0)
        other.on_detections(message, 0)
        if seq % 3 == 2:
            other = Session.restore(decode_checkpoint(encode_checkpoint(other.snapshot())), 0)
            other.recovered(0)
        assert one.learned == other.learned
        learned.add(one.learned)
    assert state_bytes(one.snapshot()) == state_bytes(other.snapshot())
    assert len(learned) > 1, "it learned on the way"


def test_rewind_goes_back_over_a_restore() -> None:
    """A frame that was late before the crash and comes after it is put in its place."""
    one, other = (Session(SENSOR.stream, NUSCENES) for _ in range(2))
    feed(one, [0, 1, 2, 4, 5], SENSOR)
    two = Session.restore(decode_checkpoint(encode_checkpoint(one.snapshot())), 0)
    got = tracks(feed(two, [3], SENSOR))
    assert [(m.seq, m.revision) for m in got] == [(3, 0), (4, 1), (5, 1)]
    feed(other, range(6), SENSOR)
    assert state_bytes(two.snapshot()) == state_bytes(other.snapshot())


def test_large_clouds_shorten_the_window_not_the_checkpoint() -> None:
    """A checkpoint holds a bounded window; the restored session goes back less far, and refuses older frames."""
    policy = Policy(checkpoint_bytes=100_000)
    one = Session(SENSOR.stream, NUSCENES, policy)
    for seq in (0, 1, 2, 3, 5, 6):
        one.on_points(SENSOR.points(seq, count=3000), 0)
        feed(one, [seq], SENSOR)
    checkpoint = one.snapshot()
    assert len(one._window.frames) == 6
    assert [entry.frame_id.seq for entry in checkpoint.window] == [5, 6]
    assert len(encode_checkpoint(checkpoint)) < 130_000
    two = Session.restore(checkpoint, 0, policy)
    assert state_bytes(two.snapshot()) == state_bytes(checkpoint)
    assert [p.code for p in problems(feed(two, [2], SENSOR))] == []
    assert two.counters.duplicates == 1
    assert [m.seq for m in tracks(feed(two, [4], SENSOR, has_points=False))] == [4, 5, 6]


# Frames that were missed


def test_a_restored_session_waits_for_what_it_missed() -> None:
    """Live frames that come before the cached ones are held until these are there, and nothing is corrected."""
    one = Session(SENSOR.stream, NUSCENES)
    feed(one, range(5), SENSOR)
    two = Session.restore(one.snapshot(), now_ns=100)
    assert two.state().state == "recovering"
    assert feed(two, [8, 9], SENSOR) == []
    assert (two.state().queue, two.deadline_ns) == (2, 100 + Policy().recovery_wait_ns)
    got = tracks(feed(two, [3, 4, 5, 6, 7], SENSOR))
    assert [(m.seq, m.revision, m.gap) for m in got] == [(seq, 0, 0) for seq in range(5, 10)]
    assert two.counters.duplicates == 2
    two.recovered(200)
    assert two.state().state == "running"


def test_what_no_cache_has_is_a_gap() -> None:
    """At the deadline, or when told that the caches gave all, the held frames go on and say how many are missing."""
    one = Session(SENSOR.stream, NUSCENES)
    feed(one, range(5), SENSOR)
    for end in ("deadline", "told"):
        two = Session.restore(one.snapshot(), now_ns=100)
        feed(two, [8, 9], SENSOR)
        assert two.on_tick(99 + Policy().recovery_wait_ns) == []
        outputs = two.on_tick(100 + Policy().recovery_wait_ns) if end == "deadline" else two.recovered(100)
        assert [(m.seq, m.gap) for m in tracks(outputs)] == [(8, 3), (9, 0)]
        assert not two.arrivals.waiting
        late = tracks(feed(two, [6], SENSOR))
        assert [(m.seq, m.revision, m.gap) for m in late] == [(6, 0, 1), (8, 1, 1), (9, 1, 0)]


def test_a_publisher_that_restarted_too_is_waited_for() -> None:
    """Frames of an epoch that the session has not seen wait for those from its beginning on."""
    one = Session(SENSOR.stream, NUSCENES)
    feed(one, range(5), SENSOR)
    two = Session.restore(one.snapshot(), now_ns=0)
    again = replace(SENSOR, epoch=b"b" * 16, start_s=SENSOR.start_s + 1)
    assert feed(two, [2, 1], again) == []
    assert [m.seq for m in tracks(feed(two, [0], again))] == [0, 1, 2]


def test_held_frames_are_not_in_a_checkpoint() -> None:
    """What waits for its cloud at a crash comes again from the cache and is no duplicate."""
    one = Session(SENSOR.stream, NUSCENES)
    feed(one, range(3), SENSOR)
    assert feed(one, [3], SENSOR, has_points=True) == []
    two = Session.restore(one.snapshot(), 0)
    assert [m.seq for m in tracks(feed(two, [3], SENSOR, has_points=False))] == [3]
    assert two.counters.duplicates == 0


# Torn, changed, foreign


def test_torn_at_every_length() -> None:
    """A checkpoint cut short anywhere is refused."""
    data = encode_checkpoint(example(7).snapshot())
    for length in range(len(data)):
        with pytest.raises(CheckpointError):
            decode_checkpoint(data[:length])


def test_any_changed_byte_is_noticed() -> None:
    """A checkpoint with one bit turned over, at any position, is refused."""
    data = encode_checkpoint(example(7).snapshot())
    for at in range(len(data)):
        changed = bytearray(data)
        changed[at] ^= 1 << at % 8
        with pytest.raises(CheckpointError):
            decode_checkpoint(bytes(changed))


@pytest.mark.parametrize("version", [1, VERSION + 1, 2**16 - 1])
def test_another_version_is_refused_by_number(version: int) -> None:
    """What another release wrote is not guessed at: the error names both formats, what to do, and all numbers."""
    checkpoint = example().snapshot()
    zones = ZoneState(numbers={"gate/entered": 7})
    checkpoint = replace(checkpoint, run=3, head=replace(checkpoint.head, zones=zones))
    data = encode_checkpoint(checkpoint)
    start = MAGIC + version.to_bytes(2, "big") + data[len(MAGIC) + 2 : HEAD - DIGEST]
    other = start + hashlib.sha256(start + data[HEAD:]).digest()[:DIGEST] + data[HEAD:]
    expected = f"format {version}: expected {VERSION}, the only one of this release; start the release that wrote it"
    with pytest.raises(CheckpointError, match=expected) as refused:
        decode_checkpoint(other)
    wanted = Incarnation(checkpoint.head.starts, checkpoint.head.density.next_id, 3, {"gate/entered": 7})
    assert refused.value.incarnation == wanted == numbers_in(seal(b"", wanted))


def test_the_format_is_named_before_the_digest_is_compared() -> None:
    """Bytes of another layout are reported as another format, not as torn."""
    data = MAGIC + (1).to_bytes(2, "big") + bytes(500)
    with pytest.raises(CheckpointError, match=r"format 1: expected .*; torn or changed") as refused:
        decode_checkpoint(data)
    assert refused.value.incarnation is None


def altered(change: Any) -> Checkpoint:
    """Read a checkpoint whose body was changed and sealed again."""
    data = encode_checkpoint(example().snapshot())
    body = msgpack.unpackb(data[HEAD + 4 + int.from_bytes(data[HEAD : HEAD + 4], "big") :])
    change(body)
    return decode_checkpoint(seal(msgpack.packb(body), Incarnation()))


def _set_profile(body: Any, **changes: Any) -> None:
    body["parameters"] = msgpack.packb(msgpack.unpackb(body["parameters"]) | changes)


def _set(body: Any, column: str, number: bytes) -> None:
    density = body["head"]["density"]
    objects = bytearray(density["bernoulli"])
    at = optipmb.Bernoullis.described[column].begin * len(objects) // optipmb.Bernoullis.width
    assert objects
    objects[at : at + 8] = number
    density["bernoulli"] = bytes(objects)


def _set_real(body: Any, column: str, value: float) -> None:
    _set(body, column, struct.pack("<d", value))


@pytest.mark.parametrize(
    ("change", "path"),
    [
        (lambda body: body.pop("base"), "base"),
        (lambda body: body.update(stream="nowhere"), "stream"),
        (lambda body: body["head"].update(next_id=0), "next_id"),
        (lambda body: body.update(head=None), "head"),
        (lambda body: body.update(window=[]), "head"),
        (lambda body: body["head"]["density"].pop("bernoulli"), "bernoulli: expected bytes, 464 for each row"),
        (lambda body: body["head"]["density"].update(bernoulli=[]), "head.density.bernoulli: expected a valid bytes"),
        (lambda body: body["head"]["density"].update(poisson=b"0" * 391), "poisson: expected bytes, 392 for each row"),
        (lambda body: body["head"]["density"].update(misses=b"0" * 16), "misses"),
        (lambda body: body["head"]["density"].update(classes=b"0" * 8), "classes"),
        (lambda body: _set(body, "extracted", (2).to_bytes(8, "little")), "bernoulli.extracted: expected flags"),
        (lambda body: _set(body, "confirmed", (256).to_bytes(8, "little")), "bernoulli.confirmed: expected flags"),
        (lambda body: _set_profile(body, nominal_period=-1), "nominal_period"),
        (lambda body: body["window"][0].update(detections=b"no"), "msgpack"),
        (lambda body: body["window"].append(body["window"][0]), "window"),
        (lambda body: body["epochs"][""][0].pop(), "epochs"),
        (lambda body: body["head"]["sensors"][""]["cursor"].update(epoch=[1]), "cursor"),
        (lambda body: body["head"].update(session="\x01" * 32), "head.session: expected a text that matches"),
        (lambda body: body["head"]["counts"].update(frames=2**62), "head.counts.frames"),
        (lambda body: body.update(run=2**63 - 1), "run"),
        (lambda body: body.update(quarantine={"": "x" * 401}), "quarantine"),
        (lambda body: body.update(cloud_wait_ns=2**62), "cloud_wait_ns"),
        (lambda body: _set_profile(body, name="a b"), "profile"),
        (lambda body: body.update(parameters=b"\xc1"), "malformed"),
        (lambda body: body.update(parameters={}), "parameters"),
        (lambda body: body["epochs"][""].append(body["epochs"][""][0]), "epochs"),
        (lambda body: body["epochs"][""][0].__setitem__(2, b"\2"), "epochs"),
        (lambda body: body["head"]["sensors"][""].update(reported=["x" * 65]), "reported"),
        (lambda body: body["head"]["sensors"].update({"site/node/other": {}}), "sensors"),
        (lambda body: body.update(fused=True), "sensors"),
        (lambda body: body["head"].update(sensors={f"site/node/{n}": {} for n in range(65)}), "sensors"),
        (lambda body: body["head"].update(stamp_ns=0), "born_ns"),
        (lambda body: _set_real(body, "existence", -0.5), "bernoulli.existence"),
        (lambda body: _set_real(body, "score", 1.5), "bernoulli.score"),
        (lambda body: body.update(stream="another/node/lidar"), "a frame of another/node/lidar"),
    ],
)
def test_what_does_not_fit_is_named(change: Any, path: str) -> None:
    """A checkpoint that is whole and yet none is refused with the path of the value."""
    with pytest.raises(CheckpointError, match=path):
        altered(change)


def test_more_may_be_added() -> None:
    """Fields that a later version of the same format adds are ignored, counters that it added before are zero."""
    checkpoint = altered(lambda body: (body.update(new=1), body["head"]["counts"].pop("astray")))
    assert checkpoint.head.counts.astray == 0


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=400))
def test_any_body_is_read_or_refused(body: bytes) -> None:
    """For any bytes under a good seal, nothing but `CheckpointError` is raised."""
    with pytest.raises(CheckpointError):
        decode_checkpoint(seal(body, Incarnation()))


# The bytes of the version


def golden() -> Session:
    """The session of the golden file; its tracker does not depend on rounding."""
    one = Session(SENSOR.stream, NUSCENES, Policy(rewind_ns=SECOND // 2), tracker=chained)
    for seq in (0, 1, 2, 5, 4, 7):
        one.on_points(SENSOR.points(seq, count=5), 0)
        feed(one, [seq], SENSOR)
    return one


def test_the_head_of_the_first_format_is_read() -> None:
    """What a file of the first release says before its body is read for ever, without what a release has of formats."""
    data = GOLDEN.read_bytes()
    magic, version, starts, next_id, digest = struct.unpack_from(">8sHQQ16s", data)
    (length,) = struct.unpack_from(">I", data, 42)
    assert (magic, version, starts, next_id) == (b"OPTIPMB\0", 5, 1, 2)
    assert digest == hashlib.sha256(data[:26] + data[42:]).digest()[:16]
    assert msgpack.unpackb(data[46 : 46 + length]) == {"run": 0, "events": {}}
    assert numbers_in(data) == Incarnation(starts, next_id)


def test_the_bytes_of_the_version_are_read() -> None:
    """A file that an earlier process wrote is restored, and goes on: a change of the bytes needs another version."""
    checkpoint = decode_checkpoint(GOLDEN.read_bytes())
    assert (checkpoint.stream, checkpoint.head.counts.frames, checkpoint.head.counts.gaps) == (SENSOR.stream, 6, 2)
    assert [entry.frame_id.seq for entry in checkpoint.window] == [2, 4, 5, 7]
    assert [entry.revision for entry in checkpoint.window] == [0, 0, 1, 0]
    one = Session.restore(checkpoint, 0, tracker=chained)
    assert [m.seq for m in tracks(feed(one, [6], SENSOR, has_points=False))] == [6, 7]


if __name__ == "__main__":  # writes the golden file: only when there is a new version
    GOLDEN.write_bytes(encode_checkpoint(golden().snapshot()))
