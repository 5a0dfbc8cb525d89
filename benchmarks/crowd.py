"""The default in crowds and among ships, beside a textbook filter: `python benchmarks/crowd.py --root data`.

People walk in a ring, both ways round, at a density of .5 to 3 for each square metre. Their points are detected with a
recall of .94, a precision of .95 and errors of .12 m, without size and heading, as people counters give them. Ships of
6 to 30 m are hit at one part or another: the centre of a box wanders by a sixth of the length, in 20 s. With
`--root` there are the pedestrians of the development data, as points too. Prints CSV, a row for each scene and tracker:
IDF1, identity switches, MOTA, false and missed boxes, where points within `NEAR` of a person are of the person, and
within `NEAR_SHIP` of a ship. `auto` is judged by its confirmed tracks, as `optipmb track` writes them.
"""

from __future__ import annotations

import argparse
import csv
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from generality import DETECTORS, sequences_of
from optipmb_tools.datasets import Truth
from optipmb_tools.evaluation.cases import Rules, prepare
from optipmb_tools.evaluation.clear import clear, combine
from optipmb_tools.evaluation.identity import evaluate_identity
from optipmb_tools.results import ResultTable, full_table, stacked
from optipmb_tools.tuning.clips import load, of_class
from optipmb_tools.tuning.scoring import rules_of
from scipy.optimize import linear_sum_assignment

import optipmb
from optipmb.learning.hindsight import with_hindsight

if TYPE_CHECKING:
    from collections.abc import Iterator

    from optipmb_tools.geometry import Floats, Ints

NAME = "pedestrian"
DENSITIES = (0.5, 1.0, 2.0, 3.0)
"""People for each square metre of the ring."""
RATES = (10.0, 5.0)
"""Frames a second."""
SECONDS = 20.0
RECALL, PRECISION, NOISE = 0.94, 0.95, 0.12
INNER, OUTER = 4.0, 6.5
"""Radii of the ring, m."""
NEAR, NEAR_SHIP = 0.5, 6.0
REAL = ("second_iou", "pvrcnn", "centerpoint", "megvii")
SURE, GATE, AGILE = 0.5, 4.0, 0.3
"""Of the textbook filter, the best of 16 settings in crowds of 1 and 3 people: score from which it takes a detection,
standard deviations of the gate, and the change of a velocity in a second, m/s."""
LIFE_NS, LIFE_SHIP_NS = 10**9, 4 * 10**9
"""How long the textbook filter keeps a person and a ship without a detection."""


@dataclass(frozen=True)
class Scene:
    """Points of people: stamps of the frames, rows of x, y and score of each; of ships length and yaw; the truth."""

    stamps: Ints
    points: tuple[Floats, ...]
    truth: Truth
    name: str = NAME
    noise: float = NOISE
    life_ns: int = LIFE_NS
    near: float = NEAR


def table(frame: Ints, identity: Ints, place: Floats, score: Floats) -> ResultTable:
    """Return tracks of points as a table."""
    count = len(frame)
    center, size = np.column_stack((place, np.full(count, 0.9))), np.tile([0.7, 0.7, 1.75], (count, 1))
    none = np.full((count, 4), np.nan)
    return ResultTable((NAME,), frame, identity, np.zeros(count, np.int64), center, size, np.zeros(count), score, none)


