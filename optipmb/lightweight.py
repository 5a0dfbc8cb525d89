"""The light-weight filter of the non-motion states (Section IV.E): box size, height, counters and confidence."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from optipmb.calibration import log_odds
from optipmb.compiled import kernel
from optipmb.density import Bernoullis
from optipmb.heading import follow_sign
from optipmb.prune import NEW
from optipmb.records import FLAG, INDEX

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb.preprocess import Measurements
    from optipmb.prune import Survivors
    from optipmb.table import ClassTable

    Array = NDArray[np.float64]
    Index = NDArray[np.int64]


def light_weight_filter(
    survivors: Survivors,
    mean: Array,
    covariance: Array,
    bernoulli: Bernoullis,
    next_id: int,
    measurements: Measurements,
    stamp_ns: int,
    before_ns: int,
    table: ClassTable,
) -> Bernoullis:
    """Update the non-motion states of all objects, new and old, and put the posterior together.

    Detected: ``x_A = (1 - z_s) x_A + z_s z_A``, ``x_cnt = 0``, ``x_s = [1 - exp(-x_len)] z_s`` (eq. Confidence
    Score). Missed: x_A stays, ``x_s = 0``. New: x_A = z_A before, ids from `next_id` on. The counters are kept as
    stamps, so that they mean the same at every frame rate: x_cnt is the number of nominal periods since `seen_ns`,
    x_len is one more than the (real) number since `born_ns`. The evidence follows `optipmb.calibration`, the sign of
    the heading `optipmb.heading`, which turns the states of `mean` and `covariance` where it changes.

    Args:
        survivors: which objects the posterior has.
        mean: (K, 6) their posterior means.
        covariance: (K, 6, 6) their posterior covariances.
        bernoulli: the predicted objects.
        next_id: id of the first new object.
        measurements: Z_k.
        stamp_ns: stamp of the frame.
        before_ns: stamp of the frame before. The evidence of a frame weighs by the time since then, that of a first
            detection by one nominal period.
        table: parameters as columns.
    """
    count = len(survivors)
    posterior = Bernoullis(
        mean,
        covariance,
        survivors.existence,
        np.empty(count, INDEX),  # label
        np.empty((count, 4)),  # auxiliary
        np.empty(count, INDEX),  # id
        np.empty(count, INDEX),  # born_ns
        np.empty(count, INDEX),  # seen_ns
        np.empty(count),  # score
        np.empty(count),  # evidence
        np.empty(count),  # heading_odds
        np.empty(count, FLAG),  # extracted
        np.empty(count, FLAG),  # confirmed
    )
    update_light_weight(
        survivors.row,
        survivors.measurement,
        bernoulli.label,
        bernoulli.auxiliary,
        bernoulli.id,
        bernoulli.born_ns,
        bernoulli.seen_ns,
        bernoulli.evidence,
        bernoulli.heading_odds,
        bernoulli.extracted,
        bernoulli.confirmed,
        next_id,
        measurements.label,
        measurements.auxiliary,
        measurements.score,
        measurements.yaw,
        stamp_ns,
        before_ns,
        table.period,
        table.memory,
        table.missed_evidence,
        table.sign_memory,
        table.sign_detection,
        table.sign_motion,
        table.sign_speed,
        posterior.mean,
        posterior.covariance,
        posterior.label,
        posterior.auxiliary,
        posterior.id,
        posterior.born_ns,
        posterior.seen_ns,
        posterior.score,
        posterior.evidence,
        posterior.heading_odds,
        posterior.extracted,
        posterior.confirmed,
    )
    return posterior


@kernel
def update_light_weight(
    row: Index,
    measurement: Index,
    label: Index,
    auxiliary: Array,
    identity: Index,
    born_ns: Index,
    seen_ns: Index,
    evidence: Array,
    heading_odds: Array,
    extracted: NDArray[np.bool_],
    confirmed: NDArray[np.bool_],
    next_id: int,
    measured_label: Index,
    measured_auxiliary: Array,
    measured_score: Array,
    measured_yaw: Array,
    stamp_ns: int,
    before_ns: int,
    period: float,
    memory: Array,
    missed_evidence: Array,
    sign_memory: Array,
    sign_detection: Array,
    sign_motion: Array,
    sign_speed: Array,
    mean: Array,
    covariance: Array,
    label_out: Index,
    auxiliary_out: Array,
    identity_out: Index,
    born_ns_out: Index,
    seen_ns_out: Index,
    score_out: Array,
    evidence_out: Array,
    heading_odds_out: Array,
    extracted_out: NDArray[np.bool_],
    confirmed_out: NDArray[np.bool_],
) -> None:
    """Write the non-motion columns of the posterior (eq. Confidence Score), and turn states whose sign has changed.

    `extracted` and `confirmed` stay as they were.
    """
    # What the evidence keeps: over the time since the frame before, and in a first detection over one nominal period.
    periods = (stamp_ns - before_ns) * 1e-9 / period
    memory_of_frame, sign_memory_of_frame = memory**periods, sign_memory**periods
    for k in range(row.shape[0]):
        n, m = row[k], measurement[k]
        if n == NEW:
            label_out[k], identity_out[k] = measured_label[m], next_id
            born_ns_out[k], extracted_out[k], confirmed_out[k] = stamp_ns, False, False
            evidence_out[k] = heading_odds_out[k] = 0.0
            for s in range(4):
                auxiliary_out[k, s] = measured_auxiliary[m, s]
            next_id += 1
        else:
            label_out[k], identity_out[k] = label[n], identity[n]
            born_ns_out[k], seen_ns_out[k], extracted_out[k] = born_ns[n], seen_ns[n], extracted[n]
            confirmed_out[k], evidence_out[k], heading_odds_out[k] = confirmed[n], evidence[n], heading_odds[n]
            for s in range(4):
                auxiliary_out[k, s] = auxiliary[n, s]
        c = label_out[k]
        first = born_ns_out[k] == stamp_ns
        score_out[k] = 0.0
        latest = -missed_evidence[c]
        if m >= 0:
            z_s = measured_score[m]
            for s in range(4):
                auxiliary_out[k, s] = (1.0 - z_s) * auxiliary_out[k, s] + z_s * measured_auxiliary[m, s]
            x_len = 1.0 + (stamp_ns - born_ns_out[k]) * 1e-9 / period
            score_out[k] = (1.0 - math.exp(-x_len)) * z_s
            seen_ns_out[k] = stamp_ns
            latest = log_odds(z_s)
            if sign_memory[c] == 0.0:  # the sign is not followed
                heading_odds_out[k] = 0.0
            else:
                heading_odds_out[k] = follow_sign(
                    heading_odds_out[k],
                    sign_memory[c] if first else sign_memory_of_frame[c],
                    sign_memory[c],
                    sign_detection[c],
                    sign_motion[c],
                    sign_speed[c],
                    z_s,
                    measured_yaw[m],
                    mean[k],
                    covariance[k],
                )
        kept = memory[c] if first else memory_of_frame[c]
        evidence_out[k] = kept * evidence_out[k] + (1.0 - kept) * latest
