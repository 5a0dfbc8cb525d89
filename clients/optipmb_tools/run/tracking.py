"""Offline tracking: one sequence in this process, or the recordings of a data set, one task each.

A replay through the service (`optipmb_tools.run.replay`) gives the same bytes as this without hindsight.
"""

import functools
import itertools
import operator
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from optipmb_client.errors import ClientError, UsageError
from optipmb_schemas import Tracks, attributes_by_name, path_fields, track_fields

import optipmb
from optipmb import (
    Density,
    FieldOfView,
    Frame,
    Modules,
    OptipmbError,
    Parameters,
    PointCloud,
    Pose,
    PredictedPaths,
    Sensors,
    StepResult,
    Tracker,
    make_frame,
    predict_tracks,
    warm_up,
)
from optipmb.learning.hindsight import with_hindsight
from optipmb.learning.self_calibration import learned_noise
from optipmb.learning.sensor_motion import UNKNOWN_MOTION
from optipmb.learning.velocity_check import EXPECTED, VelocityCheck
from optipmb.model.attributes import shown_of
from optipmb.model.density import STATE, V
from optipmb.model.parameters import ALIKE
from optipmb_tools.datasets import DataSequence, Dataset, DatasetArguments, DetectionFrame, selected_frames
from optipmb_tools.files import remove_unfinished
from optipmb_tools.results.output import Latency, Results, TrackCounts, horizons_for, latency
from optipmb_tools.run.bulk import Executor, Failed, Here, in_order, run
from optipmb_tools.spool import SpooledTracks
from optipmb_tools.table_files import Columns

if TYPE_CHECKING:
    from optipmb_tools.run.rejoining import RejoinOptions

_TOLD = ("id", "label", "existence", "age", "time_since_detection")  # columns that tell whether tracks are shown
_MOTION = ("acceleration", "yaw", "yaw_rate", "velocity")
_VARIANCE: Mapping[str, Callable[[Tracks], NDArray[Any]]] = {"covariance": lambda one: one.covariance[:, V, V]}
ROWS = 1 << 17
"""Of tracks that are decided in hindsight together: a row takes 300 bytes then."""
SHOWN = 20  # recordings that failed, named in the error


def _ignored() -> None:
    """Do nothing, as the default of a callback."""


@dataclass(frozen=True)
class Tracked:
    """Tracks of one sequence by frame index, and counts."""

    tracks: SpooledTracks
    clouds: int
    detections: int
    left_out: dict[str, int]  # detections of each class that the profile lacks, or that are below its score filter
    estimated: int  # frames in which the motion of the sensor was estimated
    on_vehicle: bool  # the sensor, as `Density.on_vehicle` in the end
    learned: tuple[str, ...]  # noise of the detections of each class, in words
    doubts: tuple[str, ...]  # velocities that contradict the motion of their boxes, by sensor, in words
    steps_ns: tuple[int, ...]
    seconds: float


@dataclass(frozen=True)
class Tracking:
    """How sequences are tracked."""

    parameters: Parameters
    classes: Sequence[str] = ()  # only detections of these; empty: all
    modules: Modules | None = None
    full: bool = False  # also write all columns of the tracks
    smooth: bool = False  # estimate states from all frames of their track (`optipmb_tools.run.smoothing`)
    hindsight_s: float = 0.0  # time after a frame that tells its velocities (`learning.hindsight`); 0: no hindsight
    show: float | None = None  # existence from which tracks are confirmed; None: as the profile says
    sensors: Sensors = ALIKE  # how frames that name their sensor are used
    rejoin: "RejoinOptions | None" = None  # join tracks over gaps (`optipmb_tools.run.rejoining`)
    ids: str = "track"  # what ids are in the results: of the track, or of its object (`object`)
    view: Path | None = None  # page of the tracks, of one sequence


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


def _trackers(
    parameters: Parameters, modules: Modules | None, sensors: Sensors
) -> Callable[[str], tuple[Parameters, Tracker, NDArray[np.float64]]]:
    """Return a function that gives the parameters of a sensor, their tracker and score filters."""

    @functools.cache
    def used(sensor: str) -> tuple[Parameters, Tracker, NDArray[np.float64]]:
        own = sensors.parameters(parameters, sensor)
        return own, Tracker(own, modules), np.array([one.score_filter for one in own.classes.values()])

    return used


