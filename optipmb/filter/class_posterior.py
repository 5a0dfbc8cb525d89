"""What an object of a group of classes is, as a posterior over the classes of the group.

Detectors call one object a car in one frame and a truck in the next. An object of a class with a `group` therefore has
probabilities pi over the G classes of the group. Its class stays, but its label depends on the view of it: labels of
neighbouring frames err together. So old labels lose weight by lambda per nominal period T:

    predicted               pi_+ = lambda^(dt/T) pi + (1 - lambda^(dt/T)) / G
    detected as d, score s  p(d | c) = s Lambda_cd + (1 - s) / G
                            p(d) = sum_c pi_+c p(d | c),    pi_c = pi_+c p(d | c) / p(d)
    missed                  pi = pi_+
    first detected as d     pi_c = p(d | c) / sum_c' p(d | c')

Lambda_cd is the probability that the label of an object of class c is d: 1 - kappa_c for d = c, kappa_c / (G - 1) for
the others of the group. With a score of s the label is of the object with probability s, and else of chance. The
likelihood of a detection hypothesis is p(d) of s = 1 times the likelihood of the position: of two boxes of a vehicle,
the one with its label is nearer however low the scores. The paper's class gate is the case of a group of one: pi = p(d)
= 1.

The class that a track reports, and whose parameters it has, is its last one until another of the group is
`CHANGE_ODDS` times as probable: alternating labels do not make it alternate.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from optipmb.compiled import kernel
from optipmb.model.density import ROUNDING

if TYPE_CHECKING:
    from optipmb.model.rows import Array, Index
    from optipmb.model.stages import Measurements, Survivors
    from optipmb.model.table import Classes


CHANGE_ODDS: Final = 3.0
"""How many times as probable as the reported class another must be to be reported."""


class Groups(NamedTuple):
    """Posteriors and confusion of classes that have a group in common.

    Attributes:
        probability: (N, C) pi_+ of the predicted objects; (N, 0) where the profile has no groups.
        confusion: (C, C) Lambda, or `UNGROUPED`.
    """

    probability: Array
    confusion: Array


UNGROUPED: Final = np.zeros((0, 0))
"""Posteriors, and Lambda, where the profile has no groups."""


@kernel
def predict_classes(
    kept: Index, label: Index, posterior: Array, periods: float, confusion: Array, classes: Classes
) -> Array:
    """Return pi_+ (K, C) of the objects that stay.

    Objects whose density has none, of a profile without groups or of an earlier version, begin as if first detected as
    their class with a score of 1.

    Arguments of its own:
        kept: (K,) objects that stay.
        posterior: (N, C) pi, (0, 0) where the density has none.
        periods: dt/T.
        confusion: Lambda; of (0, 0) the result has no columns.

    Raises:
        ValueError: the posteriors are of other objects, or an object has probabilities of classes outside its group.
    """
    count, known = confusion.shape[0], posterior.shape[0] > 0
    if count and known and posterior.shape != (label.shape[0], count):
        raise ValueError("posteriors of other objects")
    out = np.zeros((kept.shape[0], count))
    for k in range(kept.shape[0] if count else 0):
        n, total = kept[k], 0.0
        own = classes[label[n]]
        kept_part, size = own.class_memory**periods, own.group_size
        for c in range(count):
            likely = confusion[c, label[n]]
            if likely > 0.0:
                out[k, c] = posterior[n, c] if known else likely
                total += out[k, c]
            if known and posterior[n, c] < 0.0:
                raise ValueError("a negative probability")
        if known:
            if abs(total - 1.0) > ROUNDING:
                raise ValueError("probabilities of other classes")
            total = 1.0
        for c in range(count):
            if confusion[c, label[n]] > 0.0:
                out[k, c] = kept_part * (out[k, c] / total) + (1.0 - kept_part) / size
    return out


@kernel
def label_probability(pi: Array, d: int, s: float, confusion: Array, classes: Classes) -> float:
    """Compute p(d) of an object with posterior `pi` (C,) and a label `d` of its group with score `s`."""
    meant = 0.0
    for c in range(pi.shape[0]):
        meant += pi[c] * confusion[c, d]
    return s * meant + (1.0 - s) / classes[d].group_size


@kernel
def weigh_by_class(
    row: Index, measurement: Index, log_likelihood: Array, measurements: Measurements, groups: Groups, classes: Classes
) -> None:
    """Add ln p(d), of a certain label, to the log-likelihoods of pairs; classes without a group stay as they are."""
    for k in range(row.shape[0]):
        m = measurement[k]
        d = measurements.label[m]
        if classes[d].group_size > 1:
            p = label_probability(groups.probability[row[k]], d, 1.0, groups.confusion, classes)
            log_likelihood[k] += np.log(p)


@kernel
def update_classes(
    survivors: Survivors, label: Index, label_out: Index, measurements: Measurements, groups: Groups, classes: Classes
) -> Array:
    """Compute the class that each object of the posterior reports, and return pi (K, C); (K, 0) without groups."""
    class_probability, confusion = groups.probability, groups.confusion
    count, grouped = survivors.row.shape[0], confusion.shape[0]
    pi = np.zeros((count, grouped))
    for k in range(count):
        n, m = survivors.row[k], survivors.measurement[k]
        label_out[k] = measurements.label[m] if n < 0 else label[n]
        if grouped == 0:
            continue
        own, size = label_out[k], classes[label_out[k]].group_size
        for c in range(grouped):
            if confusion[own, c] > 0.0:
                pi[k, c] = 1.0 / size if n < 0 else class_probability[n, c]
        if m < 0 or size == 1:
            continue
        d, s = measurements.label[m], measurements.score[m]
        p = label_probability(pi[k], d, s, confusion, classes)
        for c in range(grouped):
            if pi[k, c] > 0.0:
                pi[k, c] *= (s * confusion[c, d] + (1.0 - s) / size) / p
        likeliest = np.argmax(pi[k])
        if pi[k, likeliest] >= CHANGE_ODDS * pi[k, own] and n >= 0:
            label_out[k] = likeliest
    return pi
