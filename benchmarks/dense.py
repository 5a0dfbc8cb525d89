"""The dense scene that trackers are timed on: seeded, with numpy alone, so that every tracker gets the same frames.

Frames at 10 Hz like KITTI's: cars, pedestrians and cyclists without velocity, one object per 16 m^2 on average, so that
gates overlap everywhere; a tenth is missed, a tenth is clutter, a third has low scores. World frame, metres, radians.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

LABELS = ("Car", "Pedestrian", "Cyclist")
SIZES = np.array([[4.0, 1.7, 1.5], [0.6, 0.6, 1.7], [1.8, 0.6, 1.7]])
FASTEST = np.array([6.0, 1.5, 4.0])
PERIOD_S = 0.1
MISSED = 0.1
SENSOR_HEIGHT = 1.7
ON_OBJECTS = 0.2


@dataclass(frozen=True)
class SceneFrame:
    """Detections of one frame; `scan` (P, 3) are points in the frame of a sensor 1.7 m above the origin."""

    stamp_ns: int
    label: np.ndarray
    center: np.ndarray
    size: np.ndarray
    yaw: np.ndarray
    score: np.ndarray
    scan: np.ndarray | None


def scan(rng: np.random.Generator, center: np.ndarray, half: float, points: int) -> np.ndarray:
    """Points on the ground and on the objects, in the order of chance: no pattern that a processor could learn."""
    angle, distance = rng.uniform(-np.pi, np.pi, points), rng.exponential(0.3 * half, points)
    height = rng.normal(-SENSOR_HEIGHT, 0.05, points)
    xyz = np.column_stack([distance * np.cos(angle), distance * np.sin(angle), height])
    on_objects = rng.random(points) < ON_OBJECTS
    hit = rng.integers(len(center), size=on_objects.sum())
    xyz[on_objects] = center[hit] - [0, 0, SENSOR_HEIGHT] + rng.normal(0, 0.5, (hit.size, 3))
    return xyz.astype(np.float32)


def dense_scene(objects: int, frames: int = 11, points: int = 0) -> list[SceneFrame]:
    """A scene of so many objects that move straight on; with `points`, every frame has a scan of so many."""
    rng = np.random.default_rng(objects)
    half = 2.0 * np.sqrt(objects)
    label = rng.integers(0, 3, objects)
    place, heading = rng.uniform(-half, half, (objects, 2)), rng.uniform(-np.pi, np.pi, objects)
    velocity = (rng.uniform(0, 1, objects) * FASTEST[label])[:, None] * np.column_stack(
        [np.cos(heading), np.sin(heading)]
    )
    confidence = rng.beta(4, 1.5, objects)
    made = []
    for k in range(frames):
        seen = np.flatnonzero(rng.random(objects) > MISSED)
        clutter = objects // 10
        position = np.concatenate(
            [place[seen] + rng.normal(0, 0.1, (seen.size, 2)), rng.uniform(-half, half, (clutter, 2))]
        )
        labels = np.concatenate([label[seen], rng.integers(0, 3, clutter)])
        score = np.concatenate([confidence[seen] + rng.normal(0, 0.05, seen.size), rng.beta(2, 4, clutter)])
        center = np.column_stack([position, np.full(len(position), 0.8)])
        made.append(
            SceneFrame(
                stamp_ns=round(k * PERIOD_S * 1e9),
                label=labels,
                center=center,
                size=SIZES[labels],
                yaw=np.concatenate([heading[seen], rng.uniform(-np.pi, np.pi, clutter)]),
                score=np.clip(score, 0.01, 1.0),
                scan=scan(rng, center, half, points) if points else None,
            )
        )
        place = place + PERIOD_S * velocity
    return made
