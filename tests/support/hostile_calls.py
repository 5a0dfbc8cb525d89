"""Calls of the public API with good and bad arguments, a program of its own: `NUMBA_BOUNDSCHECK=1 python …`.

With any input a call returns or raises an `OptipmbError`. Everything is drawn from fixed seeds.
"""

import sys
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
from numba import config
from scenes import Options, frame_of, random_parameters, scene

import optipmb

LABELS = ("Car", "Pedestrian", "Cyclist")
PROFILES = tuple(optipmb.load_profile(name) for name in ("kitti", "nuscenes"))


def scenes_through_trackers(seed: int) -> None:
    """Random scenes under random profiles, modules on and off, with clouds and without."""
    rng = np.random.default_rng(seed)
    parameters = optipmb.parse_parameters(random_parameters(seed, LABELS, calibrated=bool(seed % 2)))
    options = Options(
        labels=LABELS,
        frames=12,
        objects=int(rng.choice([0, 1, 40, 120])),
        extent=float(rng.choice([5.0, 200.0])),
        velocity=str(rng.choice(["known", "none", "mixed"])),
        clutter=float(rng.choice([0.0, 200.0])),
    )
    tracker = optipmb.Tracker(parameters, optipmb.Modules(*(bool(flag) for flag in rng.random(4) < 0.7)))
    density = tracker.initial()
    for given in scene(seed, options):
        result = tracker.step(density, frame_of(parameters, given))
        assert optipmb.sound(result.tracks)
        density = result.density
        columns = optipmb.columns_of(density)
        again = optipmb.density_of(density.stamp_ns, density.next_id, columns, density.labels)
        assert len(again.bernoulli) == len(density.bernoulli)


def frames_of_other_profiles(seed: int) -> None:
    """Frames and densities of one profile given to trackers of another."""
    one, other = PROFILES[seed % 2], PROFILES[1 - seed % 2]
    options = Options(labels=one.labels, frames=4)
    tracker, stranger = optipmb.Tracker(one), optipmb.Tracker(other)
    density = tracker.initial()
    for given in scene(seed, options):
        frame = frame_of(one, given)
        for before in (stranger.initial(), density):
            try:
                stranger.step(before, frame)
            except optipmb.FrameError:
                continue
            raise AssertionError("a frame of other classes went through")
        density = tracker.step(density, frame).density


def odd(rng: np.random.Generator, shape: tuple[int, ...]) -> Any:
    """Numbers of all magnitudes, and shapes that are a little wrong now and then."""
    if shape and rng.random() < 0.15:
        shape = (*shape[:-1], max(0, shape[-1] + int(rng.integers(-1, 2))))
    values = rng.normal(0, 1, shape) * 10.0 ** rng.integers(-12, 9)
    if values.size and rng.random() < 0.2:
        values.flat[int(rng.integers(values.size))] = rng.choice([np.nan, np.inf, -np.inf, 1e300, 0.0])
    return values


def odd_frames(seed: int) -> None:
    """`make_frame` with numbers of any kind; accepted frames are tracked over any time."""
    rng = np.random.default_rng(seed)
    parameters = PROFILES[seed % 2]
    tracker = optipmb.Tracker(parameters)
    density, stamp = tracker.initial(), 0
    for _ in range(30):
        count = int(rng.integers(0, 5))
        stamp += int(rng.choice([0, 1, 10**8, 10**9, 10**12, 10**17]))
        arguments: dict[str, Any] = {
            "labels": parameters.labels,
            "label": rng.integers(-1 if rng.random() < 0.1 else 0, len(parameters.labels), count),
            "center": odd(rng, (count, 3)),
            "size": np.abs(odd(rng, (count, 3))),
            "yaw": odd(rng, (count,)),
            "velocity": odd(rng, (count, 2)) if rng.random() < 0.5 else None,
            "score": rng.choice([0.0, 1e-300, 0.3, 0.9, 1.0], count),
        }
        with suppress(optipmb.OptipmbError):
            pose = optipmb.Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
            xyz = odd(rng, (50, 3)).astype(np.float32)
            cloud = optipmb.PointCloud(xyz, pose) if rng.random() < 0.5 else None
            frame, _ = optipmb.make_frame(parameters, stamp_ns=stamp, cloud=cloud, **arguments)
            density = tracker.step(density, frame).density


def odd_densities(seed: int) -> None:
    """Densities with a column changed at random; they are refused or stepped."""
    rng = np.random.default_rng(seed)
    parameters = PROFILES[0]
    tracker = optipmb.Tracker(parameters)
    frames = [frame_of(parameters, given) for given in scene(seed, Options(labels=parameters.labels, frames=6))]
    density = tracker.initial()
    for frame in frames[:-1]:
        density = tracker.step(density, frame).density
    for _ in range(20):
        part = str(rng.choice(["bernoulli", "poisson"]))
        rows = getattr(density, part)
        name, column = list(rows.columns())[int(rng.integers(0, len(list(rows.columns()))))]
        kind = int(rng.integers(0, 4))
        if kind == 0:
            column = column[: len(column) // 2]
        elif kind == 1:
            column = np.concatenate([column, column])
        elif column.dtype == np.float64:
            column = column * 10.0 ** rng.integers(-10, 10)
            column[rng.random(column.shape) < 0.05] = rng.choice([np.nan, np.inf, -1.0, 0.0, 1e300])
        else:
            column = column + int(rng.integers(-5, 6))
        with suppress(optipmb.OptipmbError):
            tracker.step(replace(density, **{part: rows.replaced(**{name: column})}), frames[-1])


def odd_boxes(seed: int) -> None:
    """Points in boxes and overlaps of boxes, of any place and shape."""
    rng = np.random.default_rng(seed)
    pose = optipmb.Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
    for _ in range(20):
        count = int(rng.integers(0, 6))
        with suppress(optipmb.OptipmbError):
            cloud = optipmb.PointCloud(odd(rng, (200, 3)).astype(np.float32), pose)
            optipmb.points_in_boxes(cloud, odd(rng, (count, 3)), np.abs(odd(rng, (count, 3))), odd(rng, (count,)))
        with suppress(optipmb.OptipmbError):
            optipmb.bev_iou(odd(rng, (count, 5)), odd(rng, (count, 5)))


if __name__ == "__main__":
    assert config.BOUNDSCHECK, "run with NUMBA_BOUNDSCHECK=1"
    np.seterr(all="ignore")
    for number in range(10):
        scenes_through_trackers(number)
    for number in range(6):
        frames_of_other_profiles(number)
        odd_frames(number)
        odd_densities(number)
        odd_boxes(number)
    sys.stdout.write("kernels with bounds checks: no index beyond an array\n")
