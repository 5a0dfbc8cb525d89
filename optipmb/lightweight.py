"""The light-weight filter of the non-motion states (Section IV.E): box size, height, counters, confidence, evidence."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from optipmb.calibration import weighed_evidence

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb.density import Bernoullis
    from optipmb.preprocess import Measurements
    from optipmb.table import ClassTable


def light_weight_filter(
    bernoulli: Bernoullis,
    measurement: NDArray[np.int64],
    measurements: Measurements,
    stamp_ns: int,
    before_ns: int,
    table: ClassTable,
) -> Bernoullis:
    """Update the non-motion states of all objects, new and old.

    Detected: ``x_A = (1 - z_s) x_A + z_s z_A``, ``x_cnt = 0``, ``x_s = [1 - exp(-x_len)] z_s`` (eq. Confidence
    Score). Missed: x_A stays, ``x_s = 0``. The counters are kept as stamps, so that they mean the same at every
    frame rate: x_cnt is the number of nominal periods since `seen_ns`, x_len is one more than the (real) number
    since `born_ns`.

    Args:
        bernoulli: the objects after the update, new ones with z_A as auxiliary state.
        measurement: (N,) index of the measurement of each, negative where missed.
        measurements: Z_k.
        stamp_ns: stamp of the frame.
        before_ns: stamp of the frame before. The evidence of a frame weighs by the time since then, that of a first
            detection by one nominal period.
        table: parameters as columns.
    """
    seen = measurement >= 0
    auxiliary, score = bernoulli.auxiliary.copy(), np.zeros(len(bernoulli))
    m = measurement[seen]
    z_s = measurements.score[m]
    auxiliary[seen] = (1.0 - z_s[:, None]) * auxiliary[seen] + z_s[:, None] * measurements.auxiliary[m]
    x_len = 1.0 + (stamp_ns - bernoulli.born_ns[seen]) * 1e-9 / table.period
    score[seen] = (1.0 - np.exp(-x_len)) * z_s
    periods = np.where(bernoulli.born_ns == stamp_ns, 1.0, (stamp_ns - before_ns) * 1e-9 / table.period)
    return replace(
        bernoulli,
        auxiliary=auxiliary,
        score=score,
        evidence=weighed_evidence(bernoulli, measurement, measurements, periods, table),
        seen_ns=np.where(seen, stamp_ns, bernoulli.seen_ns).astype(np.int64),
    )
