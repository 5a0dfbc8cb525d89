"""Tracking a dataset in this process, without a network: the one module of the client that imports the tracker.

It gives the same bytes as replaying the dataset through the service (`optipmb_client.replay`).
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from optipmb import (
    Modules,
    OptipmbError,
    Parameters,
    PointCloud,
    Pose,
    Tracker,
    Tracks,
    load_profile,
    make_frame,
    warm_up,
)
from optipmb_client.datasets import DataSequence, Dataset, DetectionFrame
from optipmb_client.errors import UsageError
from optipmb_client.geometry import Floats, Ints
from optipmb_client.recording import Latency, latency, selected_frames, write_results

__all__ = ["NamedTracks", "TrackedSequence", "read_profile", "track", "track_sequence", "warm_up"]


@dataclass(frozen=True)
class NamedTracks:
    """The tracker's tracks of one frame together with the names that their labels point into."""

    tracks: Tracks
    labels: tuple[str, ...]

    @property
    def id(self) -> Ints:
        """(N,)."""
        return self.tracks.id

    @property
    def label(self) -> Ints:
        """(N,) index into `labels`."""
        return self.tracks.label

    @property
    def center(self) -> Floats:
        """(N, 3)."""
        return self.tracks.center

    @property
    def size(self) -> Floats:
        """(N, 3) length, width, height."""
        return self.tracks.size

    @property
    def yaw(self) -> Floats:
        """(N,)."""
        return self.tracks.yaw

    @property
    def velocity(self) -> Floats:
        """(N, 2)."""
        return self.tracks.velocity

    @property
    def score(self) -> Floats:
        """(N,)."""
        return self.tracks.score

    @property
    def existence(self) -> Floats:
        """(N,)."""
        return self.tracks.existence

    @property
    def yaw_rate(self) -> Floats:
        """(N,)."""
        return self.tracks.yaw_rate

    @property
    def acceleration(self) -> Floats:
        """(N,)."""
        return self.tracks.acceleration

    @property
    def covariance(self) -> Floats:
        """(N, 6, 6)."""
        return self.tracks.covariance

    @property
    def age(self) -> Floats:
        """(N,)."""
        return self.tracks.age

    @property
    def time_since_detection(self) -> Floats:
        """(N,)."""
        return self.tracks.time_since_detection

    @property
    def detection(self) -> Ints:
        """(N,)."""
        return self.tracks.detection


@dataclass(frozen=True)
class TrackedSequence:
    """What tracking one sequence took and gave. `step` are the durations of the tracker's steps."""

    name: str
    file: Path
    frames: int
    clouds: int
    tracks: int
    seconds: float
    step: Latency | None


def read_profile(profile: str) -> Parameters:
    """Return a parameter profile by name or file.

    Raises:
        UsageError: There is none, or its content is not valid.
    """
    try:
        return load_profile(profile)
    except OptipmbError as error:
        raise UsageError(f"--profile {profile}: {error}") from error


def track_sequence(
    parameters: Parameters, sequence: DataSequence, classes: Sequence[str] = (), modules: Modules | None = None
) -> Iterator[tuple[DetectionFrame, NamedTracks, int]]:
    """Track one sequence; yield each frame with its tracks and the nanoseconds that the step took.

    Raises:
        UsageError: A frame holds values that the tracker refuses.
    """
    tracker = Tracker(parameters, modules)
    names = tuple(parameters.classes)
    density = tracker.initial()
    for given in selected_frames(sequence, classes):
        try:
            cloud = given.cloud
            frame, _ = make_frame(
                parameters,
                stamp_ns=given.stamp_ns,
                labels=given.labels,
                label=given.label,
                center=given.center,
                size=given.size,
                yaw=given.yaw,
                score=given.score,
                velocity=given.velocity,
                pose=Pose(given.pose.translation, given.pose.quaternion),
                cloud=None if cloud is None else PointCloud(cloud.xyz, Pose(cloud.translation, cloud.quaternion)),
            )
        except OptipmbError as error:
            raise UsageError(f"sequence {sequence.name}, frame {given.index}: {error}") from error
        begun = time.perf_counter_ns()
        result = tracker.step(density, frame)
        took = time.perf_counter_ns() - begun
        density = result.density
        yield given, NamedTracks(result.tracks, names), took


def track(
    dataset: Dataset,
    sequences: Sequence[DataSequence],
    out: Path,
    *,
    profile: str,
    classes: Sequence[str] = (),
    modules: Modules | None = None,
    full: bool = False,
    on_frame: Callable[[], None] = lambda: None,
) -> Iterator[TrackedSequence]:
    """Track sequences one after the other and write the result file of each into `out`; yield each when it is done.

    With `full`, all that is known of the tracks is written too, beside each result file.

    Raises:
        UsageError: No such profile or class, or values that the tracker refuses.
    """
    parameters = read_profile(profile)
    warm_up()
    for sequence in sequences:
        begun = time.monotonic()
        results: dict[int, NamedTracks] = {}
        steps: list[int] = []
        clouds = 0
        for frame, tracks, took in track_sequence(parameters, sequence, classes, modules):
            results[frame.index] = tracks
            steps.append(took)
            clouds += frame.cloud is not None
            on_frame()
        file = write_results(dataset, sequence, out, results, full=full)
        identities = {int(number) for tracks in results.values() for number in tracks.id}
        seconds = time.monotonic() - begun
        yield TrackedSequence(sequence.name, file, len(results), clouds, len(identities), seconds, latency(steps))
