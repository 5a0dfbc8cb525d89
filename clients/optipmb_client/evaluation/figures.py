"""All figures of the results of a dataset, beside those of CLEAR MOT and of nuScenes' own benchmark.

Conventions: metres, z up. Figures that need centres in the plane are taken in the world frame; the KITTI protocols are
taken where KITTI has its boxes, in the sensor frame of each frame and in its image.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from optipmb_client.datasets import DataSequence, DatasetError, Truth
from optipmb_client.datasets.nuscenes import CLASS_RANGE, NuScenesSequence
from optipmb_client.evaluation.ab3dmot import IOU_LIMITS, Ab3dmotResult, ab3dmot_rules, evaluate_ab3dmot
from optipmb_client.evaluation.calibration import CalibrationResult, evaluate_calibration
from optipmb_client.evaluation.cases import Case, Rules, prepare
from optipmb_client.evaluation.errors import ErrorResult, evaluate_errors
from optipmb_client.evaluation.gospa import CUTOFF, ORDER, GospaResult, evaluate_gospa
from optipmb_client.evaluation.hota import HotaResult, evaluate_hota
from optipmb_client.evaluation.hota_2d import hota_2d_rules
from optipmb_client.evaluation.nuscenes_figures import plain
from optipmb_client.evaluation.run import default_rules
from optipmb_client.evaluation.tracks import read_compared, read_full_tracks
from optipmb_client.results import ResultTable
from optipmb_client.results.full import FullTable, full_path, read_full
from optipmb_client.results.nuscenes import read_nuscenes_results, result_table

CENTRE_DISTANCE = 2.0
"""Centres farther apart than this, in metres, have no similarity (D_0 of the OptiPMB paper)."""
_ROUNDING = 1e-9


@dataclass(frozen=True)
class Recording:
    """One sequence with its truth and its tracks."""

    sequence: DataSequence
    truth: Truth
    """World frame."""
    tracks: ResultTable
    """World frame."""
    full: FullTable | None
    """Everything known of the same tracks, where it was kept."""


@dataclass(frozen=True)
class Settings:
    """What may be chosen."""

    limits: tuple[float, ...] = IOU_LIMITS
    """Least 3D intersections over union for AB3DMOT's protocol."""
    cutoff: float = CUTOFF
    """c of GOSPA and OSPA, metres."""
    order: float = ORDER
    """p of GOSPA and OSPA."""


@dataclass(frozen=True)
class TrackFigures:
    """Figures of the tracks of one class that reach a score."""

    threshold: float
    """Lowest mean score of these tracks; minus infinity for all."""
    hota_2d: HotaResult | None
    """KITTI only."""
    hota: HotaResult
    """Of centres in the plane."""
    gospa: GospaResult


@dataclass(frozen=True)
class ClassFigures:
    """The figures of one class over all sequences."""

    name: str
    ab3dmot: tuple[Ab3dmotResult, ...]
    """One for each limit; KITTI only."""
    everything: TrackFigures
    """Of all tracks."""
    best: TrackFigures | None
    """Of the tracks from the best threshold on."""
    calibration: CalibrationResult | None
    """Where the tracks were kept with all columns."""
    errors: ErrorResult | None
    """Likewise."""

    def summary(self) -> dict[str, object]:
        """Return the figures by name; None for those that are not there."""
        parts = {"all": self.everything, "best": self.best}
        return {
            "ab3dmot": {f"{result.limit:g}": result.summary() for result in self.ab3dmot},
            "hota_2d": {key: one.hota_2d.summary() if one and one.hota_2d else None for key, one in parts.items()},
            "hota_centre": {key: one.hota.summary() if one else None for key, one in parts.items()},
            "gospa": {key: one.gospa.summary() if one else None for key, one in parts.items()},
            "calibration": self.calibration.summary() if self.calibration else None,
            "errors": self.errors.summary() if self.errors else None,
        }


def load_recordings(
    dataset: str, sequences: Sequence[DataSequence], results: Path, names: Sequence[str] = ()
) -> list[Recording]:
    """Return the sequences with their truth and their tracks.

    Args:
        dataset: its name, which says what the result files look like.
        sequences: what to compare with; each must have a truth.
        results: the folder of the result files.
        names: as for `read_compared`.

    Raises:
        DatasetError: a sequence has no truth, or its results are missing or wrong.

    """
    if dataset == "nuscenes":
        return _nuscenes_recordings(sequences, results)
    pairs = zip(sequences, read_compared(sequences, results, names), strict=True)
    return [
        Recording(one, truth, tracks.to_world(one.poses), read_full_tracks(results, one))
        for one, (truth, tracks) in pairs
    ]


def class_average(figures: Sequence[ClassFigures]) -> dict[str, dict[str, float | None]]:
    """Return HOTA of centres as means over the classes that the truth has, of all tracks and of the best.

    It is what TrackEval calls class averaged (`cls_comb_cls_av`). A class without a best threshold has no tracks: 0.
    """
    known = [one for one in figures if (one.everything.hota.true + one.everything.hota.missed).any()]
    found = {}
    for key, parts in (("all", [one.everything for one in known]), ("best", [one.best for one in known])):
        values = [(one.hota.hota, one.hota.deta, one.hota.assa) if one else (0.0, 0.0, 0.0) for one in parts]
        means = np.mean(values or [(np.nan, np.nan, np.nan)], axis=0).tolist()
        found[key] = dict(zip(("HOTA", "DetA", "AssA"), map(plain, means), strict=True))
    return found


