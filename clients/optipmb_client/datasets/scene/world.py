"""Everything that moves and stands in a generated scene, for its whole length.

Conventions: world frame, z up with the ground at 0, metres, seconds; centres are geometric centres.
"""

from dataclasses import dataclass

import numpy as np

from optipmb_client.datasets.scene.detector import CLASSES, SIZES
from optipmb_client.datasets.scene.roads import manoeuvre, parking_places
from optipmb_client.datasets.scene.routes import Route, vehicle_route, walking_route
from optipmb_client.datasets.scene.traffic import Motion, drive_legs, simulate
from optipmb_client.geometry import Floats, Ints

_CAR, _PEDESTRIAN, _CYCLIST = (CLASSES.index(name) for name in ("Car", "Pedestrian", "Cyclist"))
_PARKED_SHARE = 0.35
_TURNED = 0.15
"""Share of the parked cars that stand the other way round."""
_COUPLES = 0.2
"""Share of the pedestrians' routes that two walk together."""
_MEMORY_S = 0.8
"""How long it lasts that an object is easy or hard to recognise."""


@dataclass(frozen=True)
class Crowd:
    """How many road users there are."""

    vehicles: int
    """Moving, manoeuvring and parked, without the one that carries the sensor."""
    pedestrians: int
    cyclists: int


@dataclass(frozen=True)
class World:
    """The road users of a scene at each of its frames."""

    label: Ints
    """(O,) index into `CLASSES`."""
    size: Floats
    """(O, 3)"""
    center: Floats
    """(F, O, 3)"""
    yaw: Floats
    """(F, O)"""
    velocity: Floats
    """(F, O, 2)"""
    ease: Floats
    """(F, O) how easily each is recognised, about standard normal."""
    carrier: Floats
    """(F, 3) x, y and yaw of the vehicle that carries the sensor."""


def build_world(crowd: Crowd, times: Floats, rng: np.random.Generator) -> World:
    """Return a scene at equally spaced times (F,) from 0."""
    duration = float(times[-1]) if len(times) else 0.0
    parked = round(_PARKED_SHARE * crowd.vehicles)
    busy = min(2, crowd.vehicles // 8)
    moving = crowd.vehicles - parked - busy
    cars = _sizes(rng, _CAR, 1 + crowd.vehicles)
    cycles = _sizes(rng, _CYCLIST, crowd.cyclists)
    people = _sizes(rng, _PEDESTRIAN, crowd.pedestrians)
    routes = _vehicle_routes(rng, moving, crowd.cyclists, duration)
    driving = np.vstack([cars[: 1 + moving], cycles])
    driven, walked = simulate(routes, driving, _walking_routes(rng, crowd.pedestrians, duration), times)
    rounds = [
        drive_legs(manoeuvre(lot), times, float(rng.uniform(0.0, 30.0)), 0.3 * float(cars[1 + moving + lot, 0]))
        for lot in range(busy)
    ]
    standing = _parked(rng, parked, len(times))
    motions = [_part(driven, slice(1, 1 + moving)), *rounds, standing, _part(driven, slice(1 + moving, None)), walked]
    size = np.vstack([cars[1:], cycles, people])
    label = np.repeat([_CAR, _CYCLIST, _PEDESTRIAN], [crowd.vehicles, crowd.cyclists, crowd.pedestrians])
    flat = np.concatenate([motion.center for motion in motions], axis=1)
    height = np.broadcast_to(0.5 * size[:, 2], flat.shape[:2])
    period = float(times[1] - times[0]) if len(times) > 1 else 1.0
    return World(
        label=label.astype(np.int64),
        size=size,
        center=np.concatenate([flat, height[..., None]], axis=2),
        yaw=np.concatenate([motion.yaw for motion in motions], axis=1),
        velocity=np.concatenate([motion.velocity for motion in motions], axis=1),
        ease=_ease(rng, len(times), len(size), period),
        carrier=np.column_stack([driven.center[:, 0], driven.yaw[:, 0]]),
    )


def _sizes(rng: np.random.Generator, label: int, count: int) -> Floats:
    return np.asarray(SIZES[label] * np.exp(0.06 * rng.standard_normal((count, 3)).clip(-2.5, 2.5)), dtype=np.float64)


def _vehicle_routes(rng: np.random.Generator, cars: int, cyclists: int, duration: float) -> list[Route]:
    """Return the routes of the sensor's vehicle, of the cars and of the cyclists, none too close behind another."""
    carrier = ("car", 2, float(rng.uniform(35.0, 50.0)))
    starts: list[tuple[str, int, float]] = [carrier]
    for kind, number in (("car", cars), ("cycle", cyclists)):
        spacing = 13.0 if kind == "car" else 5.0
        for _ in range(number):
            while True:
                arm, ahead = int(rng.integers(4)), 5.0 + 230.0 * float(rng.random()) ** 1.5
                if all(abs(ahead - other) > spacing for k, a, other in starts if (k, a) == (kind, arm)):
                    break
            starts.append((kind, arm, ahead))
    routes = []
    for kind, arm, ahead in starts:
        cruise = float(rng.uniform(7.5, 11.0) if kind == "car" else rng.uniform(3.5, 6.0))
        routes.append(vehicle_route(rng, kind, arm, ahead, cruise * duration, cruise))
    return routes


def _walking_routes(rng: np.random.Generator, count: int, duration: float) -> list[Route]:
    """Return the routes of the pedestrians; about every third walks beside another."""
    routes: list[Route] = []
    while len(routes) < count:
        cruise = float(np.clip(rng.normal(1.35, 0.2), 0.8, 1.9))
        choices = int(rng.integers(2**63))
        sides = (0.1, 0.85) if rng.random() < _COUPLES else (float(rng.uniform(0.0, 0.9)),)
        routes += [
            walking_route(np.random.Generator(np.random.PCG64(choices)), cruise * duration, cruise, side)
            for side in sides
        ]
    return routes[:count]


def _parked(rng: np.random.Generator, count: int, frames: int) -> Motion:
    """Return cars that stand all the time, some of them the other way round."""
    places, headings = parking_places()
    chosen = rng.choice(len(places), size=count, replace=False)
    center = places[chosen] + 0.1 * rng.standard_normal((count, 2))
    yaw = headings[chosen] + 0.03 * rng.standard_normal(count) + np.pi * (rng.random(count) < _TURNED)
    yaw = np.arctan2(np.sin(yaw), np.cos(yaw))
    return Motion(
        np.broadcast_to(center, (frames, count, 2)), np.broadcast_to(yaw, (frames, count)), np.zeros((frames, count, 2))
    )


def _part(motion: Motion, objects: slice) -> Motion:
    return Motion(motion.center[:, objects], motion.yaw[:, objects], motion.velocity[:, objects])


def _ease(rng: np.random.Generator, frames: int, objects: int, period: float) -> Floats:
    """Return how easily each object (F, O) is recognised: its own lasting part, and one that comes and goes."""
    keep = np.exp(-period / _MEMORY_S)
    noise = rng.standard_normal((frames, objects))
    for k in range(1, frames):
        noise[k] = keep * noise[k - 1] + np.sqrt(1.0 - keep**2) * noise[k]
    return np.asarray(0.5 * rng.standard_normal(objects) + np.sqrt(0.75) * noise, dtype=np.float64)
