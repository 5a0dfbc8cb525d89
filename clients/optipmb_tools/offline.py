"""Tracking one sequence in this process, without a network, and the profiles for it.

It gives the same bytes as replaying the dataset through the service (`optipmb_tools.replay`).
"""

import functools
import itertools
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any, Final

import numpy as np
from optipmb_client.errors import UsageError
from optipmb_schemas import Tracks, class_fields, path_fields

import optipmb
from optipmb import (
    FieldOfView,
    Frame,
    Modules,
    OptipmbError,
    Parameters,
    PointCloud,
    Pose,
    PredictedPaths,
    StepResult,
    Tracker,
    class_indices,
    generic_parameters,
    load_profile,
    make_frame,
    predict_tracks,
    profile_source,
    profiles,
    warm_up,
)
from optipmb_tools.datasets import DataSequence, DetectionFrame, selected_frames
from optipmb_tools.datasets.motion import LEAST_ALONG, SURE_MOVES, headings_along
from optipmb_tools.geometry import Floats

__all__ = [
    "AUTO",
    "Tracked",
    "doubts",
    "profile_compared",
    "profile_for",
    "profile_source",
    "profiles",
    "read_profile",
    "track_fields",
    "track_whole",
    "tracker_frame",
    "warm_up",
]

AUTO: Final = "auto"  # name of the profile that is made for the data: rate and classes as they come
USUAL_PERIOD: Final = 0.1
FAR: Final = 1.6  # ratio of rates from which a profile does not fit
LOOKED_AT: Final = 20  # sequences that tell rate and scores
LOOKED_INTO: Final = 300  # frames of each of them
GLANCE: Final = 20  # frames that tell whether the rate is about that of a profile: clouds, if any, take long to read


@dataclass(frozen=True)
class Tracked:
    """Tracks of one sequence by frame index, and counts."""

    tracks: dict[int, Tracks]
    clouds: int
    detections: int
    left_out: dict[str, int]  # detections of each class that the profile lacks, or that are below its score filter
    estimated: int  # frames in which the motion of the sensor was estimated
    steps_ns: tuple[int, ...]
    seconds: float


def read_profile(profile: str) -> Parameters:
    """Return a parameter profile by name or file.

    Raises:
        UsageError: There is none, or its content is not valid.
    """
    try:
        return load_profile(profile)
    except OptipmbError as error:
        raise UsageError(f"--profile {profile}: {error}") from error


@dataclass(frozen=True)
class FieldOfProfile:
    """A field of a profile."""

    path: str  # below a class
    description: str
    values: dict[str, float]  # by class


def fields_of(parameters: Parameters) -> Iterator[FieldOfProfile]:
    """Yield every field with numbers of the classes of a profile."""
    yield from _fields_of("", dict(parameters.classes))


def _fields_of(path: str, tables: dict[str, Any]) -> Iterator[FieldOfProfile]:
    for name, field in type(next(iter(tables.values()))).model_fields.items():
        values = {label: getattr(table, name) for label, table in tables.items()}
        numbers = {label: value for label, value in values.items() if isinstance(value, (int, float))}
        inner = {label: value for label, value in values.items() if hasattr(value, "model_fields_set")}
        if numbers:
            yield FieldOfProfile(path + name, field.description or "", numbers)
        if inner:
            yield from _fields_of(f"{path}{name}.", inner)


def profile_for(profile: str, sequences: Sequence[DataSequence]) -> Parameters:
    """Return a profile by name or file, or for `auto` one that is made for these sequences.

    Raises:
        UsageError: There is none, or its content is not valid, or it has no class of the sequences.
    """
    parameters = _made_for(sequences) if profile == AUTO else read_profile(profile)
    labels = _labels(sequences)
    if labels and (class_indices(labels, parameters.labels) < 0).all():
        raise UsageError(_nothing(profile, parameters, labels))
    return parameters


def profile_compared(profile: str, sequences: Sequence[DataSequence]) -> Parameters:
    """Return a profile as `profile_for` does, whose tracks are compared with a truth: class names have to be equal.

    Raises:
        UsageError: There is none, or its content is not valid, or no class has a name of the sequences.
    """
    parameters = profile_for(profile, sequences)
    labels = _labels(sequences)
    if labels and not set(labels) & set(parameters.labels):
        raise UsageError(_nothing(profile, parameters, labels))
    return parameters


def _nothing(profile: str, parameters: Parameters, labels: tuple[str, ...]) -> str:
    return (
        f"--profile {profile}: it has the classes {', '.join(parameters.labels)}, and the detections are of "
        f"{', '.join(labels)}: nothing would be tracked (--profile auto takes any)"
    )


def doubts(parameters: Parameters, sequences: Sequence[DataSequence]) -> Iterator[str]:
    """Yield doubts whether a profile fits the sequences, a line each."""
    known = parameters.labels
    labels = _labels(sequences)
    found = dict(zip(labels, class_indices(labels, known).tolist(), strict=True))
    if missing := [name for name, place in found.items() if place < 0]:
        yield f"profile {parameters.name} does not track {', '.join(missing)}: left out"
    if renamed := [f"{name} as {known[place]}" for name, place in found.items() if place >= 0 and name != known[place]]:
        yield f"profile {parameters.name} tracks {', '.join(renamed)}"
    period, nominal = _period(sequences, GLANCE), parameters.nominal_period
    if period is not None and not 1.0 / FAR <= period / nominal <= FAR:
        yield (
            f"frames come at {1.0 / period:.3g} Hz, profile {parameters.name} is for {1.0 / nominal:.3g} Hz: "
            "--profile auto, or a profile tuned at this rate, may track better"
        )
    share, moves = headings_along(one for one in sequences if not one.time_column)  # tables told theirs
    if share < LEAST_ALONG and moves >= SURE_MOVES:
        yield f"headings and motion disagree: {share:.0%} of {moves} moves of boxes are along their headings"


