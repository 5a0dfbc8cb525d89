"""The box that a track reports: nearer to its detection than the state is (not in the paper).

The state rests on measurement noise R that is larger than a detector's usual error: a half-hidden car's box that jumps
back for a few frames, and returns, then stays one track. The box that a receiver acts on need not be as doubtful. It
is the estimate with a smaller noise R' of position and heading from the same prediction. As the posterior (m, P) has
used the detection with R already, that is one more update of it, by the same z, with the noise that is left:

    R_x^-1 = R'^-1 - R^-1,    G = P_bb (P_bb + R_x)^-1,    b = (x, y, phi)
    m_b + G nu,    (I - G) P_bb,    (I - G) P_bo;          nu_phi modulo pi, as in `optipmb.update`

Speed, turn rate and acceleration, o, stay as they are (the gain of a Schmidt-Kalman filter), and nothing goes back into
the recursion. A missed object reports its state, and so does a class without `reported_noise`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from optipmb.compiled import kernel
from optipmb.density import PHI, STATE, X, Y
from optipmb.motion import wrap

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

BOX: Final = (X, Y, PHI)
"""The entries of the state that a box shows, b."""


@kernel
def follow_box(
    x: float,
    y: float,
    yaw: float,
    variance_x: float,
    variance_y: float,
    heading: float,
    mean: Array,
    covariance: Array,
) -> None:
    """Update the box of a state, in place, with its detection once more.

    R_x is diagonal, so that the entries of z can be taken one after the other, each with a scalar innovation variance.

    Args:
        x: z_x, m.
        y: z_y, m.
        yaw: z_phi, rad.
        variance_x: variance that R_x leaves for z_x, m^2; zero leaves the state as it is.
        variance_y: for z_y, m^2; likewise.
        heading: for z_phi, rad^2; likewise.
        mean: (6,) posterior mean m.
        covariance: (6, 6) posterior covariance P.
    """
    yaw = mean[PHI] + 0.5 * wrap(2.0 * (yaw - mean[PHI]))
    for s in BOX:
        if s == PHI:
            variance = heading
            innovation = yaw - mean[PHI]
        else:
            variance = variance_x if s == X else variance_y
            innovation = (x if s == X else y) - mean[s]
        if variance == 0.0:
            continue
        total = covariance[s, s] + variance
        shift = (covariance[X, s] / total, covariance[Y, s] / total, covariance[PHI, s] / total)
        for i in range(len(BOX)):
            mean[BOX[i]] += shift[i] * innovation
        for t in range(STATE):
            of_row = covariance[s, t]
            for i in range(len(BOX)):
                covariance[BOX[i], t] -= shift[i] * of_row
        for b in BOX:
            for t in range(STATE):
                covariance[t, b] = covariance[b, t]
    mean[PHI] = wrap(mean[PHI])
