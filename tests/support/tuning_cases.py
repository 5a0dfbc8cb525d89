"""Recordings whose noise is known: objects that move by the tracker's own model, seen by a detector made to order."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from optipmb_tools.datasets import DetectionFrame, Pose, Truth
from optipmb_tools.geometry import Floats, wrap_angle

LABELS = ("Car", "Pedestrian", "Cyclist")
HERE = Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))


@dataclass(frozen=True)
class Habits:
    position: float = 0.2
    heading: float = 0.08
    velocity: float | None = None
    flips: float = 0.0
    found: float = 0.9
    false: float = 0.5
    acceleration: float = 0.0
    turn_rate: float = 0.0


class Recorded:
    has_clouds = False

    def __init__(self, name: str, frames: list[DetectionFrame], truth: Truth) -> None:
        self.name = name
        self.poses = tuple(HERE for _ in frames)
        self._frames = frames
        self._truth = truth

    def __len__(self) -> int:
        return len(self._frames)

    def frames(self) -> Iterator[DetectionFrame]:
        return iter(self._frames)

    def truth(self) -> Truth:
        return self._truth


def recorded(habits: Habits, seed: int = 0, frames: int = 200, objects: int = 30, name: str = "0000") -> Recorded:
    rng = np.random.default_rng(seed)
    path = _paths(habits, frames, objects, rng)  # (frames, objects, 5): x y phi v omega
    count = frames * objects
    size = np.tile([4.0, 2.0, 1.5], (objects, 1))
    given = []
    for index in range(frames):
        hit = np.flatnonzero(rng.random(objects) < habits.found)
        extra = int(rng.poisson(habits.false))
        center = np.zeros((len(hit) + extra, 3))
        center[: len(hit), :2] = path[index, hit, :2] + habits.position * rng.standard_normal((len(hit), 2))
        center[len(hit) :, :2] = rng.uniform(-400.0, -300.0, (extra, 2))
        yaw = path[index, hit, 2] + habits.heading * rng.standard_normal(len(hit))
        yaw = yaw + np.pi * (rng.random(len(hit)) < habits.flips)
        velocity = None
        if habits.velocity is not None:
            velocity = np.full((len(hit) + extra, 2), np.nan)
            velocity[: len(hit)] = _velocity(path[index, hit]) + habits.velocity * rng.standard_normal((len(hit), 2))
        given.append(
            DetectionFrame(
                index=index,
                stamp_ns=index * 100_000_000,
                pose=HERE,
                labels=LABELS,
                label=np.zeros(len(center), dtype=np.int64),
                center=center,
                size=np.tile([4.0, 2.0, 1.5], (len(center), 1)),
                yaw=wrap_angle(np.concatenate([yaw, np.zeros(extra)])),
                score=np.concatenate([rng.uniform(0.5, 1.0, len(hit)), rng.uniform(0.1, 0.6, extra)]),
                velocity=velocity,
            )
        )
    flat = path.reshape(count, 5)
    truth = Truth.of(
        LABELS,
        np.repeat(np.arange(frames), objects),
        id=np.tile(np.arange(objects), frames),
        label=np.zeros(count, dtype=np.int64),
        center=np.column_stack([flat[:, :2], np.zeros(count)]),
        size=np.tile(size, (frames, 1)),
        yaw=wrap_angle(flat[:, 2]),
        velocity=_velocity(flat),
    )
    return Recorded(name, given, truth)


def _velocity(states: Floats) -> Floats:
    return states[..., 3:4] * np.stack([np.cos(states[..., 2]), np.sin(states[..., 2])], axis=-1)


def _paths(habits: Habits, frames: int, objects: int, rng: np.random.Generator) -> Floats:
    """Return states (frames, objects, 5) whose acceleration and turn rate walk at random, in steps of 1/100 s."""
    step = 0.01
    state = np.zeros((objects, 5))
    state[:, 0] = 100.0 * np.arange(objects)
    state[:, 2] = rng.uniform(-np.pi, np.pi, objects)
    state[:, 3] = rng.uniform(8.0, 12.0, objects)
    pull = np.zeros(objects)
    path = np.empty((frames, objects, 5))
    for index in range(frames):
        path[index] = state
        for _ in range(10):
            pull = pull + habits.acceleration * np.sqrt(step) * rng.standard_normal(objects)
            state[:, 4] += habits.turn_rate * np.sqrt(step) * rng.standard_normal(objects)
            state[:, :2] += step * _velocity(state)
            state[:, 2] += step * state[:, 4]
            state[:, 3] += step * pull
    return path
