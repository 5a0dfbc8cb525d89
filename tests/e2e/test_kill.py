"""SIGKILL at random moments while recorded sequences are replayed: no trace is left but the outage."""

import json
import os
import random
import threading
import time
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

import pytest
from fleet import Fleet
from optipmb_client import Connection
from optipmb_client.incoming import Inbox
from optipmb_schemas import Detections
from optipmb_service.session.policy import Policy
from optipmb_service.settings import RejoinSettings, ZoneSettings
from real_data import kitti_root
from recorded import KEYS, Recording, Replay, kitti
from sessions import undisturbed

import optipmb

KILLS = int(os.environ.get("OPTIPMB_TEST_KILLS", "3"))
FEW = 10
FRAMES = 120 if KILLS > FEW else 40
SEED = int(os.environ.get("OPTIPMB_TEST_SEED", "1"))
LONG_S = 2.0
"""From so long an outage on, the log of the new process is shown."""
RESTART_S = 200.0  # on a machine that is busy with other things
SEQUENCES = ("0000", "0002", "0004", "0011", "0003", "0005", "0007", "0009", "0017", "0020")[: 10 if KILLS > FEW else 4]
EVENTS_S = 30.0
ZONES: dict[str, dict[str, Any]] = {
    f"zone-{x}-{y}": {
        "streams": ["*/kitti/*"],
        "polygon": [[x, y], [x + 18, y], [x + 18, y + 12], [x, y + 12]],
        "lost_s": 2.0,
    }
    for x in (0, 20, 40, 60)
    for y in (-12, 0)
} | {f"line-{x}": {"streams": ["*/kitti/*"], "line": [[x, -20], [x, 20]], "lost_s": 2.0} for x in range(5, 85, 10)}
"""Eight zones and eight lines where the recorded vehicles start."""
JOINS: dict[str, Any] = {
    "min_probability": 0.6,
    "decide_s": 0.1,
    "embedding_model": "sizes",
    "exits": [[[0, 4], [15, 4], [15, 20], [0, 20]]],
    "passages": [
        {"from": [[0, -9], [30, -9], [30, 4], [0, 4]], "to": [[0, -9], [60, -9], [60, 4], [0, 4]], "s": [1, 9]}
    ],
}
HIDDEN = range(5, 37)
"""Frames in which nothing is detected, of every second recording."""


@pytest.fixture(scope="module", autouse=True)
def _compiled() -> None:
    optipmb.warm_up(rejoin=True)


def with_looks(recording: Recording, hidden: range) -> Recording:
    """Return a recording whose detections have their sizes as vectors of appearance and attributes, but for a gap."""
    frames = []
    for at, (one, points) in enumerate(recording.frames):
        fields: dict[str, Any] = dict(one.present()) | {"embedding": one.size, "embedding_model": "sizes"}
        if at in hidden:
            fields |= {name: fields[name][:0] for name in one.arrays if fields.get(name) is not None}
        heights = enumerate(fields["size"][:, 2].round(1).tolist())
        fields["attributes"] = [
            {"row": row, "name": "height", "text": str(high), "score": 0.3} for row, high in heights
        ]
        frames.append((Detections(**fields), points))
    return replace(recording, frames=frames)


def recordings_of(root: Path, round_: int) -> list[Recording]:
    """Return the recordings of a round."""
    streams = [kitti(root, name, f"round{round_}/kitti/{name}", FRAMES) for name in SEQUENCES]
    return [with_looks(one, HIDDEN if at % 2 else range(0)) for at, one in enumerate(streams)]


