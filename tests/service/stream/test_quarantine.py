"""A step that raises costs its session alone; its input is saved and can be replayed."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import optipmb_schemas as schemas
import pytest
from hypothesis import given
from hypothesis import strategies as st
from optipmb_client.errors import UsageError
from optipmb_service.session.checkpoint import decode_checkpoint, encode_checkpoint
from optipmb_service.session.policy import Policy
from optipmb_service.session.session import Session
from optipmb_service.streams.persistence import DUMPS, MAX_DUMPS, save_dump
from optipmb_tools.cli import run
from optipmb_tools.run import dumps as client
from router import Sensor
from sessions import Failing, begun, dumps, feed, problems, tracks

import optipmb

NUSCENES = optipmb.load_profile("nuscenes")
SENSOR = Sensor()
AGAIN = replace(SENSOR, epoch=b"b" * 16, start_s=SENSOR.start_s + 1.5)


def session(**changes: Any) -> Session:
    return Session(SENSOR.stream, NUSCENES, tracker=Failing, **changes)


def failed() -> tuple[Session, bytes]:
    """A session that failed at frame 5, with clouds and a late frame before it, and its dump."""
    one = session()
    for seq in (0, 1, 3, 2, 4):
        one.on_points(SENSOR.points(seq, count=50), 0)
        feed(one, [seq], SENSOR, has_points=True)
    outputs = feed(one, [5], SENSOR, objects=7, has_points=False)
    assert [(p.code, p.seq) for p in problems(outputs)] == [("internal", 5)]
    (saved,) = dumps(outputs)
    assert saved.error == "ZeroDivisionError: seven"
    return one, saved.dump


def test_a_failing_step_quarantines_its_session() -> None:
    """The density is unchanged, frames are refused with a problem that gives the reason, and counted."""
    one, _ = failed()
    density = one.density
    outputs = feed(one, [6, 7], SENSOR)
    assert [p.code for p in problems(outputs)] == ["quarantined", "quarantined"]
    assert (tracks(outputs), one.density is density) == ([], True)
    assert (one.state().state, one.counters.refused) == ("quarantined", 3)


def test_a_quarantine_survives_a_restart() -> None:
    """A session that failed does not fail again and again because the service was restarted."""
    one, _ = failed()
    two = Session.restore(decode_checkpoint(encode_checkpoint(one.snapshot())), 0, tracker=Failing)
    assert two.state().state == "quarantined"
    assert [p.code for p in problems(feed(two, [6], SENSOR))] == ["quarantined"]


@pytest.mark.parametrize("by", ["reset", "publisher"])
def test_a_quarantine_ends(by: str) -> None:
    """By a reset, or with a publisher that was restarted: with an empty density, a new session and fresh ids."""
    one, _ = failed()
    old, used = one.session, one.density.next_id
    if by == "reset":
        assert begun(one.reset()) == ["reset"]
        got = tracks(feed(one, range(6, 10), SENSOR, has_points=False))
    else:
        outputs = feed(one, range(4), AGAIN, has_points=False)
        assert begun(outputs)[0] == "quarantine"
        got = tracks(outputs)
    assert len(got) == 4
    assert old not in {message.session for message in got}
    assert min(got[-1].id) >= used


def test_a_late_frame_that_fails_leaves_the_rest_alone() -> None:
    """When going over the window again raises, nothing of it was done."""
    one = session()
    feed(one, [0, 1, 3, 4], SENSOR)
    density = one.density
    outputs = feed(one, [2], SENSOR, objects=7)
    assert len(dumps(outputs)) == 1
    assert tracks(outputs) == []
    assert one.density is density
    assert client.replay(schemas.decode_dump(dumps(outputs)[0].dump), Failing).seq == 2


class FailingClouds(optipmb.Tracker):
    def step(self, density: optipmb.Density, frame: optipmb.Frame) -> optipmb.StepResult:
        if frame.cloud is not None and len(frame.cloud.xyz) == 7:
            raise ZeroDivisionError("seven")
        return super().step(density, frame)


@pytest.mark.parametrize("epoch", [SENSOR.epoch, b"c" * 16])
def test_a_late_cloud_that_fails_is_no_frame(epoch: bytes) -> None:
    """None is counted as refused by it; after a reset the publisher goes on, also with the number of the cloud."""
    one = Session(SENSOR.stream, NUSCENES, Policy(late_clouds=True), tracker=FailingClouds)
    feed(one, range(4), SENSOR)
    density, stamp_ns = one.density, SENSOR.stamp_ns(2)
    outputs = one.on_points(SENSOR.points(6, count=7, epoch=epoch, stamp_ns=stamp_ns), 0)
    assert ([p.code for p in problems(outputs)], len(dumps(outputs))) == (["internal"], 1)
    assert (one.density is density, one.counters.frames, one.counters.refused) == (True, 4, 0)
    assert [p.code for p in problems(feed(one, [4], SENSOR))] == ["quarantined"]
    one.reset()
    outputs = feed(one, range(5, 8), SENSOR, has_points=False)
    assert ([m.seq for m in tracks(outputs)], problems(outputs)) == ([5, 6, 7], [])
    assert (one.counters.frames, one.counters.refused, one.counters.duplicates) == (7, 1, 0)


# The dump


def test_a_dump_fails_again_in_the_same_way() -> None:
    """Going through the saved frames raises the same error at the same frame, without the service."""
    _, dump = failed()
    result = client.replay(schemas.decode_dump(dump), Failing)
    assert result.same
    assert (result.error, result.seq, result.frames) == ("ZeroDivisionError: seven", 5, 6)
    assert "Failing" in result.trace or "sessions.py" in result.trace
    assert client.replay(schemas.decode_dump(dump)).error is None


def test_a_dump_leads_to_the_same_density() -> None:
    """Up to the failing frame the replay goes through the very densities of the session, lives included."""
    seen: list[bytes] = []

    class Noting(Failing):
        def step(self, density: optipmb.Density, frame: optipmb.Frame) -> optipmb.StepResult:
            seen.append(b"".join(column.tobytes() for column in optipmb.columns_of(density).values()))
            return super().step(density, frame)

    one = Session(SENSOR.stream, NUSCENES, tracker=Noting)
    feed(one, range(3), SENSOR)
    far = replace(SENSOR, epoch=b"f" * 16, start_s=1.0)
    (saved,) = dumps([*feed(one, range(2), far), *feed(one, [2], far, objects=7)])
    live = seen[:6]
    seen.clear()
    client.replay(schemas.decode_dump(saved.dump), Noting)
    assert seen == live
    seen.clear()
    one = Session(SENSOR.stream, NUSCENES, tracker=Noting)
    feed(one, range(5), SENSOR)
    back = replace(SENSOR, start_s=SENSOR.start_s - 3)
    (saved,) = dumps([*feed(one, range(5, 9), back), *feed(one, [9], back, objects=7)])
    live = seen[5:8]  # a dump begins on the newest clock
    seen.clear()
    client.replay(schemas.decode_dump(saved.dump), Noting)
    assert seen == live


@given(st.binary(max_size=300))
def test_what_is_no_dump_is_refused(data: bytes) -> None:
    """For any bytes, nothing but the decoder's one error is raised."""
    with pytest.raises(schemas.MessageError):
        schemas.decode_dump(data)


