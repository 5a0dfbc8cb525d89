"""Motion of boxes from frame to frame: evidence about headings, velocities and poses before anything is tracked.

Boxes of neighbouring frames are linked where each is the nearest of its class to the other and no third one is nearly
as near. A move is a chain of such links over `LEAST_MOVE` metres; its direction does not depend on any heading.
"""

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from optipmb_tools.geometry import Bools, Floats, Ints, stack_poses, to_world, wrap_angle

if TYPE_CHECKING:
    from collections.abc import Iterable

    from optipmb_tools.datasets.interface import DataSequence


LEAST_MOVE: Final = 1.5
LONGEST_CHAIN: Final = 15
LONGEST_STEP_S: Final = 2.0
REACH: Final = (1.0, 40.0, 12.0)  # longest link: metres, plus metres per second of the step, up to a limit
DISTINCT: Final = 1.5  # a second box of the class must be so many times as far away
SURE_MOVES: Final = 10
LEAST_ALONG: Final = 0.3
"""Moves from which headings are refused or doubted, and the share along them below which they are doubted."""
MOST_FRAMES: Final = 600
MOST_BOXES: Final = 300  # boxes of a frame that are looked at; bounds the work
SAME_DIRECTION: Final = np.deg2rad(20.0)  # largest angle between a heading and a move along it
CREW: Final = 4  # links from which neighbouring frames tell a common motion
MOST: Final = 0.5  # share of the links of two frames that make one rigid motion
RIGID: Final = 0.3  # largest distance in metres of a box from where that motion takes it
COMMON_SPEED: Final = 2.0
LEAST_STEP: Final = 0.4  # speed in m/s and step in metres from which a common motion is none of noise
LARGEST_OVERLAP: Final = 2.5  # distance in metres from which the centres of two boxes of a class are two places


@dataclass(frozen=True)
class Moves:
    """Moves of boxes, and the motion that boxes have in common."""

    start: Ints  # (K,) row of the box at the start
    end: Ints  # (K,) row of the same object's box at the end
    step: Floats  # (K, 2) displacement, m
    duration: Floats  # (K,) s
    common: float
    """Share of pairs of neighbouring frames most of whose boxes make one rigid motion, faster than `COMMON_SPEED`."""

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
        """Return the chosen moves."""
        return Moves(self.start[rows], self.end[rows], self.step[rows], self.duration[rows], self.common)


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
    frames = np.split(order, starts[1:])[:MOST_FRAMES] if len(order) else []
    following = np.full(len(key), -1, dtype=np.int64)
    pairs = common = 0
    for before, after in itertools.pairwise(frames):
        passed = seconds[after[0]] - seconds[before[0]]
        if key[before[0]] != key[after[0]] or passed > LONGEST_STEP_S:
            continue
        first, second = _linked(before[:MOST_BOXES], after[:MOST_BOXES], xy, kind, passed)
        following[first] = second
        if len(first) >= CREW:
            pairs += 1
            common += _move_together(xy[first], xy[second], max(COMMON_SPEED * passed, LEAST_STEP))
    start, end = _chains(following, xy)
    duration = seconds[end] - seconds[start]
    return Moves(start, end, xy[end] - xy[start], duration, common / pairs if pairs else 0.0)


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


def _move_together(first: Floats, second: Floats, least: float) -> bool:
    """Return whether most places (L, 2) make one rigid motion that moves them by `least` metres or more.

    The motion is fitted by least squares, without the worse half of the places after the first fit.
    """
    fit = np.ones(len(first), dtype=np.bool_)
    for _ in range(3):
        a, b = first[fit].mean(axis=0), second[fit].mean(axis=0)
        u, _, vt = np.linalg.svd((first[fit] - a).T @ (second[fit] - b))
        turn = vt.T @ np.diag([1.0, np.sign(np.linalg.det(vt.T @ u.T))]) @ u.T
        rest = np.linalg.norm((first - a) @ turn.T + b - second, axis=1)
        fit = rest <= np.median(rest)
    moved = float(np.median(np.linalg.norm(second - first, axis=1)))
    return moved > least and float(np.mean(rest < RIGID)) >= MOST


def _chains(following: Ints, xy: Floats) -> tuple[Ints, Ints]:
    """Return the rows of the boxes at the ends of each chain that is long enough."""
    start = end = np.flatnonzero(following >= 0)
    ended: list[tuple[Ints, Ints]] = []
    for _ in range(LONGEST_CHAIN):
        end = following[end]
        start, end = start[end >= 0], end[end >= 0]
        far = np.linalg.norm(xy[end] - xy[start], axis=1) >= LEAST_MOVE
        ended.append((start[far], end[far]))
        start, end = start[~far], end[~far]
    return np.concatenate([one for one, _ in ended]), np.concatenate([one for _, one in ended])


def overlapping(frame: Ints, xy: Floats, size: Floats, kind: Ints) -> Bools:
    """Return the boxes (B,) that share their place with another one of their frame and class.

    Of frames with more than `MOST_BOXES` boxes a part is looked at, and no more than `MOST_FRAMES` frames.
    """
    found = np.zeros(len(frame), dtype=np.bool_)
    order = np.argsort(frame, kind="stable")
    starts = np.flatnonzero(np.r_[True, np.diff(frame[order]) != 0])
    near = np.minimum(0.7 * size[:, :2].max(axis=1, initial=0.0), LARGEST_OVERLAP)
    for rows in np.split(order, starts[1:])[:MOST_FRAMES] if len(order) else []:
        some = rows[: MOST_BOXES * (1 + len(rows) // MOST_BOXES) : 1 + len(rows) // MOST_BOXES]
        away = np.linalg.norm(xy[some][:, None] - xy[some][None], axis=2)
        away[kind[some][:, None] != kind[some][None]] = np.inf
        found[some] = (away < near[some][:, None]).sum(axis=1) > 1
    return found