def test_killed_at_random_moments(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Fault 1: four recorded streams, SIGKILL in the middle, a new process: all is as without a kill.

    Vehicles are joined over gaps, with exits, passages, vectors and attributes. The tracks of every frame and their
    objects, repetitions set aside, the digest of the state and the events of zones
    are byte-equal to an undisturbed session; events that were final did not change. Every round has a moment of its
    own.
    """
    root = kitti_root()
    moments = random.Random(SEED)
    outages: list[float] = []
    repeated = 0
    waits = {"cloud_wait_s": 30, "recovery_wait_s": 10, "checkpoint_s": 0.2}
    zones = tuple(ZoneSettings(**one).zone(name) for name, one in sorted(ZONES.items()))
    final, number, rejoined = 0, 0, 0
    settings = {"zones": json.dumps(ZONES), "profile": "kitti", "queue_clouds": FRAMES, "stream_mb": 1024} | waits
    settings["rejoin"] = json.dumps({"*/kitti/*": JOINS})
    policy = Policy(zones=zones, rejoin=RejoinSettings(**JOINS).joining())
    with Fleet(tmp_path, **settings) as fleet, Connection(fleet.endpoint) as connection:
        service = fleet.service("one")
        for round_ in range(KILLS):
            recordings = recordings_of(root, round_)
            replay = Replay(connection, recordings, pace_s=0.004)
            inbox = Inbox(100_000)
            keys = [key(one.stream) for one in recordings for key in (KEYS.tracks, KEYS.events)]
            subscriptions = [connection.subscribe(key, inbox) for key in keys]
            reader = threading.Thread(target=_read, args=(inbox, replay), daemon=True)
            reader.start()
            replay.start()
            total = FRAMES * len(SEQUENCES)
            replay.wait(moments.randrange(total // 10, total * 8 // 10), RESTART_S)
            time.sleep(moments.uniform(0.0, 0.02))  # a moment in the life of a frame, not a wait for anything
            service.process.kill()
            killed = time.monotonic_ns()
            service.process.wait(60)
            service = fleet.service("one", wait=False)
            replay.finish(RESTART_S)
            outages.append(_outage(replay, killed))
            for recording in recordings:
                tracks, digest, events = undisturbed(recording.messages, "kitti", policy)
                result = replay.results[recording.stream]
                assert [result.tracks[seq] for seq in range(FRAMES)] == [{one} for one in tracks], (round_, SEED)
                state = replay.state(recording.stream)
                assert (state.digest, state.frames, state.gaps) == (digest, FRAMES, 0), (round_, SEED)
                assert replay.wait_events(recording.stream, events, EVENTS_S), (round_, SEED)
                more = len(result.final), len(events), state.rejoined or 0
                final, number, rejoined = final + more[0], number + more[1], rejoined + more[2]
                repeated += result.repeated
            if KILLS > FEW:
                _tell(capsys, f"kill {round_ + 1} of {KILLS}: outage {outages[-1]:.2f} s")
            if outages[-1] > LONG_S:
                _tell(capsys, f"the log of the new process:\n{service.errors}")
            for subscription in subscriptions:
                subscription.close()
            inbox.close()
            reader.join(60)
            replay.close()
        assert service.end()[0] == 0
    assert rejoined
    _tell(
        capsys,
        f"{KILLS} of {KILLS} kills: all tracks and events byte-equal (seed {SEED}); "
        f"{len(SEQUENCES) * KILLS * FRAMES} frames, {number} of them with events, {final} of these final; "
        f"{repeated} published again, outage median {median(outages):.2f} s, longest {max(outages):.2f} s",
    )


def _tell(capsys: pytest.CaptureFixture[str], text: str) -> None:
    with capsys.disabled():
        print(f"\n{text}", flush=True)  # noqa: T201 - the figures that the test is for


def _read(inbox: Inbox, replay: Replay) -> None:
    while (arrival := inbox.get()) is not None:
        (replay.take_events if arrival.key.endswith("/events") else replay.take)(arrival.payload)


def _outage(replay: Replay, killed_ns: int) -> float:
    after = [at for result in replay.results.values() for at in result.times_ns if at > killed_ns + 50_000_000]
    return (min(after) - killed_ns) / 1e9
