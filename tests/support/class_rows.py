"""Tables of classes for kernels, of which a test names the columns that count."""

from typing import Any

import numpy as np

from optipmb.model.table import CLASS


def class_rows(count: int, **columns: Any) -> Any:
    """Return an array (count,) of `CLASS` with these columns, and zeros in the others."""
    rows = np.zeros(count, CLASS)
    for name, values in columns.items():
        rows[name] = values
    return rows


def class_row(**values: Any) -> Any:
    return class_rows(1, **{name: [value] for name, value in values.items()})[0]
