"""PMB prediction (Section IV.C, eq. PPP_prediction and MB_prediction)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from optipmb.compiled import kernel
from optipmb.density import NO_FRAME, STATE, Bernoullis, Density, Poissons, whole_periods
from optipmb.motion import predict_state
from optipmb.records import INDEX

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb.table import ClassTable

    Array = NDArray[np.float64]
    Index = NDArray[np.int64]


LONGEST_STEP_S: Final = 6.0
"""Longest time between two frames, s, over which an object is followed although its class forgets it sooner."""


def predict(density: Density, stamp_ns: int, table: ClassTable) -> tuple[Density, int]:
    """Carry the density from its stamp to `stamp_ns`.

    Means and covariances follow the motion model of the class. The survival probability p_s holds for one nominal
    period of the stream: over dt it is ``p_s ** (dt / period)``, so that a stream at twice the rate does not forget
    twice as fast.
    Components that a silent stream has carried past their limits (`max_misses`, `poisson_steps`) are removed before
    they could be associated, but for what the last frame has seen: in a slow stream it lives until the next look. That
    holds for components whatever the time, for objects up to `LONGEST_STEP_S`.

    Args:
        density: posterior of the last frame.
        stamp_ns: stamp of the new frame, not before that of the density.
        table: parameters as columns.

    Returns:
        The predicted density and how many covariances had to be repaired.
    """
    bernoulli, poisson, misses = density.bernoulli, density.poisson, density.misses
    dt = 0.0 if density.stamp_ns == NO_FRAME else (stamp_ns - density.stamp_ns) * 1e-9
    if dt == 0.0:
        return Density(stamp_ns, density.next_id, bernoulli, poisson, density.labels, density.misses), 0
    survival = table.survival ** (dt / table.period)

    before_ns = density.stamp_ns
    seen_from_ns = before_ns if dt <= LONGEST_STEP_S else stamp_ns
    kept, mean, covariance, existence, repaired_mb = _carry(
        bernoulli,
        bernoulli.existence,
        density.missed_from_ns,
        table.max_misses,
        survival,
        dt,
        seen_from_ns,
        stamp_ns,
        table,
    )
    if kept.shape[0] < len(bernoulli):
        bernoulli = bernoulli.take(kept)
        misses = None if misses is None else misses.take(kept)
    bernoulli = Bernoullis(
        mean,
        covariance,
        existence,
        bernoulli.label,
        bernoulli.auxiliary,
        bernoulli.id,
        bernoulli.born_ns,
        bernoulli.seen_ns,
        bernoulli.score,
        bernoulli.evidence,
        bernoulli.heading_odds,
        bernoulli.extracted,
        bernoulli.confirmed,
    )
    if not len(poisson):
        return Density(stamp_ns, density.next_id, bernoulli, poisson, density.labels, misses), repaired_mb
    kept, mean, covariance, weight, repaired_ppp = _carry(
        poisson, poisson.weight, poisson.born_ns, table.poisson_steps, survival, dt, before_ns, stamp_ns, table
    )
    if kept.shape[0] < len(poisson):
        poisson = poisson.take(kept)
    poisson = Poissons(mean, covariance, weight, poisson.label, poisson.auxiliary, poisson.born_ns)
    return Density(stamp_ns, density.next_id, bernoulli, poisson, density.labels, misses), repaired_mb + repaired_ppp


def _carry(
    rows: Bernoullis | Poissons,
    weight: Array,
    since_ns: Index,
    limit: Index,
    survival: Array,
    dt: float,
    before_ns: int,
    stamp_ns: int,
    table: ClassTable,
) -> tuple[Index, Array, Array, Array, int]:
    """Predict the rows within their limit: which they are, their mean, covariance and weight, and the repairs."""
    count = weight.shape[0]
    kept, mean, covariance = np.empty(count, INDEX), np.empty((count, STATE)), np.empty((count, STATE, STATE))
    carried = np.empty(count)
    left, repaired = predict_components(
        rows.mean,
        rows.covariance,
        rows.label,
        weight,
        since_ns,
        limit,
        survival,
        dt,
        before_ns,
        stamp_ns,
        table.period,
        table.process_noise,
        table.acceleration_time,
        table.constant_velocity,
        kept,
        mean,
        covariance,
        carried,
    )
    if left < count:
        return kept[:left], mean[:left], covariance[:left], carried[:left], repaired
    return kept, mean, covariance, carried, repaired


@kernel
def predict_components(
    mean: Array,
    covariance: Array,
    label: Index,
    weight: Array,
    since_ns: Index,
    limit: Index,
    survival: Array,
    dt: float,
    before_ns: int,
    stamp_ns: int,
    period: float,
    process_noise: Array,
    acceleration_time: Array,
    constant_velocity: NDArray[np.bool_],
    kept: Index,
    mean_out: Array,
    covariance_out: Array,
    weight_out: Array,
) -> tuple[int, int]:
    """Predict the components that are within the limit of their class (eq. PPP_prediction, MB_prediction).

    Args:
        mean: (N, 6) posterior means.
        covariance: (N, 6, 6) posterior covariances.
        label: (N,) classes.
        weight: (N,) existence probability r or weight mu.
        since_ns: (N,) stamp from which periods are counted.
        limit: (C,) periods after which a component goes.
        survival: (C,) p_s over dt.
        dt: time to predict over, s, positive.
        before_ns: rows seen from this stamp on stay, whatever the limit.
        stamp_ns: stamp of the new frame.
        period: nominal period, s.
        process_noise: (C, 6) standard deviations per square root of a second.
        acceleration_time: (C,) time constant of the acceleration, s.
        constant_velocity: (C,) whether a class moves at constant velocity.
        kept: (N,) receives the rows that stay, in front.
        mean_out: (N, 6) receives m_+ of those.
        covariance_out: (N, 6, 6) receives P_+.
        weight_out: (N,) receives ``weight p_s``.

    Returns:
        How many rows stay, and how many covariances had to be repaired.
    """
    root, points = np.empty((STATE, STATE)), np.empty((2 * STATE, STATE))
    count, repaired = 0, 0
    for n in range(mean.shape[0]):
        c = label[n]
        # The frame at hand may still bring the detection that is missing, hence one period less.
        if since_ns[n] < before_ns and whole_periods(since_ns[n], stamp_ns, period) - 1 > limit[c]:
            continue
        kept[count] = n
        weight_out[count] = weight[n] * survival[c]
        if predict_state(
            mean[n],
            covariance[n],
            dt,
            process_noise[c],
            acceleration_time[c],
            constant_velocity[c],
            root,
            points,
            mean_out[count],
            covariance_out[count],
        ):
            repaired += 1
        count += 1
    return count, repaired
