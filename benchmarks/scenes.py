"""The profiles of nuScenes, scene by scene: `python benchmarks/scenes.py data/nuscenes data/nuscenes-more`.

Prints docs/tuning/scenes.csv, for each detector, scene and profile: AMOTA of cars and of pedestrians and their mean,
the mean AMOTA of the classes with labels, and how many pairs of motor vehicles of different classes overlap. A class
without labels has no AMOTA. A profile may be a file; `--group car truck` gives classes a group.
"""

from __future__ import annotations

import argparse
import csv
import math
import sys
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from optipmb_tools.datasets import open_dataset
from optipmb_tools.results.nuscenes import NUSCENES_CLASSES
from optipmb_tools.tuning.clips import load, track_clip
from optipmb_tools.tuning.scoring import Measured, Scorer, rules_of, scorer_of

import optipmb
from optipmb.filter.geometry import bev_iou

if TYPE_CHECKING:
    from collections.abc import Sequence

    from optipmb_tools.results import ResultTable

DETECTORS = ("centerpoint", "megvii")
PROFILES = ("nuscenes-paper", "nuscenes", "nuscenes-megvii")
MOTOR = ("bus", "car", "trailer", "truck")
OVERLAP = 0.3
"""Least intersection over union, from above, of two boxes on one object."""


def grouped(profile: str, names: Sequence[str]) -> optipmb.Parameters:
    """Return a profile with a group of these classes."""
    document = optipmb.load_profile(profile).model_dump()
    for name in names:
        document["classes"][name]["group"] = "of the command line"
    return optipmb.parse_parameters(document)


def overlapping(tracks: ResultTable) -> int:
    """Count the pairs of motor vehicles of different classes whose boxes overlap, over all frames."""
    motor = np.isin(tracks.label, [tracks.labels.index(name) for name in MOTOR])
    count = 0
    for frame in np.unique(tracks.frame[motor]):
        rows = np.flatnonzero(motor & (tracks.frame == frame))
        boxes = np.column_stack([tracks.center[rows, :2], tracks.size[rows, :2], tracks.yaw[rows]])
        others = tracks.label[rows][:, None] != tracks.label[rows]
        count += int(np.triu(others & (bev_iou(boxes, boxes) > OVERLAP)).sum())
    return count


def amotas(scorers: Sequence[Scorer], scenes: Sequence[Sequence[Measured]]) -> list[float]:
    """Return AMOTA of each class over some scenes, car and pedestrian first, NaN without labels."""
    found = []
    for k, scorer in enumerate(scorers):
        figures = scorer.figures([scene[k] for scene in scenes])
        found.append(figures["AMOTA"] if figures["GT"] else math.nan)
    return found


def shown(values: Sequence[float], pairs: int) -> tuple[str, ...]:
    """Return the columns of a row: car, pedestrian, their mean, the mean of all, and the pairs."""
    means = []
    for chosen in (values[:1], values[1:2], values[:2], values):
        known = [value for value in chosen if not math.isnan(value)]
        means.append(f"{100 * sum(known) / len(known):.2f}" if known else "-")
    return (*means, str(pairs))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("roots", type=Path, nargs="+", help="folders in the layout of nuScenes")
    parser.add_argument("--profiles", nargs="+", default=PROFILES, help="names or files")
    parser.add_argument("--group", nargs="+", default=[], choices=NUSCENES_CLASSES, help="classes of one group")
    given = parser.parse_args()
    out = csv.writer(sys.stdout, lineterminator="\n")
    out.writerow(("detector", "scene", "profile", "car", "pedestrian", "mean", "all classes", "overlapping pairs"))
    rules = rules_of("nuscenes")
    names = sorted(NUSCENES_CLASSES, key=lambda name: (name != "car", name != "pedestrian"))
    for detector in DETECTORS:
        roots = [root for root in given.roots if (root / "detections" / f"{detector}.json").is_file()]
        opened = [open_dataset("nuscenes", root, detector, clouds=False) for root in roots]
        sequences = list(chain.from_iterable(one.sequences(["all"]) for one in opened))
        scorers = [scorer_of("nuscenes", name, sequences) for name in names]
        for profile in given.profiles:
            parameters = grouped(profile, given.group)
            every, pairs = [], 0
            for sequence in sequences:
                clip = load(sequence, parameters, rules)
                tracks = track_clip(clip, parameters)
                every.append([scorer.measure(clip, tracks) for scorer in scorers])
                here = overlapping(tracks)
                pairs += here
                out.writerow((detector, sequence.name, profile, *shown(amotas(scorers, every[-1:]), here)))
                sys.stdout.flush()
            if every:
                out.writerow((detector, "all", profile, *shown(amotas(scorers, every), pairs)))


if __name__ == "__main__":
    main()
