"""Limits of a receiver, by name. They are checked before memory is allocated.

The defaults carry the largest LiDAR clouds in use with room to spare, and keep the memory that one hostile message can
take in the tens of megabytes. A message above a limit is answered by a `too_large` problem that names it.
"""

from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Final


def _limit(default: int, meaning: str) -> int:
    value: int = field(default=default, metadata={"meaning": meaning})
    return value


_DIMENSIONS: Final = {
    "M": "max_detections",
    "N": "max_tracks",
    "P": "max_points",
    "H": "max_horizons",
    "C": "max_labels",
}


_COLUMNS: Final = {"max_text": 2000, "max_values": 1000, "max_depth": 4, "max_labels": 256}
"""Bytes of a text, values, levels and labels that no valid message with columns of binary numbers exceeds."""


@dataclass(frozen=True)
class Limits:
    """What a receiver accepts at most. `rows` gives the limit of a symbolic array dimension."""

    max_bytes: int = _limit(32 * 2**20, "bytes of a msgpack payload")
    max_json_bytes: int = _limit(8 * 2**20, "bytes of a JSON payload")
    max_values: int = _limit(2**19, "numbers, texts, lists and maps together; an array block counts as eight or so")
    max_depth: int = _limit(12, "levels of lists and maps inside each other")
    max_text: int = _limit(4096, "bytes of one text, in UTF-8")
    max_points: int = _limit(1_000_000, "points of one cloud (P)")
    max_detections: int = _limit(5_000, "detections of one message (M)")
    max_tracks: int = _limit(20_000, "tracks, or components of a density, of one message (N)")
    max_labels: int = _limit(256, "labels of one message")
    max_horizons: int = _limit(100, "horizons of predicted paths (H)")

    def rows(self, dimension: str) -> int:
        """Return the limit of a dimension: M detections, N tracks or components, P points, H horizons, C classes.

        Other dimensions are limited by their descriptions, and by the number of values.
        """
        most: int = getattr(self, _DIMENSIONS.get(dimension, "max_values"))
        return most

    @cached_property
    def allows_columns(self) -> bool:
        """Whether a valid message with columns of binary numbers can be above no limit but the rows of its arrays."""
        return all(getattr(self, name) >= most for name, most in _COLUMNS.items())

    def described(self) -> list[tuple[str, int, str]]:
        """Return name, value and meaning of every limit, for people."""
        return [(f.name, getattr(self, f.name), f.metadata["meaning"]) for f in fields(self)]


DEFAULT: Final = Limits()
