"""Statistics that a few gross errors do not carry away, and local fits of trajectories.

Detections and labels are wrong in a few places by much: a robust spread says how large the usual error is, and a
winsorised one, in which no error counts for more than three usual ones, what a filter should expect.
"""

from dataclasses import dataclass

import numpy as np

from optipmb_client.geometry import Floats, Ints

__all__ = ["Motion", "fit_motion", "spread", "usual"]

_NORMAL = 1.482602218505602
"""Standard deviation of a Gaussian in units of its median absolute value."""
_REACH = 3.0
_LEAST_POINTS = 4


def usual(errors: Floats) -> float:
    """Return the standard deviation that a Gaussian with the same median absolute value has; NaN without errors."""
    return float(_NORMAL * np.median(np.abs(errors))) if errors.size else float("nan")


def spread(errors: Floats) -> float:
    """Return the root mean square of errors of which none counts for more than three usual ones; NaN without errors."""
    if not errors.size:
        return float("nan")
    limit = _REACH * usual(errors)
    return float(np.sqrt(np.mean(np.minimum(np.abs(errors), limit) ** 2)))


@dataclass(frozen=True)
class Motion:
    """What an object did, at the middles of windows of time that do not overlap."""

    time: Floats
    """(W,) s"""
    speed: Floats
    """(W,) along the heading, m/s"""
    acceleration: Floats
    """(W,) along the heading, m/s^2"""
    heading: Floats
    """(W,) rad, unwrapped"""
    turn_rate: Floats
    """(W,) rad/s"""
    variance: Floats
    """(W, 4) of the errors of speed, acceleration, heading and turn rate that the scatter of the points leaves"""


def fit_motion(time: Floats, position: Floats, yaw: Floats, window: float) -> Motion:
    """Fit polynomials to pieces of a trajectory: quadratic ones to the position, straight lines to the heading.

    Args:
        time: (R,) s, ascending.
        position: (R, 2) m.
        yaw: (R,) rad.
        window: length of a piece, s; pieces with fewer than four points are left out.

    """
    turned = np.unwrap(yaw)
    piece: Ints = np.floor((time - time[0]) / window + 1e-9).astype(np.int64)
    rows = []
    for which in np.unique(piece).tolist():
        use = piece == which
        if use.sum() < _LEAST_POINTS:
            continue
        middle = time[0] + (which + 0.5) * window
        rows.append((middle, *_fit(time[use] - middle, position[use], turned[use])))
    table = np.array(rows, dtype=np.float64).reshape(len(rows), 9)
    return Motion(table[:, 0], table[:, 1], table[:, 2], table[:, 3], table[:, 4], table[:, 5:])


def _fit(time: Floats, position: Floats, yaw: Floats) -> tuple[float, ...]:
    """Return speed, acceleration, heading, turn rate at time 0, and the variances of the four."""
    count = len(time)
    square = np.column_stack([np.ones(count), time, 0.5 * time**2])
    inverse = np.linalg.inv(square.T @ square)
    path = inverse @ square.T @ position
    scatter = float(((position - square @ path) ** 2).sum()) / max(1, 2 * (count - 3))
    straight = square[:, :2]
    inverse_yaw = np.linalg.inv(straight.T @ straight)
    turn = inverse_yaw @ straight.T @ yaw
    scatter_yaw = float(((yaw - straight @ turn) ** 2).sum()) / max(1, count - 2)
    ahead = np.array([np.cos(turn[0]), np.sin(turn[0])])
    return (
        float(path[1] @ ahead),
        float(path[2] @ ahead),
        float(turn[0]),
        float(turn[1]),
        scatter * float(inverse[1, 1]),
        scatter * float(inverse[2, 2]),
        scatter_yaw * float(inverse_yaw[0, 0]),
        scatter_yaw * float(inverse_yaw[1, 1]),
    )
