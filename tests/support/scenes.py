"""Random scenes: seeded, with numpy alone, as the arguments of `optipmb.make_frame`.

Objects appear, turn, stop, reverse and disappear; detections are missed, doubled, weakly scored or clutter; headings
may flip; stamps may repeat, jitter or leave gaps; clouds come from a sensor with a tilted pose. World frame: metres,
z up, radians.
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

import optipmb
from optipmb import Frame, Modules, Parameters, StepResult

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SensorPose:
    """World from sensor: translation (3,) and unit quaternion w x y z (4,)."""

    translation: Array
    quaternion: Array

    @property
    def rotation(self) -> Array:
        """Rotation matrix (3, 3)."""
        w, x, y, z = self.quaternion
        return np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )


@dataclass(frozen=True)
class SceneCloud:
    """Points in the sensor frame (P, 3) float32 and the pose of the sensor."""

    xyz: NDArray[np.float32]
    pose: SensorPose


@dataclass(frozen=True)
class SceneFrame:
    """What a detector would send, in the world frame; `truth` is the object behind each detection, -1 for clutter."""

    stamp_ns: int
    labels: tuple[str, ...]
    label: NDArray[np.int64]
    center: Array
    size: Array
    yaw: Array
    score: Array
    velocity: Array | None = None
    cloud: SceneCloud | None = None
    truth: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    def columns(self) -> dict[str, Any]:
        """The arguments of `make_frame` that are plain arrays."""
        names = ("labels", "label", "center", "size", "yaw", "score", "velocity")
        return {"stamp_ns": self.stamp_ns} | {name: getattr(self, name) for name in names}

    def taken(self, order: NDArray[np.int64]) -> Self:
        """The same frame with the detections that `order` names, in that order."""
        names = ("label", "center", "size", "yaw", "score", "truth")
        columns = {name: getattr(self, name)[order] for name in names}
        return replace(self, velocity=None if self.velocity is None else self.velocity[order], **columns)


@dataclass(frozen=True)
class Options:
    """What a random scene contains."""

    labels: tuple[str, ...] = ("Car", "Pedestrian", "Cyclist")
    frames: int = 40
    objects: int = 10  # present at once, about
    extent: float = 30.0  # half the side of the square that objects live in, m
    period: float = 0.1  # s
    clutter: float = 2.0  # expected per frame
    missed: float = 0.15
    velocity: str = "mixed"  # "known", "none", or "mixed": NaN rows
    flips: float = 0.1  # probability that a heading is turned by pi
    irregular: bool = True  # dt = 0, jitter and long gaps
    clouds: float = 0.7  # probability that a frame has a cloud
    ties: bool = True  # scores on a grid of 0.1, so that many are equal
    foreign: bool = True  # detections of a class that no profile has


@dataclass
class _Body:
    number: int
    label: int
    state: Array  # x y v phi omega a
    size: Array
    z: float
    confidence: float
    frames_left: int


def _body(rng: np.random.Generator, options: Options, number: int, anchors: Array) -> _Body:
    center = rng.uniform(-options.extent, options.extent, 2)
    label = int(rng.integers(len(options.labels)))
    speed = 0.0 if rng.random() < 0.2 else rng.uniform(-2, 12)
    if rng.random() < 0.6:  # crowds of one class, so that gates overlap and the assignment has something to decide
        crowd = number % len(anchors)
        center, label, speed = anchors[crowd] + rng.normal(0, 1.5, 2), crowd % len(options.labels), rng.uniform(0, 1.5)
    state = np.array([*center, speed, rng.uniform(-math.pi, math.pi), rng.normal(0, 0.2), rng.normal(0, 0.5)])
    size = rng.uniform([0.6, 0.5, 1.0], [4.5, 2.0, 2.2])
    if speed < 1.5:
        size[:2] *= 0.4
    confidence, life = float(rng.beta(3, 1.5)), int(rng.geometric(0.03))
    return _Body(number, label, state, size, float(rng.normal(0, 0.3)), confidence, life)


def _advance(rng: np.random.Generator, body: _Body, dt: float) -> None:
    x = body.state
    steps = 4
    for _ in range(steps):
        h = dt / steps
        x[:2] += h * x[2] * np.array([math.cos(x[3]), math.sin(x[3])])
        x[2] += h * x[5]
        x[3] += h * x[4]
    event = rng.random()
    if event < 0.03:
        x[4] = rng.normal(0, 0.6)  # a turn
    elif event < 0.05:
        x[2], x[5] = 0.0, 0.0  # a stop
    elif event < 0.08:
        x[5] = rng.normal(0, 1.0)
    if abs(x[2]) > 14:
        x[5] = 0.0


def _cloud(rng: np.random.Generator, options: Options, bodies: list[_Body]) -> SceneCloud:
    parts = [rng.uniform([-options.extent, -options.extent, -2], [options.extent, options.extent, 2], (200, 3))]
    for body in bodies:
        visible = 0.0 if rng.random() < 0.2 else rng.uniform(0, 14)
        local = rng.uniform(-0.6, 0.6, (rng.poisson(visible), 3)) * body.size
        c, s = math.cos(body.state[3]), math.sin(body.state[3])
        rotated = local @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])
        parts.append(rotated + np.array([*body.state[:2], body.z]))
    world = np.concatenate(parts)
    quaternion = np.array([1.0, *rng.normal(0, 0.05, 2), rng.normal(0, 1.0)])
    pose = SensorPose(rng.normal(0, 3, 3), quaternion / np.linalg.norm(quaternion))
    return SceneCloud(((world - pose.translation) @ pose.rotation).astype(np.float32), pose)


def _detect(rng: np.random.Generator, options: Options, bodies: list[_Body]) -> dict[str, Any]:
    rows: list[list[float]] = []
    for body in bodies:
        for copy in range(2):
            if copy == 0 and rng.random() < options.missed:
                break
            if copy == 1 and rng.random() > 0.05:  # a second box for the same object: work for the suppression
                continue
            x, y, v, phi = body.state[:4]
            yaw = phi + rng.normal(0, 0.08) + (math.pi if rng.random() < options.flips else 0.0)
            velocity = v * np.array([math.cos(phi), math.sin(phi)]) + rng.normal(0, 0.3, 2)
            size = body.size * rng.uniform(0.9, 1.1, 3)
            score = float(np.clip(body.confidence + rng.normal(0, 0.15), 0.01, 1.0))
            position = np.array([x, y]) + rng.normal(0, 0.15, 2)
            yaw = yaw if abs(yaw) < math.tau else math.remainder(yaw, math.tau)
            rows.append([body.label, *position, body.z + rng.normal(0, 0.1), *size, yaw, *velocity, score, body.number])
    for _ in range(rng.poisson(options.clutter)):
        label = int(rng.integers(len(options.labels)))
        position = rng.uniform(-options.extent, options.extent, 2)
        size = rng.uniform(0.5, 4.0, 3)
        score = float(rng.beta(1.5, 3)) + 0.01
        rows.append([label, *position, 0.0, *size, rng.uniform(-6, 6), *rng.normal(0, 3, 2), min(score, 1.0), -1])
    table = np.array(rows, dtype=np.float64).reshape(-1, 12)[rng.permutation(len(rows))]
    scores = np.clip(np.round(table[:, 10], 1), 0.1, 1.0) if options.ties else table[:, 10].copy()
    return {
        "label": table[:, 0].astype(np.int64), "center": table[:, 1:4].copy(), "size": table[:, 4:7].copy(),
        "yaw": table[:, 7].copy(), "velocity": table[:, 8:10].copy(), "score": scores,
        "truth": table[:, 11].astype(np.int64),
    }  # fmt: skip


def _velocity(rng: np.random.Generator, options: Options, velocity: Array) -> Array | None:
    if options.velocity == "none" or (options.velocity == "mixed" and rng.random() < 0.1):
        return None
    if options.velocity == "mixed":
        velocity[rng.random(len(velocity)) < 0.4] = np.nan
    return velocity


def _time_step(rng: np.random.Generator, options: Options) -> float:
    kind = rng.random() if options.irregular else 1.0
    if kind < 0.05:
        return 0.0
    if kind < 0.07:
        return options.period * float(rng.uniform(5, 15))
    return options.period * float(rng.uniform(0.5, 1.6)) if kind < 0.5 else options.period


def scene(seed: int, options: Options = Options()) -> Iterator[SceneFrame]:
    """Yield the frames of one random scene; the same seed gives the same scene."""
    rng = np.random.default_rng(seed)
    anchors = rng.uniform(-0.7 * options.extent, 0.7 * options.extent, (2, 2))
    bodies: list[_Body] = []
    number = 0
    stamp = int(rng.integers(0, 2**40))
    for index in range(options.frames):
        while len(bodies) < options.objects and (index == 0 or rng.random() < 0.5):
            bodies.append(_body(rng, options, number, anchors))
            number += 1
        columns = _detect(rng, options, bodies)
        labels = options.labels
        if options.foreign and rng.random() < 0.3 and len(columns["label"]):
            labels = (*options.labels, "unheard of")
            columns["label"] = np.where(rng.random(len(columns["label"])) < 0.1, len(options.labels), columns["label"])
        columns["velocity"] = _velocity(rng, options, columns["velocity"])
        cloud = _cloud(rng, options, bodies) if rng.random() < options.clouds else None
        yield SceneFrame(stamp, labels, cloud=cloud, **columns)
        dt = _time_step(rng, options)
        stamp += round(dt * 1e9)
        for body in bodies:
            body.frames_left -= 1
            _advance(rng, body, dt)
        bodies = [body for body in bodies if body.frames_left > 0]


def partial(
    given: SceneFrame, headings: NDArray[np.bool_], sizes: NDArray[np.bool_], heights: NDArray[np.bool_]
) -> SceneFrame:
    """The frame without the headings, sizes and heights of some detections."""
    center = given.center.copy()
    center[heights, 2] = np.nan
    size = np.where(sizes[:, None], np.nan, given.size)
    return replace(given, yaw=np.where(headings, np.nan, given.yaw), size=size, center=center)


def frame_of(parameters: Parameters, given: SceneFrame) -> Frame:
    """The tracker's frame of a scene's frame."""
    cloud = None
    if given.cloud is not None:
        pose = optipmb.Pose(translation=given.cloud.pose.translation, quaternion=given.cloud.pose.quaternion)
        cloud = optipmb.PointCloud(xyz=given.cloud.xyz, pose=pose)
    frame, _ = optipmb.make_frame(parameters, cloud=cloud, **given.columns())
    return frame


def random_parameters(
    seed: int, labels: tuple[str, ...] = ("Car", "Pedestrian", "Cyclist"), *, calibrated: bool = False
) -> dict[str, Any]:
    """A random, valid profile as the nested dictionaries that `parse_parameters` reads."""
    rng = np.random.default_rng(seed)

    def one_class() -> dict[str, Any]:
        extract_new, extract_known = sorted(rng.uniform(0.1, 0.98, 2))
        return {
            "score_filter": rng.uniform(0, 0.3), "nms_iou": rng.uniform(0.05, 0.6), "survival": rng.uniform(0.8, 1),
            "gate": rng.uniform(1, 8), "detection": rng.uniform(0.3, 0.98), "expected_points": rng.uniform(1, 15),
            "detection_floor": rng.uniform(0.05, 1), "birth_score": rng.uniform(0.2, 0.9),
            "adaptive_birth_rate": rng.uniform(0.01, 3), "undetected_birth_rate": rng.uniform(0.01, 5),
            "clutter_rate": rng.uniform(0.1, 10), "area": rng.uniform(500, 10_000),
            "poisson_steps": int(rng.integers(0, 5)), "extract_new": extract_new, "extract_known": extract_known,
            "extract_misses": int(rng.integers(0, 6)), "max_misses": int(rng.integers(0, 15)),
            "min_existence": 10 ** rng.uniform(-5, -1), "heading_sign": _heading_sign(rng),
            "birth_heading_speed": rng.choice([0.0, 1.0, 3.0]),
            "process_noise": {
                "position": rng.uniform(0.05, 0.5), "speed": rng.uniform(0.1, 2), "heading": rng.uniform(0.02, 0.3),
                "turn_rate": rng.uniform(0.05, 0.5), "acceleration": rng.uniform(0.2, 2),
            },
            "measurement_noise": {
                "position": rng.uniform(0.05, 0.6), "velocity": rng.uniform(0.2, 2), "heading": rng.uniform(0.05, 0.4),
            },
            "reported_noise": {"position": 0.06, "heading": 0.06} if rng.random() < 0.75 else None,
            "birth": {
                "position": rng.uniform(0.1, 1), "speed": rng.uniform(0.3, 3), "unknown_speed": rng.uniform(2, 8),
                "heading": rng.uniform(0.05, 0.5), "turn_rate": rng.uniform(0.05, 0.4),
                "acceleration": rng.uniform(0.2, 2),
            },
            "motion": str(rng.choice(["ctra", "cv"])), "acceleration_time": rng.choice([None, 0.5, 2.0]),
            "gate_deviations": rng.choice([0.0, 2.0]), "velocity_gate": 1.5 if seed % 2 else 0.0,
            "birth_over_clutter": bool(rng.random() < 0.5), "birth_overlap": rng.choice([0.02, 0.3, 1.0]),
            "crowded": seed % 2 == 0,
            "ground_clearance": rng.choice([0.0, 0.2]), "sure_nms_iou": 0.7 if seed % 2 else 0.0,
            "confirm_from": rng.uniform(0.3, 0.9), "confirm_until": rng.uniform(0.0, 0.3),
        }  # fmt: skip

    classes = {label: one_class() for label in labels}
    if seed % 3 == 1:
        for values in list(classes.values())[: 2 + seed % 2]:
            values |= {"group": "road users", "class_confusion": rng.uniform(0.05, 0.4)}
            values |= {"suppress_in_group": bool(seed % 2)}
            values["class_memory"] = rng.uniform(0.5, 0.99)
    if calibrated:
        for values in classes.values():
            values["calibration"] = _calibration(rng)
    detection_time = 0.1 if rng.random() < 0.5 else 0.0
    return {"name": f"random-{seed}", "nominal_period": 0.1, "detection_time": detection_time, "classes": classes}


def _heading_sign(rng: np.random.Generator) -> dict[str, Any] | None:
    values = {"memory": rng.uniform(0.2, 0.95), "detection": rng.uniform(0, 2)}
    values |= {"motion": rng.uniform(0, 2), "speed": rng.uniform(0, 2)}
    return values if rng.random() < 0.75 else None


def _calibration(rng: np.random.Generator) -> dict[str, Any]:
    knots = int(rng.integers(1, 6))
    return {
        "memory": rng.uniform(0.1, 0.95),
        "missed": rng.uniform(0, 4),
        "score_of_evidence": float(rng.choice([0.0, 0.5, 1.0])),
        "speed": 0.5,
        "turn_rate": 2.0,
        "evidence": (np.cumsum(rng.uniform(0.1, 2, knots)) - 3).tolist(),
        "existence": np.sort(rng.uniform(0, 1, knots)).tolist(),
        "along": rng.uniform(0, 1, knots).tolist(),
        "across": rng.uniform(0, 1, knots).tolist(),
        "history": None if knots % 2 else _history(knots),
    }


def _history(knots: int) -> dict[str, float]:
    return {"offset": 1.0 - knots, "existence": 0.7, "duration": 0.9, "share": 0.5 * knots, "speed": 1.1}


def boxes(  # noqa: PLR0913 - a detection has this many columns
    parameters: Parameters,
    seconds: float,
    xy: Any = (),
    *,
    yaw: Any = 0.0,
    velocity: Any = None,
    score: Any = 0.9,
    size: Any = (4.0, 1.8, 1.5),
    label: str = "Car",
    cloud: Any = None,
    pose: Any = None,
    field_of_view: Any = None,
) -> Frame:
    """A frame of boxes of one class at (x, y) and z = 0; scalars and single rows stand for all of them."""
    position = np.asarray(xy, dtype=np.float64).reshape(-1, 2)
    count = len(position)
    frame, _ = optipmb.make_frame(
        parameters,
        stamp_ns=round(seconds * 1e9),
        labels=[label],
        label=np.zeros(count, dtype=np.int64),
        center=np.column_stack([position, np.zeros(count)]),
        size=np.broadcast_to(np.asarray(size, dtype=np.float64), (count, 3)),
        yaw=np.broadcast_to(np.asarray(yaw, dtype=np.float64), (count,)),
        score=np.broadcast_to(np.asarray(score, dtype=np.float64), (count,)),
        velocity=None if velocity is None else np.broadcast_to(np.asarray(velocity, dtype=np.float64), (count, 2)),
        cloud=cloud,
        pose=pose,
        field_of_view=field_of_view,
    )
    return frame


def steps(parameters: Parameters, frames: Iterable[Frame], modules: Modules | None = None) -> list[StepResult]:
    """The results of a tracker for frames, one after the other."""
    tracker, results = optipmb.Tracker(parameters, modules), []
    density = tracker.initial()
    for frame in frames:
        results.append(tracker.step(density, frame))
        density = results[-1].density
    return results