def walked(density: float, rate: float, seconds: float, rng: np.random.Generator) -> Floats:
    """Return the places (F, N, 2) of people in the ring, who evade each other and the walls; half of them go round."""
    count = round(density * np.pi * (OUTER**2 - INNER**2))
    angle, radius = rng.uniform(-np.pi, np.pi, count), np.sqrt(rng.uniform(INNER**2, OUTER**2, count))
    place, velocity = radius[:, None] * np.column_stack((np.cos(angle), np.sin(angle))), np.zeros((count, 2))
    # Lanes: those who go round keep to the outer half, as people do
    way, usual = (
        np.where(radius > 0.5 * (INNER + OUTER), 1.0, -1.0),
        rng.normal(1.3, 0.2, count) / (1.0 + 0.5 * density),
    )
    frames, dt, reach = [], 0.05, min(0.35, 0.4 / np.sqrt(density))
    for k in range(round((seconds + 5.0) / dt)):
        outward = place / np.linalg.norm(place, axis=1)[:, None]
        along = np.column_stack((-outward[:, 1], outward[:, 0])) * way[:, None]
        force = (usual[:, None] * along - velocity) / 0.5
        apart = place[:, None] - place[None]
        distance = np.linalg.norm(apart, axis=2) + 1e-9
        push = np.where(distance < 2.0, 3.0 * np.exp((reach - distance) / 0.12), 0.0)
        np.fill_diagonal(push, 0.0)
        force += (np.minimum(push, 20.0)[:, :, None] * apart / distance[:, :, None]).sum(axis=1)
        off = np.linalg.norm(place, axis=1)
        force += outward * (np.exp((INNER - off) / 0.1) - np.exp((off - OUTER) / 0.1)).clip(-20.0, 20.0)[:, None]
        velocity += dt * force + np.sqrt(dt) * 0.15 * rng.standard_normal((count, 2))
        velocity *= np.minimum(1.0, 2.0 / np.maximum(np.linalg.norm(velocity, axis=1), 1e-9))[:, None]
        place = place + dt * velocity
        if k * dt >= 5.0 and (k + 1) % round(1.0 / (rate * dt)) == 0:
            frames.append(place)
    return np.array(frames)


def crowd(density: float, rate: float) -> Scene:
    """Return a generated crowd."""
    rng = np.random.default_rng(round(10 * density))
    places = walked(density, rate, SECONDS, rng)
    frames, count, _ = places.shape
    points = []
    for place in places:
        seen = place[rng.random(count) < RECALL]
        false = rng.poisson(len(seen) * (1.0 / PRECISION - 1.0))
        angle, radius = rng.uniform(-np.pi, np.pi, false), np.sqrt(rng.uniform(INNER**2, OUTER**2, false))
        clutter = radius[:, None] * np.column_stack((np.cos(angle), np.sin(angle)))
        score = np.concatenate((rng.beta(8, 2, len(seen)), rng.beta(4, 4, false)))
        both = np.concatenate((seen + NOISE * rng.standard_normal(seen.shape), clutter))
        points.append(np.column_stack((both, np.clip(score, 0.01, 0.99))))
    when, who = np.repeat(np.arange(frames), count), np.tile(np.arange(count), frames)
    known = table(when, who, places.reshape(-1, 2), np.ones(len(when)))
    columns = {name: getattr(known, name) for name in ("id", "label", "center", "size", "yaw")}
    stamps = np.round(np.arange(frames) / rate * 1e9).astype(np.int64)
    return Scene(stamps, tuple(points), Truth.of((NAME,), when, **columns))


