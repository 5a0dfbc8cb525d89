"""Generated sites that several streams look at: where objects are, what each stream detects, and its tracks.

A `World` has the true paths of objects at 10 Hz. Streams see parts of it, each with its own errors: of place, angle and
clock. `tracked` follows the detections of a stream with the tracker; `copied` takes the truth with noise for tracks,
where only the links matter.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from gaps import CLASSES, SIZES, SPREAD, followed
from tracks_message import tracks_message

import optipmb

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from numpy.typing import NDArray
    from optipmb_schemas import Tracks

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

RATE: Final = 10
NOISE: Final = np.array([0.15, 0.1, 0.12])
FALSE: Final = 0.2
BEGIN_NS: Final = 1_700_000_000_000_000_000


@dataclass
class World:
    """Objects: class (O,), places (F, O, 2) at 10 Hz, NaN while they are not there."""

    label: Ints
    place: Floats

    @property
    def velocity(self) -> Floats:
        """Velocities (F, O, 2)."""
        step = np.diff(self.place, axis=0, append=self.place[-1:]) * RATE
        return np.where(np.isnan(step), 0.0, step)


def plaza(seed: int, seconds: float, objects: int = 100, half: tuple[float, float] = (60.0, 40.0)) -> World:
    """Return people, cars and bicycles that go to and fro in a rectangle, with changing speeds and directions."""
    rng = np.random.default_rng(seed)
    label = rng.choice(3, objects, p=(0.25, 0.6, 0.15))
    speed = np.array([6.0, 1.3, 3.5])[label] * rng.uniform(0.7, 1.3, objects)
    limit = np.array(half)
    place, angle = rng.uniform(-limit, limit, (objects, 2)), rng.uniform(-np.pi, np.pi, objects)
    turn, found = np.zeros(objects), np.empty((round(seconds * RATE), objects, 2))
    for frame in range(len(found)):
        found[frame] = place
        turn = 0.97 * turn + 0.02 * rng.standard_normal(objects)
        angle = angle + turn / RATE * np.where(label == 1, 4.0, 1.0)
        place = place + (speed / RATE)[:, None] * np.column_stack((np.cos(angle), np.sin(angle)))
        beyond = np.abs(place) > limit
        angle = np.where(beyond[:, 0], np.pi - angle, angle)
        angle = np.where(beyond[:, 1], -angle, angle)
        place = np.clip(place, -limit, limit)
    return World(label, found)


def corridor(seed: int, objects: int = 100, every: float = 25.0, way: float = 20.0, speed: float = 1.3) -> World:
    """Return people who walk from x = -12 to 12 + `way` m, both ways, each at a speed that it keeps roughly."""
    rng = np.random.default_rng(seed)
    begin = np.cumsum(rng.exponential(every, objects))
    span = 24.0 + way
    paths = []
    for _ in range(objects):
        own, along = speed * rng.uniform(0.65, 1.5), [0.0]
        drift = 0.0
        while along[-1] < span:
            drift = 0.98 * drift + 0.03 * rng.standard_normal()
            along.append(along[-1] + own * float(np.exp(drift)) / RATE)
        x = np.array(along) - 12.0
        x = way - x if rng.random() < 0.5 else x
        aside = rng.uniform(-1.5, 1.5) + 0.1 * np.cumsum(rng.standard_normal(len(x))) / RATE
        paths.append(np.column_stack((x, aside)))
    frames = round((begin[-1] + 200.0) * RATE)
    place = np.full((frames, objects, 2), np.nan)
    for n, path in enumerate(paths):
        first = round(begin[n] * RATE)
        count = min(len(path), frames - first)
        place[first : first + count, n] = path[:count]
    return World(np.ones(objects, np.int64), place)


@dataclass(frozen=True)
class View:
    """What a stream sees: `inside` of places (N, 2), and by how much its frame and clock are wrong."""

    stream: str
    inside: Callable[[Floats], Any]
    shift: tuple[float, float] = (0.0, 0.0)
    turn: float = 0.0  # rad, about `center`
    center: tuple[float, float] = (0.0, 0.0)
    late: float = 0.0  # s by which its stamps are later than the truth


def circle(x: float, y: float, radius: float) -> Callable[[Floats], Any]:
    """Return the view of a sensor."""
    return lambda place: np.hypot(place[:, 0] - x, place[:, 1] - y) < radius


def _seen(world: World, view: View, frame: int, rng: np.random.Generator) -> tuple[Ints, Floats]:
    place = world.place[frame]
    rows = np.flatnonzero(~np.isnan(place[:, 0]) & view.inside(place))
    cos, sin = np.cos(view.turn), np.sin(view.turn)
    own = (place[rows] - view.center) @ np.array(((cos, sin), (-sin, cos))) + view.center + view.shift
    return rows, own


def _stamp(view: View, frame: int) -> int:
    return BEGIN_NS + round((frame / RATE + view.late) * 1e9)


def tracked(world: World, view: View, seed: int) -> tuple[list[Tracks], list[Ints]]:
    """Return the tracks of each frame by the tracker, and the object of each detection."""
    rng = np.random.default_rng((seed, *view.stream.encode()))
    velocity, parameters = world.velocity, optipmb.generic_parameters(CLASSES, 0.1)
    size = SIZES[world.label] * np.exp(SPREAD[world.label] * rng.standard_normal((len(world.label), 3)))
    frames, sources = [], []
    for frame in range(len(world.place)):
        rows, own = _seen(world, view, frame, rng)
        found = rng.random(len(rows)) < 0.92
        rows, own = rows[found], own[found]
        false = rng.poisson(FALSE)
        place = np.concatenate((own, own[rng.integers(0, max(len(own), 1), false)] + 4.0 if len(own) else own[:0]))
        label = np.concatenate((world.label[rows], rng.integers(0, 3, len(place) - len(rows))))
        place = place + NOISE[label][:, None] * rng.standard_normal(place.shape)
        heading = np.arctan2(velocity[frame, rows, 1], velocity[frame, rows, 0]) + view.turn
        yaw = np.concatenate((heading, np.zeros(len(place) - len(rows))))
        height = np.concatenate((size[rows], SIZES[label[len(rows) :]]))
        score = np.concatenate((rng.uniform(0.6, 1.0, len(rows)), rng.uniform(0.1, 0.5, len(place) - len(rows))))
        made, _ = optipmb.make_frame(
            parameters,
            stamp_ns=_stamp(view, frame),
            labels=CLASSES,
            label=label,
            center=np.column_stack((place, 0.5 * height[:, 2])),
            size=height,
            yaw=np.angle(np.exp(1j * yaw)),
            score=score,
        )
        frames.append(made)
        sources.append(np.concatenate((rows, np.full(len(place) - len(rows), -1))))
    tracks = [one.model_copy(update={"stream": view.stream}) for one in followed(frames, parameters).values()]
    return tracks, sources


def copied(
    world: World, view: View, seed: int, session: str = "0" * 32, frames: Iterable[int] | None = None
) -> list[Tracks]:
    """Return the truth with noise as tracks, whose id is the object's number, of all frames or of some."""
    rng = np.random.default_rng((seed, *view.stream.encode()))
    velocity, first, made = world.velocity, np.full(len(world.label), -1), []
    for frame in range(len(world.place)) if frames is None else frames:
        rows, own = _seen(world, view, frame, rng)
        gone = np.ones(len(first), np.bool_)
        gone[rows] = False
        first[gone] = -1
        first[rows] = np.where(first[rows] < 0, frame, first[rows])
        made.append(
            tracks_message(
                view.stream,
                frame,
                rows.tolist(),
                stamp_ns=_stamp(view, frame),
                session=session,
                labels=CLASSES,
                label=world.label[rows],
                center=np.column_stack((own + 0.1 * rng.standard_normal(own.shape), np.zeros(len(own)))),
                velocity=velocity[frame, rows] + 0.1 * rng.standard_normal(own.shape),
                covariance=np.diag((0.01, 0.01, 0.01, 0.01, 0.01, 0.01)),
                age=(frame - first[rows]) / RATE,
                confirmed=1,
            )
        )
    return made
