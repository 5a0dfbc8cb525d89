"""Recorded sequences as the messages that a sensor would send, and a replay of them through a service."""

import hashlib
import threading
import time
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

from optipmb_client.merging import FinalEvents
from optipmb_client.zenoh import Connection
from optipmb_schemas import Detections, Events, Keys, Points, Pose, SessionState, Tracks, decode, encode, encoding_of
from optipmb_tools.datasets import open_dataset
from router import plain
from sessions import bare_events

KEYS = Keys()
WINDOW = 8
"""Frames under way at most."""


@dataclass(frozen=True)
class Recording:
    """One stream's messages: every frame with its cloud, if it has one."""

    stream: str
    frames: list[tuple[Detections, Points | None]]

    @property
    def messages(self) -> list[Detections | Points]:
        return [one for detections, points in self.frames for one in (points, detections) if one is not None]


def kitti(root: Path, name: str, stream: str, frames: int) -> Recording:
    """The first frames of a KITTI sequence, under a stream and an epoch of its own."""
    return recording("kitti", root, "pointrcnn", name, stream, frames)


def recording(kind: str, root: Path, detector: str, name: str, stream: str, frames: int) -> Recording:
    """The first frames of a sequence (or of the first one, for `all`), under a stream and an epoch of its own."""
    dataset = open_dataset(kind, root, detector)
    sequence = dataset.sequences([name])[0]
    epoch = hashlib.blake2b(stream.encode(), digest_size=16).digest()
    made: list[tuple[Detections, Points | None]] = []
    clouds = 0
    for seq, frame in enumerate(islice(sequence.frames(), frames)):
        detections = Detections(
            stream=stream,
            epoch=epoch,
            seq=seq,
            stamp_ns=frame.stamp_ns,
            frame="sensor",
            pose=Pose(translation=frame.pose.translation, quaternion=frame.pose.quaternion),
            labels=frame.labels,
            label=frame.label,
            center=frame.center,
            size=frame.size,
            yaw=frame.yaw,
            score=frame.score,
            velocity=frame.velocity,
            has_points=frame.cloud is not None,
        )
        points = None
        if frame.cloud is not None:
            pose = Pose(translation=frame.cloud.pose.translation, quaternion=frame.cloud.pose.quaternion)
            points = Points(
                stream=stream,
                epoch=epoch,
                seq=clouds,
                stamp_ns=frame.stamp_ns,
                frame="sensor",
                pose=pose,
                xyz=frame.cloud.xyz,
            )
            clouds += 1
        made.append((detections, points))
    return Recording(stream, made)


@dataclass
class Replayed:
    """Results of a recording: by frame the distinct tracks, in the order of their revisions."""

    tracks: dict[int, set[bytes]] = field(default_factory=dict)
    repeated: int = 0
    times_ns: list[int] = field(default_factory=list)
    merged: FinalEvents = field(default_factory=FinalEvents)
    final: list[bytes] = field(default_factory=list)
    """Events of frames as they became final."""

    @property
    def events(self) -> list[bytes]:
        rest = sorted(self.merged.held.values(), key=lambda one: one.seq)
        return self.final + [bare_events(one) for one in rest if one.events]


class Replay:
    """Sends recordings, each on a thread, with at most `WINDOW` frames of each under way; collects their tracks."""

    def __init__(self, connection: Connection, recordings: list[Recording], *, pace_s: float = 0.0) -> None:
        self._connection = connection
        self._pace_s = pace_s
        self.recordings = recordings
        self.results = {recording.stream: Replayed() for recording in recordings}
        self.changed = threading.Condition()
        self.failed: list[str] = []
        self._senders = []
        for recording in recordings:
            detections = connection.cached_sender(
                KEYS.detections(recording.stream), encoding_of(Detections), cache=len(recording.frames)
            )
            # Clouds too are kept: a frame tracked with its cloud before a kill must be tracked with it again.
            points = connection.plain_sender(
                KEYS.points(recording.stream), encoding_of(Points), cache=len(recording.frames)
            )
            self._senders.append((detections, points))
        self._threads = [
            threading.Thread(target=self._send, args=(recording, *senders), daemon=True)
            for recording, senders in zip(recordings, self._senders, strict=True)
        ]

    def take(self, payload: bytes) -> None:
        tracks = decode(payload, Tracks)
        if (result := self.results.get(tracks.stream)) is None:
            return
        with self.changed:
            seen = result.tracks.setdefault(tracks.seq, set())
            result.repeated += bool(seen)
            if not seen:
                result.times_ns.append(time.monotonic_ns())
            seen.add(plain(tracks))
            self.changed.notify_all()

    def take_events(self, payload: bytes) -> None:
        events = decode(payload, Events)
        if (result := self.results.get(events.stream)) is not None:
            with self.changed:
                result.final += [bare_events(one) for one in result.merged.take(events) if one.events]
                self.changed.notify_all()

    def wait_events(self, stream: str, expected: list[bytes], deadline_s: float) -> bool:
        with self.changed:
            return self.changed.wait_for(lambda: self.results[stream].events == expected, deadline_s)

    def start(self) -> None:
        for thread in self._threads:
            thread.start()

    @property
    def returned(self) -> int:
        return sum(len(result.tracks) for result in self.results.values())

    def wait(self, frames: int, deadline_s: float) -> None:
        with self.changed:
            came = self.changed.wait_for(lambda: self.returned >= frames, deadline_s)
        assert came, f"{self.returned} of {frames} frames came back within {deadline_s:g} s"

    def finish(self, deadline_s: float) -> None:
        self.wait(sum(len(recording.frames) for recording in self.recordings), deadline_s)
        for thread in self._threads:
            thread.join(deadline_s)

    def close(self) -> None:
        for senders in self._senders:
            for sender in senders:
                sender.close()

    def state(self, stream: str) -> SessionState:
        (answer,) = self._connection.query(KEYS.query(stream, "state"), timeout=60.0)
        return decode(answer.payload, SessionState)

    def _send(self, recording: Recording, detections: object, points: object) -> None:
        result = self.results[recording.stream]
        for number, (frame, cloud) in enumerate(recording.frames):
            with self.changed:
                self.changed.wait_for(lambda number=number: number - len(result.tracks) < WINDOW)  # type: ignore[misc]  # bound now
            if self._pace_s:
                time.sleep(self._pace_s)  # the rate of a sensor, not a wait for anything
            if cloud is not None:
                points.put(encode(cloud))  # type: ignore[attr-defined]  # a sender
            detections.put(encode(frame))  # type: ignore[attr-defined]  # a sender
