"""Loading the kernels, and nothing that they do not need: what a process that tracks holds, it holds for ever."""

from __future__ import annotations

import ctypes
import mmap
import sys
from importlib import import_module
from pathlib import Path
from typing import Final

import optipmb

UNUSED: Final = "scipy.linalg"
COMPILER: Final = "libllvmlite"
MAPS: Final = Path("/proc/self/maps")


def warm_up() -> None:
    """Compile the kernels, or load them, in a process of which the service is the master.

    With its array functions numba loads scipy's linear algebra where that is installed: 15 MB and a seventh of the
    start, for functions that no kernel uses. It does without where there is none, so it is shown none.
    """
    if UNUSED not in sys.modules:
        sys.modules[UNUSED] = None  # type: ignore[assignment]  # what makes an import fail, as Python has it
        try:
            import_module("numba.np.arraymath")
        finally:
            del sys.modules[UNUSED]
    optipmb.warm_up()
    release_compiler()


def release_compiler() -> None:
    """Give back the pages of the compiler's code: 65 MB that were read to load the kernels and are not read again.

    They are a file's, never written to, so the next use, should there be one, reads them anew. Where this is not Linux
    they stay.
    """
    if sys.platform != "linux":
        return
    advise = ctypes.CDLL(None).madvise
    advise.argtypes = (ctypes.c_size_t, ctypes.c_size_t, ctypes.c_int)
    for line in MAPS.read_text(encoding="utf-8").splitlines():
        extent, access = line.split(maxsplit=2)[:2]
        # Code alone: what is only read may hold addresses that were filled in when the library was loaded.
        if COMPILER in line and access == "r-xp":
            begin, end = (int(bound, 16) for bound in extent.split("-"))
            advise(begin, end - begin, mmap.MADV_DONTNEED)
