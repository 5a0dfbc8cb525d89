"""Figures of profiles over detectors, data sets, rates and classes: `python benchmarks/generality.py --root data`.

Prints CSV, a row for each cell and profile. All classes of a detector are tracked together, as users do. `auto` is
made from the first frames of each recording, as `optipmb track --profile auto` does. Slower rates take every second
and every fifth frame of KITTI. Columns in addition to `optipmb evaluate`:

- sure: HOTA of the confirmed tracks alone, without a threshold on scores.
- confirmed: share of all tracks that are confirmed.
- delay: mean time from the first frame of a track to its first confirmed one, s, of tracks that are ever confirmed.
- ghosts: confirmed tracks without an object within two metres.
- ECE: expected calibration error of `existence`, over ten bins.
"""

from __future__ import annotations

import argparse
import csv
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from optipmb_tools.datasets import open_dataset
from optipmb_tools.evaluation import default_rules
from optipmb_tools.evaluation.calibration import calibration
from optipmb_tools.evaluation.cases import CENTRE_DISTANCE
from optipmb_tools.geometry import Pose, to_sensor, to_world
from optipmb_tools.results import FullTable, full_table, stacked
from optipmb_tools.results.kitti import LEAST_SHOWN
from optipmb_tools.run import profiles
from optipmb_tools.tuning.clips import Clip, load, of_class
from optipmb_tools.tuning.scoring import plain_figures, rules_of, scorer_of

import optipmb

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from optipmb_tools.datasets import DataSequence, DetectionFrame, Truth
    from optipmb_tools.geometry import Bools, Floats, Ints

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
PARTS = ("sure", "confirmed", "delay", "ghosts", "ECE")
TUNED = {
    "kitti": ("kitti", "kitti-second-iou", "kitti-virconv"),
    "nuscenes": ("nuscenes", "nuscenes-megvii"),
    "nuscenes-more": ("nuscenes", "nuscenes-megvii"),
}
LEAST = 1e-3


@dataclass(frozen=True)
class Thinned:
    """Every `stride`-th frame of a sequence; without poses, boxes are given as if the sensor stood."""

    whole: DataSequence
    stride: int
    posed: bool
    distort: str

    def __getattr__(self, name: str) -> object:
        return getattr(self.whole, name)

    def __len__(self) -> int:
        return len(self.poses)

    @property
    def poses(self) -> Sequence[Pose]:
        """World from sensor of the frames that are left."""
        return list(self.whole.poses)[:: self.stride]

    def frames(self) -> Iterator[DetectionFrame]:
        """Yield them."""
        for frame in self.whole.frames():
            if frame.index % self.stride == 0:
                pose = frame.pose if self.posed else Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
                scores = {"": frame.score, "scaled": 0.4 * frame.score, "cubed": frame.score**3}[self.distort]
                yield replace(frame, index=frame.index // self.stride, pose=pose, score=np.maximum(scores, LEAST))

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

    def rows(self) -> list[list[str]]:
        """Return a row of figures for each class."""
        folder, names = DETECTORS[self.detector]
        dataset = "kitti" if folder == "kitti" else "nuscenes"
        rules = rules_of(dataset)
        opened = open_dataset(dataset, self.root / folder, self.detector, clouds=False)
        sequences = list(opened.sequences(["all"]))
        plain = self.stride == 1 and self.posed and not self.distort
        taken = sequences if plain else [Thinned(one, self.stride, self.posed, self.distort) for one in sequences]
        tracked = []
        for one in taken:
            parameters = profiles.profile_for(self.profile, [one])
            clip = load(one, parameters, rules)
            tracked.append((clip, *track(clip, parameters, posed=self.posed)))
        rows = []
        for name in names:
            if name not in tracked[0][0].labels:
                continue
            scorer = scorer_of(dataset, name, sequences)
            near = default_rules(dataset, "distance", CENTRE_DISTANCE)
            all_of, sure, true, existence, certain, waits = [], [], [], [], [], []
            for clip, table, confirmed in tracked:
                own, mine = of_class(clip, name, rules), table.names == name
                all_of.append(scorer.measure(own, table.take(mine)))
                sure.append(scorer.measure(own, table.take(mine & confirmed)))
                found = calibration(own.world, table.take(mine), table.take(mine), name, near)
                existence.append(found.existence)
                true.append(found.true)
                shown = table.take(mine & confirmed)
                ghosts = calibration(own.world, shown, shown, name, near)
                certain.append((~ghosts.true).sum())
                waits.extend(_delays(table.id[mine], clip.stamps[table.frame[mine]], confirmed[mine]))
            figures = plain_figures(scorer.figures(all_of))
            confirmed_share = sum(int((table.names[sure_of] == name).sum()) for _, table, sure_of in tracked)
            count = sum(int((table.names == name).sum()) for _, table, _ in tracked)
            extra = (
                plain_figures(scorer.figures(sure))["HOTA, all"],
                confirmed_share / max(count, 1),
                float(np.mean(waits)) if waits else None,
                int(sum(certain)),
                calibration_error(np.concatenate(existence), np.concatenate(true)),
            )
            key = (self.detector, f"1/{self.stride}", name, self.profile, "" if self.posed else "none", self.distort)
            rows.append([*key, *(_shown(figures[one]) for one in SHOWN), *(_shown(one) for one in extra)])
        return rows


def track(clip: Clip, parameters: Parameters, *, posed: bool) -> tuple[FullTable, Bools]:
    """Return the tracks of all classes in the world frame, and which are confirmed."""
    tracker = optipmb.Tracker(parameters)
    found: dict[int, Tracks] = {}
    density = tracker.initial()
    for index, frame in enumerate(clip.frames):
        result = tracker.step(density, frame)
        density, found[index] = result.density, result.tracks
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


def calibration_error(existence: Floats, true: Bools) -> float:
    """Return the mean distance between `existence` and the share of true tracks, over ten bins by their counts."""
    place = np.minimum((existence * 10).astype(np.int64), 9)
    return float(np.abs(np.bincount(place, existence - true, 10)).sum() / max(len(existence), 1))


def _delays(identity: Ints, stamp_ns: Ints, confirmed: Bools) -> Iterator[float]:
    for one in np.unique(identity[confirmed]):
        rows = identity == one
        yield (stamp_ns[rows & confirmed].min() - stamp_ns[rows].min()) * 1e-9


def _shown(value: float | None) -> str:
    if value is None:
        return "-"
    return str(int(value)) if value == int(value) and abs(value) > 1 else f"{value:.4f}"


def _rows(cell: Cell) -> list[list[str]]:
    return cell.rows()


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
    parser.add_argument("--jobs", type=int, default=1)
    given = parser.parse_args()
    cells = [
        Cell(given.root, detector, stride, name, not given.unposed, given.distort)
        for detector, stride in product(given.detectors.split(","), map(int, given.strides.split(",")))
        if stride in STRIDES[folder := DETECTORS[detector][0]]
        for profile in given.profiles.split(",")
        for name in (TUNED[folder] if profile == "best" else (profile,))
    ]
    out = csv.writer(sys.stdout, lineterminator="\n")
    out.writerow(("detector", "rate", "class", "profile", "poses", "scores", *SHOWN, *PARTS))
    with ProcessPoolExecutor(given.jobs) as pool:
        for rows in pool.map(_rows, cells):
            out.writerows(rows)
            sys.stdout.flush()


if __name__ == "__main__":
    main()