def test_dumps_are_written_whole_and_bounded(tmp_path: Path) -> None:
    """The newest stay, nothing else is left in the folder, and names say which stream it was."""
    files = [Path(save_dump(tmp_path, "a/b/c", b"%d" % number)) for number in range(MAX_DUMPS + 2)]
    assert [file.name for file in sorted((tmp_path / DUMPS).iterdir())] == [file.name for file in files[2:]]
    assert files[4].name == "a_b_c-000005.dump"
    assert files[4].read_bytes() == b"4"
    (tmp_path / "file").touch()
    assert save_dump(None, "a/b/c", b"") == save_dump(tmp_path / "file", "a/b/c", b"") == ""


def test_the_command_replays_a_dump(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`optipmb track --dump` ends with status 1 and one line that names frame and error; the trace only when asked."""
    # An error of the real tracker: a density that is ahead of its frame.
    good = schemas.decode_dump(failed()[1])
    text = "FrameError: stamp_ns: expected a stamp from 9000000000000000000 on, received 10000000000000"
    file = tmp_path / "saved.dump"
    file.write_bytes(schemas.encode_dump(replace(good, stamp_ns=9 * 10**18, error=text)))
    assert run(["track", "--dump", str(file)]) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "frame 0" in error
    assert "the saved error again" in error
    assert run(["track", "--dump", str(file), "--trace"]) == 1
    assert "Traceback" in capsys.readouterr().err


def test_the_command_says_when_nothing_fails_any_more(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With a tracker that does not fail, the status is 0."""
    file = tmp_path / "saved.dump"
    file.write_bytes(failed()[1])
    assert run(["track", "--dump", str(file)]) == 0
    assert "6 frames without an error" in capsys.readouterr().out


def test_the_command_refuses_what_is_no_dump(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A wrong file, and a density that is none, are one line and status 2; so is a command without data."""
    file = tmp_path / "text"
    file.write_text("no dump", encoding="utf-8")
    assert run(["track", "--dump", str(file)]) == 2
    assert run(["track"]) == 2
    assert capsys.readouterr().err.count("\n") == 2
    good = schemas.decode_dump(failed()[1])
    with pytest.raises(UsageError, match="bernoulli: expected bytes, 464 for each row, received 40 bytes"):
        client.replay(replace(good, density=good.density | {"bernoulli": bytes(40)}))