def track_whole(
    how: Tracking,
    sequence: DataSequence,
    *,
    on_frame: Callable[[], None] = _ignored,
    sensor: NDArray[np.float64] | None = None,
) -> Tracked:
    """Track one sequence. Tracks are not yet decided in hindsight, and not joined.

    `sensor`: `Density.sensor` before the first frame.

    Raises:
        UsageError: A frame holds values that the tracker refuses.
        DatasetError: The sequence cannot be read.
    """
    parameters = how.parameters
    _warm()
    begun = time.monotonic()
    found = SpooledTracks()
    steps: list[int] = []
    checks: defaultdict[str, VelocityCheck] = defaultdict(VelocityCheck)  # by sensor
    clouds = detections = estimated = 0
    left_out: Counter[str] = Counter()
    size = len(parameters.classes)
    given, low = np.zeros(size, np.int64), np.zeros(size, np.int64)
    smoother = None
    if how.smooth:
        from optipmb_tools.run.smoothing import Smoother  # noqa: PLC0415  of --smooth alone

        smoother = Smoother(parameters)
    # A smoother joins the frames of a track, which an estimated motion has in axes of their own.
    followed = parameters.model_copy(update={"sensor_motion": False}) if how.smooth else parameters
    used = _trackers(followed, how.modules, how.sensors)
    density = replace(Density.empty(parameters.labels), sensor=sensor)
    for frame in selected_frames(sequence, how.classes):
        own, tracker, least = used(frame.sensor)
        taken = tracker_frame(own, sequence.name, frame)
        started = time.perf_counter_ns()
        result = tracker.step(density, taken)
        steps.append(time.perf_counter_ns() - started)
        density = result.density
        found.add(frame.index, _message(parameters, sequence, frame, result))
        if smoother is not None:
            smoother.add(frame.index, density, result.tracks)
        checks[frame.sensor].add(taken, estimated=density.sensor_motion is not None)
        clouds += frame.cloud is not None
        estimated += density.sensor_motion is not None
        detections += len(frame)
        if len(taken.source) < len(frame):
            left_out.update(frame.labels[i] for i in np.delete(frame.label, taken.source).tolist())
        given += np.bincount(taken.label, minlength=size)
        if not parameters.self_calibration:  # which never filters the upper half of a class
            low += np.bincount(taken.label[taken.score < least[taken.label]], minlength=size)
        on_frame()
    left_out.update(_below_filters(parameters.labels, low, given))
    if smoother is not None:
        smoothed = SpooledTracks()
        for index, one in smoother.tracks():
            paths = predict_tracks(one, parameters.horizons, parameters) if parameters.horizons else None
            smoothed.add(index, found[index].model_copy(update=fields_of(one, paths)))
        found = smoothed
    counts = clouds, detections, dict(left_out), estimated, density.on_vehicle
    doubts = tuple(one.contradiction for one in checks.values() if one.contradiction)
    return Tracked(found, *counts, learned_noise(density), doubts, tuple(steps), time.monotonic() - begun)


def _below_filters(labels: Sequence[str], low: NDArray[np.int64], given: NDArray[np.int64]) -> dict[str, int]:
    """Return how many detections of each class are below its filter, in words."""
    return {
        f"{name} below its score_filter{', most of the class' if count > total / 2 else ''}": count
        for name, count, total in zip(labels, low.tolist(), given.tolist(), strict=True)
        if count
    }


def fields_of(tracks: optipmb.Tracks, paths: PredictedPaths | None, **others: Any) -> dict[str, Any]:
    """Return tracks, their paths and other columns that there may be as fields of the message.

    Raises:
        MessageError: Paths or others hold numbers that no message may.
    """
    fields = dict(tracks.columns()) | {"confirmed": tracks.confirmed.astype(np.int64)}
    if paths is not None:
        fields |= path_fields(paths.horizons, paths.mean, paths.covariance)
    return fields | track_fields(**others)


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
    others = {"class_probability": result.class_probability, "measured": result.measured}
    fields = fields_of(result.tracks, result.paths, **others)
    if result.density.attributes is not None:
        texts = shown_of(result.density.attributes, result.tracks.id)
        fields["attributes"] = attributes_by_name(texts, len(result.tracks.id)) or None
    return Tracks.trusted(header | fields)


