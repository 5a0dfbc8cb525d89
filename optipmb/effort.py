"""How many pairs a step would look at, counted before it does: what is near each other costs time."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from optipmb.compiled import kernel
from optipmb.errors import EffortError
from optipmb.gating import gate_radii, gate_widening
from optipmb.neighbours import NOBODY, block, empty_torus, insert

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb.density import Bernoullis, Poissons
    from optipmb.preprocess import Measurements
    from optipmb.table import ClassTable

    Array = NDArray[np.float64]
    Index = NDArray[np.int64]

UNLIMITED: Final = 2**62


def check_effort(
    bernoulli: Bernoullis, poisson: Poissons, measurements: Measurements, dt: float, table: ClassTable, most: int
) -> None:
    """Refuse a frame with too many pairs in the gates.

    Counted are the measurements in the gate of each predicted object and Poisson component, and in that of each
    measurement, which may be an object of the next step.

    Args:
        bernoulli: predicted detected objects.
        poisson: predicted Poisson components.
        measurements: Z_k.
        dt: s since the last frame.
        table: parameters as columns.
        most: pairs that are allowed.

    Raises:
        EffortError: there are more.
    """
    count = measurements.score.shape[0]
    if (len(bernoulli) + len(poisson) + count) * count <= most:
        return
    positions = np.concatenate((bernoulli.mean[:, :2], poisson.mean[:, :2], measurements.position[:, :2]))
    labels = np.concatenate((bernoulli.label, poisson.label, measurements.label))
    radius = np.concatenate(
        (
            gate_radii(bernoulli.covariance, bernoulli.label, dt, table.classes),
            gate_radii(poisson.covariance, poisson.label, dt, table.classes),
            table["gate"][measurements.label],
        )
    )
    widening = gate_widening(measurements.position, measurements.label, table.classes)
    group = table["group"]
    measured = measurements.position, group[measurements.label], widening
    if count_pairs(positions, group[labels], radius, *measured, len(table.classes), most) > most:
        raise EffortError("center", f"at most {most} pairs of an object and a detection in its gate", "more")


@kernel
def count_pairs(
    center: Array,
    label: Index,
    radius: Array,
    position: Array,
    measured_label: Index,
    widening: Array,
    classes: int,
    most: int,
) -> int:
    """Count the measurements of an object's class within its gate, over all objects; no further than `most` + 1.

    Args:
        center: (N, 2) positions of the objects, m.
        label: (N,) their classes.
        radius: (N,) gating distances, m.
        position: (M, 2) z_xy, m.
        measured_label: (M,) z_c.
        widening: (M,) of the gates, m^2.
        classes: C.
        most: where counting ends.
    """
    widest, wider = np.zeros(classes), np.zeros(classes)
    for m in range(position.shape[0]):
        wider[measured_label[m]] = max(wider[measured_label[m]], widening[m])
    for n in range(center.shape[0]):
        widest[label[n]] = max(widest[label[n]], math.sqrt(radius[n] ** 2 + wider[label[n]]))
    head, following, side = empty_torus(position.shape[0])
    for m in range(position.shape[0]):
        insert(head, following, side, m, position[m, 0], position[m, 1], 2.0 * widest[measured_label[m]])
    count = 0
    for n in range(center.shape[0]):
        eta_2 = radius[n] ** 2
        reach = math.sqrt(eta_2 + wider[label[n]])
        first_x, last_x, first_y, last_y = block(center[n, 0], center[n, 1], reach, 2.0 * widest[label[n]])
        for i in range(first_x, last_x + 1):
            for j in range(first_y, last_y + 1):
                m = head[(i & (side - 1)) * side + (j & (side - 1))]
                while m != NOBODY:
                    dx, dy = position[m, 0] - center[n, 0], position[m, 1] - center[n, 1]
                    if dx * dx + dy * dy <= eta_2 + widening[m] and measured_label[m] == label[n]:
                        count += 1
                        if count > most:
                            return count
                    m = following[m]
    return count
