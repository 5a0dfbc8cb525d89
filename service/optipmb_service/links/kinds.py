"""Kinds of objects that links distinguish: by the common name of one of their classes."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Final

import numpy as np

from optipmb.joining.decision import Kinds
from optipmb.joining.evidence import motion_of
from optipmb.joining.places import DeclaredPlaces
from optipmb.model.class_names import common_name

if TYPE_CHECKING:
    from optipmb.model.rows import Index

KINDS: Final = ("", "car", "bicycle", "pedestrian")
"""A class of each kind; `""`: any other class."""
_KIND_OF: Final = {motion_of(name): number for number, name in enumerate(KINDS)}
AREA_M2: Final = 1e4
"""Area over which new objects are spread where nothing is known of them."""
MOTION: Final = Kinds(
    np.array([motion_of(name) for name in KINDS]),
    np.arange(len(KINDS)),
    np.full(len(KINDS), AREA_M2),
    DeclaredPlaces.of(),
)


@lru_cache(maxsize=64)
def kinds_of(labels: tuple[str, ...]) -> Index:
    """Return the kind of each class; classes without a common name are of no kind, which fits all."""
    return np.array([_KIND_OF[motion_of(one)] if common_name(one) else 0 for one in labels], dtype=np.int64)
