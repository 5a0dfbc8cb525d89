"""Detections paired with the labels they belong to, and the labels' trajectories.

Conventions: world frame, metres, seconds. In each frame as many pairs as possible are made within a distance, and of
those ways the one of least total distance is taken.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from optipmb_tools.evaluation import Rules
from optipmb_tools.evaluation.cases import assign_frames, most_pairs, prepare
from optipmb_tools.geometry import Bools, Floats, Ints, to_sensor, wrap_angle
from optipmb_tools.results import ResultTable
from optipmb_tools.tuning.clips import Clip


@dataclass(frozen=True)
class Trajectory:
    """One labelled object."""

    frame: Ints
    """(R,) ascending"""
    time: Floats
    """(R,) s"""
    position: Floats
    """(R, 2) m"""
    yaw: Floats
    """(R,) rad"""
    velocity: Floats
    """(R, 2) m/s; NaN where unknown"""
    ignored: Bools
    """(R,)"""


def trajectories(clip: Clip, name: str) -> dict[int, Trajectory]:
    """Return the labelled objects of a class by id."""
    truth = clip.world.take(clip.world.names == name)
    stamps = clip.stamps
    found = {}
    for identity in np.unique(truth.id).tolist():
        rows = np.flatnonzero(truth.id == identity)
        rows = rows[np.argsort(truth.frame[rows], kind="stable")]
        frame = truth.frame[rows]
        found[identity] = Trajectory(
            frame=frame,
            time=(stamps[frame] - stamps[0]) * 1e-9,
            position=truth.center[rows, :2],
            yaw=truth.yaw[rows],
            velocity=_velocities(truth.velocity[rows], (stamps[frame] - stamps[0]) * 1e-9, truth.center[rows, :2]),
            ignored=truth.ignored[rows],
        )
    return found


def _velocities(given: Floats, time: Floats, position: Floats) -> Floats:
    """Return the labels' velocities, or where they have none those of the positions before and after."""
    if len(time) < 3 or np.isfinite(given).all():  # noqa: PLR2004  one before, one after
        return given
    return np.where(np.isfinite(given), given, np.gradient(position, time, axis=0))


@dataclass(frozen=True)
class Pairs:
    """Detections of one class, and which label each belongs to; rows are ordered by frame."""

    clip: str
    frame: Ints
    """(M,)"""
    score: Floats
    """(M,)"""
    place: Floats
    """(M, 2) in the sensor frame, m"""
    position: Floats
    """(M, 2)"""
    yaw: Floats
    """(M,)"""
    velocity: Floats
    """(M, 2); NaN where unknown"""
    object: Ints
    """(M,) id of the label; -1 for none"""
    false: Bools
    """(M,) belongs to no label and is not excused"""
    truth: int
    """Labels that count"""
    found: int
    """Of these, those that a detection belongs to"""
    frames: int


def pair_detections(clip: Clip, name: str, least: float, limit: float, rules: Rules) -> Pairs:
    """Pair the detections of a class with its labels.

    Args:
        clip: with this class only.
        name: the class.
        least: lowest score of the detections that are used.
        limit: largest distance of a pair, m.
        rules: which labels are ignored, and which detections are excused.

    """
    frames = clip.frames
    when: Ints = np.repeat(np.arange(len(frames)), [len(frame.score) for frame in frames]).astype(np.int64)
    columns: dict[str, Floats] = {key: np.concatenate([getattr(frame, key) for frame in frames]) for key in _COLUMNS}
    use = columns["score"] >= least
    when = when[use]
    center, size, yaw, velocity, score = (columns[key][use] for key in _COLUMNS)
    local, turned = to_sensor(clip.rotation[when], clip.translation[when], center, yaw)
    image = clip.camera.boxes(local, size, turned)[0] if clip.camera else np.full((len(when), 4), np.nan)
    rows = np.arange(len(when))
    table = ResultTable((name,), when, rows, np.zeros_like(rows), local, size, turned, score, image)
    near = Rules("distance", limit, neighbours=rules.neighbours, min_height=rules.min_height, regions=rules.regions)
    case = prepare(clip.truth, table, name, near)
    pairs = assign_frames(case.pair_frame, case.truth_row, case.track_row, case.cost, most_pairs)
    label, matched = case.truth_row[pairs], case.track_row[pairs]
    owner = np.full(len(when), -1, dtype=np.int64)
    # Labels of a class alike are ignored, and no examples of this one.
    names = clip.truth.take(np.argsort(clip.truth.frame, kind="stable")).names
    same = names[label] == name
    owner[matched[same]] = case.truth_id[label[same]]
    false = ~case.excused
    false[matched] = False
    return Pairs(
        clip=clip.name,
        frame=when,
        score=score,
        place=local[:, :2],
        position=center[:, :2],
        yaw=yaw,
        velocity=velocity,
        object=owner,
        false=false,
        truth=int((~case.ignored).sum()),
        found=int((~case.ignored[label]).sum()),
        frames=len(frames),
    )


_COLUMNS = ("center", "size", "yaw", "velocity", "score")


@dataclass(frozen=True)
class Residuals:
    """Detections against their labels, ordered by object and then by frame."""

    gap: Floats
    """(H,) s since the detection before of the same object; NaN for the first"""
    position: Floats
    """(H, 2) m"""
    heading: Floats
    """(H,) rad in [-pi, pi)"""
    velocity: Floats
    """(H, 2) m/s; NaN where one of the two is unknown"""

    @property
    def first(self) -> Bools:
        """(H,) the first detection of an object."""
        return np.isnan(self.gap)


def residuals(pairs: Sequence[Pairs], paths: Sequence[dict[int, Trajectory]]) -> Residuals:
    """Return detection minus label of all pairs."""
    parts = [(np.empty(0), np.empty((0, 2)), np.empty(0), np.empty((0, 2)))]
    parts += [
        (
            np.diff(path.time[at], prepend=np.nan),
            found.position[rows] - path.position[at],
            wrap_angle(found.yaw[rows] - path.yaw[at]),
            found.velocity[rows] - path.velocity[at],
        )
        for found, path, rows, at in detected(pairs, paths)
    ]
    return Residuals(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def detected(
    pairs: Sequence[Pairs], paths: Sequence[dict[int, Trajectory]]
) -> Iterator[tuple[Pairs, Trajectory, Ints, Ints]]:
    """Yield each detected object: its recording, its path, and the rows of its detections in both."""
    for found, objects in zip(pairs, paths, strict=True):
        for identity, path in objects.items():
            rows = np.flatnonzero(found.object == identity)
            if len(rows):
                yield found, path, rows, np.searchsorted(path.frame, found.frame[rows])
