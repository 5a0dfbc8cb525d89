"""A density as named arrays and back, so that it can be stored; what is read back is checked.

Names are `bernoulli.mean`, `poisson.weight` and so on; the two scalars of a density are kept beside them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from optipmb.density import NO_FRAME, Bernoullis, Density, Poissons
from optipmb.errors import DensityError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

_Rows = TypeVar("_Rows", Bernoullis, Poissons)


def columns_of(density: Density) -> dict[str, NDArray[Any]]:
    """Return the arrays of a density by name, always in the same order."""
    parts = (("bernoulli", density.bernoulli), ("poisson", density.poisson))
    return {f"{part}.{name}": column for part, rows in parts for name, column in rows.columns()}


def density_of(stamp_ns: int, next_id: int, columns: Mapping[str, Any], classes: int) -> Density:
    """Return the density of named arrays.

    Args:
        stamp_ns: stamp of its last frame.
        next_id: id of the next new track.
        columns: what `columns_of` gave.
        classes: number of classes of the parameters that it belongs to.

    Raises:
        DensityError: a column is missing, has another shape or type, or holds values that no density has.
    """
    if not NO_FRAME <= stamp_ns < 2**63:
        raise DensityError("stamp_ns", "a stamp", str(stamp_ns))
    bernoulli = _rows("bernoulli", Bernoullis, columns)
    poisson = _rows("poisson", Poissons, columns)
    for part, rows in (("bernoulli", bernoulli), ("poisson", poisson)):
        label = rows.label
        if label.size and not (label.min() >= 0 and label.max() < classes):
            raise DensityError(f"{part}.label", f"indices below {classes}", f"{label.min()} to {label.max()}")
        if label.size and not 0 <= rows.born_ns.min() <= rows.born_ns.max() <= stamp_ns:
            raise DensityError(f"{part}.born_ns", f"stamps up to {stamp_ns}", "others")
    if len(bernoulli) and not (bernoulli.born_ns <= bernoulli.seen_ns).all() & (bernoulli.seen_ns <= stamp_ns).all():
        raise DensityError("bernoulli.seen_ns", f"stamps from born_ns to {stamp_ns}", "others")
    for path, column, high in (
        ("bernoulli.existence", bernoulli.existence, 1.0),
        ("bernoulli.score", bernoulli.score, 1.0),
        ("poisson.weight", poisson.weight, np.inf),
    ):
        if column.size and not 0.0 <= column.min() <= column.max() <= high:
            raise DensityError(path, f"numbers from 0 to {high:g}", f"{column.min():g} to {column.max():g}")
    ids = bernoulli.id
    if ids.size and not (np.diff(ids) > 0).all():
        raise DensityError("bernoulli.id", "ascending ids", "others")
    if not 0 <= int(ids.max(initial=0)) < next_id < 2**63:
        raise DensityError("next_id", f"an id above {ids.max(initial=0)}", str(next_id))
    return Density(stamp_ns=stamp_ns, next_id=next_id, bernoulli=bernoulli, poisson=poisson)


def _rows(part: str, kind: type[_Rows], columns: Mapping[str, Any]) -> _Rows:
    found: dict[str, Any] = {}
    count: int | None = None
    for name, like in kind.empty().columns():
        path = f"{part}.{name}"
        column = columns.get(path)
        if not isinstance(column, np.ndarray) or column.dtype != like.dtype or column.shape[1:] != like.shape[1:]:
            raise DensityError(path, f"(N, {', '.join(map(str, like.shape[1:]))}) {like.dtype}", _shown(column))
        count = len(column) if count is None else count
        if column.ndim != like.ndim or len(column) != count:
            raise DensityError(path, f"{count} rows", _shown(column))
        if column.dtype.kind == "f" and not np.isfinite(column).all():
            raise DensityError(path, "finite numbers", "others")
        found[name] = np.array(column, order="C")  # as kernels are compiled for: in one piece, and not read-only
    return kind(**found)


def _shown(column: object) -> str:
    return f"{column.shape} {column.dtype}" if isinstance(column, np.ndarray) else type(column).__name__
