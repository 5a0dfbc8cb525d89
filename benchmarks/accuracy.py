"""The tracker beside two simple ones, same detections, same evaluator: `python benchmarks/accuracy.py --root data`.

Prints the table of docs/tuning.md as Markdown. Simple are a greedy tracker of nearest centres and AB3DMOT's Kalman
filters (`tests/support/greedy.py`, `kalman.py`); their parameters are the published ones. The tracker runs with the
values of the paper's table and with the profile that ships. KITTI counts at a 3D overlap of 0.25, ten sequences.
"""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))

from greedy import greedy_tracks
from kalman import HABITS, kalman_tracks
from optipmb_client.datasets import open_dataset
from optipmb_client.tuning.degrade import Degradation, degrade
from optipmb_client.tuning.material import Clip, load, of_class, track_clip
from optipmb_client.tuning.scoring import rules_of, scorer_of
from optipmb_client.tuning.values import only

import optipmb

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from optipmb_client.results import ResultTable

    Way = tuple[str, Callable[[Clip], ResultTable]]

SETS = (
    ("kitti", "pointrcnn", ("Car", "Pedestrian", "Cyclist")),
    ("nuscenes", "centerpoint", ("car", "pedestrian")),
    ("nuscenes", "pointpillars", ("car",)),
)
SHOWN = ("sAMOTA", "AMOTA", "MOTA", "HOTA", "HOTA, all", "IDS")


def ways(dataset: str, name: str) -> Iterator[Way]:
    """Yield the trackers by name."""
    yield "greedy", partial(greedy_tracks, name=name)
    if name in HABITS:
        yield "Kalman filters (AB3DMOT)", partial(kalman_tracks, name=name)
    for profile in (f"{dataset}-paper", dataset):
        yield f"`{profile}`", partial(track_clip, parameters=only(optipmb.load_profile(profile), name))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--root", type=Path, required=True, help="folder with kitti/ and nuscenes/")
    parser.add_argument("--degrade", action="store_true", help="of detections made worse, as `optipmb tune` does")
    given = parser.parse_args()
    print("| | tracker | " + " | ".join(SHOWN) + " |\n| --- | --- |" + " ---: |" * len(SHOWN))
    for dataset, detections, names in SETS:
        options = {"z_bottom": True} if detections == "pointpillars" else {}
        opened = open_dataset(dataset, given.root / dataset, detections, clouds=False, **options)
        sequences = opened.sequences(["all"])
        rules = rules_of(dataset)
        every = [load(one, optipmb.load_profile(dataset), rules) for one in sequences]
        for name in names:
            clips = [of_class(clip, name, rules) for clip in every]
            if given.degrade:
                clips = [degrade(clip, Degradation(), 0) for clip in clips]
            scorer = scorer_of(dataset, name, sequences)
            for way, run in ways(dataset, name):
                found = scorer.figures([scorer.measure(clip, run(clip)) for clip in clips]).to_json()
                print(f"| {detections} {name} | {way} | " + " | ".join(_shown(found[key]) for key in SHOWN) + " |")


def _shown(value: float | None) -> str:
    if value is None:
        return "-"
    return str(int(value)) if value == int(value) else f"{value:.4f}"


if __name__ == "__main__":
    main()
