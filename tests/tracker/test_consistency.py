"""Whether the filter knows how well it knows: NEES over simulated drives that follow its own model."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import oracle_formulas as textbook
import pytest

import optipmb
from optipmb.filter.predict import predict_state
from optipmb.filter.update import ukf_update, workspace
from optipmb.model.table import ClassTable

DRIVES, FRAMES, SETTLED = 80, 20, 2
FACING, HALF_TURN = np.array([1.0, 1.0, -1.0, 1.0, 1.0, -1.0]), np.array([0.0, 0.0, 0.0, math.pi, 0.0, 0.0])


def nees(label: str, missed: float, seed: int) -> float:
    """Mean NEES / 6 of a class of `nuscenes-paper` with measured velocities.

    A state and the one with the opposite heading describe the same motion; that with the smaller NEES counts.
    """
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
            predict_state(x, 1e-12 * np.eye(6), dt, still, buffers, after, spoiled)
            x = after + drift * math.sqrt(dt) * rng.normal(size=6)
            m, p = np.empty(6), np.empty((6, 6))
            predict_state(mean, covariance, dt, own, buffers, m, p)
            mean, covariance = m, p
            if rng.random() >= missed:
                z = textbook.measure(x, with_velocity=True) + sigma[:5] * rng.normal(size=5)
                m, p = np.empty(6), np.empty((6, 6))
                ukf_update(mean, covariance, z, sigma, workspace(), m, p)
                mean, covariance = m, p
            if k >= SETTLED:
                errors = [mean - x, mean - FACING * x + HALF_TURN]
                for error in errors:
                    error[3] = textbook.wrap(error[3])
                found.append(min(float(e @ np.linalg.solve(covariance, e)) for e in errors) / 6.0)
    return float(np.mean(found))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("label", ["bus", "car", "trailer", "truck"])
def test_updates_are_consistent_where_headings_are_known(label: str, seed: int) -> None:
    """NEES / 6 of large vehicles, whose headings are known to half a radian, is between 0.7 and 1.5."""
    assert 0.7 < nees(label, 0.0, seed) < 1.5


def test_updates_claim_too_much_where_headings_are_hardly_known() -> None:
    """A limit of twelve sigma points: with headings known to a radian, pedestrians' NEES / 6 is several times one."""
    assert nees("pedestrian", 0.0, 0) > 5.0
