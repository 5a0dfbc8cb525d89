"""A stream that several services take over from each other: the result equals an undisturbed session."""

import itertools
import time
from collections.abc import Sequence
from functools import cache

from fleet import PROFILE
from optipmb_schemas import Keys, SessionState, Tracks, decode
from router import Node, Sensor, plain, until
from sessions import undisturbed

KEYS = Keys()
SENSOR = Sensor()


def expected(frames: int, sensor: Sensor = SENSOR, profile: str = PROFILE) -> tuple[list[bytes], str]:
    return undisturbed([sensor.detections(seq) for seq in range(frames)], profile)[:2]


def distinct(node: Node, sensor: Sensor = SENSOR) -> dict[int, set[bytes]]:
    """The distinct tracks published for each frame."""
    found: dict[int, set[bytes]] = {}
    key = KEYS.tracks(sensor.stream)
    for payload in [payload for at, payload, _ in node.tracks_seen.items if at == key]:
        seq, content = content_of(payload)
        found.setdefault(seq, set()).add(content)
    return found


@cache  # asked again and again while more is waited for
def content_of(payload: bytes) -> tuple[int, bytes]:
    message = decode(payload, Tracks)
    return message.seq, plain(message)


def send(node: Node, first: int, last: int, pace_s: float = 0.05, sensors: Sequence[Sensor] = (SENSOR,)) -> None:
    for seq in range(first, last):
        node.send(*(sensor.detections(seq) for sensor in sensors))
        time.sleep(pace_s)  # the rate of a sensor, not a wait for anything


def check(node: Node, frames: int, *, owner: str, sensor: Sensor = SENSOR) -> SessionState:
    """All frames have been tracked as if nothing had happened, and one instance says that it owns the stream."""
    tracks, digest = expected(frames, sensor)
    until(lambda: len(distinct(node, sensor)) == frames, f"the tracks of {frames} frames", 30.0)
    assert distinct(node, sensor) == {seq: {one} for seq, one in enumerate(tracks)}
    owned = [KEYS.owner(sensor.stream, owner)]
    until(lambda: node.alive(KEYS.owners(sensor.stream)) == owned, f"{owner} owns it")
    state = node.ask(KEYS.query(sensor.stream, "state"), SessionState)
    assert (state.digest, state.frames, state.gaps) == (digest, frames, 0)
    return state


def published_by(node: Node, instance: str, sensor: Sensor = SENSOR) -> list[Tracks]:
    return [one for one in node.tracks(sensor.stream, 1) if one.delivery and one.delivery.instance == instance]


def outage_s(node: Node, since_ns: int, sensor: Sensor = SENSOR) -> float:
    key = KEYS.tracks(sensor.stream)
    later = [
        at
        for at, (where, _, _) in zip(node.tracks_seen.times_ns, node.tracks_seen.items, strict=True)
        if where == key and at > since_ns + 100_000_000
    ]
    return (min(later) - since_ns) / 1e9


def longest_silence_s(node: Node, sensor: Sensor = SENSOR, since_ns: int = 0) -> float:
    key = KEYS.tracks(sensor.stream)

    def times() -> list[int]:
        seen = tuple(zip(node.tracks_seen.times_ns, node.tracks_seen.items, strict=False))  # more may come meanwhile
        return [at for at, (where, _, _) in seen if where == key]

    until(lambda: max(times(), default=0) > since_ns, "the stream has tracks again")
    return max(later - earlier for earlier, later in itertools.pairwise(times()) if later > since_ns) / 1e9