@dataclass(frozen=True)
class TrackedSequence:
    """Result of tracking one sequence."""

    name: str
    file: Path
    frames: int
    clouds: int
    detections: int
    left_out: dict[str, int]  # detections of each class that the profile lacks, or that are below its score filter
    estimated: int  # frames in which the motion of the sensor was estimated
    cut: tuple[int, int]  # boxes above the limit of a benchmark in a sample, and such samples
    tracks: int  # that are shown in some frame
    rows: int  # a track in a frame
    unconfirmed_rows: int
    learned: tuple[str, ...]  # noise of the detections of each class, in words
    doubts: tuple[str, ...]  # velocities that contradict the motion of their boxes, in words
    joined: tuple[int, int] | None  # confirmed tracks and their objects; None: they are not joined over gaps
    seconds: float
    step: Latency | None  # durations of the tracker's steps


def decided(tracked: Tracked, how: Tracking) -> SpooledTracks:
    """Return the tracks by frame index, confirmed as `how` says; velocities change where all frames have equal axes."""
    found = tracked.tracks
    if how.hindsight_s and len(found):
        velocity_s = 0.0 if how.smooth or tracked.estimated else how.hindsight_s
        names = [*_TOLD, *(_MOTION if velocity_s else ())]
        wanted: dict[str, Callable[[Tracks], NDArray[Any]]] = {name: operator.attrgetter(name) for name in names}
        wanted |= _VARIANCE
        identity = found.columns({"id": operator.attrgetter("id")})["id"]
        columns: Columns = {}
        for ids in np.split(unique := np.unique(identity), np.searchsorted(unique, np.sort(identity)[ROWS::ROWS])):
            if not len(ids):  # a track of more rows is before
                continue
            of_ids = (identity >= ids[0]) & (identity <= ids[-1])
            rows = found.columns(wanted, of_ids)
            rows["covariance"] = np.broadcast_to(rows["covariance"][:, None, None], (len(rows["id"]), STATE, STATE))
            (changed,) = with_hindsight([SimpleNamespace(**rows)], how.parameters, velocity_s=velocity_s, show=how.show)
            changed["confirmed"] = changed["confirmed"].astype(np.int64)
            for name, values in changed.items():
                columns.setdefault(name, np.empty((len(identity), *values.shape[1:]), values.dtype))[of_ids] = values
        return found.with_columns(columns)
    if how.show is not None and len(found):
        shown = found.columns({"existence": operator.attrgetter("existence")})["existence"] >= how.show
        return found.with_columns({"confirmed": shown.astype(np.int64)})
    return found


@dataclass(frozen=True)
class _Job:
    """Arguments of all tasks of a run."""

    data: DatasetArguments
    out: Path
    how: Tracking
    here: Dataset | None = None  # opened already, with its sequences; another process opens the data set itself
    sequences: Mapping[str, DataSequence] = field(default_factory=dict)
    on_frame: Callable[[], None] = _ignored

    @functools.cached_property
    def dataset(self) -> Dataset:
        return self.here or self.data.open()


class RecordingsFailed(ClientError):  # noqa: N818  as its siblings
    """Some of several recordings failed; the others are tracked, and their results are written.

    Attributes:
        failures: Reason by name of the recording.
    """

    def __init__(self, failures: Mapping[str, Failed], count: int) -> None:
        self.failures = dict(failures)
        names = " ".join([*itertools.islice(failures, SHOWN), *(["…"] if len(failures) > SHOWN else [])])
        super().__init__(f"{len(failures)} of {count} recordings failed, the others are tracked: {names}")
        for trace in dict.fromkeys(one.trace for one in failures.values() if one.trace):
            self.add_note(trace)


