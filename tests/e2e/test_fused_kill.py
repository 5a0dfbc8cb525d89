"""SIGKILL while several sensors feed one session: no trace of it is left."""

import json
from pathlib import Path
from typing import Any

import pytest
from fleet import Fleet
from fusing import FUSED, drive
from optipmb_schemas import Detections, Keys, MoveRequest, ServiceStatus, SessionState, Tracks, decode
from optipmb_service.session.policy import Policy
from optipmb_service.session.session import Session
from router import Node, until
from sessions import Merged

import optipmb

KEYS = Keys()
RESTART_S = 240.0
UNEQUAL = {"site/*/rear": {"profile": "kitti", "starts_tracks": False, "trust_size": False, "trust_heading": False}}


def given_back(node: Node, session: str) -> Merged:
    """The tracks as a user has them: of each frame the latest run, and in it the latest revision."""
    merged = Merged()
    with node.tracks_seen.changed:
        items = [payload for key, payload, _ in node.tracks_seen.items if key == KEYS.tracks(session)]
    for payload in items:
        message = decode(payload, Tracks)
        assert message.delivery is not None
        where = message.epoch + (message.sensor or "").encode(), message.seq
        run, old = merged.newest.get(where, (-1, message))
        if (message.delivery.run, message.revision) > (run, old.revision if run >= 0 else -1):
            merged.newest[where] = message.delivery.run, message
    return merged


def state(node: Node, session: str) -> SessionState | None:
    """What the service says of the session, None while there is none."""
    answers = node.query(KEYS.query(session, "state"))
    return decode(answers[0][2], SessionState) if answers and answers[0][0] else None


def moved_with_its_sensor(node: Node, session: str, before: SessionState) -> None:
    """Move a sensor's stream to the other worker: the session goes there as it is."""

    def worker() -> int | None:
        return {one.stream: one.worker for one in node.ask(KEYS.status("one"), ServiceStatus).sessions}.get(session)

    here = worker()
    assert here is not None
    request = MoveRequest(stream="site/node/front", worker=1 - here)
    until(lambda: node.query(KEYS.move("one"), request, timeout=60.0)[0][0], "the session is moved", RESTART_S)
    node.send(drive(41)[80])
    until(lambda: worker() == 1 - here, "the other worker has it", RESTART_S)
    after = state(node, session)
    assert after is not None
    assert (after.session, after.frames >= before.frames) == (before.session, True)


@pytest.mark.parametrize(
    ("session", "settings"),
    [
        (FUSED, {"fuse": "site/node/*"}),
        (FUSED, {"fuse": "site/node/*", "workers": 2}),
        (
            "site/fused/crossing",
            {
                "fused": json.dumps({"crossing": {"streams": ["site/*/*"]}}),
                "sensors": json.dumps(UNEQUAL),
                "workers": 2,
            },
        ),
    ],
)
def test_killed_while_two_sensors_feed_one_session(tmp_path: Path, session: str, settings: dict[str, Any]) -> None:
    """State and tracks equal a run without a kill, to the byte: with workers, with nodes of a site, unequal sensors."""
    frames: list[Detections] = drive(40)
    sensors = optipmb.Sensors.read(UNEQUAL if "sensors" in settings else {})
    policy = Policy(recovery_wait_ns=0, sensors=sensors)
    one, merged = Session(session, optipmb.load_profile("nuscenes"), policy, fused=True), Merged()
    for frame in frames:
        merged.take(one.on_detections(frame, 0))
    wanted = merged.plain()
    with Fleet(tmp_path, recovery_wait_s=30, checkpoint_s=0.2, **settings) as fleet, Node(fleet.endpoint) as node:

        def tracked(count: int) -> bool:
            return (found := state(node, session)) is not None and found.frames >= count

        service = fleet.service("one")
        node.send(*frames[:40])
        until(lambda: tracked(20), "frames are tracked", RESTART_S)
        service.process.kill()
        service.process.wait(60)
        node.send(*frames[40:60])
        service = fleet.service("one", wait=False)
        node.send(*frames[60:])
        service.wait_ready()
        until(lambda: tracked(len(frames)), "all frames", RESTART_S)
        until(lambda: given_back(node, session).plain() == wanted, "the tracks of no kill", RESTART_S)
        found = state(node, session)
        assert found is not None
        assert (found.gaps, found.late) == (0, 0)
        if "workers" in settings:
            moved_with_its_sensor(node, session, found)
        assert service.end()[0] == 0
