"""Whether the filter knows how well it knows: NEES over simulated drives that follow its own model."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import oracle_formulas as textbook
import pytest

import optipmb
from optipmb.motion import predict_state
from optipmb.table import ClassTable
from optipmb.update import linearised_update, ukf_update, workspace

DRIVES, FRAMES, SETTLED = 80, 20, 2
FACING = np.array([1.0, 1.0, -1.0, 1.0, 1.0, -1.0])


def nees(label: str, missed: float, linearisations: int, seed: int = 0) -> float:
    """Mean NEES / 6 of a class of `nuscenes-paper` with measured velocities; the sign of the heading does not count."""
    parameters = optipmb.load_profile("nuscenes-paper")
    table, c, dt = ClassTable.of(parameters), parameters.labels.index(label), parameters.nominal_period
    rng = np.random.default_rng(seed)
    own: Any = table.classes[c]
    still, drift = own.copy(), own["process_noise"]
    still["process_noise"] = 1e-9 * drift
    spread = [own["noise_position"]] * 2 + [own["noise_velocity"]] * 2 + [own["noise_heading"]]
    sigma = np.array([*spread, 0.0])
    buffers = np.empty((6, 6)), np.empty((12, 6))
    found = []
    for _ in range(DRIVES):
        mean = np.array([0.0, 0.0, rng.uniform(0, 1.5 if label == "pedestrian" else 12), rng.uniform(-3, 3), 0, 0])
        covariance = np.diag(own["birth_known"] ** 2)
        x = mean + own["birth_known"] * rng.normal(size=6)
        for k in range(FRAMES):
            after, spoiled = np.empty(6), np.empty((6, 6))
            predict_state(x, 1e-12 * np.eye(6), dt, still, *buffers, after, spoiled)
            x = after + drift * math.sqrt(dt) * rng.normal(size=6)
            m, p = np.empty(6), np.empty((6, 6))
            predict_state(mean, covariance, dt, own, *buffers, m, p)
            mean, covariance = m, p
            if rng.random() >= missed:
                z = textbook.measure(x, with_velocity=True) + sigma[:5] * rng.normal(size=5)
                m, p = np.empty(6), np.empty((6, 6))
                if linearisations:
                    linearised_update(mean, covariance, z, sigma, linearisations, workspace(), m, p)
                else:
                    ukf_update(mean, covariance, z, sigma, workspace(), m, p)
                mean, covariance = m, p
            error = mean - x
            if math.cos(error[3]) < 0.0:
                error = mean - FACING * x
                error[3] += math.pi
            error[3] = textbook.wrap(error[3])
            if k >= SETTLED:
                found.append(float(error @ np.linalg.solve(covariance, error)) / 6.0)
    return float(np.mean(found))


@pytest.mark.parametrize(
    ("label", "missed"),
    [
        *((label, missed) for label in ("car", "bicycle", "bus", "motorcycle") for missed in (0.0, 0.3)),
        ("pedestrian", 0.0),
    ],
)
def test_linearised_updates_are_consistent(label: str, missed: float) -> None:
    """NEES / 6 is between 0.7 and 1.5, with every frame and with three in ten missed."""
    assert 0.7 < nees(label, missed, 3) < 1.5


def test_the_unscented_update_is_not() -> None:
    """What the linearised update is for: with pedestrians' headings the paper's filter is off many times over."""
    assert nees("pedestrian", 0.0, 0) > 5.0
