"""Motion of boxes from frame to frame: evidence about headings, velocities and poses before anything is tracked.

Boxes of neighbouring frames are linked where each is the nearest of its class to the other and no third one is nearly
as near. A move is a chain of such links over `LEAST_MOVE` metres and over `STEADY` times the scatter of the object's
boxes about its path: jitter is no motion. Its direction does not depend on any heading.
"""

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from optipmb_tools.datasets.evidence import Evidence
from optipmb_tools.datasets.interface import Reports
from optipmb_tools.geometry import Bools, Floats, Ints, stack_poses, to_world, wrap_angle

if TYPE_CHECKING:
    from collections.abc import Iterable

    from optipmb_tools.datasets.interface import DataSequence


LEAST_MOVE: Final = 1.5
LONGEST_CHAIN: Final = 15
LONGEST_STEP_S: Final = 2.0
REACH: Final = (1.0, 40.0, 12.0)  # longest link: metres, plus metres per second of the step, up to a limit
DISTINCT: Final = 1.5  # a second box of the class must be so many times as far away
STEADY: Final = 8.0
SURE_MOVES: Final = 10
LEAST_ALONG: Final = 0.3
"""Moves from which headings are doubted, and the share along them below which they are."""
MOST_FRAMES: Final = 600
LEAST_FRAMES: Final = 60  # of each recording, if there are several
MOST_BOXES: Final = 300  # boxes of a frame that are looked at; bounds the work
SAME_DIRECTION: Final = np.deg2rad(20.0)  # largest angle between a heading and a move along it
CREW: Final = 4  # places from which two frames tell a common motion; any two places fit a turn and a shift
MOST: Final = 0.5  # share of the others that make one rigid motion with them
RIGID: Final = 0.4  # largest distance in metres of a box from where that motion takes it
COMMON_STEP: Final = 4.0
COMMON_S: Final = 1.5  # median step in metres from which a motion tells rigid ones from traffic; longest time for it
LIKE: Final = 0.25  # least score of the boxes at one place, by their largest, from which none is a weaker guess
MOST_ALONE: Final = 0.9  # share of frames with one box, and of boxes that come back, of objects that report one by one
SPEEDS: Final = (40.0, 350.0)  # m/s that such objects reach: on the ground and on water, in the air
LONGEST_ALONE_S: Final = 30.0  # to the next report of an object,
LONGEST_WAY_S: Final = 1.5  # in which it goes no further than at its highest speed for so long
LEAST_LOOK: Final = 10.0  # least range in metres of a look at one object
SMALL: Final = 1.5  # longest side in metres of things that may stand side by side at less than `LARGEST_OVERLAP`
BODY: Final = 0.6  # width in metres of a person
ASIDE: Final = 0.5  # of their width from which the centres of two things are two
MANY_FRAMES: Final = 10
RUNNING: Final = 4.0  # m/s, faster than people go
ELBOWS: Final = 1.5  # m between people that is too little for vehicles
PERSON: Final = ((0.2, 1.4), (0.2, 1.3), (1.0, 2.3))
"""Least and largest length, width and height of people, m."""
LARGEST_OVERLAP: Final = 2.5  # distance in metres from which the centres of two boxes of a class are two places


@dataclass(frozen=True)
class Moves:
    """Moves of boxes, and the motion that boxes have in common."""

    start: Ints  # (K,) row of the box at the start
    end: Ints  # (K,) row of the same object's box at the end
    step: Floats  # (K, 2) displacement, m
    duration: Floats  # (K,) s
    object: Ints  # (K,) number of the object, which has one for each unbroken chain of links
    common: Evidence  # pairs of frames most of whose boxes make one rigid motion
    chain: Ints  # (B,) number of the object of each box, in the frames that were looked at; -1 in others

    def __len__(self) -> int:
        return len(self.start)

    @property
    def velocity(self) -> Floats:
        """(K, 2) mean velocity, m/s."""
        return self.step / self.duration[:, None]

    def turn(self, yaw: Floats) -> Floats:
        """Return the angle (K,) from a heading `yaw` (K,) to the direction of each move."""
        return wrap_angle(np.arctan2(self.step[:, 1], self.step[:, 0]) - yaw)

    def take(self, rows: Bools) -> "Moves":
        floats, numbers = (self.step[rows], self.duration[rows]), self.object[rows]
        return Moves(self.start[rows], self.end[rows], *floats, numbers, self.common, self.chain)


