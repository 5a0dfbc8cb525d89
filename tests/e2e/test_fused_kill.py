"""SIGKILL while several sensors feed one session: no trace of it is left."""

from pathlib import Path

import pytest
from fleet import Fleet
from fusing import FUSED, drive
from optipmb_schemas import Detections, Keys, MoveRequest, ServiceStatus, SessionState, Tracks, decode
from optipmb_service.stream.session import Session
from optipmb_service.stream.values import Policy
from router import Node, until
from sessions import Merged

import optipmb

KEYS = Keys()
RESTART_S = 240.0


def given_back(node: Node) -> Merged:
    """The tracks as a user has them: of each frame the latest run, and in it the latest revision."""
    merged = Merged()
    with node.tracks_seen.changed:
        items = [payload for key, payload, _ in node.tracks_seen.items if key == KEYS.tracks(FUSED)]
    for payload in items:
        message = decode(payload, Tracks)
        assert message.delivery is not None
        where = message.epoch + (message.sensor or "").encode(), message.seq
        run, old = merged.newest.get(where, (-1, message))
        if (message.delivery.run, message.revision) > (run, old.revision if run >= 0 else -1):
            merged.newest[where] = message.delivery.run, message
    return merged


def state(node: Node) -> SessionState | None:
    """What the service says of the session, None while there is none."""
    answers = node.query(KEYS.query(FUSED, "state"))
    return decode(answers[0][2], SessionState) if answers and answers[0][0] else None


def moved_with_its_sensor(node: Node, before: SessionState) -> None:
    """Move a sensor's stream to the other worker: the session goes there as it is."""

    def worker() -> int | None:
        return {one.stream: one.worker for one in node.ask(KEYS.status("one"), ServiceStatus).sessions}.get(FUSED)

    here = worker()
    assert here is not None
    request = MoveRequest(stream="site/node/front", worker=1 - here)
    until(lambda: node.query(KEYS.move("one"), request, timeout=60.0)[0][0], "the session is moved", RESTART_S)
    node.send(drive(41)[80])
    until(lambda: worker() == 1 - here, "the other worker has it", RESTART_S)
    after = state(node)
    assert after is not None
    assert (after.session, after.frames >= before.frames) == (before.session, True)


@pytest.mark.parametrize("workers", [1, 2])
def test_killed_while_two_sensors_feed_one_session(tmp_path: Path, workers: int) -> None:
    """State and tracks equal a run without a kill, to the byte, with one process and with workers."""
    optipmb.warm_up()
    frames: list[Detections] = drive(40)
    one, merged = Session(FUSED, optipmb.load_profile("nuscenes"), Policy(recovery_wait_ns=0), fused=True), Merged()
    for frame in frames:
        merged.take(one.on_detections(frame, 0))
    wanted = merged.plain()
    settings = {"fuse": "site/node/*", "recovery_wait_s": 30, "checkpoint_s": 0.2, "workers": workers}
    with Fleet(tmp_path, **settings) as fleet, Node(fleet.endpoint) as node:
        service = fleet.service("one")
        node.send(*frames[:40])
        until(lambda: (found := state(node)) is not None and found.frames >= 20, "frames are tracked", RESTART_S)
        service.process.kill()
        service.process.wait()
        node.send(*frames[40:60])
        service = fleet.service("one", wait=False)
        node.send(*frames[60:])
        service.wait_ready()
        until(lambda: (found := state(node)) is not None and found.frames == len(frames), "all frames", RESTART_S)
        until(lambda: given_back(node).plain() == wanted, "the tracks of no kill", RESTART_S)
        found = state(node)
        assert found is not None
        assert (found.gaps, found.late) == (0, 0)
        if workers > 1:
            moved_with_its_sensor(node, found)
        assert service.end()[0] == 0
