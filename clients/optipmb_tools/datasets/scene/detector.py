"""A detector with the habits of real ones, given what the LiDAR saw.

Conventions: sensor frame, metres, radians. It sees nothing without points, misses little with many, and its misses come
in runs, since what makes an object hard to see lasts. Errors grow with distance and with few points and have heavier
tails than a Gaussian; boxes are pulled towards the side that is seen. Headings are turned round now and then.

Its scores are calibrated: of all detections with score s, the share s are objects. To that end every detection of an
object with score s brings along, on average, (1 - s) / s false ones with the same score somewhere in the scene.
"""

from dataclasses import dataclass

import numpy as np

from optipmb_tools.geometry import Floats, Ints, wrap_angle

CLASSES = ("Car", "Pedestrian", "Cyclist")
SIZES: Floats = np.array([[4.3, 1.82, 1.55], [0.7, 0.65, 1.74], [1.75, 0.65, 1.74]])
"""Typical length, width and height of each class."""
MIN_SCORE = 0.1
FALSE = -1  # source of a detection that is no object

_FLIP = np.array([0.01, 0.06, 0.03])
_YAW_ERROR = np.array([0.03, 0.2, 0.08])
_MIX = np.array([0.5, 0.3, 0.2])
_STUDENT = 5.0  # degrees of freedom of the errors


@dataclass(frozen=True)
class InRange:
    """The objects in range at one time."""

    index: Ints  # (N,) which objects of the scene they are
    label: Ints  # (N,) index into `CLASSES`
    center: Floats  # (N, 3)
    size: Floats  # (N, 3)
    yaw: Floats  # (N,)
    velocity: Floats  # (N, 2) over ground along the axes of the sensor
    points: Ints  # (N,) returned points
    ease: Floats  # (N,) how easily the object is recognised now, about standard normal, slowly changing


@dataclass(frozen=True)
class Found:
    """The detections of one time."""

    label: Ints
    center: Floats
    size: Floats
    yaw: Floats
    velocity: Floats
    score: Floats
    source: Ints  # (M,) index of the object as in `InRange.index`, or `FALSE`


def detection_probability(points: Ints, ease: Floats) -> Floats:
    """Return the probability (N,) that an object with that many points is found; 0 without points."""
    logit = -1.6 + 1.3 * np.log1p(points) + 0.8 * ease
    return np.where(points > 0, 0.985 / (1.0 + np.exp(-logit)), 0.0)


def detect(seen: InRange, sites: Floats, radius: float, height: float, rng: np.random.Generator) -> Found:
    """Return what the detector finds, in random order.

    Args:
        seen: the objects in range.
        sites: (S, 2) places in the sensor frame that are often taken for objects.
        radius: how far it looks.
        height: of the sensor above the ground.
        rng: the source of all chance.
    """
    chance = detection_probability(seen.points, seen.ease)
    logit = -2.2 + np.log1p(seen.points) + 0.6 * seen.ease + 0.3 * rng.standard_normal(len(chance))
    score = np.clip(1.0 / (1.0 + np.exp(-logit)), 0.01, 0.99)
    hit = np.flatnonzero((rng.random(len(chance)) < chance) & (score >= MIN_SCORE))
    true = _noisy(seen, hit, score[hit], rng)
    false = _false(true, sites, radius, height, rng)
    order = rng.permutation(len(true.label) + len(false.label))
    return Found(*(np.concatenate([getattr(true, n), getattr(false, n)])[order] for n in Found.__dataclass_fields__))


def _noisy(seen: InRange, hit: Ints, score: Floats, rng: np.random.Generator) -> Found:
    """Return the detections of some objects."""
    label, points = seen.label[hit], seen.points[hit]
    count = len(hit)
    ground = seen.center[hit, :2]
    distance = np.linalg.norm(ground, axis=1)
    spread = (0.04 + 0.0025 * distance) * (1.0 + 1.5 / np.sqrt(points))
    pull = 0.15 / np.sqrt(points) * np.minimum(seen.size[hit, 1], 1.0)
    center = seen.center[hit].copy()
    center[:, :2] += _errors(rng, (count, 2)) * spread[:, None] - pull[:, None] * ground / distance[:, None]
    center[:, 2] += 0.04 * (1.0 + 1.0 / np.sqrt(points)) * _errors(rng, count)
    yaw = seen.yaw[hit] + _YAW_ERROR[label] * (1.0 + 2.0 / np.sqrt(points)) * _errors(rng, count)
    yaw = yaw + np.pi * (rng.random(count) < _FLIP[label])
    # A detector knows the typical sizes and leans on them when it sees little.
    trust = (points / (points + 10.0))[:, None]
    size = trust * seen.size[hit] + (1.0 - trust) * SIZES[label]
    size = size * np.exp(0.04 * rng.standard_normal((count, 3)))
    velocity = seen.velocity[hit] + (0.25 + 0.01 * distance)[:, None] * _errors(rng, (count, 2))
    return Found(label, center, size, wrap_angle(yaw), velocity, score, seen.index[hit])


def _false(true: Found, sites: Floats, radius: float, height: float, rng: np.random.Generator) -> Found:
    """Return detections that are no objects, as many and with such scores as calibration asks for."""
    number = rng.poisson((1.0 - true.score) / true.score)
    count = int(number.sum())
    # A little unlike the score it belongs to, for equal scores never occur in practice.
    score = np.clip(np.repeat(true.score, number) * np.exp(0.05 * rng.standard_normal(count)), MIN_SCORE, 0.99)
    label = rng.choice(len(CLASSES), size=count, p=_MIX).astype(np.int64)
    distance, angle = radius * np.sqrt(rng.uniform(0.004, 1.0, count)), rng.uniform(-np.pi, np.pi, count)
    place = np.column_stack([distance * np.cos(angle), distance * np.sin(angle)])
    near = sites[np.linalg.norm(sites, axis=1) < radius]
    kind = rng.random(count)
    if len(near):
        pick = near[rng.integers(len(near), size=count)] + 0.25 * rng.standard_normal((count, 2))
        place = np.where((kind < 0.5)[:, None], pick, place)  # noqa: PLR2004 - half are at the usual places
    if len(true.label):
        twin = rng.integers(len(true.label), size=count)
        beside = true.center[twin, :2] + 0.5 * true.size[twin, :1] * rng.standard_normal((count, 2))
        again = kind > 0.85  # noqa: PLR2004 - some are second boxes on an object
        place = np.where(again[:, None], beside, place)
        label = np.where(again, true.label[twin], label)
    size = SIZES[label] * np.exp(0.1 * rng.standard_normal((count, 3)))
    center = np.column_stack([place, 0.5 * size[:, 2] - height + 0.1 * rng.standard_normal(count)])
    yaw = rng.uniform(-np.pi, np.pi, count)
    velocity = 0.5 * rng.standard_normal((count, 2))
    return Found(label, center, size, yaw, velocity, score, np.full(count, FALSE, dtype=np.int64))


def _errors(rng: np.random.Generator, shape: int | tuple[int, int]) -> Floats:
    """Return errors of unit variance with heavy tails."""
    return np.asarray(rng.standard_t(_STUDENT, shape) * np.sqrt((_STUDENT - 2.0) / _STUDENT), dtype=np.float64)