def _track_one(job: _Job, name: str) -> tuple[TrackedSequence, Path | Iterable[Columns]]:
    """Track one sequence and write its results; idempotent. Return the rows where all sequences share one table."""
    dataset, how = job.dataset, job.how
    sequence = job.sequences[name] if name in job.sequences else dataset.sequences([name])[0]
    found = track_whole(how, sequence, on_frame=job.on_frame)
    if how.hindsight_s and found.on_vehicle:  # also before its frames showed it
        found = track_whole(how, sequence, sensor=UNKNOWN_MOTION)
    if how.rejoin is not None and found.estimated:
        expected = "expected boxes in a world frame, or poses of the sensor"
        raise UsageError(f"--rejoin: sequence {name}: {expected}; here the motion of the sensor is estimated")
    found = replace(found, tracks=decided(found, how))
    objects = None if how.rejoin is None else how.rejoin.objects(found.tracks, how.parameters)
    joined = None if objects is None else (len(objects.id), len(np.unique(objects.object)))
    if objects is not None and how.ids == "object":
        joined_tracks = SpooledTracks()
        for index, one in found.tracks.items():
            joined_tracks.add(index, objects.as_ids(one))
        found = replace(found, tracks=joined_tracks)
        objects = None
    written = Results(dataset, job.out, full=how.full).write(sequence, found.tracks, objects)
    if job.here is None and not isinstance(written, Path):
        written = list(written)
    if how.view is not None:
        from optipmb_tools.views.page import write_page  # noqa: PLC0415  only where it is asked for

        write_page(how.view, name, found.tracks)
    beyond = []
    if dataset.name == "nuscenes" and isinstance(written, Path):
        from optipmb_tools.results.nuscenes import NUSCENES_MAX_BOXES  # noqa: PLC0415  of one format

        counts = [len(one.id) for one in found.tracks.values()]
        beyond = [count - NUSCENES_MAX_BOXES for count in counts if count > NUSCENES_MAX_BOXES]
    return TrackedSequence(
        name,
        written if isinstance(written, Path) else job.out,
        len(found.tracks),
        found.clouds,
        found.detections,
        found.left_out,
        found.estimated,
        (sum(beyond), len(beyond)),
        *TrackCounts.of(found.tracks.values()),
        found.learned,
        tuple(f"velocity: expected {EXPECTED}, received {one}" for one in found.doubts),
        joined,
        found.seconds,
        latency(found.steps_ns),
    ), written


def _taken(
    ended: Iterable[tuple[int, Any]],
    sequences: Sequence[DataSequence],
    results: Results,
    note: Callable[[str], None],
    on_frame: Callable[[], None],
) -> Iterator[tuple[int, TrackedSequence | Failed]]:
    """Yield the place and result of each sequence that ended, and count its frames."""
    for place, value in ended:
        sequence, result = sequences[place], value
        if not isinstance(value, Failed):
            result, written = value
            if not results.take(sequence, written):
                result = Failed(f"{written} is on another machine: --out needs a folder that all machines share")
        if isinstance(result, Failed) and len(sequences) > 1:
            note(f"recording {sequence.name} failed: {result.reason}")
        yield place, result
        for _ in range(len(sequence)):
            on_frame()


def track(
    dataset: Dataset,
    sequences: Sequence[DataSequence],
    out: Path,
    how: Tracking,
    *,
    executor: Executor | None = None,
    on_frame: Callable[[], None] = lambda: None,
    note: Callable[[str], None] = lambda _: None,
) -> Iterator[TrackedSequence]:
    """Track sequences, one task each, and write their results into `out`, a folder or a table.

    Yields each sequence when it and those before it are done and written. The results are the same bytes with any
    executor; other processes open the data set themselves. A sequence that fails does not stop the others.

    Raises:
        RecordingsFailed: Some of several sequences failed; raised when all others are done and written.
        UsageError, ClientError: All of them failed.
    """
    executor = executor or Here()
    if (horizons := horizons_for(out)) is not None:
        how = replace(how, parameters=how.parameters.model_copy(update={"horizons": horizons}))
    names = tuple(one.name for one in sequences)
    job = _Job(dataset.arguments, out, replace(how, classes=tuple(how.classes)))
    if executor.here:
        job = replace(job, here=dataset, sequences={one.name: one for one in sequences}, on_frame=on_frame)
        on_frame = _ignored  # frames are counted while they are tracked
    executor.start(_track_one, job)
    results = Results(dataset, out, full=how.full)
    failures: dict[str, Failed] = {}
    ended = run(executor, names, lambda name: f"recording {name}", note)
    taken = _taken(ended, sequences, results, note, on_frame)
    for name, one in zip(names, in_order(taken), strict=True):
        if isinstance(one, Failed):
            failures[name] = one
        else:
            yield one
    if len(failures) == len(names) > 0:
        raise failures[names[0]].error()
    for text in results.close(sequences):
        note(text)
    if not executor.here:
        remove_unfinished(out, names)
    if failures:
        raise RecordingsFailed(failures, len(names))
