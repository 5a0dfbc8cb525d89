"""The profiles with every detector, and two simple trackers: `python benchmarks/accuracy.py --root data`.

Prints docs/tuning/detectors.csv: the profiles with each detector and class, and for comparison, for some of
these, a greedy tracker of nearest centres and AB3DMOT's Kalman filters (`tests/support/greedy.py`, `kalman.py`) with
their published parameters. The same detections and evaluator; KITTI counts at a 3D overlap of 0.25, ten sequences.
"""

from __future__ import annotations

import argparse
import csv
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))

from greedy import greedy_tracks
from kalman import HABITS, kalman_tracks
from optipmb_tools.datasets import open_dataset
from optipmb_tools.evaluation.errors import evaluate_errors
from optipmb_tools.evaluation.figures import cell
from optipmb_tools.tuning.clips import Clip, load, of_class, track_clip
from optipmb_tools.tuning.scoring import plain_figures, rules_of, scorer_of
from optipmb_tools.tuning.values import only

import optipmb

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from optipmb_tools.datasets import DataSequence
    from optipmb_tools.evaluation.cases import Rules
    from optipmb_tools.results import ResultTable

    Way = tuple[str, Callable[[Clip], ResultTable]]

CARS, ROAD_USERS = ("Car",), ("Car", "Pedestrian", "Cyclist")
SETS = (
    ("kitti", "pointrcnn", ROAD_USERS),
    ("kitti", "second_iou", ROAD_USERS),
    ("kitti", "pvrcnn", ROAD_USERS),
    ("kitti", "casa", CARS),
    ("kitti", "virconv", CARS),
    ("nuscenes", "centerpoint", ("car", "pedestrian")),
    ("nuscenes", "pointpillars", ("car",)),
)
"""Datasets, detectors and the classes that they detect."""
SIMPLE = ("pointrcnn", "centerpoint")
"""Detectors whose detections go through the simple trackers too."""
SHOWN = ("sAMOTA", "AMOTA", "MOTA", "HOTA", "HOTA, all", "IDS", "FP", "FN")


def ways(dataset: str, detections: str, name: str) -> Iterator[Way]:
    """Yield the trackers by name."""
    if detections in SIMPLE:
        yield "greedy", partial(greedy_tracks, name=name)
        if name in HABITS:
            yield "Kalman filters (AB3DMOT)", partial(kalman_tracks, name=name)
    for profile in (f"{dataset}-paper", dataset):
        yield profile, partial(track_clip, parameters=only(optipmb.load_profile(profile), name))


def backward(
    sequences: Sequence[DataSequence], clips: Sequence[Clip], profile: str, name: str, rules: Rules
) -> tuple[str, str]:
    """Return the shares of boxes that face backwards, of tracks and of their detections, in percent."""
    parameters = only(optipmb.load_profile(profile), name)
    tracked = [(one, clip.world, track_clip(clip, parameters)) for one, clip in zip(sequences, clips, strict=True)]
    found = evaluate_errors([(*one, one[-1]) for one in tracked], name, rules)
    shares = found.figures(found.detected)["backward"]
    return f"{100 * shares['track']:.2f}", f"{100 * shares['detection']:.2f}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--root", type=Path, required=True, help="folder with kitti/ and nuscenes/")
    given = parser.parse_args()
    out = csv.writer(sys.stdout, lineterminator="\n")
    out.writerow(("detector", "class", "tracker", *SHOWN, "backward %", "of the detections"))
    for dataset, detections, names in SETS:
        options = {"z_bottom": True} if detections == "pointpillars" else {}
        opened = open_dataset(dataset, given.root / dataset, detections, clouds=False, **options)
        sequences = opened.sequences(["all"])
        rules = rules_of(dataset)
        every = [load(one, optipmb.load_profile(dataset), rules) for one in sequences]
        for name in names:
            clips = [of_class(clip, name, rules) for clip in every]
            scorer = scorer_of(dataset, name, sequences)
            for way, run in ways(dataset, detections, name):
                found = plain_figures(scorer.figures([scorer.measure(clip, run(clip)) for clip in clips]))
                known = way in optipmb.profiles()
                sides = backward(sequences, clips, way, name, scorer.near) if known else ("-", "-")
                out.writerow((detections, name, way, *(cell(key, found[key]) for key in SHOWN), *sides))
                sys.stdout.flush()


if __name__ == "__main__":
    main()
