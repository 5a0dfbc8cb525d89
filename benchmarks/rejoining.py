"""Tracks joined over gaps: `python benchmarks/rejoining.py --root data`.

Prints the tables of docs/gaps.md as Markdown: four generated scenes (`tests/support/gaps.py`), the generated traffic
with lasting objects, and with `--root` KITTI and nuScenes. A join is right if the earlier track ended on the object on
which the later one began. Profile `auto`.
"""

from __future__ import annotations

import argparse
import sys
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))

from gaps import CLASSES, FALSE_OBJECT, SCENES, SIZES, Judged, judge, owners, record, tracked
from generality import DETECTORS, identity_f1, sequences_of
from optipmb_tools.datasets import Truth, open_dataset
from optipmb_tools.evaluation.cases import default_rules, prepare
from optipmb_tools.evaluation.clear import clear
from optipmb_tools.results import full_table, stacked
from optipmb_tools.run import profiles
from optipmb_tools.run.rejoining import Rejoin
from optipmb_tools.run.tracking import track_whole

from optipmb import generic_parameters

if TYPE_CHECKING:
    from collections.abc import Sequence

    from gaps import Recording
    from optipmb_schemas import Tracks
    from optipmb_tools.geometry import Ints

    from optipmb import Parameters

LENGTHS = (1, 2, 3, 5, 10, 20, 40)
LEVELS = (0.8, 0.9, 0.95, 0.98, 0.99, 1.01)
NEAR_M = 2.0


def truth_of(recording: Recording, labels: dict[int, int]) -> Truth:
    """Return the objects of a generated scene where they can be seen."""
    frame = np.repeat(np.arange(len(recording.truth)), [len(ids) for ids, _ in recording.truth])
    identity = np.concatenate([ids for ids, _ in recording.truth])
    label = np.array([labels[one] for one in identity.tolist()], dtype=np.int64)
    place = np.concatenate([where for _, where in recording.truth])
    center = np.column_stack((place, 0.5 * SIZES[label][:, 2]))
    return Truth.of(
        CLASSES, frame, id=identity, label=label, center=center, size=SIZES[label], yaw=np.zeros(len(frame))
    )


def identities(tracks: dict[int, Tracks], parameters: Parameters, truth: Truth) -> list[tuple[float, int]]:
    """Return IDF1 and switches of the confirmed tracks, by id and by object."""
    objects, rules = Rejoin().objects(tracks, parameters), default_rules("scene")
    table, sure = full_table(parameters.labels, tracks), stacked(list(tracks.values()), "confirmed") > 0
    stamps = np.array([tracks[index].stamp_ns for index in sorted(tracks)])
    joined = objects.columns(table.id, stamps[np.searchsorted(sorted(tracks), table.frame)])["object"]
    found = []
    for number in (table.id, np.where(joined < 0, table.id, joined)):
        shown = table.take(sure)
        object.__setattr__(shown, "id", number[sure])
        cases = [prepare(truth, shown, name, rules) for name in truth.labels]
        found.append((identity_f1(cases, -np.inf), sum(clear(case, rules).switches for case in cases)))
    return found


def owners_by_place(tracks: dict[int, Tracks], truth: Truth) -> dict[int, tuple[int, int]]:
    """Return the objects on which each track began and ended: the nearest ones of the annotated frames."""
    rows: dict[int, list[int]] = {}
    by_frame = {frame: np.flatnonzero(truth.frame == frame) for frame in np.unique(truth.frame).tolist()}
    for index, one in tracks.items():
        near = by_frame.get(index, np.empty(0, dtype=np.int64))
        for identity, place, detection in zip(one.id.tolist(), one.center, one.detection.tolist(), strict=True):
            own = rows.setdefault(identity, [])
            if detection >= 0 and len(near):
                apart = np.linalg.norm(truth.center[near, :2] - place[:2], axis=1)
                own.append(int(truth.id[near[apart.argmin()]]) if apart.min() < NEAR_M else FALSE_OBJECT)
    return {one: (own[0], own[-1]) if own else (FALSE_OBJECT, FALSE_OBJECT) for one, own in rows.items()}


def line(*cells: object) -> None:
    """Print a row of a table."""
    print("|", " | ".join(map(str, cells)), "|", flush=True)


