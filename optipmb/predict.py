"""PMB prediction (Section IV.C, eq. PPP_prediction and MB_prediction)."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from optipmb.density import NO_FRAME, Density, whole_periods
from optipmb.motion import predict_states

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb.table import ClassTable

    Array = NDArray[np.float64]


def predict(density: Density, stamp_ns: int, table: ClassTable) -> tuple[Density, int]:
    """Carry the density from its stamp to `stamp_ns`.

    Means and covariances follow the CTRA model. The survival probability p_s holds for one nominal period of the
    stream: over dt it is ``p_s ** (dt / period)``, so that a stream at twice the rate does not forget twice as fast.
        Components that a silent stream
    has carried past their limits (`max_misses`, `poisson_steps`) are removed before they could be associated.

    Args:
        density: posterior of the last frame.
        stamp_ns: stamp of the new frame, not before that of the density.
        table: parameters as columns.

    Returns:
        The predicted density and how many covariances had to be repaired.
    """
    if density.stamp_ns == NO_FRAME:
        return replace(density, stamp_ns=stamp_ns), 0
    dt = (stamp_ns - density.stamp_ns) * 1e-9
    if dt == 0.0:
        return density, 0
    bernoulli, poisson = density.bernoulli, density.poisson
    # The frame at hand may still bring the detection that is missing, hence one period less.
    silent = whole_periods(bernoulli.seen_ns, stamp_ns, table.period) - 1 > table.max_misses[bernoulli.label]
    if silent.any():
        bernoulli = bernoulli.take(~silent)
    stale = whole_periods(poisson.born_ns, stamp_ns, table.period) - 1 > table.poisson_steps[poisson.label]
    if stale.any():
        poisson = poisson.take(~stale)
    survival = table.survival ** (dt / table.period)

    mean, covariance, repaired_mb = _carry(bernoulli.mean, bernoulli.covariance, bernoulli.label, dt, table)
    bernoulli = replace(
        bernoulli, mean=mean, covariance=covariance, existence=bernoulli.existence * survival[bernoulli.label]
    )
    mean, covariance, repaired_ppp = _carry(poisson.mean, poisson.covariance, poisson.label, dt, table)
    poisson = replace(poisson, mean=mean, covariance=covariance, weight=poisson.weight * survival[poisson.label])
    predicted = Density(stamp_ns=stamp_ns, next_id=density.next_id, bernoulli=bernoulli, poisson=poisson)
    return predicted, repaired_mb + repaired_ppp


def _carry(
    mean: Array, covariance: Array, label: NDArray[np.int64], dt: float, table: ClassTable
) -> tuple[Array, Array, int]:
    mean_out, covariance_out = np.empty_like(mean), np.empty_like(covariance)
    repaired = predict_states(mean, covariance, label, dt, table.process_noise, mean_out, covariance_out)
    return mean_out, covariance_out, repaired
