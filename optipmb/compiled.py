"""How kernels are compiled: once, to disk, with IEEE arithmetic, and which of them let other threads run meanwhile.

``fastmath`` stays off, so that the same input gives the same bytes on every run; ``parallel`` stays off, so that a
service may run many streams side by side without threads inside a frame. Division by zero follows IEEE
(``error_model="numpy"``): kernels guard their divisors themselves.

What the stages of a step take is described once, here; docstrings list what a stage takes beyond that.

    objects, components    predicted objects (N) and Poisson components (J): `mean` (N, 6), `covariance` (N, 6, 6), …
    measurements           Z_k (M), as `optipmb.preprocess.Measurements`
    hypotheses             the local hypotheses of the frame, as `optipmb.hypotheses.Hypotheses`
    row, measurement       (K,) object and measurement of each pair or result
    label                  classes, indices into the parameters
    p_d                    (N,) detection probabilities
    moment                 stamps and times of the frame, as `optipmb.density.Moment`
    missed_from_ns         (N,) stamps from which misses count
    classes, table         parameters of the classes, as `optipmb.table.ClassTable`
    mean_out, …            receive results
"""

from __future__ import annotations

import hashlib
import logging
import os
import tempfile
import time
from functools import cache, partial
from pathlib import Path
from stat import S_ISDIR, S_IWGRP, S_IWOTH
from typing import TYPE_CHECKING, Any, Final, TypeVar, cast

import numba
from numba.core import config, event
from numba.core.caching import IndexDataCacheFile

if TYPE_CHECKING:
    from collections.abc import Callable

    F = TypeVar("F", bound=Callable[..., object])
else:
    F = TypeVar("F")


_log: Final = logging.getLogger(__package__)


def _digest() -> str:
    """Digest of the source of the whole package; times of files would change when an image is packed."""
    digest = hashlib.blake2b(digest_size=16)
    for file in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(file.read_bytes())
    return digest.hexdigest()


_SOURCES: Final = _digest()

PROGRESS_S: Final = 10.0
"""Time between two lines about the progress of a compilation."""


class _Progress(event.Listener):
    """Log that kernels of the package are compiled, and how far it is: a first frame may take a minute.

    These are warnings, because Python prints those to standard error where a program has not configured logging.
    """

    def __init__(self) -> None:
        self.kernels: set[str] = set()
        """All kernels of the modules imported so far."""
        self.compiled: set[str] = set()
        self.said_at: float | None = None

    def on_start(self, event: Any) -> None:
        """Announce the first compilation of this process."""
        if self.said_at is None and self._name(event) in self.kernels:
            self.said_at = time.monotonic()
            _log.warning("optipmb: compiling the tracker, once after an installation; it takes up to a minute")

    def on_end(self, event: Any) -> None:
        """Count a compiled kernel, with a line every few seconds."""
        if (name := self._name(event)) not in self.kernels:
            return
        self.compiled.add(name)
        if self.said_at is not None and time.monotonic() > self.said_at + PROGRESS_S:
            self.said_at = time.monotonic()
            _log.warning("optipmb: compiled %d of %d kernels", len(self.compiled), len(self.kernels))

    @staticmethod
    def _name(event: Any) -> str:
        function = event.data["dispatcher"].py_func
        return f"{function.__module__}.{function.__qualname__}"


_progress: Final = _Progress()
event.register("numba:compile", _progress)  # type: ignore[no-untyped-call]  # numba has no types


def kernel(function: F) -> F:
    """Compile `function` with numba at its first call; later processes load the machine code from beside the source.

    It keeps the lock of the interpreter. A step of 40 objects spends 0.1 ms in five kernels: to give the lock to
    another thread in each of them, and to wait for it afterwards, takes longer than the kernel.

    Kernels have others compiled into them, and constants, from other modules. Numba takes code from its cache while the
    file of the kernel itself is as it was; here it does while the whole package is.
    """
    return _compiled(function, nogil=False)


def long_kernel(function: F) -> F:
    """Compile as `kernel` does what may take milliseconds and is worth a change of threads: others run meanwhile."""
    return _compiled(function, nogil=True)


def _compiled(function: F, *, nogil: bool) -> F:
    _progress.kernels.add(f"{function.__module__}.{function.__qualname__}")
    jit = partial(numba.njit, nogil=nogil, error_model="numpy")
    try:
        compiled: Any = jit(cache=True)(function)
    except RuntimeError:  # numba finds no folder that this user may write to
        folder = _private_folder()
        if folder is None:
            return cast("F", jit()(function))
        options: Any = config  # it has names that are set at run time
        usual, options.CACHE_DIR = options.CACHE_DIR, folder
        try:
            compiled = jit(cache=True)(function)
        finally:
            options.CACHE_DIR = usual
    cache = compiled._cache._cache_file  # noqa: SLF001 - numba has no public name for it
    cache._source_stamp = _SOURCES  # noqa: SLF001 - as above
    cache.__class__ = _Index
    return cast("F", compiled)


class _Index(IndexDataCacheFile):
    """An index of machine code that names what an earlier version of the package had is as good as none."""

    def _load_index(self) -> Any:
        try:
            return super()._load_index()  # type: ignore[no-untyped-call]  # numba ships no types
        except (AttributeError, ImportError):
            return {}


@cache
def _private_folder() -> str | None:
    """Return the folder for compiled kernels of a user who may write nowhere else, None where there can be none.

    Machine code is loaded from it: a folder that somebody else owns or may write to is not used.
    """
    folder = Path(tempfile.gettempdir()) / f"optipmb-kernels-{os.getuid()}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
    except OSError:
        found = None
    if found and S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & (S_IWGRP | S_IWOTH):
        _log.warning("optipmb: no cache can be written: kernels are kept in %s; set NUMBA_CACHE_DIR", folder)
        return str(folder)
    _log.warning("optipmb: no cache can be written: every process compiles its kernels; set NUMBA_CACHE_DIR")
    return None