def _labels(sequences: Sequence[DataSequence]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(label for one in sequences for label in one.labels))


def _period(sequences: Sequence[DataSequence], frames: int) -> float | None:
    """Return the median time in seconds between the first `frames` frames of the first sequences."""
    steps = [
        (after.stamp_ns - before.stamp_ns) / 1e9
        for one in itertools.chain.from_iterable(one.sensors or (one,) for one in sequences[:LOOKED_AT])
        for before, after in itertools.pairwise(itertools.islice(one.frames(), frames))
    ]
    return median(steps) or None if steps else None


def _made_for(sequences: Sequence[DataSequence]) -> Parameters:
    labels = _labels(sequences)
    try:
        return generic_parameters(labels or ("object",), _period(sequences, LOOKED_INTO) or USUAL_PERIOD)
    except OptipmbError as error:
        raise UsageError(f"--profile {AUTO}: {error}") from error


def tracker_frame(parameters: Parameters, sequence: str, given: DetectionFrame) -> Frame:
    """Return a frame of a sequence for the tracker.

    Raises:
        UsageError: It holds values that the tracker refuses.
    """
    cloud = given.cloud
    try:
        frame, _ = make_frame(
            parameters,
            stamp_ns=given.stamp_ns,
            labels=given.labels,
            pose=Pose(*given.pose),
            cloud=None if cloud is None else PointCloud(cloud.xyz, Pose(*cloud.pose)),
            field_of_view=FieldOfView.of(given.field_of_view, None),
            **given.columns,
        )
    except OptipmbError as error:
        raise UsageError(f"sequence {sequence}, frame {given.index}: {error}") from error
    return frame


_warm = functools.cache(warm_up)  # once in each process


def track_whole(
    parameters: Parameters,
    sequence: DataSequence,
    classes: Sequence[str] = (),
    modules: Modules | None = None,
    *,
    smooth: bool = False,
    on_frame: Callable[[], None] = lambda: None,
) -> Tracked:
    """Track one sequence, with `smooth` so that states are given all frames of their track.

    Raises:
        UsageError: A frame holds values that the tracker refuses.
        DatasetError: The sequence cannot be read.
    """
    _warm()
    begun = time.monotonic()
    found: dict[int, Tracks] = {}
    steps: list[int] = []
    clouds = detections = estimated = 0
    left_out: Counter[str] = Counter()
    least = np.array([one.score_filter for one in parameters.classes.values()])
    given, low = np.zeros(len(least), np.int64), np.zeros(len(least), np.int64)
    smoother = None
    if smooth:
        from optipmb_tools.smoothing import Smoother  # noqa: PLC0415  of --smooth alone

        smoother = Smoother(parameters)
    # A smoother joins the frames of a track, which an estimated motion has in axes of their own.
    tracker = Tracker(parameters.model_copy(update={"sensor_motion": False}) if smooth else parameters, modules)
    density = tracker.initial()
    for frame in selected_frames(sequence, classes):
        taken = tracker_frame(parameters, sequence.name, frame)
        started = time.perf_counter_ns()
        result = tracker.step(density, taken)
        steps.append(time.perf_counter_ns() - started)
        density = result.density
        found[frame.index] = _message(parameters, sequence, frame, result)
        if smoother is not None:
            smoother.add(frame.index, density, result.tracks)
        clouds += frame.cloud is not None
        estimated += density.sensor_motion is not None
        detections += len(frame)
        if len(taken.source) < len(frame):
            left_out.update(frame.labels[i] for i in np.delete(frame.label, taken.source).tolist())
        given += np.bincount(taken.label, minlength=len(least))
        if not parameters.self_calibration:  # which never filters the upper half of a class
            low += np.bincount(taken.label[taken.score < least[taken.label]], minlength=len(least))
        on_frame()
    for name, count, total in zip(parameters.labels, low.tolist(), given.tolist(), strict=True):
        if count:
            most = ", most of the class" if count > total / 2 else ""
            left_out[f"{name} below its score_filter{most}"] = count
    if smoother is not None:
        for index, one in smoother.tracks():
            paths = predict_tracks(one, parameters.horizons, parameters) if parameters.horizons else None
            found[index] = found[index].model_copy(update=track_fields(one, paths))
    return Tracked(found, clouds, detections, dict(left_out), estimated, tuple(steps), time.monotonic() - begun)


def track_fields(
    tracks: optipmb.Tracks, paths: PredictedPaths | None, class_probability: Floats | None = None
) -> dict[str, Any]:
    """Return tracks, their paths and classes as fields of the message.

    Raises:
        MessageError: Paths or classes hold numbers that no message may.
    """
    fields = dict(tracks.columns()) | {"confirmed": tracks.confirmed.astype(np.int64)}
    if paths is not None:
        fields |= path_fields(paths.horizons, paths.mean, paths.covariance)
    return fields if class_probability is None else fields | class_fields(class_probability)


def _message(parameters: Parameters, sequence: DataSequence, frame: DetectionFrame, result: StepResult) -> Tracks:
    """Return the tracks of a frame as the service publishes them, in a session that has no name."""
    header = {
        "stream": sequence.name,
        "epoch": bytes(16),
        "seq": frame.index,
        "stamp_ns": frame.stamp_ns,
        "session": "0" * 32,
        "profile": parameters.name,
        "cloud_used": frame.cloud is not None,
        "labels": parameters.labels,
    }
    return Tracks.trusted(header | track_fields(result.tracks, result.paths, result.class_probability))
