"""The compiled part of the recursion: the PMB update of Algorithm 1, and a whole recursion in one call."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from optipmb.association import associate
from optipmb.birth import first_detected_states
from optipmb.births_beside import forbid_births
from optipmb.class_posterior import UNGROUPED, update_classes
from optipmb.compiled import kernel
from optipmb.density import STATE, BernoulliArrays, PoissonArrays
from optipmb.extract import extract_tracks
from optipmb.hypotheses import local_hypotheses
from optipmb.lightweight import light_weight_filter
from optipmb.position_noise import PLAIN
from optipmb.predict import predict_density
from optipmb.preprocess import Measurements, select
from optipmb.prune import surviving_objects
from optipmb.undetected import update_undetected
from optipmb.update import ukf_updates

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from optipmb.records import Columns
    from optipmb.table import ClassRow

    Array = NDArray[np.float64]
    Index = NDArray[np.int64]


@kernel
def update(
    objects: Columns,
    class_probability: Array,
    p_d: Array,
    missed_from_ns: Index,
    components: Columns,
    p_d_poisson: Array,
    n_predicted: int,
    measurements: Columns,
    dt: float,
    stamp_ns: int,
    before_ns: int,
    next_id: int,
    adaptive: bool,
    period: float,
    confusion: Array,
    classes: Sequence[ClassRow],
) -> tuple[Columns, Array, Columns, Index, Index, int, int, int]:
    """Update the prediction with the measurements: the PMB update of Algorithm 1.

    Args:
        objects: predicted objects.
        class_probability: (N, C) their class posteriors, (0, 0) where no classes have a group in common.
        p_d: (N,) their detection probabilities.
        missed_from_ns: (N,) stamps from which their misses count.
        components: predicted Poisson components, and behind them, without HABM, those of the measurements.
        p_d_poisson: (J,) their detection probabilities.
        n_predicted: how many of them were predicted.
        measurements: Z_k.
        dt: s since the frame before.
        stamp_ns: stamp of the frame.
        before_ns: stamp of the frame before.
        next_id: id of the first new object.
        adaptive: whether HABM is on.
        period: nominal period, s.
        confusion: (C, C) Lambda of `optipmb.class_posterior`, (0, 0) likewise.
        classes: (C,) parameters.

    Returns:
        The columns of the objects, their class posteriors and the columns of the Poisson components; the other fields
        of `Survivors`; how many covariances had to be repaired.
    """
    z = Measurements(*measurements)
    objects, components = BernoulliArrays(*objects), PoissonArrays(*components)

    # Local hypotheses: missed, detected, first-time detected; HABM
    hypotheses = local_hypotheses(
        objects, class_probability, p_d, components, p_d_poisson, z, dt, period, confusion, classes
    )

    # Data association: the best global hypothesis, and what of it outlives the pruning of the MB
    row, measurement, cost = hypotheses.row, hypotheses.measurement, hypotheses.detection_cost
    assigned = associate(row, measurement, cost, hypotheses.first_cost, p_d.shape[0])
    forbid_births(objects, assigned, hypotheses, z, missed_from_ns, stamp_ns, period, classes)
    kept = surviving_objects(objects, p_d, assigned, hypotheses, z.label, missed_from_ns, stamp_ns, period, classes)

    # Motion states: detected and missed objects by the UKF, then the births of first-time detections
    count, known = kept.row.shape[0], kept.known
    mean, covariance = np.empty((count, STATE)), np.empty((count, STATE, STATE))
    repaired = ukf_updates(kept.row, kept.measurement, objects.mean, objects.covariance, z, classes, mean, covariance)
    repaired += first_detected_states(
        kept.measurement[known:], hypotheses, components, z, classes, mean[known:], covariance[known:]
    )

    # Other states: class, light-weight filter
    label, class_probability = update_classes(kept, objects.label, class_probability, z, confusion, classes)
    posterior = light_weight_filter(
        kept, label, mean, covariance, objects, next_id, z, stamp_ns, before_ns, period, classes
    )

    # Undetected objects: PPP update, RPP, and the births of HABM
    undetected = update_undetected(
        components, p_d_poisson, n_predicted, hypotheses, z, stamp_ns, period, classes, adaptive
    )
    return posterior, class_probability, undetected, kept.row, kept.measurement, known, kept.detected, repaired


@kernel
def recursion(
    objects: Columns,
    components: Columns,
    detections: Columns,
    p_d0: Array,
    dt: float,
    before_ns: int,
    stamp_ns: int,
    next_id: int,
    two_thresholds: bool,
    most: int,
    period: float,
    classes: Sequence[ClassRow],
) -> tuple[Columns, Columns, Columns, tuple[int, int, int, int, int]]:
    """Run one recursion of Algorithm 1, where p_d is that of the class and no classes have a group in common.

    It calls the stages that `Tracker.step` otherwise calls one by one, and gives the same bytes. What one stage hands
    to the next does not pass through Python, so a step of few objects takes three quarters of the time.

    Args:
        objects: detected objects.
        components: Poisson components.
        detections: center, size, yaw, velocity, score, label and source of the frame.
        p_d0: (C,) detection probabilities of the classes over dt.
        dt: s since the frame before, positive.
        before_ns: stamp of the frame before.
        stamp_ns: stamp of the frame.
        next_id: id of the first new object.
        two_thresholds: whether OTE is on.
        most: pairs of detections that may overlap.
        period: nominal period, s.
        classes: (C,) parameters.

    Returns:
        The columns of the objects, of the Poisson components and of the tracks; and how many detections pass the score
        filter, or -1 when more than `most` pairs may overlap, how many of them are measurements, how many of these were
        given to objects, how many objects are not new, and how many covariances had to be repaired.

    Raises:
        ValueError: columns do not fit together.
    """
    # PMB prediction
    given, announced = BernoulliArrays(*objects), PoissonArrays(*components)
    predicted, undetected = predict_density(
        objects, given.seen_ns, components, dt, before_ns, stamp_ns, period, classes
    )
    kept, mean, covariance, existence, repaired = predicted
    seen_ns, label = given.seen_ns[kept], given.label[kept]
    objects = (
        mean,
        covariance,
        existence,
        label,
        given.auxiliary[kept],
        given.id[kept],
        given.born_ns[kept],
        seen_ns,
        given.score[kept],
        given.evidence[kept],
        given.heading_odds[kept],
        given.extracted[kept],
        given.confirmed[kept],
    )
    kept, mean, covariance, weight, repaired_poisson = undetected
    label_poisson = announced.label[kept]
    components = mean, covariance, weight, label_poisson, announced.auxiliary[kept], announced.born_ns[kept]

    # Measurements
    center, size, yaw, velocity, score, which, source = detections
    above, chosen, measurements = select(center, size, yaw, velocity, score, which, source, PLAIN, classes, most)

    # PMB update
    posterior, _, undetected_after, _, hits, known, detected, repaired_now = update(
        objects,
        UNGROUPED,
        p_d0[label],
        seen_ns,
        components,
        p_d0[label_poisson],
        weight.shape[0],
        measurements,
        dt,
        stamp_ns,
        before_ns,
        next_id,
        True,
        period,
        UNGROUPED,
        classes,
    )

    # Track extraction
    since_ns = BernoulliArrays(*posterior).seen_ns
    tracks = extract_tracks(posterior, since_ns, hits, measurements, stamp_ns, two_thresholds, period, classes)
    counts = above, chosen.shape[0], detected, known, repaired + repaired_poisson + repaired_now
    return posterior, undetected_after, tracks, counts
