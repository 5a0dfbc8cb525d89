"""Tracks joined over gaps: `python benchmarks/rejoining.py --root data [--online]`.

Prints the tables of docs/gaps.md as Markdown: four generated scenes (`tests/support/gaps.py`), the generated traffic
with lasting objects, and with `--root` KITTI and nuScenes. A join is right if the earlier track ended on the object on
which the later one began, by the last and the first five detections. Profile `auto`. With `--online` tracks are joined
while tracking: rows that are not decided have no identity, joins below the least probability are those of a second
run, and scenes of doors and a corridor follow, without and with what is declared of them. With `--vectors` detections
of the generated scenes bring simulated vectors of appearance (`gaps.with_vectors`).
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))

from gaps import (
    CLASSES,
    DECLARED,
    FALSE_OBJECT,
    SCENES,
    SITES,
    SIZES,
    Judged,
    decided,
    ends_of,
    followed,
    judge,
    owners,
    record,
    with_vectors,
)
from generality import DETECTORS, identity_f1, sequences_of
from optipmb_tools.datasets import Truth, open_dataset
from optipmb_tools.evaluation.cases import default_rules, prepare
from optipmb_tools.evaluation.clear import clear, combine
from optipmb_tools.evaluation.hota import evaluate_hota
from optipmb_tools.results import full_table, stacked
from optipmb_tools.run import profiles
from optipmb_tools.run.rejoining import RejoinOptions, joins, tracklets
from optipmb_tools.run.tracking import tracker_frame

import optipmb
from optipmb import generic_parameters
from optipmb.joining.decision import Kinds

if TYPE_CHECKING:
    from collections.abc import Sequence

    from gaps import Recording
    from optipmb_schemas import Tracks
    from optipmb_tools.evaluation.cases import Case
    from optipmb_tools.evaluation.clear import ClearResult
    from optipmb_tools.geometry import Floats, Ints

    from optipmb import Frame, Parameters
    from optipmb.model.lost_objects import Tracklets

LENGTHS = (1, 2, 3, 5, 10, 20, 40)
LEVELS = (0.8, 0.9, 0.95, 0.98, 0.99, 1.01)
NEAR_M = 2.0
RULES = default_rules("scene")


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


def ids_of(tracks: dict[int, Tracks]) -> Ints:
    """Return the id of each row."""
    return stacked(list(tracks.values()), "id")


@dataclass(frozen=True)
class How:
    """How tracks are joined."""

    least: float
    online: bool
    view: float = 0.0  # of the simulated vectors of appearance; 0: there are none
    lasts: bool = False

    def tracked(self, frames: Sequence[Frame], parameters: Parameters, least: float = 0.0) -> dict[int, Tracks]:
        """Return the tracks of frames, joined while tracking if that is asked for."""
        model = "reid-7" if self.view else None
        how = optipmb.Rejoin(min_probability=least or self.least, embedding_model=model)
        return followed(frames, parameters, how if self.online else None)

    def joins(self, tracks: dict[int, Tracks], parameters: Parameters) -> tuple[Tracklets, tuple[Ints, Ints, Floats]]:
        """Return the confirmed tracks and the joins."""
        found = tracklets(tracks, parameters.labels)
        return found, decided(tracks, found) if self.online else joins(found, Kinds.of(parameters), RejoinOptions.gap_s)

    def numbers(self, tracks: dict[int, Tracks], parameters: Parameters) -> Ints:
        """Return the object of each row, -1 of one that has none."""
        if self.online:
            return stacked(list(tracks.values()), "object").astype(np.int64)
        stamps = np.repeat([one.stamp_ns for one in tracks.values()], [len(one.id) for one in tracks.values()])
        identity = ids_of(tracks)
        number = (
            RejoinOptions(min_probability=self.least).objects(tracks, parameters).columns(identity, stamps)["object"]
        )
        return np.where(number < 0, identity, number)


def cases_by(number: Ints, tracks: dict[int, Tracks], parameters: Parameters, truth: Truth) -> list[Case]:
    """Return the cases of the classes with the confirmed tracks, given the identity of each row, or -1."""
    table, sure = full_table(parameters.labels, tracks), stacked(list(tracks.values()), "confirmed") > 0
    rows = sure & (number >= 0)
    shown = table.take(rows)
    object.__setattr__(shown, "id", number[rows])
    return [prepare(truth, shown, name, RULES) for name in truth.labels]


def counts_of(cases: Sequence[Case]) -> ClearResult:
    """Return the CLEAR figures of all classes together."""
    return combine(clear(case, RULES) for case in cases)


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
    return {one: ends_of(own) if own else (FALSE_OBJECT, FALSE_OBJECT) for one, own in rows.items()}


def line(*cells: object) -> None:
    """Print a row of a table."""
    print("|", " | ".join(map(str, cells)), "|", flush=True)


def head(*cells: object) -> None:
    """Print the first rows of a table."""
    print()
    line(*cells)
    line(*["---"] * len(cells))


def sites(seeds: Sequence[int], least: float) -> None:
    """Print the table of scenes in which exits and passages may be declared, or are learned, joined while tracking."""
    parameters, late_ns = generic_parameters(CLASSES, 0.1), 200 * 10**9
    head(
        "scene",
        "declared",
        "right",
        "wrong",
        "2 to 10 s, %",
        "10 to 30 s, %",
        "after 200 s: right",
        "wrong",
        "10 to 30 s, %",
    )
    for name in SITES:
        for declared in (False, True):
            settings = optipmb.Rejoin(min_probability=least, **DECLARED[name] if declared else {})
            every, later = Judged(), Judged()
            for seed in seeds:
                recording = record(name, seed, 500.0)
                tracks = followed(
                    (optipmb.make_frame(parameters, **one)[0] for one in recording.frames), parameters, settings
                )
                found, owner = tracklets(tracks, parameters.labels), owners(tracks, recording.source)
                before, after, probability = decided(tracks, found)
                every += judge(found, (before, after, probability), owner)
                late = found.first_ns >= late_ns
                began = [
                    owner[one][0] if known else FALSE_OBJECT for one, known in zip(found.id.tolist(), late, strict=True)
                ]
                owner |= {one: (first, owner[one][1]) for one, first in zip(found.id.tolist(), began, strict=True)}
                rows = late[after]
                later += judge(found, (before[rows], after[rows], probability[rows]), owner)
            cells = []
            for one, lengths in ((every, ((2, 10), (10, 30))), (later, ((10, 30),))):
                shares = [one.share(low, high, least) for low, high in lengths]
                cells += [*one.counts(least)[:2], *(f"{100 * share:.0f} of {count}" for share, count in shares)]
            line(name, "yes" if declared else "no", *cells)


def generated(seeds: Sequence[int], how: How, scenes: Sequence[str]) -> None:
    """Print the tables of the generated scenes."""
    parameters, least = generic_parameters(CLASSES, 0.1), how.least
    every, unsure, rows = Judged(), Judged(), []
    for name in scenes:
        here, figures = Judged(), []
        for seed in seeds:
            recording = record(name, seed)
            given = with_vectors(recording, how.view, seed, lasts=how.lasts) if how.view else recording.frames
            frames = [optipmb.make_frame(parameters, **one)[0] for one in given]
            tracks = how.tracked(frames, parameters)
            here += judge(*how.joins(tracks, parameters), owners(tracks, recording.source))
            if how.online:
                other = how.tracked(frames, parameters, LEVELS[0])
                unsure += judge(*how.joins(other, parameters), owners(other, recording.source))
            numbers, truth = (ids_of(tracks), how.numbers(tracks, parameters)), truth_of(recording, recording.labels)
            cases = [cases_by(one, tracks, parameters, truth) for one in numbers]
            figures.append([(identity_f1(one, -np.inf), counts_of(one).switches) for one in cases])
        every += here
        table = np.array(figures)  # (S, 2, 2)
        score, switches = 100.0 * table[:, :, 0].mean(axis=0), table[:, :, 1].sum(axis=0).astype(int)
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
    join = (unsure if how.online else every).join
    for low, high in pairwise(LEVELS):
        known = join[(join[:, 0] >= low) & (join[:, 0] < high) & ~np.isnan(join[:, 1])]
        line(f"{low:g} to {min(high, 1.0):g}", len(known), f"{100.0 * known[:, 1].mean():.0f}" if len(known) else "-")


def cut_out(frames: Sequence[Frame], seconds: float) -> list[Frame]:
    """Return frames of which every third part of so many seconds has no detections."""
    arrays = ("center", "size", "yaw", "velocity", "score", "label", "source")
    found, first_ns = [], frames[0].stamp_ns
    for one in frames:
        if int((one.stamp_ns - first_ns) * 1e-9 / seconds) % 3 == 2:
            none: dict[str, Any] = {name: getattr(one, name)[:0] for name in arrays}
            found.append(replace(one, **none, position_covariance=None, embedding=None))
        else:
            found.append(one)
    return found


def recorded(root: Path | None, frames: int, how: How, cut_s: float) -> None:
    """Print the table of the traffic of the product and, with a root, of KITTI and nuScenes."""
    cells = (
        "data",
        "confirmed tracks",
        "true gaps",
        "right",
        "wrong",
        "of unlabelled objects",
        "IDF1 by id",
        "by object",
    )
    head(*cells, "figures by id")
    traffic = [
        one
        for seed in range(4)
        for one in open_dataset("scene", seed=seed, frames=frames, clouds=False, lasting=1).sequences(["0000"])
    ]
    sets = {"generated traffic": traffic}
    sets |= {name: list(sequences_of(root, name, fast=False)) for name in DETECTORS} if root else {}
    for name, sequences in sets.items():
        judged, tracked_ids, figures, same = Judged(), 0, [], True
        for sequence in sequences:
            parameters = profiles.profile_for("auto", [sequence])
            given = list(sequence.frames())
            made = [tracker_frame(parameters, sequence.name, one) for one in given]
            made = cut_out(made, cut_s) if cut_s else made
            truth = sequence.truth()
            if truth is None:
                raise SystemExit(f"{sequence.name}: no annotations")

            order = [one.index for one in given]
            tracks, plain = (
                dict(zip(order, one.tracked(made, parameters).values(), strict=True))
                for one in (how, replace(how, online=False))
            )
            shown: list[Ints] = [one.id[one.confirmed > 0] for one in tracks.values() if one.confirmed is not None]
            tracked_ids += len(np.unique(np.concatenate(shown)))
            judged += judge(*how.joins(tracks, parameters), owners_by_place(tracks, truth), whole=False)
            by_id, by_object = (
                cases_by(one, tracks, parameters, truth) for one in (ids_of(tracks), how.numbers(tracks, parameters))
            )
            without = cases_by(ids_of(plain), plain, parameters, truth)
            same &= counts_of(without) == counts_of(by_id)
            same &= evaluate_hota(without, RULES).summary() == evaluate_hota(by_id, RULES).summary()
            figures.append([identity_f1(one, -np.inf) for one in (by_id, by_object)])
        score = 100.0 * np.mean(figures, axis=0)
        shares = (f"{value:.1f}" for value in score)
        line(name, tracked_ids, len(judged.gap), *judged.counts(how.least), *shares, "equal" if same else "different")


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--root", type=Path, help="folder with kitti/, nuscenes/ and nuscenes-more/")
    parser.add_argument("--seeds", type=int, nargs="*", default=range(31, 37))
    parser.add_argument("--frames", type=int, default=900, help="of the generated traffic; 0: without it")
    parser.add_argument("--online", action="store_true", help="join while tracking")
    parser.add_argument("--scenes", nargs="*", default=list(SCENES), choices=list(SCENES))
    parser.add_argument("--vectors", type=float, default=0.0, help="length of what changes in them, as 1.25")
    parser.add_argument("--lasts", action="store_true", help="with --vectors: that changes over gaps only")
    parser.add_argument("--cut", type=float, default=0.0, help="of recordings, cut out gaps of so many seconds")
    parser.add_argument("--min-probability", type=float, help="default: that of the product")
    given = parser.parse_args()
    default = optipmb.Rejoin.min_probability if given.online else RejoinOptions.min_probability
    how = How(given.min_probability or default, given.online, given.vectors, given.lasts)
    if given.seeds:
        generated(given.seeds, how, given.scenes)
        if given.online:
            sites(given.seeds, how.least)
    if given.frames:
        recorded(given.root, given.frames, how, given.cut)


if __name__ == "__main__":
    main()
