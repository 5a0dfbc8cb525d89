"""Figures of the results of a dataset against its truth.

Conventions: metres, z up. CLEAR MOT and the protocols of KITTI are taken where KITTI has its boxes, in the sensor frame
of each frame and in its image, so that a tilt of the sensor changes nothing; figures that need centres in the plane are
taken in the world frame.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from optipmb_tools.datasets import DataSequence, DatasetArguments, DatasetError, Truth
from optipmb_tools.datasets.nuscenes import CLASS_RANGE, NuScenesSequence
from optipmb_tools.evaluation.ab3dmot import IOU_LIMITS, Ab3dmotResult, evaluate_ab3dmot
from optipmb_tools.evaluation.calibration import CalibrationResult, evaluate_calibration
from optipmb_tools.evaluation.cases import Case, Rules, ab3dmot_rules, default_rules, hota_2d_rules, prepare
from optipmb_tools.evaluation.clear import ClearResult, Sweep, clear, combine, sweep
from optipmb_tools.evaluation.errors import ErrorResult, evaluate_errors
from optipmb_tools.evaluation.figures import defined
from optipmb_tools.evaluation.gospa import CUTOFF, ORDER, GospaResult, evaluate_gospa
from optipmb_tools.evaluation.hota import HotaResult, evaluate_hota
from optipmb_tools.evaluation.identity import IdentityResult, evaluate_identity, velocity_errors
from optipmb_tools.evaluation.tracks import (
    By,
    read_compared,
    read_full_tracks,
    result_file,
    scene_table,
    shown_submission,
)
from optipmb_tools.results import FullTable, ResultTable
from optipmb_tools.results.nuscenes import read_nuscenes_results, scene_file

_ROUNDING = 1e-9


@dataclass(frozen=True)
class ClassResult:
    """The CLEAR MOT figures of one class."""

    name: str
    total: ClearResult  # all tracks, all sequences
    sequences: dict[str, ClearResult]  # all tracks, by sequence
    sweep: Sweep  # all sequences, over thresholds on the mean score of a track
    confirmed: ClearResult | None  # tracks that are shown, all sequences; None where the files do not tell

    @property
    def shown(self) -> ClearResult:
        """Figures of the tracks that are shown."""
        return self.confirmed or self.total


def evaluate_files(
    sequences: Sequence[DataSequence],
    results: Path,
    names: Sequence[str],
    rules: Rules,
    warn: Callable[[str], None] | None = None,
    *,
    by: By = "id",
) -> list[ClassResult]:
    """Return the CLEAR MOT figures of each class from the tracks of each sequence.

    Args:
        sequences: each must have a truth.
        results: the folder of the result files, or a table of tracks.
        names: classes; a class that occurs neither in the truth nor in the results is left out.
        rules: how to compare.
        warn: is called with each assumption.
        by: column that tells which rows are of one track.

    Raises:
        DatasetError: a sequence has no truth, or its result file is missing or wrong.
    """
    cases: dict[str, list[Case]] = {name: [] for name in names}
    confirmed: dict[str, list[Case]] = {name: [] for name in names}
    pairs = read_compared(sequences, results, names, warn, by=by)
    for sequence, (truth, table) in zip(sequences, pairs, strict=True):
        local = truth.to_sensor(sequence.poses)
        for name in names:
            cases[name].append(prepare(local, table, name, rules, sequence.name))
            if table.confirmed is not None:
                confirmed[name].append(prepare(local, table.shown, name, rules, sequence.name))
    found = []
    for name, parts in cases.items():
        if any(len(part.truth_id) or len(part.track_id) for part in parts):
            single = {case.sequence: clear(case, rules) for case in parts}
            shown = combine(clear(case, rules) for case in confirmed[name]) if confirmed[name] else None
            found.append(ClassResult(name, combine(single.values()), single, sweep(parts, rules), shown))
    return found


@dataclass(frozen=True)
class EvaluatedSequence:
    """One sequence with its truth and its tracks, both in the world frame."""

    sequence: DataSequence
    truth: Truth
    tracks: ResultTable
    full: FullTable | None  # all columns of the same tracks, where they were kept


@dataclass(frozen=True)
class FigureOptions:
    """Options of the figures."""

    limits: tuple[float, ...] = IOU_LIMITS  # least 3D intersections over union for AB3DMOT's protocol
    cutoff: float = CUTOFF  # c of GOSPA and OSPA, metres
    order: float = ORDER  # p of GOSPA and OSPA


@dataclass(frozen=True)
class TrackFigures:
    """Figures of the tracks of one class that reach a score."""

    threshold: float  # lowest mean score of these tracks; minus infinity for all
    hota_2d: HotaResult | None  # KITTI only
    hota: HotaResult  # of centres in the plane
    gospa: GospaResult
    identity: IdentityResult  # of centres in the plane


@dataclass(frozen=True)
class ClassFigures:
    """The figures of one class over all sequences."""

    name: str
    ab3dmot: tuple[Ab3dmotResult, ...]  # one for each limit; KITTI only
    everything: TrackFigures  # of all tracks
    best: TrackFigures | None  # of the tracks from the best threshold on
    confirmed: TrackFigures | None  # of the tracks that are shown; None where the files do not tell
    calibration: CalibrationResult | None  # where the tracks were kept with all columns
    errors: ErrorResult | None  # likewise
    velocity_error: float  # mean error of velocities, m/s; NaN where none are known
    clear: ClearResult | None  # of the confirmed tracks, matched by centres in the plane

    @property
    def shown(self) -> TrackFigures:
        return self.confirmed or self.everything

    def summary(self) -> dict[str, object]:
        """Return the figures by name; None where missing."""
        parts = {"all": self.everything, "best": self.best, "confirmed": self.confirmed}
        return {
            "ab3dmot": {f"{result.limit:g}": result.summary() for result in self.ab3dmot},
            "hota_2d": {key: one.hota_2d.summary() if one and one.hota_2d else None for key, one in parts.items()},
            "hota_centre": {key: one.hota.summary() if one else None for key, one in parts.items()},
            "gospa": {key: one.gospa.summary() if one else None for key, one in parts.items()},
            "identity": {key: one.identity.summary() if one else None for key, one in parts.items()},
            "velocity_error": defined(self.velocity_error),
            "calibration": self.calibration.summary() if self.calibration else None,
            "errors": self.errors.summary() if self.errors else None,
            "clear_centre": self.clear.summary() if self.clear else None,
        }


def load_recordings(
    dataset: str, sequences: Sequence[DataSequence], results: Path, names: Sequence[str] = (), by: By = "id"
) -> list[EvaluatedSequence]:
    """Return the sequences with their truth and their tracks, which each data set has in a layout of its own.

    Raises:
        DatasetError: a sequence has no truth, or its results are missing or wrong.
    """
    if dataset == "nuscenes":
        return _nuscenes_recordings(sequences, results)
    pairs = zip(sequences, read_compared(sequences, results, names, by=by), strict=True)
    return [
        EvaluatedSequence(one, truth, tracks.to_world(one.poses), read_full_tracks(result_file(results, one.name)))
        for one, (truth, tracks) in pairs
    ]


def _nuscenes_recordings(sequences: Sequence[DataSequence], results: Path) -> list[EvaluatedSequence]:
    submission, shown = read_nuscenes_results(results), shown_submission(results)
    recordings = []
    for sequence in sequences:
        if not isinstance(sequence, NuScenesSequence):
            raise TypeError(f"a sequence of nuScenes is wanted, received {type(sequence).__name__}")
        truth = sequence.truth()
        if truth is None:
            raise DatasetError(f"sequence {sequence.name}", "annotations to compare with", "none")
        table = scene_table(submission, shown, sequence)
        # The benchmark compares near boxes only, by class; truth farther away is ignored already.
        reach = np.array([CLASS_RANGE.get(name, 0.0) for name in table.labels] or [0.0])
        near = sequence.ego_distance(table.frame, table.center) < reach[table.label]
        full = read_full_tracks(scene_file(submission.path.parent, sequence.name))
        recordings.append(EvaluatedSequence(sequence, truth, table.take(near), full))
    return recordings


def class_average(figures: Sequence[ClassFigures]) -> dict[str, dict[str, float | None]]:
    """Return HOTA of centres as means over the classes that the truth has, of all tracks and of the best.

    It is what TrackEval calls class averaged (`cls_comb_cls_av`). A class without a best threshold has no tracks: 0.
    """
    known = [one for one in figures if (one.everything.hota.true + one.everything.hota.missed).any()]
    found = {}
    for key, parts in (("all", [one.everything for one in known]), ("best", [one.best for one in known])):
        values = [(one.hota.hota, one.hota.deta, one.hota.assa) if one else (0.0, 0.0, 0.0) for one in parts]
        means = np.mean(values or [(np.nan, np.nan, np.nan)], axis=0).tolist()
        found[key] = dict(zip(("HOTA", "DetA", "AssA"), map(defined, means), strict=True))
    return found


def evaluate_figures(
    dataset: str,
    recordings: Sequence[EvaluatedSequence],
    names: Sequence[str],
    settings: FigureOptions | None = None,
    thresholds: Mapping[str, float] | None = None,
) -> list[ClassFigures]:
    """Return the figures of each class; classes that neither the truth nor the tracks have are left out.

    Args:
        dataset: its name, on which it depends which boxes are ignored.
        recordings: sequences with truth and tracks.
        names: classes.
        settings: options of the figures.
        thresholds: lowest mean score of the tracks that are also evaluated without the others, by class; for KITTI by
            default the threshold with the highest MOTA of AB3DMOT's protocol at its first limit.
    """
    settings, thresholds = settings or FigureOptions(), thresholds or {}
    present = {name for one in recordings for table in (one.truth, one.tracks) for name in table.names.tolist()}
    local = [
        (one.truth.to_sensor(one.sequence.poses), one.tracks.to_sensor(one.sequence.poses), one.sequence.name)
        for one in (recordings if dataset == "kitti" else ())
    ]
    near, far = (default_rules(dataset, "distance", limit) for limit in (None, settings.cutoff))
    compared = [(len(one.sequence), one.truth.labelled) for one in recordings]
    frames = [count if mask is None else int(mask.sum()) for count, mask in compared]
    whole = [(one.sequence, one.truth, one.tracks, one.full) for one in recordings if one.full is not None]
    told = any(one.tracks.confirmed is not None for one in recordings)

    def of_class(name: str) -> ClassFigures:
        def cases(rules: Rules, *, shown: bool = False) -> list[Case]:
            tables = [one.tracks.shown if shown else one.tracks for one in recordings]
            parts = zip(recordings, tables, strict=True)
            return [prepare(one.truth, table, name, rules, one.sequence.name) for one, table in parts]

        def local_cases(rules: Rules) -> list[Case]:
            return [prepare(truth, tracks, name, rules, sequence) for truth, tracks, sequence in local]

        image, centres, sets = local_cases(hota_2d_rules()), cases(near), cases(far)

        def of_cases(threshold: float, flat: list[Case], plane: list[Case], kept: list[Case]) -> TrackFigures:
            return TrackFigures(
                threshold=threshold,
                hota_2d=evaluate_hota(flat, hota_2d_rules()) if flat else None,
                hota=evaluate_hota(plane, near),
                gospa=evaluate_gospa(zip(kept, frames, strict=True), far, settings.order),
                identity=evaluate_identity(plane, near),
            )

        def from_score(threshold: float) -> TrackFigures:
            # The benchmark of nuScenes sums up scores in another order: a track at its own threshold is kept anyway.
            parts = ([case.from_score(threshold - _ROUNDING) for case in one] for one in (image, centres, sets))
            return of_cases(threshold, *parts)

        boxes = local_cases(ab3dmot_rules(min(settings.limits)))
        protocol = tuple(evaluate_ab3dmot(boxes, limit) for limit in settings.limits if local)
        shown = (
            (one.sequence.stamps, one.truth, one.tracks.shown) for one in recordings if one.tracks.velocity is not None
        )
        errors = np.concatenate([np.empty(0), *(velocity_errors(*one, name, near) for one in shown)])
        threshold = thresholds.get(name, protocol[0].threshold if protocol else -np.inf)
        return ClassFigures(
            name=name,
            ab3dmot=protocol,
            everything=from_score(-np.inf),
            best=from_score(threshold) if np.isfinite(threshold) else None,
            confirmed=of_cases(-np.inf, [], cases(near, shown=True), cases(far, shown=True)) if told else None,
            calibration=evaluate_calibration([part[1:] for part in whole], name, near) if whole else None,
            errors=evaluate_errors(whole, name, near) if whole else None,
            velocity_error=float(errors.mean()) if len(errors) else np.nan,
            clear=combine(clear(case, near) for case in cases(near, shown=True)) if told else None,
        )

    return [of_class(name) for name in names if name in present]


@dataclass(frozen=True)
class Evaluation:
    """Data of one tracker that all tasks share; can be sent to another process without `here`."""

    data: DatasetArguments
    names: tuple[str, ...]  # of the sequences
    tracks: Path
    settings: FigureOptions
    classes: tuple[str, ...] = ()  # names that classes of truth and tracks are mapped to
    here: Sequence[DataSequence] | None = None  # the sequences, where this process has opened them
    by: By = "id"

    @cached_property
    def recordings(self) -> Sequence[EvaluatedSequence]:
        """Truth and tracks; a process reads them once."""
        sequences = self.here or self.data.open().sequences(self.names)
        return load_recordings(self.data.name, sequences, self.tracks, self.classes, self.by)


def figures_of(shared: Evaluation, task: tuple[str, float | None]) -> list[ClassFigures]:
    """Return the figures of one class; none for a class that neither truth nor tracks have.

    The task is the class, and the threshold of the tracks that are also evaluated without the others; None: as
    `evaluate_figures` chooses it.

    Raises:
        DatasetError: as `load_recordings`.
    """
    name, threshold = task
    thresholds: Mapping[str, float] = {} if threshold is None else {name: threshold}
    return evaluate_figures(shared.data.name, shared.recordings, (name,), shared.settings, thresholds)
