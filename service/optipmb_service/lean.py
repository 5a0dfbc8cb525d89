"""Loading the kernels, and nothing that they do not need: every process that tracks holds what it loads for ever."""

from __future__ import annotations

import sys
from importlib import import_module
from typing import Final

import optipmb

UNUSED: Final = "scipy.linalg"


def warm_up() -> None:
    """Compile the kernels, or load them, in a process of which the service is the master.

    With its array functions numba loads scipy's linear algebra where that is installed: 17 MB, for functions that no
    kernel uses. It does without where there is none, so it is shown none.
    """
    if UNUSED not in sys.modules:
        sys.modules[UNUSED] = None  # type: ignore[assignment]  # what makes an import fail, as Python has it
        try:
            import_module("numba.np.arraymath")
        finally:
            del sys.modules[UNUSED]
    optipmb.warm_up()
