"""Whether the filter knows how well it knows: NEES over simulated drives that follow its own model."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import oracle_formulas as textbook
import pytest

import optipmb
from optipmb.linearised import linearised_update
from optipmb.motion import predict_state
from optipmb.table import ClassTable
from optipmb.update import ukf_update, workspace

DRIVES, FRAMES, SETTLED = 80, 20, 2
FACING, HALF_TURN = np.array([1.0, 1.0, -1.0, 1.0, 1.0, -1.0]), np.array([0.0, 0.0, 0.0, math.pi, 0.0, 0.0])


def nees(label: str, missed: float, linearisations: int, seed: int = 0) -> float:
    """Mean NEES / 6 of a class of `nuscenes-paper` with measured velocities.

    A state and the one with the opposite heading describe the same motion; that with the smaller NEES counts.
    """
    parameters = optipmb.load_profile("nuscenes-paper")
    table, c, dt = ClassTable.of(parameters), parameters.labels.index(label), parameters.nominal_period
    rng = np.random.default_rng(seed)
    own: Any = table.classes[c]
    own["linearisations"] = linearisations
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
            if k >= SETTLED:
                errors = [mean - x, mean - FACING * x + HALF_TURN]
                for error in errors:
                    error[3] = textbook.wrap(error[3])
                found.append(min(float(e @ np.linalg.solve(covariance, e)) for e in errors) / 6.0)
    return float(np.mean(found))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("missed", [0.0, 0.3])
@pytest.mark.parametrize("label", optipmb.load_profile("nuscenes-paper").labels)
def test_linearised_updates_are_consistent(label: str, missed: float, seed: int) -> None:
    """NEES / 6 is between 0.7 and 1.5 for every class, with every frame and with three in ten missed."""
    assert 0.7 < nees(label, missed, 3, seed) < 1.5


def test_the_unscented_update_is_not() -> None:
    """What the linearised update is for: with pedestrians' headings the paper's filter is off many times over."""
    assert nees("pedestrian", 0.0, 0) > 5.0
