"""The motion of a sensor without poses: found, used and reported where it moves, and nothing where it stands."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING

import numpy as np
import pytest

import optipmb
from optipmb.learning.sensor_motion import (
    APART,
    MOST_SIDEWAYS,
    NEAR,
    TURNED,
    Pairs,
    common_motion,
    least,
    nearest,
    sideways,
    taken,
    together,
    within,
)
from optipmb.model.density import NO_FRAME

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

GENERIC = optipmb.load_profile("generic")
FIXED = GENERIC.model_copy(update={"sensor_motion": False})
PLACES = np.random.default_rng(5).uniform((0.0, -25.0), (300.0, 25.0), (60, 2))
"""Parked cars along a way of 300 m."""
HEADINGS = np.random.default_rng(6).choice([0.0, math.pi, 0.5 * math.pi], 60)
"""Along the way, either way, and across it."""


def street(
    speed: float, rate: float, *, turn: float = 0.0, moving: float = 0.0, noise: float = 0.1
) -> list[tuple[float, Array, Array]]:
    """Times, boxes (x, y, yaw) and numbers of the cars within 50 m of a sensor that drives past them, in its axes.

    With `moving` all cars drive along x at that speed. Places of boxes have white `noise`.
    """
    rng, frames = np.random.default_rng(0), []
    for k in range(int(6.0 * rate)):
        t = k / rate
        heading = turn * t
        along, across = (math.sin(heading) / heading, (1.0 - math.cos(heading)) / heading) if heading else (1.0, 0.0)
        cars = PLACES + np.array([moving * t - along * speed * t, -across * speed * t])
        yaw = np.zeros(60) if moving else HEADINGS
        cos, sin = math.cos(heading), math.sin(heading)
        local = np.column_stack((cos * cars[:, 0] + sin * cars[:, 1], cos * cars[:, 1] - sin * cars[:, 0]))
        seen = np.flatnonzero(np.hypot(*local.T) < 50.0)
        noisy = local[seen] + rng.normal(0.0, noise, (len(seen), 2))
        frames.append((t, np.column_stack((noisy, yaw[seen] - heading)), seen))
    return frames


def tracked(
    parameters: optipmb.Parameters, frames: list[tuple[float, Array, Array]]
) -> tuple[list[optipmb.OnlineTracks], dict[int, set[int]]]:
    """The tracks of each frame, and the ids of each car after the first half second."""
    tracker, found, ids = optipmb.OnlineTracker(parameters), [], dict[int, set[int]]()
    for t, boxes, cars in frames:
        count = len(boxes)
        tracks = tracker.update(
            t=t,
            center=np.column_stack((boxes[:, :2], np.zeros(count))),
            size=np.tile([4.5, 1.9, 1.6], (count, 1)),
            yaw=boxes[:, 2],
            score=np.full(count, 0.9),
            label=["car"] * count,
        )
        for identity, row in zip(tracks.id.tolist(), tracks.detection.tolist(), strict=True):
            if row >= 0 and t > 0.5:
                ids.setdefault(int(cars[row]), set()).add(identity)
        found.append(tracks)
    return found, ids


@pytest.mark.parametrize(("speed", "turn", "rate"), [(15.0, 0.0, 10.0), (15.0, 0.0, 2.0), (10.0, 0.3, 5.0)])
def test_parked_cars_keep_their_ids_and_stand(speed: float, turn: float, rate: float) -> None:
    """Past a sensor that drives straight or round a bend: one id each, and no speed; without it more ids.

    Some are parked across the way: rows along it alone would tell nothing.
    """
    frames = street(speed, rate, turn=turn)
    found, ids = tracked(GENERIC, frames)
    assert all(len(one) == 1 for one in ids.values())
    for tracks in found[max(3, int(0.5 * rate)) :]:
        assert tracks.sensor_motion is not None
        np.testing.assert_allclose(tracks.sensor_motion, [-speed, 0.0, -turn], atol=1.5)
    old = found[-1].age > 1.0
    assert np.abs(found[-1].velocity[old]).max() < 1.0
    _, without = tracked(FIXED, frames)
    assert sum(map(len, without.values())) > len(ids) or speed / rate < 2.0


def test_noisy_boxes_show_the_motion_in_the_end() -> None:
    """Errors of 0.3 m at 1.5 m a frame: the evidence of many frames is enough, none of which is clear."""
    found, _ = tracked(GENERIC, street(15.0, 10.0, noise=0.3))
    assert all(one.sensor_motion is not None for one in found[40:])


@pytest.mark.parametrize("moving", [0.0, 12.0], ids=["parked", "traffic"])
def test_a_sensor_that_stands_changes_no_byte(moving: float) -> None:
    """Neither next to parked cars nor in traffic that all drives one way, along its headings."""
    frames = street(0.0, 10.0, moving=moving)
    found, fixed = tracked(GENERIC, frames)[0], tracked(FIXED, frames)[0]
    assert all(one.sensor_motion is None for one in found)
    assert [one.tracks.words.tobytes() for one in found] == [one.tracks.words.tobytes() for one in fixed]


def crossing(rate: float, parked: int, crossing: int, flipped: str, lanes: Array) -> list[tuple[float, Array, Array]]:
    """Boxes and numbers of the cars at a crossing where a sensor stands: six approach at 12 m/s, others cross or park.

    All approach with the same speed from 40 m on, and pass. Parked cars stand along the way. Headings of none, of a
    random half or of all boxes are turned around.
    """
    rng, count = np.random.default_rng(parked + crossing), 6 + parked + crossing
    place = np.vstack(
        (
            np.column_stack((40.0 + 8.0 * np.arange(6), np.resize(lanes, 6))),
            np.column_stack((rng.uniform(6.0, 35.0, parked), rng.choice([-7.0, 7.0], parked))),
            np.column_stack((15.0 + 4.0 * (np.arange(crossing) % 2), -40.0 - 9.0 * np.arange(crossing))),
        )
    )
    speed = np.repeat([[-12.0, 0.0], [0.0, 0.0], [0.0, 9.0]], [6, parked, crossing], axis=0)
    yaw = np.r_[np.full(6, math.pi), rng.choice([0.0, math.pi], parked), np.full(crossing, 0.5 * math.pi)]
    yaw += math.pi * (rng.random(count) < {"none": 0.0, "random": 0.5, "all": 1.0}[flipped])
    yaw[yaw > math.pi] -= 2.0 * math.pi
    return [
        (
            k / rate,
            np.column_stack((place + speed * k / rate + rng.normal(0.0, 0.1, (count, 2)), yaw))
            + rng.normal(0.0, [0.0, 0.0, 0.05], (count, 3)),
            np.arange(count),
        )
        for k in range(int(12.0 * rate))
    ]


@pytest.mark.parametrize("lanes", [[-3.5], [-3.5, 3.5]], ids=["one_lane", "both_sides"])
@pytest.mark.parametrize("rate", [2.0, 10.0])
def test_traffic_that_approaches_a_standing_sensor_is_not_its_motion(rate: float, lanes: list[float]) -> None:
    """Six cars that move alike, with boxes turned either way, among parked and crossing cars."""
    for parked, across, flipped in itertools.product((0, 2, 5), (0, 4), ("none", "random", "all")):
        found, _ = tracked(GENERIC, crossing(rate, parked, across, flipped, np.array(lanes)))
        assert all(tracks.sensor_motion is None for tracks in found), (parked, across, flipped)


def test_pedestrians_that_walk_together_are_not_its_motion() -> None:
    """Neither with headings of no use: people walk any way. What people cannot do is motion of the sensor."""
    rng = np.random.default_rng(0)
    place, yaw = rng.uniform([2.0, -10.0], [22.0, 10.0], (12, 2)), rng.uniform(-math.pi, math.pi, 12)
    for speed, moves in ((1.6, False), (12.0, True)):
        tracker, density = optipmb.Tracker(GENERIC), optipmb.Tracker(GENERIC).initial()
        for k in range(15):
            boxes = np.column_stack((place - [0.1 * speed * k, 0.0] + rng.normal(0.0, 0.08, (12, 2)), yaw))
            density = tracker.step(density, frame_of(0.1 * k, boxes, label="pedestrian")).density
        assert (density.sensor_motion is not None) == moves


def test_a_sensor_that_stops_soon_stands() -> None:
    """The estimate ends where the sensor does, which moved for less than two seconds."""
    moving = street(15.0, 10.0)[:15]
    t, boxes, cars = moving[-1]
    rng = np.random.default_rng(1)
    still = [(t + 0.1 * k, boxes + rng.normal(0.0, [0.1, 0.1, 0.0], boxes.shape), cars) for k in range(1, 30)]
    found, _ = tracked(GENERIC, moving + still)
    assert found[len(moving) - 1].sensor_motion is not None
    assert found[-1].sensor_motion is None


def test_a_vehicle_that_stopped_is_known_to_move_again_at_once() -> None:
    """After six seconds of driving a stop does not end the estimate, and the next motion needs no evidence."""
    moving = street(5.0, 10.0)
    t, boxes, cars = moving[-1]
    rng = np.random.default_rng(1)
    still = [(t + 0.1 * k, boxes + rng.normal(0.0, [0.1, 0.1, 0.0], boxes.shape), cars) for k in range(1, 15)]
    on = [(t + 1.4 + 0.1 * k, boxes - [0.5 * k, 0.0, 0.0], cars) for k in range(1, 5)]
    found, _ = tracked(GENERIC, moving + still + on)
    stood, drives = (one.sensor_motion for one in (found[len(moving) + 13], found[-1]))
    assert stood is not None
    assert drives is not None
    np.testing.assert_allclose(stood, 0.0, atol=0.3)
    np.testing.assert_allclose(drives[:2], [-5.0, 0.0], atol=1.0)


@pytest.mark.parametrize("missing", [3, 40], ids=["carried_on", "ended"])
def test_a_motion_is_carried_on_over_frames_that_do_not_show_it(missing: int) -> None:
    """Boxes elsewhere, in three frames: the motion of before. In forty: a vehicle that is taken to stand."""
    moving = street(10.0, 10.0)
    rng = np.random.default_rng(2)
    others = [
        (moving[-1][0] + 0.1 * k, np.column_stack((rng.uniform(-40.0, 40.0, (20, 2)), np.zeros(20))), np.zeros(20, int))
        for k in range(1, missing + 1)
    ]
    motion = tracked(GENERIC, moving + others)[0][-1].sensor_motion
    assert motion is not None
    np.testing.assert_allclose(motion[:2], [-10.0 if missing == 3 else 0.0, 0.0], atol=2.0)


def test_evidence_that_nothing_adds_to_ends() -> None:
    """Cars that move alike for a fifth of a second and then stand: in the end nothing is kept of it."""
    tracker, (first, second, third, *_) = optipmb.Tracker(GENERIC), street(15.0, 10.0)
    density = tracker.initial()
    for t, boxes, _ in (first, second, third):
        density = tracker.step(density, frame_of(t, boxes)).density
    assert density.sensor is not None
    assert density.sensor_motion is None
    for k in range(1, 80):
        density = tracker.step(density, frame_of(third[0] + 0.1 * k, third[1])).density
    assert density.sensor is None


def test_frames_with_a_pose_are_not_estimated() -> None:
    """A given pose is used, and ends the estimate."""
    tracker = optipmb.Tracker(GENERIC)
    density = tracker.initial()
    for t, boxes, _ in street(15.0, 10.0)[:10]:
        density = tracker.step(density, frame_of(t, boxes)).density
    assert density.sensor_motion is not None
    pose = optipmb.Pose(np.array([15.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0]))
    t, boxes, _ = street(15.0, 10.0)[10]
    assert tracker.step(density, frame_of(t, boxes, pose)).density.sensor_motion is None


def test_the_estimate_is_stored_with_the_density() -> None:
    """Bytes make the same density again, which goes on with the same bytes; what no motion is, is refused by name."""
    tracker, frames = optipmb.Tracker(GENERIC), street(15.0, 10.0)
    density = tracker.initial()
    for t, boxes, _ in frames[:10]:
        density = tracker.step(density, frame_of(t, boxes)).density
    columns = optipmb.columns_in(optipmb.bytes_of(density), len(density.labels))
    again = optipmb.density_of(density.stamp_ns, density.next_id, columns, density.labels)
    following = frame_of(*frames[10][:2])
    first, second = (tracker.step(one, following).density for one in (density, again))
    assert first.stamp_ns != NO_FRAME
    assert optipmb.bytes_of(first) == optipmb.bytes_of(second)
    with pytest.raises(optipmb.DensityError, match="sensor"):
        optipmb.density_of(density.stamp_ns, density.next_id, {**columns, "sensor": np.full(5, np.nan)}, density.labels)


def frame_of(t: float, boxes: Array, pose: optipmb.Pose | None = None, label: str = "car") -> optipmb.Frame:
    """A frame of objects of one class."""
    count = len(boxes)
    return optipmb.make_frame(
        GENERIC,
        stamp_ns=round(t * 1e9),
        labels=(label,),
        label=np.zeros(count, np.int64),
        center=np.column_stack((boxes[:, :2], np.zeros(count))),
        size=np.tile([4.5, 1.9, 1.6], (count, 1)),
        yaw=boxes[:, 2],
        score=np.full(count, 0.9),
        pose=pose,
    )[0]


@pytest.mark.parametrize("seed", range(3))
def test_the_motion_is_the_rigid_fit_of_the_pairs_it_joins(seed: int) -> None:
    """Found among outliers of its class and others, for any guess; it is numpy's least squares over these pairs."""
    rng = np.random.default_rng(seed)
    start, label = rng.uniform(-40.0, 40.0, (20, 2)), rng.integers(0, 2, 20)
    true = np.array([-6.0, 0.8, 0.06]) + rng.normal(0.0, [0.5, 0.2, 0.01])
    target = np.vstack((taken(start, true)[:14] + rng.normal(0.0, 0.05, (14, 2)), rng.uniform(-40.0, 40.0, (8, 2))))
    order = target[:, 0].argsort()
    target, target_label = target[order], np.r_[label[:14], rng.integers(0, 2, 8)][order]
    pairs = Pairs(start, label, target, target_label)
    motion, count, cost = common_motion(pairs, np.zeros(3), 10.0, 0.15, 0.0)
    np.testing.assert_allclose(motion, true, atol=0.1)
    assert count >= 14

    moved = taken(start, motion)
    distance = np.hypot(*(moved[:, None] - target[None]).transpose(2, 0, 1))
    distance[label[:, None] != target_label[None]] = np.inf
    rows = np.flatnonzero(distance.min(axis=1) < NEAR)
    held = np.maximum(0.0, 1.0 - distance.min(axis=1) ** 2 / NEAR**2)
    np.testing.assert_allclose(together(pairs, motion), held, atol=1e-12)
    np.testing.assert_allclose(cost, 20.0 - held.sum())
    assert count == len(rows)
    assert [nearest(*moved[n], label[n], target, target_label, NEAR**2)[0] for n in rows] == distance[rows].argmin(
        axis=1
    ).tolist()

    # The fit of complex numbers: q = e^{i theta} p + t
    p, q = start[rows] @ [1, 1j], target[distance[rows].argmin(axis=1)] @ [1, 1j]
    theta = np.angle(((p - p.mean()).conj() * (q - q.mean())).sum())
    shift = q.mean() - np.exp(1j * theta) * p.mean()
    np.testing.assert_allclose(motion, [shift.real, shift.imag, theta], atol=1e-9)


