"""PMB prediction (Section IV.C, eq. PPP_prediction and MB_prediction)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from optipmb.class_posterior import predict_classes
from optipmb.columns import check_fitting, labels_within
from optipmb.compiled import kernel
from optipmb.density import (
    COMPONENT,
    NO_FRAME,
    OBJECT,
    STATE,
    Bernoullis,
    Density,
    Poissons,
    components_in,
    misses_counted_from,
    objects_in,
    whole_periods,
)
from optipmb.motion import predict_state

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from optipmb.table import ClassRow, ClassTable

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

    Raises:
        DensityError: the parts of the density do not fit together, or a label is of no class.
    """
    misses, before_ns = density.misses, density.stamp_ns
    dt = 0.0 if before_ns == NO_FRAME else (stamp_ns - before_ns) * 1e-9
    own = density.self_calibration
    if dt == 0.0 or misses is not None or len(table.confusion) or own is not None:
        check_fitting(density, density.labels)
    if dt == 0.0:
        pi = predict_classes(density, None, dt, table)
        return Density(stamp_ns, density.next_id, density.bernoulli, density.poisson, density.labels, misses, pi), 0
    try:
        kept, objects, components, repaired = predict_density(
            density.bernoulli.words,
            density.missed_from_ns,
            density.poisson.words,
            dt,
            before_ns,
            stamp_ns,
            table.period,
            table.classes,
        )
    except ValueError:
        check_fitting(density, density.labels)  # names the column
        raise
    pi = predict_classes(density, kept, dt, table)
    if misses is not None and kept.shape[0] < len(misses):
        misses = misses.take(kept)
    parts = Bernoullis.of(objects), Poissons.of(components)
    return Density(stamp_ns, density.next_id, *parts, density.labels, misses, pi), repaired


@kernel
def predict_density(
    object_words: Array,
    missed_from_ns: Index,
    component_words: Array,
    dt: float,
    before_ns: int,
    stamp_ns: int,
    period: float,
    classes: Sequence[ClassRow],
) -> tuple[Index, Array, Array, int]:
    """Predict the objects and components that are within the limit of their class (eq. PPP_prediction, MB_prediction).

    Args:
        object_words: array of `Bernoullis`.
        missed_from_ns: `Density.missed_from_ns`.
        component_words: array of `Poissons`.
        dt: time to predict over, s, positive.
        before_ns: stamp of the density.
        stamp_ns: stamp of the new frame.
        period: nominal period, s.
        classes: (C,) parameters.

    Returns:
        The (K,) objects that stay, the arrays of the predicted objects and components, and how many covariances had to
        be repaired.

    Raises:
        ValueError: a label is none, and reading its parameters would leave their array.
    """
    if not labels_within(object_words, component_words, len(classes)):
        raise ValueError("labels of classes that there are not")
    survival = np.empty(len(classes))
    for c in range(len(classes)):
        survival[c] = classes[c].survival ** (dt / period)

    old = objects_in(object_words)
    seen_from_ns = before_ns if dt <= LONGEST_STEP_S else stamp_ns
    since_ns = misses_counted_from(old, missed_from_ns)
    kept = rows_within(old.label, since_ns, seen_from_ns, False, stamp_ns, period, classes)
    predicted = np.empty(kept.shape[0] * OBJECT)
    new = objects_in(predicted)
    repaired = predict_rows(kept, old, old.existence, new, new.existence, survival, dt, classes)
    for k in range(kept.shape[0]):
        n = kept[k]
        new.id[k], new.seen_ns[k] = old.id[n], old.seen_ns[n]
        new.score[k], new.evidence[k], new.heading_odds[k] = old.score[n], old.evidence[n], old.heading_odds[n]
        new.extracted[k], new.confirmed[k] = old.extracted[n], old.confirmed[n]

    undetected = components_in(component_words)
    chosen = rows_within(undetected.label, undetected.born_ns, before_ns, True, stamp_ns, period, classes)
    carried = np.empty(chosen.shape[0] * COMPONENT)
    later = components_in(carried)
    repaired += predict_rows(chosen, undetected, undetected.weight, later, later.weight, survival, dt, classes)
    return kept, predicted, carried, repaired


@kernel
def rows_within(
    label: Index,
    since_ns: Index,
    seen_from_ns: int,
    undetected: bool,
    stamp_ns: int,
    period: float,
    classes: Sequence[ClassRow],
) -> Index:
    """Return the rows that are within the limit of their class.

    Args:
        label: (N,) classes.
        since_ns: (N,) stamp from which periods are counted.
        seen_from_ns: rows counted from this stamp on stay, whatever the limit.
        undetected: whether the limit is `poisson_steps`; else `max_misses`.
        stamp_ns: stamp of the new frame.
        period: nominal period, s.
        classes: (C,) parameters.
    """
    kept, count = np.empty(label.shape[0], np.int64), 0
    for n in range(label.shape[0]):
        own = classes[label[n]]
        limit = own.poisson_steps if undetected else own.max_misses
        # The frame at hand may still bring the detection that is missing, hence one period less.
        if since_ns[n] < seen_from_ns and whole_periods(since_ns[n], stamp_ns, period) - 1 > limit:
            continue
        kept[count] = n
        count += 1
    return kept[:count]


@kernel
def predict_rows(
    rows: Index,
    old: Bernoullis | Poissons,
    weight: Array,
    new: Bernoullis | Poissons,
    weight_out: Array,
    survival: Array,
    dt: float,
    classes: Sequence[ClassRow],
) -> int:
    """Predict objects or components: m_+, P_+ and ``weight p_s``; what both have beside these stays.

    Args:
        rows: (K,) which of them.
        old: their columns.
        weight: (N,) existence probability r or weight mu.
        new: receives the columns of the K rows.
        weight_out: (K,) receives r_+ or mu_+.
        survival: (C,) p_s over dt.
        dt: time to predict over, s, positive.
        classes: (C,) parameters.

    Returns:
        How many covariances had to be repaired.
    """
    root, points = np.empty((STATE, STATE)), np.empty((2 * STATE, STATE))
    repaired = 0
    for k in range(rows.shape[0]):
        n = rows[k]
        own = classes[old.label[n]]
        if predict_state(old.mean[n], old.covariance[n], dt, own, root, points, new.mean[k], new.covariance[k]):
            repaired += 1
        weight_out[k] = weight[n] * survival[old.label[n]]
        new.label[k], new.born_ns[k] = old.label[n], old.born_ns[n]
        for s in range(4):
            new.auxiliary[k, s] = old.auxiliary[n, s]
    return repaired
