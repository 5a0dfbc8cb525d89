"""Doubts about the sizes of a sensor's detections, for the library and the service; no track depends on them.

Widths before lengths and lengths in another unit pass every check of a single frame.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from optipmb.model.class_names import common_name
from optipmb.model.table import usual_size

if TYPE_CHECKING:
    from optipmb.model.frame import Frame

EXPECTED: Final = "length, width, height in metres"
COMPARED: Final = 100
"""Boxes with a size after which they are judged."""
LONG: Final = ("car", "truck", "bus", "trailer")
"""Objects that are longer than wide."""
FAR: Final = 15.0
"""Ratio to the usual length of a class from which a size is of another unit: the units are 25 and more apart."""


class SizeCheck:
    """Check of the sizes of one sensor.

    Attributes:
        contradiction: what the sizes contradict, in words; empty until most do.
    """

    def __init__(self) -> None:
        self.contradiction = ""
        self._counts = np.zeros(4, dtype=np.int64)
        """Boxes with a size of a known kind, those far from the usual one, vehicles, and vehicles wider than long."""
        self._length = 0.0
        self._known: dict[tuple[str, ...], tuple[np.ndarray, np.ndarray]] = {}

    def add(self, frame: Frame) -> bool:
        """Compare the sizes of a frame, until there are enough; return whether a contradiction has been found now."""
        if self._counts[0] >= COMPARED or not len(frame.label):
            return False
        if frame.labels not in self._known:
            kinds = [common_name(name) for name in frame.labels]
            usual = [usual_size(name)[0] if kind else np.nan for name, kind in zip(frame.labels, kinds, strict=True)]
            self._known = {frame.labels: (np.array(usual), np.array([kind in LONG for kind in kinds]))}
        usual_length, is_long = (known[frame.label] for known in self._known[frame.labels])
        length, width = frame.size[:, :2].T
        told = np.isfinite(length) & np.isfinite(usual_length)
        ratio = length[told] / usual_length[told]
        far = (ratio > FAR) | (ratio < 1.0 / FAR)
        vehicles = told & is_long
        self._length = float(length[told][0]) if told.any() else self._length
        self._counts += [told.sum(), far.sum(), vehicles.sum(), (length < width)[vehicles].sum()]
        boxes, away, long, wide = self._counts.tolist()
        if boxes < COMPARED:
            return False
        if 2 * away > boxes:
            self.contradiction = f"{away} of {boxes} boxes of sizes as {self._length:g}: in another unit?"
        elif long and 2 * wide > long:
            self.contradiction = f"{wide} of {long} vehicles wider than long"
        return bool(self.contradiction)