def head(*cells: object) -> None:
    """Print the first rows of a table."""
    print()
    line(*cells)
    line(*["---"] * len(cells))


def generated(seeds: Sequence[int], least: float) -> None:
    """Print the tables of the four scenes."""
    parameters = generic_parameters(CLASSES, 0.1)
    every, rows = Judged(), []
    for name in SCENES:
        here, figures = Judged(), []
        for seed in seeds:
            recording = record(name, seed)
            tracks = tracked(recording.frames, parameters)
            here += judge(tracks, owners(tracks, recording.source), parameters)
            figures.append(identities(tracks, parameters, truth_of(recording, recording.labels)))
        every += here
        one = np.array(figures)  # (S, 2, 2)
        score, switches = 100.0 * one[:, :, 0].mean(axis=0), one[:, :, 1].sum(axis=0).astype(int)
        rows.append((name, here, score, switches))
    head("share of true gaps joined, %", *(f"{a} to {b} s" for a, b in pairwise(LENGTHS)))
    for name, one in (*((row[0], row[1]) for row in rows), ("all", every)):
        shares = [one.share(a, b, least) for a, b in pairwise(LENGTHS)]
        line(name, *(f"{100.0 * share:.0f} of {count}" if count else "-" for share, count in shares))
    head("scene", "right", "wrong", "precision, %", "IDF1 by id", "by object", "switches by id", "by object")
    total = ("all", every, np.mean([row[2] for row in rows], axis=0), sum(row[3] for row in rows))
    for name, one, score, switches in (*rows, total):
        right, wrong, _ = one.counts(least)
        share = f"{100.0 * right / max(right + wrong, 1):.1f}"
        line(name, right, wrong, share, *(f"{value:.1f}" for value in score), *switches.tolist())
    head("probability", "joins", "right, %")
    for low, high in pairwise(LEVELS):
        known = every.join[(every.join[:, 0] >= low) & (every.join[:, 0] < high) & ~np.isnan(every.join[:, 1])]
        line(f"{low:g} to {min(high, 1.0):g}", len(known), f"{100.0 * known[:, 1].mean():.0f}" if len(known) else "-")


def recorded(root: Path | None, frames: int, least: float) -> None:
    """Print the table of the traffic of the product and, with a root, of KITTI and nuScenes."""
    head("data", "confirmed tracks", "true gaps", "right", "wrong", "of unlabelled objects", "IDF1 by id", "by object")
    traffic = [
        one
        for seed in range(4)
        for one in open_dataset("scene", seed=seed, frames=frames, clouds=False, lasting=1).sequences(["0000"])
    ]
    sets = {"generated traffic": traffic}
    sets |= {name: list(sequences_of(root, name, fast=False)) for name in DETECTORS} if root else {}
    for name, sequences in sets.items():
        found, tracked_ids, figures = Judged(), 0, []
        for sequence in sequences:
            parameters = profiles.profile_for("auto", [sequence])
            tracks = track_whole(parameters, sequence).tracks
            truth = sequence.truth()
            if truth is None:
                raise SystemExit(f"{sequence.name}: no annotations")
            shown: list[Ints] = [one.id[one.confirmed > 0] for one in tracks.values() if one.confirmed is not None]
            tracked_ids += len(np.unique(np.concatenate(shown)))
            found += judge(tracks, owners_by_place(tracks, truth), parameters, whole=False)
            figures.append([score for score, _ in identities(tracks, parameters, truth)])
        score = 100.0 * np.mean(figures, axis=0)
        line(name, tracked_ids, len(found.gap), *found.counts(least), *(f"{value:.1f}" for value in score))


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--root", type=Path, help="folder with kitti/, nuscenes/ and nuscenes-more/")
    parser.add_argument("--seeds", type=int, nargs="+", default=range(21, 27))
    parser.add_argument("--frames", type=int, default=900, help="of the generated traffic")
    parser.add_argument("--min-probability", type=float, default=Rejoin.min_probability)
    given = parser.parse_args()
    generated(given.seeds, given.min_probability)
    recorded(given.root, given.frames, given.min_probability)


if __name__ == "__main__":
    main()
