"""Units of times and sizes."""

from typing import Final

SECOND: Final = 1_000_000_000
"""In nanoseconds."""

DAY_S: Final = 86_400.0

MEGABYTE: Final = 2**20
