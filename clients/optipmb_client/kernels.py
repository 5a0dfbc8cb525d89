"""Loading the kernels: in a process that runs nothing but this package, without what they do not need."""

import functools
import sys
from importlib import import_module
from typing import Final

__all__ = ["load_kernels"]

UNUSED: Final = "scipy.linalg"

own_process = False
"""Whether this process runs nothing but this package: the command, and what it starts, say so."""


@functools.cache
def load_kernels() -> None:
    """Compile the kernels, or load them, once in each process.

    With its array functions numba loads scipy's linear algebra where that is installed: a tenth of the start, for
    functions that no kernel uses. It does without where there is none, so in a process of our own it is shown none.
    """
    from optipmb import warm_up  # noqa: PLC0415  a second that the help of the command does without

    if own_process and UNUSED not in sys.modules:
        sys.modules[UNUSED] = None  # type: ignore[assignment]  # what makes an import fail, as Python has it
        try:
            import_module("numba.np.arraymath")
        finally:
            del sys.modules[UNUSED]
    warm_up()