def ships(rate: float, *, sized: bool, seconds: float = 120.0, count: int = 12, half: float = 200.0) -> Scene:
    """Return generated ships in a square of which `half` is half the side, with their sizes and headings if `sized`."""
    rng, dt = np.random.default_rng(1), 1.0 / rate
    length, speed = rng.uniform(6.0, 30.0, count), rng.uniform(0.0, 6.0, count) * (rng.random(count) < 0.8)
    place, yaw, turn = rng.uniform(-half, half, (count, 2)), rng.uniform(-3.0, 3.0, count), rng.normal(0.0, 0.01, count)
    off, seen = rng.standard_normal(count) * length / 6.0, np.ones(count, np.bool_)
    kept, again = np.exp(-dt / 20.0), 1.0 - np.exp(-dt / 0.7)
    points, places = [], []
    for _ in range(round(seconds * rate)):
        ahead = np.column_stack((np.cos(yaw), np.sin(yaw)))
        place, yaw = place + dt * speed[:, None] * ahead, np.remainder(yaw + turn * dt + np.pi, 2.0 * np.pi) - np.pi
        off = kept * off + np.sqrt(1.0 - kept**2) * rng.standard_normal(count) * length / 6.0
        seen = np.where(rng.random(count) < again, rng.random(count) < 0.85, seen)
        hit = place + off[:, None] * ahead + 0.2 * rng.standard_normal((count, 2))
        false = rng.poisson(6.0)
        waves = np.column_stack((rng.uniform(-half, half, (false, 2)), rng.beta(4, 6, false), np.full(false, 3.0)))
        boxes = np.column_stack((hit, rng.beta(8, 3, count), length, yaw))[seen]
        both = np.concatenate((boxes, np.column_stack((waves, rng.uniform(-3.0, 3.0, false)))))
        points.append(both if sized else both[:, :3])
        places.append(place)
    when, who = np.repeat(np.arange(len(places)), count), np.tile(np.arange(count), len(places))
    known = table(when, who, np.concatenate(places), np.ones(len(when)))
    columns = {name: getattr(known, name) for name in ("id", "label", "center", "size", "yaw")}
    stamps = np.round(np.arange(len(places)) * dt * 1e9).astype(np.int64)
    truth = Truth.of((NAME,), when, **columns)
    return Scene(stamps, tuple(points), truth, "boat", 1.0, LIFE_SHIP_NS, NEAR_SHIP)


def recorded(root: Path, detector: str, *, fast: bool) -> Iterator[Scene]:
    """Yield the pedestrians of the sequences of a detector."""
    folder, names = DETECTORS[detector]
    name, rules = names[1], rules_of("kitti" if folder == "kitti" else "nuscenes")
    for one in sequences_of(root, detector, fast=fast):
        clip = load(one, optipmb.generic_parameters((name,), 0.1), rules)
        own = of_class(clip, name, rules)
        points = tuple(np.column_stack((frame.center[:, :2], frame.score)) for frame in own.frames)
        kept = own.world.of_class(name)
        label = np.zeros(len(kept), np.int64)
        columns = {"id": kept.id, "center": kept.center, "size": kept.size, "yaw": kept.yaw, "label": label}
        if len(kept):
            yield Scene(clip.stamps, points, Truth.of((NAME,), kept.frame, **columns))


def auto(scene: Scene) -> ResultTable:
    """Return the confirmed tracks of the default."""
    period = float(np.median(np.diff(scene.stamps))) * 1e-9
    parameters = optipmb.generic_parameters((scene.name,), period)
    tracker, found = optipmb.Tracker(parameters), []
    density = tracker.initial()
    for stamp, points in zip(scene.stamps.tolist(), scene.points, strict=True):
        center = np.column_stack((points[:, :2], np.full(len(points), np.nan)))
        label, score = np.zeros(len(points), np.int64), points[:, 2]
        boxes = {}
        if points.shape[1] > 3:
            length = points[:, 3]
            boxes = {"size": np.column_stack((length, length / 4.0, np.full(len(length), 3.0))), "yaw": points[:, 4]}
        frame, _ = optipmb.make_frame(
            parameters, stamp_ns=stamp, labels=(scene.name,), label=label, center=center, score=score, **boxes
        )
        result = tracker.step(density, frame)
        density = result.density
        found.append(result.tracks)
    changed = with_hindsight(found, parameters)
    later = {k: one.replaced(**columns) for k, (one, columns) in enumerate(zip(found, changed, strict=True))}
    every = full_table((scene.name,), later)
    shown = every.take(stacked(list(later.values()), "confirmed").astype(np.bool_))
    return table(shown.frame, shown.id, shown.center[:, :2], shown.score)


