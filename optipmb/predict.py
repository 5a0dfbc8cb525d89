"""PMB prediction (Section IV.C, eq. PPP_prediction and MB_prediction)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
from numba.core.errors import NumbaError, NumbaWarning

from optipmb.class_posterior import predict_classes
from optipmb.columns import check_fitting, columns_fit, only_arrays
from optipmb.compiled import kernel
from optipmb.density import (
    NO_FRAME,
    STATE,
    BernoulliArrays,
    Bernoullis,
    Density,
    PoissonArrays,
    Poissons,
    columns_of_components,
    columns_of_objects,
    whole_periods,
)
from optipmb.motion import predict_state

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from optipmb.records import Columns
    from optipmb.table import ClassRow, ClassTable

    Array = NDArray[np.float64]
    Index = NDArray[np.int64]
    Predicted = tuple[Index, Array, Array, Array, int]


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

    Raises:
        DensityError: the columns of the density do not fit together.
    """
    bernoulli, poisson, misses = density.bernoulli, density.poisson, density.misses
    before_ns = density.stamp_ns
    dt = 0.0 if before_ns == NO_FRAME else (stamp_ns - before_ns) * 1e-9
    given, undetected = columns_of_objects(bernoulli), columns_of_components(poisson)
    if dt == 0.0 or misses is not None or len(table.confusion) or not only_arrays(given, undetected):
        check_fitting(density, density.labels)
    if dt == 0.0:
        pi = predict_classes(density, None, dt, table)
        return Density(stamp_ns, density.next_id, bernoulli, poisson, density.labels, misses, pi), 0
    try:
        objects, components = predict_density(
            given,
            density.missed_from_ns,
            undetected,
            dt,
            before_ns,
            stamp_ns,
            table.period,
            table.classes,
        )
    except (AttributeError, TypeError, ValueError, NumbaError, NumbaWarning):
        check_fitting(density, density.labels)  # names the column
        raise
    kept, mean, covariance, existence, repaired = objects
    pi = predict_classes(density, kept, dt, table)
    if kept.shape[0] < bernoulli.existence.shape[0]:
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
    kept, mean, covariance, weight, repaired_poisson = components
    if kept.shape[0] < poisson.weight.shape[0]:
        poisson = poisson.take(kept)
    poisson = Poissons(mean, covariance, weight, poisson.label, poisson.auxiliary, poisson.born_ns)
    posterior = Density(stamp_ns, density.next_id, bernoulli, poisson, density.labels, misses, pi)
    return posterior, repaired + repaired_poisson


@kernel
def predict_density(
    objects: Columns,
    missed_from_ns: Index,
    components: Columns,
    dt: float,
    before_ns: int,
    stamp_ns: int,
    period: float,
    classes: Sequence[ClassRow],
) -> tuple[Predicted, Predicted]:
    """Predict objects and components: of each the rows that stay, m_+, P_+, r or mu, and the repairs.

    Raises:
        ValueError: columns do not fit together, and reading them would leave them.
    """
    if not columns_fit(objects, components, len(classes)):
        raise ValueError("columns that do not fit together")
    objects, components = BernoulliArrays(*objects), PoissonArrays(*components)
    survival = np.empty(len(classes))
    for c in range(len(classes)):
        survival[c] = classes[c].survival ** (dt / period)
    seen_from_ns = before_ns if dt <= LONGEST_STEP_S else stamp_ns
    return (
        predict_components(
            objects.mean,
            objects.covariance,
            objects.label,
            objects.existence,
            missed_from_ns,
            seen_from_ns,
            False,
            survival,
            dt,
            stamp_ns,
            period,
            classes,
        ),
        predict_components(
            components.mean,
            components.covariance,
            components.label,
            components.weight,
            components.born_ns,
            before_ns,
            True,
            survival,
            dt,
            stamp_ns,
            period,
            classes,
        ),
    )


@kernel
def predict_components(
    mean: Array,
    covariance: Array,
    label: Index,
    weight: Array,
    since_ns: Index,
    seen_from_ns: int,
    undetected: bool,
    survival: Array,
    dt: float,
    stamp_ns: int,
    period: float,
    classes: Sequence[ClassRow],
) -> Predicted:
    """Predict the components that are within the limit of their class (eq. PPP_prediction, MB_prediction).

    Args:
        mean: (N, 6) posterior means.
        covariance: (N, 6, 6) posterior covariances.
        label: (N,) classes.
        weight: (N,) existence probability r or weight mu.
        since_ns: (N,) stamp from which periods are counted.
        seen_from_ns: rows counted from this stamp on stay, whatever the limit.
        undetected: whether the limit is `poisson_steps`; else `max_misses`.
        survival: (C,) p_s over dt.
        dt: time to predict over, s, positive.
        stamp_ns: stamp of the new frame.
        period: nominal period, s.
        classes: (C,) parameters.

    Returns:
        The K rows that stay, (K, 6) m_+ and (K, 6, 6) P_+ of those, (K,) ``weight p_s``, and how many covariances had
        to be repaired.
    """
    size = mean.shape[0]
    kept, carried = np.empty(size, np.int64), np.empty(size)
    mean_out, covariance_out = np.empty((size, STATE)), np.empty((size, STATE, STATE))
    root, points = np.empty((STATE, STATE)), np.empty((2 * STATE, STATE))
    count, repaired = 0, 0
    for n in range(mean.shape[0]):
        own = classes[label[n]]
        limit = own.poisson_steps if undetected else own.max_misses
        # The frame at hand may still bring the detection that is missing, hence one period less.
        if since_ns[n] < seen_from_ns and whole_periods(since_ns[n], stamp_ns, period) - 1 > limit:
            continue
        kept[count] = n
        carried[count] = weight[n] * survival[label[n]]
        if predict_state(mean[n], covariance[n], dt, own, root, points, mean_out[count], covariance_out[count]):
            repaired += 1
        count += 1
    return kept[:count], mean_out[:count], covariance_out[:count], carried[:count], repaired
