"""The light-weight filter of the non-motion states (Section IV.F): box size, height, counters and confidence."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from optipmb.calibration import log_odds
from optipmb.compiled import kernel
from optipmb.heading import follow_sign
from optipmb.prune import NEW

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from optipmb.density import Bernoullis
    from optipmb.preprocess import Measurements
    from optipmb.prune import Survivors
    from optipmb.table import ClassRow

    Array = NDArray[np.float64]
    Index = NDArray[np.int64]


@kernel
def light_weight_filter(
    survivors: Survivors,
    label: Index,
    posterior: Bernoullis,
    objects: Bernoullis,
    next_id: int,
    measurements: Measurements,
    stamp_ns: int,
    before_ns: int,
    period: float,
    classes: Sequence[ClassRow],
) -> None:
    """Update the non-motion states of all objects, new and old.

    Detected: ``x_A = (1 - z_s) x_A + z_s z_A``, ``x_cnt = 0``, ``x_s = [1 - exp(-x_len)] z_s`` (eq. Confidence
    Score). Missed: x_A stays, ``x_s = 0``. New: x_A = z_A before, ids from `next_id` on. The counters are kept as
    stamps, so that they mean the same at every frame rate: x_cnt is the number of nominal periods since `seen_ns`,
    x_len is one more than the (real) number since `born_ns`. The evidence follows `optipmb.calibration`, the sign of
    the heading `optipmb.heading`, which turns the motion states where it changes. `extracted` and `confirmed` stay as
    they were.

    Args:
        survivors: which objects the posterior has.
        label: (K,) their classes.
        posterior: the objects, whose motion states are known; receives all other columns.
        objects: the predicted objects.
        next_id: id of the first new object.
        measurements: Z_k.
        stamp_ns: stamp of the frame.
        before_ns: stamp of the frame before. The evidence of a frame weighs by the time since then, that of a first
            detection by one nominal period.
        period: nominal period, s.
        classes: (C,) parameters.
    """
    mean, covariance, auxiliary, identity = posterior.mean, posterior.covariance, posterior.auxiliary, posterior.id
    born_ns, seen_ns, score, evidence = posterior.born_ns, posterior.seen_ns, posterior.score, posterior.evidence
    heading_odds, extracted, confirmed = posterior.heading_odds, posterior.extracted, posterior.confirmed
    # What the evidence keeps over the time since the frame before; in a first detection over one nominal period.
    periods = (stamp_ns - before_ns) * 1e-9 / period
    memory_of_frame, sign_memory_of_frame = np.empty(len(classes)), np.empty(len(classes))
    for c in range(len(classes)):
        memory_of_frame[c], sign_memory_of_frame[c] = classes[c].memory ** periods, classes[c].sign_memory ** periods
    for k in range(survivors.row.shape[0]):
        n, m = survivors.row[k], survivors.measurement[k]
        posterior.existence[k], posterior.label[k] = survivors.existence[k], label[k]
        if n == NEW:
            identity[k] = next_id
            born_ns[k], extracted[k], confirmed[k] = stamp_ns, False, False
            evidence[k] = heading_odds[k] = 0.0
            for s in range(4):
                auxiliary[k, s] = measurements.auxiliary[m, s]
            next_id += 1
        else:
            identity[k] = objects.id[n]
            born_ns[k], seen_ns[k], extracted[k] = objects.born_ns[n], objects.seen_ns[n], objects.extracted[n]
            confirmed[k], evidence[k], heading_odds[k] = (
                objects.confirmed[n],
                objects.evidence[n],
                objects.heading_odds[n],
            )
            for s in range(4):
                auxiliary[k, s] = objects.auxiliary[n, s]
        own, first = classes[label[k]], born_ns[k] == stamp_ns
        score[k] = 0.0
        latest = -own.missed_evidence
        if m >= 0:
            z_s = measurements.score[m]
            for s in range(4):
                auxiliary[k, s] = (1.0 - z_s) * auxiliary[k, s] + z_s * measurements.auxiliary[m, s]
            x_len = 1.0 + (stamp_ns - born_ns[k]) * 1e-9 / period
            score[k] = (1.0 - math.exp(-x_len)) * z_s
            seen_ns[k] = stamp_ns
            latest = log_odds(z_s)
            if own.sign_memory == 0.0:  # the sign is not followed
                heading_odds[k] = 0.0
            else:
                kept = own.sign_memory if first else sign_memory_of_frame[label[k]]
                heading_odds[k] = follow_sign(
                    heading_odds[k], kept, own, z_s, measurements.yaw[m], mean[k], covariance[k]
                )
        kept = own.memory if first else memory_of_frame[label[k]]
        evidence[k] = kept * evidence[k] + (1.0 - kept) * latest
