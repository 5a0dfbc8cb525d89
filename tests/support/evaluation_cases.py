"""Truth and tracks made by hand, in memory and as files of KITTI, for the tests of figures."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from optipmb_tools.camera import Camera, alpha_of, kitti_from_sensor
from optipmb_tools.datasets import Truth
from optipmb_tools.evaluation.cases import Rules, prepare
from optipmb_tools.evaluation.clear import ClearResult, clear
from optipmb_tools.results import ResultTable

LABELS = ("Car", "Van", "Pedestrian", "Person", "Cyclist")
SIZE = (4.0, 2.0, 1.5)
IMAGE = (100.0, 100.0, 200.0, 200.0)

TruthRow = tuple[int, int, float, float]
"""Frame, id, x, y."""
TrackRow = tuple[int, int, float, float, float]
"""Frame, id, x, y, score."""


def evaluate_clear(
    truth: Truth, tracks: ResultTable, name: str, rules: Rules | None = None, *, sequence: str = ""
) -> ClearResult:
    rules = rules or Rules()
    return clear(prepare(truth, tracks, name, rules, sequence), rules)


def truth_of(rows: Sequence[TruthRow], names: Sequence[str] | str = "Car", ignored: Sequence[int] = ()) -> Truth:
    """Give objects of one size, in any order; `ignored` names rows."""
    count = len(rows)
    names = [names] * count if isinstance(names, str) else names
    mask = np.zeros(count, dtype=np.bool_)
    mask[list(ignored)] = True
    truth = Truth.of(
        LABELS,
        np.array([row[0] for row in rows], dtype=np.int64),
        id=np.array([row[1] for row in rows], dtype=np.int64),
        label=np.array([LABELS.index(name) for name in names], dtype=np.int64),
        center=np.array([[row[2], row[3], 0.0] for row in rows], dtype=np.float64).reshape(-1, 3),
        size=np.tile(SIZE, (count, 1)),
        yaw=np.zeros(count),
        box2d=np.tile(IMAGE, (count, 1)),
        ignored=mask,
    )
    return truth.take(np.argsort(truth.frame, kind="stable"))


def tracks_of(rows: Sequence[TrackRow], names: Sequence[str] | str = "Car") -> ResultTable:
    count = len(rows)
    labels = (names,) if isinstance(names, str) else tuple(dict.fromkeys(names))
    table = ResultTable(
        labels=labels,
        frame=np.array([row[0] for row in rows], dtype=np.int64),
        id=np.array([row[1] for row in rows], dtype=np.int64),
        label=np.array([0 if isinstance(names, str) else labels.index(names[i]) for i in range(count)], dtype=np.int64),
        center=np.array([[row[2], row[3], 0.0] for row in rows], dtype=np.float64).reshape(-1, 3),
        size=np.tile(SIZE, (count, 1)),
        yaw=np.zeros(count),
        score=np.array([row[4] for row in rows], dtype=np.float64),
        box2d=np.tile(IMAGE, (count, 1)),
    )
    return table.take(np.argsort(table.frame, kind="stable"))


def parked(objects: int, frames: int, apart: float = 10.0) -> list[TruthRow]:
    return [(frame, one, apart * one, 0.0) for frame in range(frames) for one in range(objects)]


def followed(rows: Sequence[TruthRow], score: float = 0.9, dx: float = 0.0) -> list[TrackRow]:
    """Give tracks that follow objects at a distance, with the ids of the objects."""
    return [(frame, one, x + dx, y, score) for frame, one, x, y in rows]


def shuffled(rows: Sequence[TrackRow], seed: int = 0) -> list[TrackRow]:
    """Give the same boxes with the ids exchanged at random in every frame."""
    chance = np.random.default_rng(seed)
    found: list[TrackRow] = []
    for frame in sorted({row[0] for row in rows}):
        here = [row for row in rows if row[0] == frame]
        ids = chance.permutation([row[1] for row in here]).tolist()
        found += [(frame, one, *row[2:]) for one, row in zip(ids, here, strict=True)]
    return found


PROJECTION = np.array([[720.0, 0.0, 610.0, 45.0], [0.0, 720.0, 173.0, 0.2], [0.0, 0.0, 1.0, 0.003]])
CAMERA = Camera(PROJECTION)
CLASSES = {"Car": SIZE, "Van": (5.0, 2.0, 2.2), "Pedestrian": (0.8, 0.6, 1.75), "Cyclist": (1.8, 0.6, 1.75)}


def write_kitti(root: Path, results: Path, seed: int, sequences: Sequence[str] = ("0000", "0001")) -> Path:
    """Write a small benchmark with all that its rules name but no detections, and disturbed tracks; return its root.

    Objects drive ahead of a camera that drives along a bend; some are vans, some hidden or cut by the image for a
    while, some so near to others that a track could be either's. Tracks are inaccurate, lost and resumed under another
    id, twice on one object, false, small, or in regions without annotations. Their scores say a little about all that.
    """
    chance = np.random.default_rng(seed)
    for folder in ("calib", "poses", "label_02"):
        (root / "training" / folder).mkdir(parents=True, exist_ok=True)
    results.mkdir(parents=True, exist_ok=True)
    unit = "1 0 0 0 0 1 0 0 0 0 1 0"
    for sequence in sequences:
        frames = int(chance.integers(30, 50))
        calibration = (
            f"P2: {' '.join(map(str, PROJECTION.ravel()))}\nR0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: {unit}\n"
        )
        (root / "training" / "calib" / f"{sequence}.txt").write_text(calibration)
        (root / "training" / "poses" / f"{sequence}.txt").write_text("".join(_pose(frame) for frame in range(frames)))
        labels, tracks = _drive(chance, frames)
        (root / "training" / "label_02" / f"{sequence}.txt").write_text("".join(labels))
        (results / f"{sequence}.txt").write_text("".join(tracks))
    return root


def _pose(frame: int) -> str:
    turn = 0.01 * frame
    cos, sin = np.cos(turn), np.sin(turn)
    return f"{cos:.9f} 0 {sin:.9f} {0.01 * frame:.6f} 0 1 0 0 {-sin:.9f} 0 {cos:.9f} {0.5 * frame:.6f}\n"


def _drive(chance: np.random.Generator, frames: int) -> tuple[list[str], list[str]]:
    labels, tracks = [], []
    following = 100
    for one in range(28):
        name = str(chance.choice(list(CLASSES), p=[0.5, 0.1, 0.25, 0.15]))
        size = np.array(CLASSES[name]) * chance.uniform(0.9, 1.1, 3)
        begin, end = sorted(chance.integers(0, frames, 2).tolist())
        place = np.array([chance.uniform(8, 45), chance.uniform(-6, 6), chance.uniform(-1.0, -0.6)])
        speed, yaw = chance.normal(0, 0.3, 2), chance.uniform(-np.pi, np.pi)
        hidden = chance.integers(0, 4, frames) * (chance.random(frames) < 0.3)
        cut = (chance.random(frames) < 0.1).astype(int)
        found = {"Van": "Car"}.get(name, name)
        quality = chance.uniform(0.3, 1.0)
        identity, following = following, following + 1
        for frame in range(begin, end + 1):
            center = place + np.array([*(speed * (frame - begin)), 0.0])
            labels.append(_line(frame, one, name, center, size, yaw, f"{cut[frame]} {hidden[frame]}"))
            if chance.random() < 0.08:
                identity, following = following, following + 1
            if chance.random() > quality:
                continue
            moved = center + chance.normal(0, 0.15, 3) * (1.0, 1.0, 0.3) * (3.0 if chance.random() < 0.1 else 1.0)
            score = float(np.clip(quality * chance.uniform(0.6, 1.0), 0.0, 1.0))
            wide = size * chance.uniform(0.9, 1.1, 3)
            turned = yaw + chance.normal(0, 0.1)
            tracks.append(_line(frame, identity, found, moved, wide, turned, "-1 -1", f" {score:.6f}"))
            if chance.random() < 0.1:  # a second track on the same object
                beside = moved + chance.normal(0, 0.4, 3) * (1.0, 1.0, 0.1)
                tracks.append(_line(frame, 50 + one, found, beside, wide, turned, "-1 -1", f" {0.5 * score:.6f}"))
    for frame in range(frames):
        left = float(chance.uniform(0, 900))
        labels.append(
            f"{frame} -1 DontCare -1 -1 -10 {left:.2f} 100.00 {left + 250:.2f} 300.00 -1 -1 -1 -1000 -1000 -1000 -10\n"
        )
    for clutter in range(12):
        name = str(chance.choice(["Car", "Pedestrian", "Cyclist"]))
        begin = int(chance.integers(0, frames - 5))
        place = np.array([chance.uniform(8, 70), chance.uniform(-10, 10), -0.8])
        for frame in range(begin, begin + int(chance.integers(1, 6))):
            score = f" {chance.uniform(0.05, 0.6):.6f}"
            tracks.append(_line(frame, 1000 + clutter, name, place, np.array(CLASSES[name]), 0.3, "-1 -1", score))
    order = chance.permutation(len(tracks))
    return labels, [tracks[i] for i in order]


def _line(
    frame: int, identity: int, name: str, center: np.ndarray, size: np.ndarray, yaw: float, state: str, score: str = ""
) -> str:
    rows = center[None], size[None], np.array([yaw])
    (image,), _ = CAMERA.boxes(*rows)
    bottom, hwl, turn = kitti_from_sensor(*rows)
    values = [*image, *hwl[0], *bottom[0], turn[0]]
    text = " ".join(f"{value:.6f}" for value in (alpha_of(bottom, turn)[0], *values))
    return f"{frame} {identity} {name} {state} {text}{score}\n"