def evaluate_figures(
    dataset: str,
    recordings: Sequence[Recording],
    names: Sequence[str],
    settings: Settings | None = None,
    thresholds: Mapping[str, float] | None = None,
) -> list[ClassFigures]:
    """Return the figures of each class; classes that neither the truth nor the tracks have are left out.

    Args:
        dataset: its name, which says what is ignored.
        recordings: sequences with truth and tracks.
        names: classes.
        settings: what may be chosen.
        thresholds: lowest mean score of the tracks that are also evaluated without the others, by class; for KITTI by
            default the threshold with the highest MOTA of AB3DMOT's protocol at its first limit.

    """
    settings, thresholds = settings or Settings(), thresholds or {}
    present = {
        name for one in recordings for labels in (one.truth.names, _names(one.tracks)) for name in labels.tolist()
    }
    local = [_to_sensor(one) for one in recordings] if dataset == "kitti" else []
    figures = []
    for name in names:
        if name not in present:
            continue
        cases = _Cases(dataset, recordings, local, name, settings)
        protocol = tuple(evaluate_ab3dmot(cases.boxes, limit) for limit in settings.limits if local)
        threshold = thresholds.get(name, protocol[0].threshold if protocol else -np.inf)
        kept = [(one.truth, one.tracks, one.full) for one in recordings if one.full is not None]
        whole = [(one.sequence, one.truth, one.tracks, one.full) for one in recordings if one.full is not None]
        figures.append(
            ClassFigures(
                name=name,
                ab3dmot=protocol,
                everything=cases.evaluate(-np.inf),
                best=cases.evaluate(threshold) if np.isfinite(threshold) else None,
                calibration=evaluate_calibration(kept, name, cases.near) if kept else None,
                errors=evaluate_errors(whole, name, cases.near) if whole else None,
            )
        )
    return figures


class _Cases:
    """One class in all sequences, prepared for every figure."""

    def __init__(
        self,
        dataset: str,
        recordings: Sequence[Recording],
        local: Sequence[tuple[Truth, ResultTable, str]],
        name: str,
        settings: Settings,
    ) -> None:
        def world(rules: Rules) -> list[Case]:
            return [prepare(one.truth, one.tracks, name, rules, one.sequence.name) for one in recordings]

        def image(rules: Rules) -> list[Case]:
            return [prepare(truth, tracks, name, rules, sequence) for truth, tracks, sequence in local]

        self.near = default_rules(dataset, "distance", CENTRE_DISTANCE)
        self.boxes = image(ab3dmot_rules(min(settings.limits)))
        self._image = image(hota_2d_rules())
        self._centres = world(self.near)
        self._cutoff = default_rules(dataset, "distance", settings.cutoff)
        self._sets = world(self._cutoff)
        pairs = [(one.sequence, one.truth.labelled) for one in recordings]
        self._frames = [len(sequence) if mask is None else int(mask.sum()) for sequence, mask in pairs]
        self._order = settings.order

    def evaluate(self, threshold: float) -> TrackFigures:
        """Return the figures of the tracks from a mean score on."""
        sets = zip(_from_score(self._sets, threshold), self._frames, strict=True)
        return TrackFigures(
            threshold=threshold,
            hota_2d=evaluate_hota(_from_score(self._image, threshold), hota_2d_rules()) if self._image else None,
            hota=evaluate_hota(_from_score(self._centres, threshold), self.near),
            gospa=evaluate_gospa(sets, self._cutoff, self._order),
        )


def _from_score(cases: Sequence[Case], threshold: float) -> list[Case]:
    # The benchmark of nuScenes sums up scores in another order: a track at its own threshold is kept all the same.
    return [case.keep(case.mean_scores() >= threshold - _ROUNDING) for case in cases]


def _to_sensor(one: Recording) -> tuple[Truth, ResultTable, str]:
    poses = one.sequence.poses
    return one.truth.to_sensor(poses), one.tracks.to_sensor(poses), one.sequence.name


def _names(tracks: ResultTable) -> np.ndarray:
    return np.asarray(tracks.labels, dtype=np.str_)[np.unique(tracks.label)] if len(tracks) else np.empty(0, np.str_)


def _nuscenes_recordings(sequences: Sequence[DataSequence], results: Path) -> list[Recording]:
    submission = read_nuscenes_results(results)
    recordings = []
    for sequence in sequences:
        if not isinstance(sequence, NuScenesSequence):
            raise TypeError(f"a sequence of nuScenes is wanted, received {type(sequence).__name__}")
        truth = sequence.truth()
        if truth is None:
            raise DatasetError(f"sequence {sequence.name}", "annotations to compare with", "none")
        table = result_table(submission, sequence.name, sequence.samples)
        # The benchmark compares only what is near, by class; truth farther away is ignored already.
        reach = np.array([CLASS_RANGE.get(name, 0.0) for name in table.labels] or [0.0])
        near = sequence.ego_distance(table.frame, table.center) < reach[table.label]
        beside = full_path(submission.path.parent / "scenes" / f"{sequence.name}.json")
        full = read_full(beside) if beside.is_file() else None
        recordings.append(Recording(sequence, truth, table.take(near), full))
    return recordings
