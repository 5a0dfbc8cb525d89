"""Links between the tracks of streams: `python benchmarks/linking.py [--seeds 1 2 3]`.

Prints a table as Markdown: generated sites of two to eight streams with 100 objects (`tests/support/sites.py`), tracked
by the tracker with the profile for unknown detectors. An object is common while two streams have a confirmed track of
it. A link is right if both tracks are mostly of one object; `while it held`, if they were in most frames in which they
were linked: a track may go over to another object.

With `--kitti DIR`, two detectors saw one drive: each is a stream, and the second one is at another place and time.
Objects are the labelled ones within `NEAR_M` of a detection.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter, defaultdict
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, Self

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))

from gaps import followed
from optipmb_service.links.linker import Linker
from optipmb_service.settings import LinkSettings
from optipmb_tools.datasets import open_dataset
from optipmb_tools.run.tracking import tracker_frame
from sites import RATE, View, World, circle, copied, corridor, plaza, tracked

import optipmb

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray
    from optipmb_schemas import Tracks

SOON = round(1.5 * RATE)
VECTOR = 32
DETECTORS = ("pvrcnn", "pointrcnn")
LEAST_SCORE = 0.3
NEAR_M = 2.0
EVERY = LinkSettings(streams=("*/*/*",))


@dataclass
class Figures:
    """Counts of a run."""

    episodes: int = 0
    soon: int = 0
    right: int = 0
    wrong: int = 0
    held: int = 0
    late: list[int] = field(default_factory=list)

    def __iadd__(self, other: Figures) -> Self:
        """Add the counts of another run."""
        for name in ("episodes", "soon", "right", "wrong", "held"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        return self

    def __str__(self) -> str:
        """Return shares as text."""
        links = self.right + self.wrong
        return (
            f"{self.soon} of {self.episodes} ({100 * self.soon / max(self.episodes, 1):.1f} %) | "
            f"{self.right} of {links} ({100 * self.right / max(links, 1):.2f} %) | "
            f"{100 * self.held / max(links, 1):.2f} %"
        )


Key = tuple[str, int]


class Owners(NamedTuple):
    """Object with most detections of each track, and object of its newest detection after each frame."""

    mostly: dict[Key, int]
    newest: dict[tuple[str, int], dict[int, int]]

    @classmethod
    def of(cls, streams: Iterable[tuple[Sequence[Tracks], Sequence[NDArray[np.int64]]]]) -> Owners:
        """Return the owners of tracks by the objects of the detections of each frame."""
        votes: dict[Key, Counter[int]] = defaultdict(Counter)
        newest: dict[tuple[str, int], dict[int, int]] = {}
        for tracks, sources in streams:
            known: dict[int, int] = {}
            for one, source in zip(tracks, sources, strict=True):
                for identity, row in zip(one.id.tolist(), one.detection.tolist(), strict=True):
                    if row >= 0:
                        known[identity] = int(source[row])
                        votes[one.stream, identity][known[identity]] += 1
                newest[one.stream, one.seq] = {n: known[n] for n in one.id.tolist() if n in known}
        return cls({key: count.most_common(1)[0][0] for key, count in votes.items()}, newest)


def linked(
    settings: LinkSettings,
    messages: Sequence[Tracks],
    vectors: dict[tuple[str, int], NDArray[np.float32]] | None = None,
) -> tuple[Linker, list[dict[Key, bytes]]]:
    """Return the linker after messages, and the global id of each track after each of them."""
    linker, state, after = Linker("benchmark", settings), {}, []
    for one in messages:
        given = None if vectors is None else vectors.get((one.stream, one.seq))
        linker.take(one, one.stamp_ns, given)
        for row in linker.changes():
            state = {**state, (row.stream, row.object): row.global_id}
        after.append(state)
    return linker, after


def judge(messages: Sequence[Tracks], after: Sequence[dict[Key, bytes]], owners: Owners) -> Figures:  # noqa: C901 - a loop over messages and their pairs
    """Count common objects that are linked soon, and the links of tracks that are seen at once."""
    found, owner = Figures(), owners.mostly
    pairs: dict[tuple[Key, Key], list[int]] = {}
    shown: dict[str, list[int]] = {}
    newest: dict[str, dict[int, int]] = {}
    common: dict[tuple[int, str, str], int] = {}
    when: dict[tuple[int, str, str], int | None] = {}
    seen_at: dict[tuple[int, str, str], int] = {}

    def close(key: tuple[int, str, str]) -> None:
        begin, at, last = common.pop(key), when.pop(key), seen_at.pop(key)
        if last - begin >= SOON:
            found.episodes += 1
            found.soon += at is not None and at - begin <= SOON

    begin_ns = messages[0].stamp_ns
    for one, state in zip(messages, after, strict=True):
        frame = round((one.stamp_ns - begin_ns) * 1e-9 * RATE)
        sure = one.confirmed > 0 if one.confirmed is not None else np.ones(len(one.id), bool)
        shown[one.stream] = one.id[sure].tolist()
        newest[one.stream] = owners.newest[one.stream, one.seq]
        mine = {owner.get((one.stream, n), -1): n for n in shown[one.stream]}
        ids = {state[one.stream, n]: n for n in shown[one.stream] if (one.stream, n) in state}
        for stream, tracks in shown.items():
            if stream == one.stream:
                continue
            for n in tracks:
                if (mate := ids.get(state.get((stream, n), b""))) is not None:
                    both = (one.stream, mate), (stream, n)
                    held = pairs.setdefault((min(both), max(both)), [])
                    held.append(newest[one.stream].get(mate, -1) == newest[stream].get(n, -2))
                who = owner.get((stream, n), -1)
                if who < 0 or who not in mine:
                    continue
                key = (who, *sorted((stream, one.stream)))
                common.setdefault(key, frame)
                when.setdefault(key, None)
                seen_at[key] = frame
                own = state.get((one.stream, mine[who]))
                if when[key] is None and own is not None and own == state.get((stream, n)):
                    when[key] = frame
        for key in [key for key, last in seen_at.items() if frame - last > RATE]:
            close(key)
    for key in list(common):
        close(key)
    real = {key: held for key, held in pairs.items() if all(owner.get(one, -1) >= 0 for one in key)}
    found.right = sum(owner[one] == owner[other] for one, other in real)
    found.wrong = len(real) - found.right
    found.held = sum(2 * sum(held) > len(held) for held in real.values())
    return found


def ordered(streams: Sequence[Sequence[Tracks]]) -> list[Tracks]:
    """Return messages of streams in the order in which they come: by the true time, not by their stamps."""
    return [one for frame in zip(*streams, strict=True) for one in frame]


def views_of(count: int) -> list[View]:
    """Return overlapping views of the plaza."""
    at = np.linspace(-30.0, 30.0, max(count // 2, 2))
    places = [(x, y) for x in at for y in ((0.0,) if count == 2 else (-12.0, 12.0))][:count]
    return [View(f"site/n{k}/lidar", circle(x, y, 38.0)) for k, (x, y) in enumerate(places)]


def overlap(
    seed: int,
    count: int,
    seconds: float,
    *,
    shift: tuple[float, float] = (0.0, 0.0),
    turn: float = 0.0,
    late: float = 0.0,
) -> tuple[Figures, Linker, list[float]]:
    """Link a plaza, whose second stream has another place, angle and clock."""
    world, views = plaza(seed, seconds), views_of(count)
    views[1] = replace(views[1], shift=shift, turn=turn, late=late)
    streams = [tracked(world, view, seed) for view in views]
    given = ordered([tracks for tracks, _ in streams])
    linker, after = linked(EVERY, given)
    return judge(given, after, Owners.of(streams)), linker, _found(given, views) if late else []


def _found(messages: Sequence[Tracks], views: Sequence[View]) -> list[float]:
    """Return after how many seconds place, angle and clock are within .1 m, .2 degrees and 20 ms, for good."""
    linker, ends, begin = Linker("benchmark", EVERY), [0.0, 0.0, 0.0], messages[0].stamp_ns
    for one in messages:
        linker.take(one, one.stamp_ns)
        if not len(linker.biases):
            continue
        bias = linker.biases[0]
        wrong = views[1]
        center = bias["center"] - wrong.center
        # What the second stream says of a place, less the place: by the turn about its centre, and the shift.
        own = np.array((-center[1], center[0])) * wrong.turn + wrong.shift
        errors = (
            np.hypot(*(bias["estimate"][:2] + own)) / 0.1,
            abs(bias["estimate"][2] + wrong.turn) / np.radians(0.2),
            abs(bias["estimate"][3] - wrong.late) / 0.02,
        )
        for k, error in enumerate(errors):
            if error > 1.0:
                ends[k] = (one.stamp_ns - begin) * 1e-9
    return ends


def passages(
    seed: int, *, every: float = 25.0, declared: bool, equal_error: float = 0.0, door: bool = False
) -> tuple[int, int, int]:
    """Return right and wrong links over a corridor, and how many there were to find."""
    world = corridor(seed, every=every)
    views = [View("site/west/lidar", lambda p: p[:, 0] < 0.0), View("site/east/lidar", lambda p: p[:, 0] > 20.0)]
    if door:  # others come out than go in
        other = corridor(seed + 1000)
        half = len(world.label) // 2
        frames = min(len(world.place), len(other.place))
        west, east = world.place[:frames].copy(), other.place[:frames].copy()
        west[west[:, :, 0] > 0.0] = np.nan
        east[east[:, :, 0] < 20.0] = np.nan
        world = World(np.ones(2 * half, np.int64), np.concatenate((west[:, :half], east[:, :half]), axis=1))
    streams = [tracked(world, view, seed) for view in views]
    sources = {view.stream: source for view, (_, source) in zip(views, streams, strict=True)}
    owner = Owners.of(streams).mostly
    given = ordered([tracks for tracks, _ in streams])
    vectors = _vectors(given, sources, seed, equal_error) if equal_error else None
    sides = (("*/west/*", "*/east/*"), ("*/east/*", "*/west/*")) if declared else ()
    settings = LinkSettings(
        streams=EVERY.streams,
        passages=tuple({"from": one, "to": other, "s": (10.0, 30.0)} for one, other in sides),
        exits=(((-4.0, -5.0), (24.0, -5.0), (24.0, 5.0), (-4.0, 5.0)),) if door else (),
        embedding_model="reid" if vectors else "",
    )
    _, after = linked(settings, given, vectors)
    wanted = Counter(one for (_, _), one in owner.items() if one >= 0)
    streams: dict[bytes, set[Key]] = defaultdict(set)
    for key, one in after[-1].items():
        streams[one].add(key)
    right = wrong = 0
    for keys in streams.values():
        who = [owner.get(key, -1) for key in sorted(keys)]
        if len({key[0] for key in keys}) > 1:
            right, wrong = (right + 1, wrong) if len(set(who)) == 1 else (right, wrong + 1)
    both = sum(1 for one in wanted if len({key[0] for key, who in owner.items() if who == one}) > 1)
    return right, wrong, both


def _vectors(
    messages: Sequence[Tracks], sources: dict[str, list[NDArray[np.int64]]], seed: int, equal_error: float
) -> dict[tuple[str, int], NDArray[np.float32]]:
    """Return vectors at 1 Hz whose distances of one object and of two have an equal error rate."""
    rng = np.random.default_rng(seed)
    noise = spread_of(equal_error)
    names: dict[int, NDArray[np.float64]] = {}
    views: dict[tuple[str, int], NDArray[np.float64]] = {}
    found = {}
    for one in messages:
        if one.seq % RATE:
            continue
        rows = np.full((len(one.id), VECTOR), np.nan, np.float32)
        for n, row in enumerate(one.detection.tolist()):
            who = int(sources[one.stream][one.seq][row]) if row >= 0 else -1
            if who < 0:
                continue
            base = names.setdefault(who, rng.standard_normal(VECTOR))
            side = views.setdefault((one.stream, who), noise * rng.standard_normal(VECTOR))
            rows[n] = base + side + 0.3 * noise * rng.standard_normal(VECTOR)
        found[one.stream, one.seq] = rows
    return found


def spread_of(equal_error: float) -> float:
    """Return the spread of the vectors of one object in two views for an equal error rate."""
    rng = np.random.default_rng(0)
    base = rng.standard_normal((2000, VECTOR))
    low, high = 0.1, 5.0
    for _ in range(20):
        middle = 0.5 * (low + high)
        one, other = (base + middle * rng.standard_normal(base.shape) for _ in range(2))
        one, other = (x / np.linalg.norm(x, axis=1)[:, None] for x in (one, other))
        same = (one * other).sum(axis=1)
        different = (one * np.roll(other, 1, axis=0)).sum(axis=1)
        cuts = np.sort(np.concatenate((same, different)))
        errors = [((same < cut).mean(), (different >= cut).mean()) for cut in cuts[::20]]
        rate = min(max(pair) for pair in errors)
        low, high = (middle, high) if rate < equal_error else (low, middle)
    return middle


def recorded(root: Path, name: str) -> Figures:
    """Link the tracks of two detectors on one drive, of which the second one is off."""
    wrong = View("site/b/lidar", circle(0.0, 0.0, np.inf), shift=(0.4, -0.3), turn=np.radians(1.0), late=0.1)
    streams = []
    for stream, detector in (("site/a/lidar", DETECTORS[0]), (wrong.stream, DETECTORS[1])):
        (sequence,) = open_dataset("kitti", root, detector, clouds=0).sequences([name])
        truth = sequence.truth()
        if truth is None:
            raise SystemExit(f"{root}: expected the labels of {name}, received none")
        frames, sources = [], []
        parameters = optipmb.generic_parameters(("Car",), 0.1)
        for one in sequence.frames():
            frame = tracker_frame(parameters, name, one.take(one.score >= LEAST_SCORE))
            rows = np.flatnonzero(truth.frame == one.index)
            far = np.hypot(*np.moveaxis(frame.center[:, None, :2] - truth.center[rows][:, :2], 2, 0))
            nearest = far.argmin(axis=1) if len(rows) else np.zeros(0, np.int64)
            near = far[np.arange(len(nearest)), nearest] < NEAR_M
            sources.append(np.where(near, truth.id[rows][nearest], -1) if len(rows) else np.full(len(far), -1))
            frames.append(frame)
        found = []
        for one in followed(frames, parameters).values():
            changes: dict[str, object] = {"stream": stream}
            if stream == wrong.stream:
                place, cos, sin = one.center.copy(), np.cos(wrong.turn), np.sin(wrong.turn)
                middle = frames[0].center[:, :2].mean(axis=0)
                turn = np.array(((cos, sin), (-sin, cos)))
                place[:, :2] = (place[:, :2] - middle) @ turn + middle + wrong.shift
                changes |= {"center": place, "velocity": one.velocity @ turn}
                changes |= {"stamp_ns": one.stamp_ns + round(1e9 * wrong.late)}
            found.append(one.model_copy(update=changes))
        streams.append((found, sources))
    given = ordered([tracks for tracks, _ in streams])
    _, after = linked(EVERY, given)
    return judge(given, after, Owners.of(streams))


def cost(seed: int) -> tuple[float, float, float]:
    """Return the share of a core for 20 streams at 10 Hz, the tracks of one, and bytes of state for each object."""
    world = plaza(seed, 20.0, objects=600, half=(150.0, 60.0))
    places = [(x, y) for x in np.linspace(-130.0, 130.0, 10) for y in (-25.0, 25.0)]
    views = [View(f"site/n{k}/lidar", circle(x, y, 34.0)) for k, (x, y) in enumerate(places)]
    messages = ordered([copied(world, view, seed) for view in views])
    linker = Linker("benchmark", EVERY)
    half = len(messages) // 2
    for one in messages[:half]:
        linker.take(one, one.stamp_ns)
    begin = time.process_time()
    for one in messages[half:]:
        linker.take(one, one.stamp_ns)
    share = (time.process_time() - begin) / 10.0
    return (
        share,
        float(np.mean([len(one.id) for one in messages])),
        len(linker.state()) / max(len(linker.objects.table), 1),
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="*", default=[1, 2, 3])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--parts", nargs="*", default=["overlap", "bias", "passages", "door", "cost"])
    parser.add_argument("--every", type=float, default=60.0, help="mean time between two people in a corridor, s")
    parser.add_argument("--kitti", type=Path, help="folder of KITTI tracking")
    parser.add_argument("--sequences", nargs="*", default=["0003", "0007", "0020"])
    given = parser.parse_args()
    print("| figure | seeds | linked | right | while it held |\n| --- | --- | --- | --- | --- |")
    for count in (2, 4, 8) if "overlap" in given.parts else ():
        total = Figures()
        for seed in given.seeds:
            total += overlap(seed, count, given.seconds)[0]
        print(f"| overlap of {count} streams, within 1.5 s | {given.seeds} | {total} |", flush=True)
    if "bias" in given.parts:
        total, ends = Figures(), []
        for seed in given.seeds:
            figures, _, found = overlap(seed, 2, given.seconds, shift=(0.4, -0.3), turn=np.radians(1.0), late=0.1)
            total += figures
            ends.append(found)
        print(f"| the same, second stream .5 m, 1 degree, 100 ms off | {given.seeds} | {total} |", flush=True)
        print(f"| place, angle, clock found after, s | {given.seeds} | {np.round(ends, 1).tolist()} | |", flush=True)
    for declared, error in (
        ((False, 0.0), (False, 0.12), (True, 0.0), (True, 0.12)) if "passages" in given.parts else ()
    ):
        runs = [passages(n, every=given.every, declared=declared, equal_error=error) for n in given.seeds]
        right, wrong, both = np.sum(runs, axis=0)
        name = f"passage {'declared' if declared else 'learned'}, {'with' if error else 'without'} vectors"
        share = f"{right} of {both} ({100 * right / both:.0f} %) | {100 * right / max(right + wrong, 1):.1f} %"
        print(f"| {name} | {given.seeds} | {share} |", flush=True)
    if "door" in given.parts:
        right, wrong, _ = np.sum([passages(n, declared=False, door=True) for n in given.seeds], axis=0)
        print(f"| door with exits declared: wrong links | {given.seeds} | {right + wrong} | |", flush=True)
    for name in given.sequences if given.kitti else ():
        print(f"| two detectors on one drive, one off | {name} | {recorded(given.kitti, name)} |", flush=True)
    if "cost" in given.parts:
        share, tracks, size = cost(given.seeds[0])
        print(f"| share of a core, 20 streams of {tracks:.0f} tracks, 10 Hz | {given.seeds[:1]} | {share:.3f} | |")
        print(f"| bytes of state for each object | {given.seeds[:1]} | {size:.0f} | |")


if __name__ == "__main__":
    main()