def kalman(scene: Scene) -> ResultTable:
    """Return the tracks of constant velocity filters that the Hungarian method gives their points.

    A track ends `life_ns` after its last point, and is written from the third point on, in frames with one.
    """
    means, covariances = np.empty((0, 4)), np.empty((0, 4, 4))
    identity, hits, seen = np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, np.int64)
    rows, count, before = [], 0, int(scene.stamps[0])
    for k, (stamp, given) in enumerate(zip(scene.stamps.tolist(), scene.points, strict=True)):
        dt, z = (stamp - before) * 1e-9, given[given[:, 2] >= SURE, :2]
        before, step = stamp, np.eye(4)
        step[0, 2] = step[1, 3] = dt
        noise = np.diag([0.02, 0.02, AGILE, AGILE]) ** 2 * dt
        means, covariances = means @ step.T, step @ covariances @ step.T + noise
        spread = covariances[:, :2, :2] + scene.noise**2 * np.eye(2)
        off = z[None] - means[:, None, :2]
        inverse = np.linalg.inv(spread)
        squared = np.einsum("nmi,nij,nmj->nm", off, inverse, off)
        cost = np.where(squared < GATE**2, squared + np.log(np.linalg.det(spread))[:, None], 1e6)
        n, m = linear_sum_assignment(cost)
        good = cost[n, m] < 1e6
        n, m = n[good], m[good]
        gain = covariances[n][:, :, :2] @ inverse[n]
        means[n] += np.einsum("nij,nj->ni", gain, off[n, m])
        covariances[n] -= gain @ covariances[n][:, :2]
        hits[n] += 1
        seen[n] = stamp
        fresh = np.setdiff1d(np.arange(len(z)), m)
        means = np.concatenate((means, np.pad(z[fresh], ((0, 0), (0, 2)))))
        start = np.diag([scene.noise**2, scene.noise**2, 1.0, 1.0])
        covariances = np.concatenate((covariances, np.tile(start, (len(fresh), 1, 1))))
        identity = np.concatenate((identity, count + np.arange(len(fresh))))
        hits, seen = (
            np.pad(hits, (0, len(fresh)), constant_values=1),
            np.pad(seen, (0, len(fresh)), constant_values=stamp),
        )
        count += len(fresh)
        shown = (hits >= 3) & (seen == stamp)
        rows.append((np.full(shown.sum(), k), identity[shown], means[shown, :2]))
        lives = stamp - seen <= scene.life_ns
        means, covariances, identity, hits, seen = (one[lives] for one in (means, covariances, identity, hits, seen))
    frame, found, place = (np.concatenate(column) for column in zip(*rows, strict=True))
    return table(frame, found, place, np.ones(len(frame)))


TRACKERS = {"auto": auto, "kalman": kalman}


def scenes(root: Path | None, *, fast: bool) -> Iterator[tuple[str, list[Scene]]]:
    """Yield names and scenes."""
    for density in DENSITIES:
        for rate in RATES:
            yield f"{density:g} people/m2 {rate:g} Hz", [crowd(density, rate)]
    for rate, sized in ((10.0, True), (2.0, True), (2.0, False), (0.6, True)):
        yield f"ships {'as boxes' if sized else 'as points'} {rate:g} Hz", [ships(rate, sized=sized)]
    if root is not None:
        for detector in REAL:
            yield f"{detector} as points", list(recorded(root, detector, fast=fast))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--root", type=Path, help="folder with kitti/, nuscenes/ and nuscenes-more/")
    parser.add_argument("--fast", action="store_true", help="a few sequences only")
    given = parser.parse_args()
    out = csv.writer(sys.stdout, lineterminator="\n")
    out.writerow(("scene", "tracker", "IDF1", "switches", "MOTA", "false", "missed"))
    for name, parts in scenes(given.root, fast=given.fast):
        rules = Rules("distance", parts[0].near)
        for tracker, track in TRACKERS.items():
            cases = [prepare(one.truth, track(one), NAME, rules) for one in parts]
            whole, identity = combine(clear(one, rules) for one in cases), evaluate_identity(cases, rules)
            figures = 200.0 * identity.true / identity.boxes, 100.0 * whole.figures()["MOTA"]
            out.writerow(
                (name, tracker, f"{figures[0]:.1f}", whole.switches, f"{figures[1]:.1f}", whole.false, whole.missed)
            )
        sys.stdout.flush()


if __name__ == "__main__":
    main()