@pytest.mark.parametrize("count", [0, 1, 5, 40])
def test_the_least_values_come_in_their_order(count: int) -> None:
    """By numpy's stable sort, equal values among them; those that are infinite do not."""
    value = np.random.default_rng(count).integers(0, 6, count).astype(float)
    value[value == 5.0] = np.inf
    wanted = [row for row in np.argsort(value, kind="stable").tolist() if value[row] < np.inf]
    assert [least(value, most).tolist() for most in (1, 7, 64)] == [wanted[:most] for most in (1, 7, 64)]


def test_all_pairs_that_a_motion_may_bring_together_are_near() -> None:
    """Of one class, under any motion within reach and turn of the guess."""
    rng, guess = np.random.default_rng(1), np.array([1.0, -2.0, 0.1])
    start, target = rng.uniform(-40.0, 40.0, (30, 2)), rng.uniform(-40.0, 40.0, (30, 2))
    label = rng.integers(0, 2, 30)
    pairs = Pairs(start, label, target[target[:, 0].argsort()], label)
    near, brought = set(map(tuple, within(pairs, guess, 3.0, 0.05).tolist())), set[tuple[int, int]]()
    for _ in range(200):
        moved = taken(start, guess + rng.uniform(-1.0, 1.0, 3) * [0.0, 0.0, 0.05])
        apart = np.abs(pairs.target[None] - moved[:, None]).max(axis=2)
        brought |= set(map(tuple, np.argwhere((apart <= 3.0) & (label[:, None] == label[None])).tolist()))
    assert brought <= near < set(itertools.product(range(30), range(30)))


