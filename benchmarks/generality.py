"""Figures of profiles over detectors, data sets, rates and classes: `python benchmarks/generality.py --root data`.

Prints CSV, a row for each cell and profile. All classes of a detector are tracked together, as users do. `auto` is
made from the first frames of each recording, as `optipmb track --profile auto` does. Slower rates take every second
and every fifth frame of KITTI. Columns in addition to `optipmb evaluate`:

- IDF1, IDS all: of the tracks above the best threshold, and identity switches of all tracks.
- scenes: AMOTA of nuScenes, the mean over scenes that have objects.
- confirmed tracks, existence, NEES and inside: as `optipmb track` writes them, with `--hindsight` seconds.
- sure: HOTA of the confirmed tracks alone, without a threshold on scores.
- gain: confirmed tracks with an object within two metres, less those without, as a share of the objects.
- confirmed: share of all tracks that are confirmed.
- delay: mean time from the first frame of a track to its first confirmed one, s, of tracks that are ever confirmed.
- ghosts: confirmed tracks without an object within two metres.
- NEES, inside: of the positions of confirmed tracks; inside is the share within the ellipse of 95 %.
- existence: largest difference of the predicted and the observed share of objects, of tenths with `TENTH` of the boxes.
- speed: root mean square error of the velocity of moving objects in KITTI, m/s, against labels half a second apart.

With `--summary` it prints the figures by which a change of the default is judged, a line each. With `--table` it prints
figures of each detector at the full rate, with `auto` and with its tuned profile. With `--shown` it prints MOTA of what
is shown beside the best cut of the same tracks by their mean score, as recordings and as streams show it: all cells,
also of detectors that only write scores from .3 and from .5 on, and the sample. With `--cache` a cell is computed once
for each state of the tracker.
"""

from __future__ import annotations

import argparse
import csv
import functools
import hashlib
import json
import math
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import astuple, dataclass, replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from optipmb_tools.datasets import open_dataset
from optipmb_tools.evaluation import default_rules
from optipmb_tools.evaluation.calibration import calibration, rows_of, sample
from optipmb_tools.evaluation.cases import CENTRE_DISTANCE, best_pairs, match_frames, prepare
from optipmb_tools.evaluation.clear import clear, combine, sweep
from optipmb_tools.geometry import Pose, stack_poses, to_sensor, to_world
from optipmb_tools.results import FullTable, full_table, stacked
from optipmb_tools.results.kitti import LEAST_SHOWN
from optipmb_tools.run import profiles
from optipmb_tools.run.tracking import tracker_frame
from optipmb_tools.tuning.clips import Clip, load, of_class
from optipmb_tools.tuning.scoring import plain_figures, rules_of, scorer_of

import optipmb
from optipmb.learning.hindsight import with_hindsight
from optipmb.learning.sensor_motion import UNKNOWN_MOTION

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from optipmb_tools.datasets import DataSequence, DetectionFrame, Truth
    from optipmb_tools.evaluation import Rules
    from optipmb_tools.evaluation.cases import Case
    from optipmb_tools.evaluation.clear import Counts
    from optipmb_tools.geometry import Bools, Floats, Ints
    from optipmb_tools.tuning.scoring import Measured, Scorer

    from optipmb import Parameters, Tracks

CARS, ROAD_USERS = ("Car",), ("Car", "Pedestrian")
FOUR = ("car", "pedestrian", "truck", "bus")
DETECTORS = {
    "pointrcnn": ("kitti", ROAD_USERS),
    "second_iou": ("kitti", ROAD_USERS),
    "pvrcnn": ("kitti", ROAD_USERS),
    "casa": ("kitti", CARS),
    "virconv": ("kitti", CARS),
    "centerpoint": ("nuscenes", FOUR),
    "megvii": ("nuscenes-more", FOUR),
}
"""Folder and classes of each detector; `nuscenes-more` has seven scenes."""
STRIDES = {"kitti": (1, 2, 5), "nuscenes": (1,), "nuscenes-more": (1,)}
SHOWN = ("sAMOTA", "AMOTA", "MOTA", "HOTA", "HOTA, all", "IDS", "FP", "FN")
PARTS = (
    *("IDF1", "IDS all", "scenes", "sure", "gain", "confirmed", "delay", "ghosts"),
    *("NEES", "inside", "existence", "speed"),
)
TUNED = {
    "kitti": ("kitti", "kitti-second-iou", "kitti-virconv"),
    "nuscenes": ("nuscenes", "nuscenes-megvii"),
    "nuscenes-more": ("nuscenes", "nuscenes-megvii"),
}
LEAST = 1e-3
FEW_SEQUENCES = ("0004", "0007", "0011", "0017", "scene-0061", "scene-0103", "scene-0553", "scene-1077")
"""Those of `--fast`."""
TENTH = 0.02
"""Share of the boxes from which a tenth of the existence probabilities is looked at."""
MOVING = 2.0
"""Speed from which an object counts as moving, m/s."""