def find_moves(key: Ints, seconds: Floats, xy: Floats, kind: Ints) -> Moves:
    """Return the moves of boxes, of the first `MOST_FRAMES` frames of each of the first recordings.

    Args:
        key: (B,) recording of each box.
        seconds: (B,) time.
        xy: (B, 2) position in the plane, in one frame of reference.
        kind: (B,) class.
    """
    order = np.lexsort((seconds, key))
    starts = np.flatnonzero(np.r_[True, (np.diff(key[order]) != 0) | (np.diff(seconds[order]) > 0.0)])
    most = max(LEAST_FRAMES, MOST_FRAMES // max(1, len(np.unique(key))))
    frames: list[Ints] = []
    recording, taken = -1, 0
    for frame in np.split(order, starts[1:]) if len(order) else []:
        recording, taken = int(key[frame[0]]), taken + 1 if key[frame[0]] == recording else 0
        if taken < most and len(frames) < MOST_FRAMES:
            frames.append(frame[:MOST_BOXES])
    following, chain = np.full(len(key), -1, dtype=np.int64), np.arange(len(key))
    for before, after in itertools.pairwise(frames):
        passed = seconds[after[0]] - seconds[before[0]]
        if key[before[0]] == key[after[0]] and passed <= LONGEST_STEP_S:
            first, second = _linked(before, after, xy, kind, passed)
            following[first], chain[second] = second, chain[first]
    least = np.maximum(LEAST_MOVE, STEADY * _scatter(following, chain, seconds, xy))
    start, end = _chains(following, xy, least)
    common = _common(frames, key, seconds, xy, chain)
    looked = np.full(len(key), -1, dtype=np.int64)
    if frames:
        rows = np.concatenate(frames)
        looked[rows] = chain[rows]
    return Moves(start, end, xy[end] - xy[start], seconds[end] - seconds[start], chain[start], common, looked)


def next_steps(key: Ints, seconds: Floats, xy: Floats, kind: Ints) -> tuple[Floats, Floats]:
    """Return the distances (S,) in metres from boxes to the nearest of their class in the next frame, and the times.

    The arguments are as for `find_moves`, without its limits on how far a box may go.
    """
    order = np.lexsort((seconds, key))[: LEAST_FRAMES * MOST_BOXES]
    starts = np.flatnonzero(np.r_[True, (np.diff(key[order]) != 0) | (np.diff(seconds[order]) > 0.0)])
    steps, times = [np.empty(0)], [np.empty(0)]
    for before, after in itertools.pairwise(np.split(order, starts[1:])[:LEAST_FRAMES] if len(order) else []):
        first, second = before[:MOST_BOXES], after[:MOST_BOXES]
        if key[first[0]] == key[second[0]]:
            away = np.linalg.norm(xy[first][:, None] - xy[second][None], axis=2)
            away[kind[first][:, None] != kind[second][None]] = np.inf
            nearest = away.min(axis=1)
            steps.append(nearest[np.isfinite(nearest)])
            times.append(np.full(len(steps[-1]), seconds[second[0]] - seconds[first[0]]))
    return np.concatenate(steps), np.concatenate(times)


def _scatter(following: Ints, chain: Ints, seconds: Floats, xy: Floats) -> Floats:
    """Return the scatter (B,) of each object's boxes about its path in metres; the median where it is not known."""
    first = np.flatnonzero(following >= 0)
    first = first[following[following[first]] >= 0]
    middle = following[first]
    last = following[middle]
    part = ((seconds[middle] - seconds[first]) / (seconds[last] - seconds[first]))[:, None]
    off = xy[middle] - xy[first] * (1.0 - part) - xy[last] * part
    square = (off**2).sum(axis=1) / (1.0 + part**2 + (1.0 - part) ** 2)[:, 0]
    count = np.bincount(chain[middle], minlength=len(chain))
    mean = np.sqrt(np.bincount(chain[middle], square, len(chain)) / np.maximum(count, 1))
    usual = float(np.median(mean[count > 0])) if count.any() else 0.0
    return np.where(count > 0, mean, usual)[chain]


def _common(frames: list[Ints], key: Ints, seconds: Floats, xy: Floats, chain: Ints) -> Evidence:
    """Return how many of the pairs of frames that are far enough apart show one motion of most places."""
    found: list[bool] = []
    for number, before in enumerate(frames):
        for after in frames[number + 1 :]:
            if key[before[0]] != key[after[0]] or seconds[after[0]] - seconds[before[0]] > COMMON_S:
                break
            _, mine, other = np.intersect1d(chain[before], chain[after], return_indices=True)
            first, second = xy[before[mine]], xy[after[other]]
            if len(first) < CREW:
                break
            if np.median(np.linalg.norm(second - first, axis=1)) >= COMMON_STEP:
                away = np.linalg.norm(first[:, None] - first[None], axis=2) < LARGEST_OVERLAP
                single = ~np.tril(away, -1).any(axis=1)  # one place may have several boxes
                if single.sum() >= CREW:
                    found.append(_move_together(first[single], second[single]))
                break
        else:
            continue
    return Evidence(sum(found), len(found))


def headings_along(sequences: "Iterable[DataSequence]") -> tuple[float, int]:
    """Return the share of moves along the headings of the boxes in the first frames, and the number of moves."""
    parts: list[tuple[Floats, ...]] = []
    names: dict[str, int] = {}
    frames = ((number, frame) for number, one in enumerate(sequences) for frame in one.frames())
    for number, frame in itertools.islice(frames, MOST_FRAMES):
        rotation, translation = stack_poses([frame.pose])
        center, yaw = to_world(rotation[0], translation[0], frame.center, frame.yaw)
        kind = np.array([names.setdefault(label, len(names)) for label in frame.labels], dtype=np.float64)
        same = np.ones(len(frame))
        parts.append((number * same, frame.stamp_ns / 1e9 * same, *center[:, :2].T, yaw, kind[frame.label]))
    if not parts:
        return 1.0, 0
    key, seconds, x, y, heading, label = (np.concatenate(column) for column in zip(*parts, strict=True))
    moves = find_moves(key.astype(np.int64), seconds, np.column_stack([x, y]), label.astype(np.int64))
    off = np.abs(moves.turn(heading[moves.start]))
    off = off[np.isfinite(off)]  # the other headings are unknown
    return float(np.mean(np.minimum(off, np.pi - off) < SAME_DIRECTION)) if len(off) else 1.0, len(off)


def _linked(before: Ints, after: Ints, xy: Floats, kind: Ints, passed: float) -> tuple[Ints, Ints]:
    away = np.linalg.norm(xy[before][:, None] - xy[after][None], axis=2)
    away[kind[before][:, None] != kind[after][None]] = np.inf
    nearest, back = np.argmin(away, axis=1), np.argmin(away, axis=0)
    mutual = back[nearest] == np.arange(len(before))
    least = away[np.arange(len(before)), nearest]
    rest = away.copy()
    rest[np.arange(len(before)), nearest] = np.inf
    distinct = np.minimum(rest.min(axis=1), rest.min(axis=0)[nearest]) > DISTINCT * least
    reach = min(REACH[0] + REACH[1] * passed, REACH[2])
    found = mutual & distinct & (least <= reach)
    return before[found], after[nearest[found]]


def _move_together(first: Floats, second: Floats) -> bool:
    """Return whether most places (L, 2) make one rigid motion.

    The motion is fitted by least squares, without the worse half of the places after the first fit.
    """
    fit = np.ones(len(first), dtype=np.bool_)
    for _ in range(3):
        a, b = first[fit].mean(axis=0), second[fit].mean(axis=0)
        u, _, vt = np.linalg.svd((first[fit] - a).T @ (second[fit] - b))
        turn = vt.T @ np.diag([1.0, np.sign(np.linalg.det(vt.T @ u.T))]) @ u.T
        rest = np.linalg.norm((first - a) @ turn.T + b - second, axis=1)
        fit = rest <= np.median(rest)
    return bool((rest < RIGID).sum() - 2 >= MOST * (len(first) - 2))


def _chains(following: Ints, xy: Floats, least: Floats) -> tuple[Ints, Ints]:
    """Return the rows of the boxes at the ends of each chain that is as long as its object's `least`."""
    start = end = np.flatnonzero(following >= 0)
    ended: list[tuple[Ints, Ints]] = []
    for _ in range(LONGEST_CHAIN):
        end = following[end]
        start, end = start[end >= 0], end[end >= 0]
        far = np.linalg.norm(xy[end] - xy[start], axis=1) >= least[start]
        ended.append((start[far], end[far]))
        start, end = start[~far], end[~far]
    return np.concatenate([one for one, _ in ended]), np.concatenate([one for _, one in ended])


def overlapping(frame: Ints, xy: Floats, size: Floats, kind: Ints, score: Floats) -> Ints:
    """Return how many boxes of its frame and class are at the place of each box (B,), itself among them.

    A detector without suppression gives many boxes of an object, of scores from high to low: these count as one.
    Things that keep apart (`kinds_apart`) have places of their own.
    Of frames with more than `MOST_BOXES` boxes a part is looked at, and no more than `MOST_FRAMES` frames.
    """
    found = np.ones(len(frame), dtype=np.int64)
    near = np.minimum(0.7 * size[:, :2].max(axis=1, initial=0.0), LARGEST_OVERLAP)
    near[np.isin(kind, kinds_apart(frame, xy, size, kind))] = 0.0
    for rows in _some(frame):
        away = np.linalg.norm(xy[rows][:, None] - xy[rows][None], axis=2)
        close = (away < near[rows][:, None]) & (kind[rows][:, None] == kind[rows][None])
        least = np.where(close, score[rows][None], np.inf).min(axis=1, initial=np.inf)
        most = np.where(close, score[rows][None], 0.0).max(axis=1, initial=0.0)
        found[rows] = np.where(least > LIKE * most, np.maximum(close.sum(axis=1), 1), 1)
    return found


def kinds_apart(frame: Ints, xy: Floats, size: Floats, kind: Ints) -> Ints:
    """Return the classes (K,) of small things that stand close together in many frames, and at one place in none.

    These are people side by side. Boxes of one person by two detectors come as near to each other as they scatter.
    """
    small = size[:, :2].max(axis=1, initial=0.0) <= SMALL
    parts: list[tuple[Floats, Ints, Ints]] = []
    for rows in _some(frame):
        some = rows[small[rows]]
        away = np.linalg.norm(xy[some][:, None] - xy[some][None], axis=2)
        away[kind[some][:, None] != kind[some][None]] = np.inf
        np.fill_diagonal(away, np.inf)
        nearest = away.min(axis=1, initial=np.inf) / np.minimum(size[some, :2].min(axis=1, initial=SMALL), BODY)
        close = nearest < 1.0 / BODY
        parts.append((nearest[close], kind[some][close], frame[some][close]))
    if not parts:
        return np.empty(0, dtype=np.int64)
    away, kinds, frames = (np.concatenate(one) for one in zip(*parts, strict=True))
    found = []
    for one in np.unique(kinds).tolist():
        mine = away[kinds == one]
        low, usual = np.quantile(mine, (0.05, 0.5)).tolist()
        if len(np.unique(frames[kinds == one])) >= MANY_FRAMES and low > max(0.5 * usual, ASIDE):
            found.append(one)
    return np.array(found, dtype=np.int64)


def _some(frame: Ints) -> "Iterable[Ints]":
    """Yield rows of each frame, `MOST_BOXES` at most."""
    order = np.argsort(frame, kind="stable")
    starts = np.flatnonzero(np.r_[True, np.diff(frame[order]) != 0])
    for rows in np.split(order, starts[1:])[:MOST_FRAMES] if len(order) else []:
        yield rows[: MOST_BOXES * (1 + len(rows) // MOST_BOXES) : 1 + len(rows) // MOST_BOXES]


def are_people(frame: Ints, xy: Floats, size: Floats | None, speed: Floats) -> bool:
    """Tell whether boxes (B,) are of people: by sizes (B, 3), or by distances where these are unknown.

    None of them goes faster than people do, by their speeds (S,) to the next frame in m/s.
    """
    if len(speed) < SURE_MOVES or float(np.quantile(speed, 0.9)) > RUNNING:
        return False
    if size is not None:
        low, high = (np.array(one) for one in zip(*PERSON, strict=True))
        return bool(np.mean(((size >= low) & (size <= high)).all(axis=1)) > MOST_ALONE)
    distances = [np.empty(0)]
    for rows in _some(frame):
        away = np.linalg.norm(xy[rows][:, None] - xy[rows][None], axis=2)
        np.fill_diagonal(away, np.inf)
        distances.append(away.min(axis=1, initial=np.inf))
    return int((np.concatenate(distances) < ELBOWS).sum()) >= SURE_MOVES


def find_reports(key: Ints, seconds: Floats, xy: Floats, kind: Ints) -> Reports | None:
    """Return how the objects of boxes (B,) report where they do so one by one; None otherwise.

    Then nearly every frame has one box, the next box is elsewhere, and a later one is where motion would take it.
    """
    order = np.lexsort((seconds, key))[:MOST_FRAMES]
    time, place, mine = seconds[order], xy[order], key[order]
    again = np.diff(mine) == 0
    if len(order) < LEAST_FRAMES // 2 or not again.any() or np.mean((np.diff(time) > 0.0)[again]) < MOST_ALONE:
        return None
    away = np.linalg.norm(place[:, None] - place[None], axis=2)
    passed = time[None] - time[:, None]
    same = (mine[:, None] == mine[None]) & (kind[order][:, None] == kind[order][None])
    same &= (passed > 0.0) & (passed <= LONGEST_ALONE_S)
    before, after = np.flatnonzero(again), np.flatnonzero(again) + 1
    for speed in SPEEDS:
        reach = REACH[0] + speed * passed
        back = same & (away <= np.minimum(reach, LONGEST_WAY_S * speed))
        found = np.flatnonzero(back.any(axis=1))
        jumps = np.mean(away[before, after] > reach[before, after])
        if jumps >= MOST and len(found) >= MOST_ALONE * len(order):
            following = np.argmax(back[found], axis=1)
            way, duration = away[found, following], passed[found, following]
            fastest = float(np.quantile(way / duration, 0.95))
            return Reports(max(2.0 * float(np.quantile(way, 0.95)), LEAST_LOOK), float(np.median(duration)), fastest)
    return None
