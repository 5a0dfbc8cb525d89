"""How accurate the position of a detection is, where the detector says so (not in the paper).

R of a class has sigma^2 for x and for y, the same for all its detections (eq. Single Object Measurement Model). A
detection may bring a covariance of its own, R_xy. It is kept relative to that of the class, rho = R_xy / sigma^2, in
the columns behind a measured position. All that a profile says beside sigma scales with it: the innovation covariance
is S = P_xy + sigma^2 rho, R has sigma^2 rho, the birth covariance P^0 has its variance of x and y times rho, and R_x of
`optipmb.reported` its own times rho_xx and rho_yy. The gate widens by the larger variance that rho adds
(`optipmb.gating.gate_widening`). With rho = I everything is as without, to the last bit.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from optipmb.errors import FrameError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

PLAIN: Final = 2
"""Columns of measured positions, x and y; five with rho_xx, rho_xy and rho_yy."""

LEAST_VARIANCE: Final = 1e-8
"""Least variance of a position along any axis, m^2."""

LARGEST_VARIANCE: Final = 1e8
"""Largest variance, m^2."""

SYMMETRY: Final = 1e-6
"""Share of the largest variance by which opposite entries may differ: those of float32 do."""


def horizontal_covariance(covariance: Array, rotation: Array | None) -> Array:
    """Check covariances of positions and return those of x and y in the world.

    Args:
        covariance: (M, 3, 3) of x, y and z along the axes of the arrays, m^2; of NaN where unknown.
        rotation: (3, 3) from these axes to the world; None: they are those of the world.

    Returns:
        (M, 3) variance of x, covariance of x and y, variance of y; NaN where unknown.

    Raises:
        FrameError: one is not symmetric, or a variance along some axis is out of bounds; names the object.
    """
    unknown: NDArray[np.bool_] = np.all(np.isnan(covariance), axis=(1, 2))
    known = np.where(unknown[:, None, None], np.eye(3), covariance)
    expected = (
        f"a symmetric covariance with variances from {LEAST_VARIANCE:g} to {LARGEST_VARIANCE:g} m^2 along every axis"
    )
    good: NDArray[np.bool_] = np.all(np.abs(known) <= LARGEST_VARIANCE, axis=(1, 2))  # NaN is not
    known[~good] = 0.0
    difference = np.abs(known - known.transpose(0, 2, 1)).max(axis=(1, 2))
    known = 0.5 * (known + known.transpose(0, 2, 1))
    good &= difference <= SYMMETRY * known.max(axis=(1, 2))
    variance = np.linalg.eigvalsh(known)
    good &= (variance[:, 0] >= LEAST_VARIANCE) & (variance[:, 2] <= LARGEST_VARIANCE)
    if not good.all():
        row = int(np.argmin(good))
        raise FrameError(f"position_covariance[{row}]", expected, str(covariance[row].tolist())[:200])
    if rotation is not None:
        known = rotation @ known @ rotation.T
    horizontal = np.column_stack((known[:, 0, 0], known[:, 0, 1], known[:, 1, 1]))
    horizontal[unknown] = np.nan
    return horizontal


def semidefinite(horizontal: Array) -> NDArray[np.bool_]:
    """Tell which rows (M, 3) of R_xx, R_xy and R_yy can be those of a covariance, up to rounding, or are of NaN."""
    xx, xy, yy = horizontal.T
    good = (xx > 0.0) & (yy > 0.0) & (xy * xy <= (1.0 + SYMMETRY) * xx * yy) & (np.maximum(xx, yy) < np.inf)
    return np.asarray(good | np.isnan(horizontal).all(axis=1), np.bool_)
