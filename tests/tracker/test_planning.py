"""What a planner relies on: speeds under hard braking, and of parked cars that are missed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

import optipmb

if TYPE_CHECKING:
    from numpy.typing import NDArray

DT = 0.1


def followed(place: NDArray[np.float64], noise: float, seed: int, profile: str = "kitti") -> list[optipmb.Tracks]:
    """The tracks of a car whose centre is x, detected with noise at 10 Hz."""
    rng, tracker, found = np.random.default_rng(seed), optipmb.OnlineTracker(profile), []
    for k, x in enumerate(place):
        centre = [x + noise * rng.normal(), noise * rng.normal(), 0.0]
        boxes: Any = {"center": [centre], "size": [[4.2, 1.8, 1.5]], "yaw": [0.02 * rng.normal()], "score": [0.95]}
        found.append(tracker.update({**boxes, "label": ["Car"]}, t=DT * k))
    return found


def test_hard_braking_is_followed() -> None:
    """At 15 m/s and 8 m/s^2 the published speed is off by 1.3 m/s in the root mean square at most."""
    speed = np.concatenate([np.full(30, 15.0), np.clip(15.0 - 8.0 * DT * np.arange(50), 0.0, None)])
    place = np.concatenate([[0.0], np.cumsum(0.5 * DT * (speed[1:] + speed[:-1]))])
    for seed in range(3):
        found = followed(place, 0.1, seed)
        error = np.array([one.velocity[0, 0] for one in found[30:]]) - speed[30:]
        assert np.sqrt(np.mean(error**2)) < 1.3


@pytest.mark.parametrize(("turn", "same"), [(0.0, True), (0.1, True), (0.9, False), (1.5, False)])
@pytest.mark.parametrize(("profile", "label"), [("generic", "car"), ("kitti", "Car")])
def test_a_missed_car_is_not_its_neighbour(profile: str, label: str, turn: float, *, same: bool) -> None:
    """At 2 Hz an object seen once may be 8 m ahead in the next frame, unless the box there heads another way."""
    tracker = optipmb.OnlineTracker(profile)
    found = []
    for k, x in enumerate((0.0, 8.0)):
        boxes: Any = {"center": [[x, 0.3, 0.0]], "size": [[4.2, 1.8, 1.5]], "yaw": [turn * k], "score": [0.95]}
        found.append(tracker.update({**boxes, "label": [label]}, t=0.5 * k))
    assert (found[0].id.tolist() == found[1].id.tolist()) == same