STANDING = Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
Figures = dict[str, dict[str, "float | None"]]


@dataclass(frozen=True)
class Thinned:
    """Every `stride`-th frame of a sequence; without poses, boxes are given as if the sensor stood."""

    whole: DataSequence
    stride: int
    posed: bool
    distort: str
    cut: float = 0.0

    def __getattr__(self, name: str) -> object:
        return getattr(self.whole, name)

    def __len__(self) -> int:
        return len(self.poses)

    @property
    def poses(self) -> Sequence[Pose]:
        """World from sensor of the frames that are left."""
        return list(self.whole.poses)[:: self.stride]

    def frames(self) -> Iterator[DetectionFrame]:
        """Yield them, with the detections of scores from `cut` on."""
        for frame in self.whole.frames():
            if frame.index % self.stride == 0:
                pose = frame.pose if self.posed else STANDING
                scores = {"": frame.score, "scaled": 0.4 * frame.score, "cubed": frame.score**3}[self.distort]
                kept = replace(frame, index=frame.index // self.stride, pose=pose, score=np.maximum(scores, LEAST))
                yield kept.take(scores >= self.cut) if self.cut else kept

    def truth(self) -> Truth | None:
        """Return the annotations of them."""
        truth = self.whole.truth()
        if truth is None or self.stride == 1:
            return truth
        kept, regions = truth.take(truth.frame % self.stride == 0), truth.regions
        left = regions.frame % self.stride == 0
        regions = replace(regions, frame=regions.frame[left] // self.stride, box2d=regions.box2d[left])
        return replace(kept, frame=kept.frame // self.stride, regions=regions)


@dataclass(frozen=True)
class Cell:
    """What one process computes: all classes of a detector at one rate with one profile."""

    root: Path
    detector: str
    stride: int
    profile: str
    posed: bool = True
    distort: str = ""
    fast: bool = False
    hindsight: float = 1.0
    cut: float = 0.0

    def figures(self) -> Figures:
        """Return the figures of each class."""
        folder, names = DETECTORS[self.detector]
        dataset = "kitti" if folder == "kitti" else "nuscenes"
        rules, near = rules_of(dataset), default_rules(dataset, "distance", CENTRE_DISTANCE)
        sequences = sequences_of(self.root, self.detector, fast=self.fast)
        plain = self.stride == 1 and self.posed and not self.distort and not self.cut
        how = self.stride, self.posed, self.distort, self.cut
        taken = sequences if plain else [Thinned(one, *how) for one in sequences]
        tracked = []
        for one in taken:
            parameters = profiles.profile_for(self.profile, [one])
            clip = load(one, parameters, rules)
            tracked.append((clip, *track(clip, parameters, posed=self.posed, hindsight=self.hindsight)))
        found = {}
        for name in names:
            if name not in tracked[0][0].labels:
                continue
            scorer = scorer_of(dataset, name, sequences)
            all_of, sure, waits, speeds, good, certain = [], [], [], [], [], []
            for clip, table, confirmed in tracked:
                own, mine = of_class(clip, name, rules), table.names == name
                shown = table.take(mine & confirmed)
                all_of.append(scorer.measure(own, table.take(mine)))
                sure.append(scorer.measure(own, shown))
                good.append(calibration(own.world, table.take(mine), table.take(mine), name, near))
                certain.append(calibration(own.world, shown, shown, name, near))
                waits.extend(_delays(table.id[mine], clip.stamps[table.frame[mine]], confirmed[mine]))
                if dataset == "kitti":
                    pairs = sample(own.world, shown, shown, name, near)
                    rows = pairs.row[pairs.true]
                    speeds.append(_velocity_errors(own, shown.take(rows), pairs.owner[pairs.true]))
            whole = scorer.figures(all_of)
            every, closest = sum(good[1:], good[0]), sum(certain[1:], certain[0])
            counts = [clear(one.near, scorer.near) for one in all_of]
            truth = sum(one.truth for one in counts)
            squared = np.concatenate(speeds) if speeds else np.empty(0)
            found[name] = {key: plain_figures(whole)[key] for key in SHOWN} | {
                "IDF1": identity_f1([one.near for one in all_of], whole["threshold"]),
                "IDS all": sum(one.switches for one in counts),
                "scenes": _mean_of_scenes(scorer, all_of),
                "sure": plain_figures(scorer.figures(sure))["HOTA, all"],
                "gain": (2 * int(closest.true.sum()) - len(closest.true)) / max(truth, 1),
                "confirmed": len(closest.true) / max(len(every.true), 1),
                "delay": float(np.mean(waits)) if waits else None,
                "ghosts": int((~closest.true).sum()),
                "NEES": closest.mean if self.posed else None,
                "inside": closest.coverage if self.posed else None,
                "existence": existence_error(every.existence, every.true),
                "speed": float(np.sqrt(squared.mean())) if len(squared) else None,
            }
        return found


@functools.cache
def sequences_of(root: Path, detector: str, *, fast: bool) -> tuple[DataSequence, ...]:
    """Return the sequences of a detector, with `fast` a few of them."""
    folder = DETECTORS[detector][0]
    opened = open_dataset("kitti" if folder == "kitti" else "nuscenes", root / folder, detector, clouds=False)
    return tuple(one for one in opened.sequences(["all"]) if not fast or one.name in FEW_SEQUENCES)


def track(clip: Clip, parameters: Parameters, *, posed: bool, hindsight: float) -> tuple[FullTable, Bools]:
    """Return the tracks of all classes in the world frame, and which are confirmed, with some seconds of hindsight."""
    tracker = optipmb.Tracker(parameters)
    found: dict[int, Tracks] = {}
    density, index, tried = tracker.initial(), 0, False
    while index < len(clip.frames):
        result = tracker.step(density, clip.frames[index])
        density, found[index], index = result.density, result.tracks, index + 1
        if hindsight and density.on_vehicle and not tried:  # `optipmb track` starts over here too
            density, index, tried = replace(tracker.initial(), sensor=UNKNOWN_MOTION), 0, True
    if hindsight:
        changed = with_hindsight(list(found.values()), parameters, velocity_s=hindsight if posed else 0.0)
        found = {index: found[index].replaced(**columns) for index, columns in zip(found, changed, strict=True)}
    table = full_table(parameters.labels, found)
    confirmed, when = stacked(list(found.values()), "confirmed").astype(np.bool_), table.frame
    rotation, translation = clip.rotation[when], clip.translation[when]
    if not posed and len(when):
        center, yaw = to_world(rotation, translation, table.center, table.yaw)
        table = replace(table, center=center, yaw=yaw)
    if clip.camera is not None and len(when):
        center, yaw = to_sensor(rotation, translation, table.center, table.yaw)
        table = replace(table, box2d=clip.camera.boxes(center, table.size, yaw, LEAST_SHOWN)[0])
    return table, confirmed


@dataclass(frozen=True)
class Shown:
    """Counts of one class in one cell: what is shown beside what is known."""

    best: Counts  # of the tracks from the best mean score on
    recording: Counts  # of the tracks that `optipmb track` shows
    stream: Counts  # of those that a service shows
    early: tuple[int, int]  # objects that a stream shows within a second of their first track, and all
    minutes: float

    def figures(self) -> tuple[float, ...]:
        """Return MOTA of the three, the share of early objects and false boxes a minute in streams."""
        counts = self.best.mota, self.recording.mota, self.stream.mota
        return *counts, self.early[0] / max(self.early[1], 1), self.stream.false / max(self.minutes, LEAST)


def shown_of(sequences: Sequence[DataSequence], rules: Rules, names: Sequence[str], profile: str) -> dict[str, Shown]:
    """Return the counts of each class over some sequences."""
    near = replace(rules, measure="distance", limit=CENTRE_DISTANCE)
    cases: dict[str, list[tuple[Case, Case, Case]]] = {name: [] for name in names}
    early, seconds = dict.fromkeys(names, (0, 0)), 0.0
    for one in sequences:
        parameters = profiles.profile_for(profile, [one])
        clip = load(one, parameters, rules)
        seconds += float(np.ptp(clip.stamps)) * 1e-9
        table, told = track(clip, parameters, posed=True, hindsight=0.0)
        _, whole = track(clip, parameters, posed=True, hindsight=1.0)
        for name in names:
            mine = table.names == name
            truth = of_class(clip, name, rules).world if name in clip.labels else clip.world.take([])
            parts = [
                prepare(truth, table.take(rows), name, near, one.name) for rows in (mine, mine & whole, mine & told)
            ]
            cases[name].append((parts[0], parts[1], parts[2]))
            found, every = _early(parts[0], parts[2], clip.stamps)
            early[name] = early[name][0] + found, early[name][1] + every
    return {
        name: Shown(
            max(
                sweep([case for case, _, _ in parts], near).results,
                key=lambda one: np.nan_to_num(one.mota, nan=-np.inf),
            ),
            combine(clear(case, near) for _, case, _ in parts),
            combine(clear(case, near) for _, _, case in parts),
            early[name],
            seconds / 60.0,
        )
        for name, parts in cases.items()
    }


def _early(case: Case, told: Case, stamps: Ints) -> tuple[int, int]:
    """Return how many objects that are tracked for a second are shown within a second, and how many there are."""
    known, shown = (match_frames(one) >= 0 for one in (case, told))
    when, found, every = stamps[case.truth_frame], 0, 0
    for one in np.unique(case.truth_id[known & ~case.ignored]):
        rows = case.truth_id == one
        begun = when[rows & known].min()
        if when[rows & known].max() - begun >= SECOND:
            every += 1
            found += bool(shown[rows & (when <= begun + SECOND)].any())
    return found, every


SECOND = 1_000_000_000


def shown_table(root: Path, detectors: Sequence[str], strides: Sequence[int], *, fast: bool) -> Iterator[str]:
    """Yield the rows of the table of what is shown."""
    yield f"{'cell':26} {'class':10} {'best cut':>8} {'recording':>9} {'stream':>6} {'early':>5} {'false/min':>9}"
    sample = Path(__file__).parent.parent / "examples"
    found: list[tuple[float, ...]] = []
    for detector, stride, least in product((*detectors, "crossing"), strides, (0.0, 0.3, 0.5)):
        if detector == "crossing":
            opened = open_dataset("table", sample / "crossing.csv", truth=str(sample / "crossing_truth.csv"))
            sequences, rules = tuple(opened.sequences(["all"])), default_rules("table")
            names = profiles.profile_for("auto", sequences).labels
        else:
            folder, names = DETECTORS[detector]
            if stride not in STRIDES[folder]:
                continue
            sequences, rules = sequences_of(root, detector, fast=fast), rules_of(folder.partition("-")[0])
        taken = [Thinned(one, stride, posed=True, distort="", cut=least) for one in sequences]
        for name, one in shown_of(taken, rules, names, "auto").items():
            if one.best.truth:
                found.append(one.figures())
                best, recording, stream, early, false = found[-1]
                cell = f"{detector} 1/{stride} from {least:g}"
                yield f"{cell:26} {name:10} {best:8.1%} {recording:9.1%} {stream:6.1%} {early:5.0%} {false:9.1f}"
    best, recording, stream, early, false = np.array(found).T
    for name, gap in (("recordings", best - recording), ("streams", best - stream)):
        yield f"best cut less shown, {name}: mean {gap.mean():.1%}, largest {gap.max():.1%}"
    yield f"early: {early.mean():.1%} in the mean; false a minute: {false.mean():.1f}"


def existence_error(existence: Floats, true: Bools) -> float | None:
    """Return the largest difference of the mean of `existence` and the share of true tracks over tenths."""
    place = np.minimum((existence * 10).astype(np.int64), 9)
    count, off = np.bincount(place, minlength=10), np.bincount(place, existence - true, 10)
    looked_at = count >= max(TENTH * len(existence), 1)
    return float(np.abs(off[looked_at] / count[looked_at]).max()) if looked_at.any() else None


def identity_f1(cases: Sequence[Case], threshold: float) -> float:
    """Return IDF1 of the tracks from a mean score on: of the pairs of identities that agree in most frames."""
    agreed = total = 0
    for whole in cases:
        case = whole.from_score(threshold)
        counts = ~case.ignored[case.truth_row]
        pairs = np.column_stack((case.truth_id[case.truth_row], case.track_id[case.track_row]))[counts]
        both, times = np.unique(pairs, axis=0, return_counts=True)
        if len(both):
            chosen = best_pairs(both[:, 0], both[:, 1], times.astype(np.float64))
            agreed += int(times[chosen].sum())
        judged = ~case.excused  # a track of an object counts although it would be excused without the object
        judged[case.track_row[counts]] = True
        total += int((~case.ignored).sum() + judged.sum())
    return 2.0 * agreed / max(total, 1)


def _mean_of_scenes(scorer: Scorer, measured: Sequence[Measured]) -> float | None:
    if scorer.scenes is None:
        return None
    found = [scorer.figures([one])["AMOTA"] for one in measured if (~one.near.ignored).any()]
    return float(np.nanmean(found)) if found else None


def _velocity_errors(clip: Clip, tracks: FullTable, owner: Ints) -> Floats:
    """Return the squared errors of the velocities of tracks whose object moves, by its labels before and after."""
    truth, half = clip.world, max(1, round(0.25 / np.median(np.diff(clip.stamps * 1e-9))))
    before = rows_of(truth.frame, truth.id, tracks.frame - half, owner)
    after = rows_of(truth.frame, truth.id, tracks.frame + half, owner)
    known = (before >= 0) & (after >= 0)
    frame = tracks.frame[known]
    seconds = (clip.stamps[frame + half] - clip.stamps[frame - half]) * 1e-9
    velocity = (truth.center[after[known], :2] - truth.center[before[known], :2]) / seconds[:, None]
    errors = ((tracks.velocity[known] - velocity) ** 2).sum(axis=1)
    return np.asarray(errors[np.linalg.norm(velocity, axis=1) > MOVING], np.float64)


def _delays(identity: Ints, stamp_ns: Ints, confirmed: Bools) -> Iterator[float]:
    for one in np.unique(identity[confirmed]):
        rows = identity == one
        yield (stamp_ns[rows & confirmed].min() - stamp_ns[rows].min()) * 1e-9


def _shown(value: float | None) -> str:
    if value is None or math.isnan(value):
        return "-"
    return str(int(value)) if value == int(value) and abs(value) > 1 else f"{value:.4f}"


SMOOTHED = (0.1, 0.2, 0.3, 0.5)
"""Standard deviations of the white noise of boxes, m."""


def smoothing() -> float:
    """Return the ratio of the errors of tracks and their boxes, for objects at constant velocity at 10 Hz."""
    ratios, rng = [], np.random.Generator(np.random.PCG64(1))
    for noise in SMOOTHED:
        tracker = optipmb.OnlineTracker("generic")
        start, velocity = np.array([[10.0, -20.0], [40.0, 10.0], [0.0, 30.0]]), np.array([[8.0, 0], [-12, 3], [1, 1]])
        errors = []
        for k in range(300):
            place = start + 0.1 * k * velocity
            boxes = place + noise * rng.standard_normal((3, 2))
            yaw, size = np.arctan2(velocity[:, 1], velocity[:, 0]), [[4.5, 1.9, 1.6], [4.5, 1.9, 1.6], [0.7, 0.7, 1.75]]
            given = {"center": np.column_stack((boxes, np.zeros(3))), "size": size, "yaw": yaw, "score": [0.9] * 3}
            tracks = tracker.update(given, t=0.1 * k, label=["car", "car", "pedestrian"])
            for n, detection in zip(range(len(tracks)), tracks.detection.tolist(), strict=True):
                if k >= 50 and detection >= 0:
                    of_track = tracks.center[n, :2] - place[detection]
                    errors.append(((of_track**2).sum(), ((boxes - place)[detection] ** 2).sum()))
        ratios.append(math.sqrt(np.divide(*np.sum(errors, axis=0))))
    return float(np.mean(ratios))


STOOD = 50
"""Frames that a sensor is taken to stand for."""


def false_starts(root: Path, detectors: Iterable[str], *, fast: bool) -> tuple[int, int]:
    """Return in how many frames a standing sensor is said to move, and how many frames there are.

    Boxes are in the axes of the world, with the sensor as the origin once in `STOOD` frames.
    """
    wrong = count = 0
    for one in (one for detector in detectors for one in sequences_of(root, detector, fast=fast)):
        parameters = profiles.profile_for("auto", [one])
        tracker, (rotation, translation) = optipmb.Tracker(parameters), stack_poses(one.poses)
        density = tracker.initial()
        for frame in one.frames():
            if frame.index % STOOD == 0:
                density, origin = tracker.initial(), translation[min(frame.index + STOOD // 2, len(translation) - 1)]
            center, yaw = to_world(rotation[[frame.index]], translation[[frame.index]], frame.center, frame.yaw)
            still = replace(frame, center=center - origin, yaw=yaw, pose=STANDING)
            density = tracker.step(density, tracker_frame(parameters, one.name, still)).density
            wrong += density.sensor_motion is not None
            count += 1
    return wrong, count


@dataclass(frozen=True)
class Summary:
    """The figures by which a change of the default is judged."""

    of: Callable[..., Figures]  # figures of the classes of a cell: detector, stride, …
    root: Path
    fast: bool

    def lines(self) -> Iterator[tuple[str, str]]:
        """Yield name and value of each figure."""
        for name, value in SUMMARY.items():
            yield name, value(self)

    def across(self, figure: str, label: str, cells: Iterable[tuple[str, int]], **given: bool) -> list[float]:
        """Return a figure of a class in some cells that have it."""
        values = (self.of(*cell, **given).get(label, {}).get(figure) for cell in cells)
        return [value for value in values if value is not None]


KITTI = tuple(name for name, (folder, _) in DETECTORS.items() if folder == "kitti")
NUSCENES = (("centerpoint", 1), ("megvii", 1))
EIGHT = {"centerpoint": 1, "megvii": 7}  # scenes
ALL = tuple(product(KITTI, STRIDES["kitti"])) + NUSCENES


def _joined(values: Iterable[float], form: str = ".1f", scale: float = 1.0) -> str:
    return " / ".join(format(scale * value, form) for value in values)


def _unposed(given: Summary) -> str:
    return _joined((given.across("sAMOTA", "Car", [cell], posed=False)[0] for cell in UNPOSED), scale=100.0)


UNPOSED = (("pointrcnn", 1), ("second_iou", 2), ("pvrcnn", 5))


def _eight(given: Summary, profile: dict[str, str]) -> str:
    found = []
    for label in ("car", "pedestrian"):
        parts = [
            (given.of(detector, 1, profile.get(detector, "auto"))[label]["scenes"] or 0.0, count)
            for detector, count in EIGHT.items()
        ]
        found.append(sum(value * count for value, count in parts) / sum(EIGHT.values()))
    return _joined(found, scale=100.0)


def _sums(given: Summary, figure: str) -> str:
    cars = [sum(given.across(figure, "Car", product(KITTI, [stride]))) for stride in STRIDES["kitti"]]
    others = [sum(given.across(figure, label, NUSCENES)) for label in ("car", "pedestrian")]
    return f"{_joined(cars, '.0f')}; {_joined(others, '.0f')}"


def _ranges(given: Summary, figure: str, form: str, scale: float = 1.0) -> str:
    """Return the least and largest value of a figure over all cells, and the cells in a line each."""
    parts = []
    for label in ("car", "pedestrian"):
        cells = [(cell, given.of(*cell)) for cell in ALL]
        values = [(found[name][figure] or 0.0) for _, found in cells for name in found if name.lower() == label]
        parts.append(f"{label} {scale * min(values):{form}} to {scale * max(values):{form}}")
    return ", ".join(parts)


def _each(given: Summary, figure: str, low: float, high: float) -> str:
    """Return how many cells of cars and pedestrians have a figure from `low` to `high`, and name the others."""
    count, others = 0, []
    for cell in ALL:
        for label, found in given.of(*cell).items():
            value = found[figure]
            if value is not None and label.lower() in {"car", "pedestrian"}:
                count += 1
                others += [] if low <= value <= high else [f"{cell[0]} 1/{cell[1]} {label} {value:.3g}"]
    return f"{count - len(others)} of {count} from {low:g} to {high:g}; not {', '.join(others) or 'none'}"


def _gains(given: Summary) -> str:
    values = []
    for label in ROAD_USERS:
        values += given.across("gain", label, [("pointrcnn", 1), ("second_iou", 1), ("second_iou", 5)])
    values += given.across("gain", "Car", [("casa", 1)])
    for label in ("car", "pedestrian"):
        values += given.across("gain", label, NUSCENES)
    return f"{np.mean(values):.3f} over {len(values)} cells"


def _starts(given: Summary) -> str:
    wrong, count = false_starts(given.root, ("pointrcnn", "pvrcnn", "centerpoint", "megvii"), fast=given.fast)
    return f"{wrong} of {count} frames"


def _speeds(given: Summary) -> str:
    return _joined((given.across("speed", "Car", [cell])[0] for cell in product(KITTI, [1])), ".2f")


SUMMARY: dict[str, Callable[[Summary], str]] = {
    "sAMOTA without poses, PointRCNN 10 Hz / SECOND 5 Hz / PV-RCNN 2 Hz": _unposed,
    "false starts of a standing sensor": _starts,
    "AMOTA of eight nuScenes scenes, car / pedestrian, auto": lambda given: _eight(given, {}),
    "the same, tuned": lambda given: _eight(given, {"centerpoint": "nuscenes", "megvii": "nuscenes-megvii"}),
    "switches at the best threshold, KITTI cars 10 / 5 / 2 Hz; nuScenes car / pedestrian": (
        lambda given: _sums(given, "IDS")
    ),
    "switches of all tracks": lambda given: _sums(given, "IDS all"),
    "ghosts": lambda given: _sums(given, "ghosts"),
    "HOTA, %": lambda given: _ranges(given, "HOTA", ".1f", 100.0),
    "inside the 95 % ellipse, %": lambda given: _ranges(given, "inside", ".0f", 100.0),
    "NEES": lambda given: _ranges(given, "NEES", ".1f"),
    "inside from .90 to .97, NEES from 1.5 to 3, existence to .15, cells": lambda given: " | ".join(
        _each(given, *one) for one in (("inside", 0.9, 0.97), ("NEES", 1.5, 3.0), ("existence", 0.0, 0.15))
    ),
    "position error of tracks beside boxes": lambda _: f"{smoothing():.2f}",
    "velocity error of moving cars, m/s, by KITTI detector": _speeds,
    "existence, largest difference": lambda given: _ranges(given, "existence", ".2f"),
    "confirmed, (TP - FP) / true": _gains,
}


def table(given: Summary) -> Iterator[str]:
    """Yield the rows of the table in `docs/tuning.md`: figures with `auto`, and with the profile of the detector."""
    yield "| detector | class | figure | `auto` | tuned | profile |"
    yield "| --- | --- | --- | ---: | ---: | --- |"
    for detector, (folder, names) in DETECTORS.items():
        figure = "sAMOTA" if folder == "kitti" else "AMOTA"
        opened = open_dataset("kitti" if folder == "kitti" else "nuscenes", given.root / folder, detector, clouds=False)
        for name in (one for one in names if one.lower() in {"car", "pedestrian"}):
            auto, tuned = (given.of(detector, 1, profile)[name][figure] or 0.0 for profile in ("auto", opened.profile))
            values = _joined((auto, tuned), scale=100.0).replace(" / ", " | ")
            yield f"| {detector} | {name} | {figure} | {values} | `{opened.profile}` |"


def _state(profile: str) -> str:
    """Return a digest of the tracker, the profiles and this file."""
    folder = Path(optipmb.__file__).parent
    files = [*folder.rglob("*.py"), *folder.rglob("*.toml"), Path(__file__)]
    content = b"".join(one.read_bytes() for one in sorted(files))
    return hashlib.sha256(content + profile.encode()).hexdigest()[:16]


def figures(cell: Cell, cache: Path | None = None) -> Figures:
    """Return the figures of the classes of a cell, from the cache if it has them."""
    key = "-".join(str(one) for one in astuple(cell)[1:])
    path = None if cache is None else cache / _state(cell.profile) / f"{key}.json"
    if path is not None and path.is_file():
        known: Figures = json.loads(path.read_text())
        return known
    found = cell.figures()
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(found))
    return found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--root", type=Path, required=True, help="folder with kitti/, nuscenes/ and nuscenes-more/")
    parser.add_argument(
        "--profiles", default="auto", help="names with commas; `best` is the tuned ones of the data set"
    )
    parser.add_argument("--detectors", default=",".join(DETECTORS), help="names with commas")
    parser.add_argument("--strides", default="1,2,5", help="of frames, with commas")
    parser.add_argument("--unposed", action="store_true", help="withhold the poses of the sensor")
    parser.add_argument("--distort", default="", choices=["", "scaled", "cubed"], help="scores x 0.4, or cubed")
    parser.add_argument("--cut", type=float, default=0.0, help="leave out detections of lower scores")
    parser.add_argument("--hindsight", type=float, default=1.0, help="seconds; 0: as the service confirms tracks")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--fast", action="store_true", help="a few sequences only")
    parser.add_argument("--summary", action="store_true", help="print the figures by which the default is judged")
    parser.add_argument("--table", action="store_true", help="print the table of docs/tuning.md")
    parser.add_argument("--shown", action="store_true", help="print what is shown beside the best cut")
    parser.add_argument("--cache", type=Path, help="folder of figures of cells")
    given = parser.parse_args()
    measured = functools.partial(figures, cache=given.cache)
    if given.shown:
        strides = tuple(map(int, given.strides.split(",")))
        for line in shown_table(given.root, given.detectors.split(","), strides, fast=given.fast):
            print(line, flush=True)
        return
    shared = given.distort, given.fast, given.hindsight, given.cut
    if given.summary or given.table:

        def of(detector: str, stride: int, profile: str = "auto", *, posed: bool = True) -> Figures:
            return measured(Cell(given.root, detector, stride, profile, posed, *shared))

        summary = Summary(of, given.root, given.fast)
        for line in table(summary) if given.table else (": ".join(one) for one in summary.lines()):
            print(line, flush=True)
        return
    cells = [
        Cell(given.root, detector, stride, name, not given.unposed, *shared)
        for detector, stride in product(given.detectors.split(","), map(int, given.strides.split(",")))
        if stride in STRIDES[folder := DETECTORS[detector][0]]
        for profile in given.profiles.split(",")
        for name in (TUNED[folder] if profile == "best" else (profile,))
    ]
    out = csv.writer(sys.stdout, lineterminator="\n")
    columns = (*SHOWN, *PARTS)
    out.writerow(("detector", "rate", "class", "profile", "poses", "scores", *columns))
    with ProcessPoolExecutor(given.jobs) as pool:
        for cell, found in zip(cells, pool.map(measured, cells), strict=True):
            how = "" if cell.posed else "none", cell.distort
            for name, values in found.items():
                key = (cell.detector, f"1/{cell.stride}", name, cell.profile, *how)
                out.writerow([*key, *(_shown(values[one]) for one in columns)])
            sys.stdout.flush()


if __name__ == "__main__":
    main()