def test_few_points_follow_the_guess() -> None:
    """A guess that is trusted weighs in the fit as so many points; without points it is the motion."""
    guess, label = np.array([-1.0, 0.1, 0.02]), np.zeros(1, np.int64)
    start = np.array([[20.0, 5.0]])
    alone = common_motion(Pairs(start, label, start + 500.0, label), guess, 1.0, 0.05, 4.0)
    np.testing.assert_allclose(alone[0], guess, atol=1e-12)
    assert (alone[1], alone[2]) == (0, 1.0)
    off = taken(start, guess) + np.array([0.5, 0.0])
    drawn = common_motion(Pairs(start, label, off, label), guess, 1.0, 0.0, 4.0)[0]
    assert 0.0 < math.hypot(*(taken(start, drawn) - taken(start, guess))[0]) < 0.5


def test_sideways_is_the_least_distance_to_where_an_object_can_drive() -> None:
    """In numpy over all pairs: across the axis and beyond the reach of a vehicle, beyond the circle of a walker."""
    rng = np.random.default_rng(3)
    start, target = rng.uniform(-5.0, 5.0, (20, 2)), rng.uniform(-5.0, 5.0, (15, 2))
    label, target_label = rng.integers(0, 3, 20), rng.integers(0, 2, 15)
    heading, reach, walks = rng.uniform(-math.pi, math.pi, 20), rng.uniform(0.1, 2.0, 20), rng.random(20) < 0.5
    axis = np.exp(1j * heading)
    apart = ((target[None] - start[:, None]) @ [1, 1j]) * axis.conj()[:, None]
    along = np.where(walks[:, None], np.abs(apart), np.abs(apart.real))
    across = np.where(walks[:, None], 0.0, apart.imag)
    squared = across**2 + np.maximum(along - reach[:, None], 0.0) ** 2
    turned = np.where(walks[:, None], 0.0, TURNED * np.minimum(along, reach[:, None]))
    cost = np.where(label[:, None] == target_label[None], 0.5 * squared / (APART**2 + turned**2), np.inf)
    ahead = np.column_stack((axis.real, axis.imag))
    found = sideways(Pairs(start, label, target, target_label), ahead, reach, walks)
    np.testing.assert_allclose(found, np.minimum(cost.min(axis=1), MOST_SIDEWAYS), atol=1e-12)
