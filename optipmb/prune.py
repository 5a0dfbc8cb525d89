"""What is removed after the update (Section IV.E and redundant PPP pruning, RPP, Section IV.G)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from optipmb.density import Poissons, whole_periods

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from optipmb.density import Bernoullis
    from optipmb.table import ClassTable


def surviving_objects(bernoulli: Bernoullis, stamp_ns: int, table: ClassTable) -> NDArray[np.bool_]:
    """Tell which Bernoullis stay: those likely enough (`min_existence`) and not missed too long (`max_misses`).

    The second limit is ours: with p_s = 1, as the paper sets it for KITTI, r stays 1 through any number of misses.
    """
    misses = whole_periods(bernoulli.seen_ns, stamp_ns, table.period)
    alive: NDArray[np.bool_] = (bernoulli.existence >= table.min_existence[bernoulli.label]) & (
        misses <= table.max_misses[bernoulli.label]
    )
    return alive


def surviving_components(
    poisson: Poissons, announced: NDArray[np.int64], stamp_ns: int, table: ClassTable
) -> NDArray[np.bool_]:
    """Tell which Poisson components stay under RPP.

    Components that took part in any first-time detection hypothesis are marked and go, so that they cannot start a
    second track; the others go after eta_step nominal periods.

    Args:
        poisson: the components.
        announced: rows of the components that stand in any J^m.
        stamp_ns: stamp of the frame.
        table: parameters as columns.
    """
    keep = whole_periods(poisson.born_ns, stamp_ns, table.period) <= table.poisson_steps[poisson.label]
    keep[announced] = False
    return keep
