"""How kernels are compiled: once, to disk, with IEEE arithmetic, and which of them let other threads run meanwhile.

``fastmath`` stays off, so that the same input gives the same bytes on every run; ``parallel`` stays off, so that a
service may run many streams side by side without threads inside a frame. Division by zero follows IEEE
(``error_model="numpy"``): kernels guard their divisors themselves.

What the stages of a step take is described once, here; docstrings list what a stage takes beyond that.

    objects, components    predicted objects (N) and Poisson components (J): `mean` (N, 6), `covariance` (N, 6, 6), …
    measurements           Z_k (M), as `optipmb.model.stages.Measurements`
    hypotheses             the local hypotheses of the frame, as `optipmb.filter.hypotheses.Hypotheses`
    row, measurement       (K,) object and measurement of each pair or result
    label                  classes, indices into the parameters
    p_d                    (N,) detection probabilities
    moment                 stamps and times of the frame, as `optipmb.model.density.Moment`
    missed_from_ns         (N,) stamps from which misses count
    classes, table         parameters of the classes, as `optipmb.model.table.ClassTable`
    mean_out, …            receive results
"""

from __future__ import annotations

import hashlib
import logging
import os
import subprocess
import sys
import tempfile
from contextlib import ExitStack, contextmanager, suppress
from functools import cache, partial, wraps
from pathlib import Path
from stat import S_ISDIR, S_IWGRP, S_IWOTH
from typing import TYPE_CHECKING, Any, Final, TypeVar, cast

import numba
import numpy as np
from llvmlite.binding import get_host_cpu_features
from numba.core import config, event
from numba.core.caching import IndexDataCacheFile, _CacheLocator

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from typing import IO

    F = TypeVar("F", bound=Callable[..., object])
else:
    F = TypeVar("F")


_log: Final = logging.getLogger(__package__)


def _digest() -> str:
    """Digest of the source of the whole package; times of files would change when an image is packed."""
    digest = hashlib.blake2b(digest_size=16)
    folder = Path(__file__).parent
    for file in sorted(folder.rglob("*.py")):
        digest.update(bytes(file.relative_to(folder)) + file.read_bytes())
    return digest.hexdigest()


_SOURCES: Final = _digest()

SHIPPED: Final = Path(__file__).parent / "machine_code"
"""Folder with the machine code that a wheel brings (packaging/wheels.sh); a checkout has none."""
PROCESSOR: Final = "x86-64-v2"
"""Processor that it is compiled for, by the name that LLVM has for it, and"""
FEATURES: Final = ("cx16", "popcnt", "sahf", "sse3", "sse4.1", "sse4.2", "ssse3")
"""what the processor needs for it, which is all that this one has beyond the first of its kind."""
STEPS: Final = 4
"""Lines about the progress of a compilation where there is no terminal; on one, a line moves."""

PROCESSES: Final = "OPTIPMB_COMPILE_PROCESSES"
"""Environment variable: how many processes compile; 0 compiles each kernel at its first call, in its own process."""
JOINING: Final = f"{__package__}.joining."
"""Folder of modules whose kernels take as long to compile as all others, and few trackers need."""
MOST_PROCESSES: Final = 4
"""More are not faster: one kernel takes a third of the time."""


class _Progress(event.Listener):
    """Log that kernels of the package are compiled, and how far it is: a first frame may take half a minute.

    These are warnings, because Python prints those to standard error where a program has not configured logging.
    """

    def __init__(self) -> None:
        self.kernels: set[str] = set()
        """Kernels of the modules imported so far that every tracker needs."""
        self.others: set[str] = set()
        """Those that few need: they are compiled at their first call, by the process that calls them."""
        self.compiled: set[str] = set()
        self.built: set[str] | None = None
        """Kernels that helper processes compiled; None until one was missing."""
        self.announced = False
        self.is_helper = False
        """Whether this process compiles for another one, which reads the names of the kernels."""

    def on_start(self, event: Any) -> None:
        """Announce the first compilation of this process."""
        if self._name(event) in self.kernels | self.others:
            self.announce()

    def on_end(self, event: Any) -> None:
        """Count a compiled kernel."""
        if (name := self._name(event)) in self.kernels:
            self.count(name)

    def announce(self) -> None:
        """Say that a compilation begins, once in a process."""
        if not (self.announced or self.is_helper):
            self.announced = True
            _log.warning("optipmb: compiling the tracker, once after an installation; it takes up to a minute")

    def count(self, name: str) -> None:
        """Count a compiled kernel, once for all types of arguments, and show how far it is."""
        if name in self.compiled:
            return
        self.compiled.add(name)
        if self.is_helper:
            print(name, flush=True)  # noqa: T201 - to that process
        elif self.announced:
            done, count = len(self.compiled), len(self.kernels | self.compiled)
            if sys.stderr is not None and sys.stderr.isatty():
                print(f"optipmb: compiled {done} of {count} kernels ", end="\r", file=sys.stderr, flush=True)  # noqa: T201 - moves
            elif STEPS * done // count > STEPS * (done - 1) // count:
                _log.warning("optipmb: compiled %d of %d kernels", done, count)

    @staticmethod
    def _name(event: Any) -> str:
        function = event.data["dispatcher"].py_func
        return f"{function.__module__}.{function.__qualname__}"


progress: Final = _Progress()
event.register("numba:compile", progress)  # type: ignore[no-untyped-call]  # numba has no types


class _Calls:
    """The calls of kernels from Python, in a process in which numba compiles nothing (``NUMBA_DISABLE_JIT=1``)."""

    def __init__(self) -> None:
        self.signatures: dict[tuple[str, Any], None] = {}
        """Names of kernels and types of their arguments."""
        self._inside = False

    def recorded(self, function: F) -> F:
        """Return a kernel that runs as Python and records the types that Python calls it with."""
        name = f"{function.__module__}.{function.__qualname__}"

        @wraps(function)
        def call(*arguments: Any) -> Any:
            if self._inside:
                return function(*arguments)
            self.signatures[name, tuple(map(numba.typeof, arguments))] = None
            self._inside = True
            try:  # columns of a class are attributes to numba, which they are in a recarray
                with np.errstate(all="ignore"):  # as in machine code
                    return function(*map(_with_attributes, arguments))
            finally:
                self._inside = False

        return cast("F", call)


def _with_attributes(value: object) -> object:
    named = isinstance(value, np.ndarray | np.void) and value.dtype.names is not None
    return np.asarray(value).view(np.recarray)[()] if named else value  # [()]: a row stays one


calls: Final = _Calls()


def kernel(function: F) -> F:
    """Compile `function` with numba at its first call; later processes load the machine code from the package's folder.

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
    options: Any = config  # it has names that are set at run time
    if options.DISABLE_JIT:
        return calls.recorded(function)
    common = not function.__module__.startswith(JOINING)
    (progress.kernels if common else progress.others).add(f"{function.__module__}.{function.__qualname__}")
    jit = partial(numba.njit, nogil=nogil, error_model="numpy", no_cfunc_wrapper=True)
    try:
        compiled: Any = jit(cache=True)(function)
    except RuntimeError:  # numba finds no folder that this user may write to
        folder = _private_folder()
        if folder is None:
            return cast("F", jit()(function))
        usual, options.CACHE_DIR = options.CACHE_DIR, folder
        try:
            compiled = jit(cache=True)(function)
        finally:
            options.CACHE_DIR = usual
    cache = compiled._cache._cache_file  # noqa: SLF001 - numba has no public name for it
    cache._source_stamp = _SOURCES  # noqa: SLF001 - as above
    cache.__class__ = _PackageIndex if common and function.__module__.startswith(f"{__package__}.") else _Index
    return cast("F", compiled)


class _Index(IndexDataCacheFile):
    """An index of machine code; one that refers to names of an earlier version of the package counts as empty."""

    def _load_index(self) -> Any:
        try:
            return super()._load_index()  # type: ignore[no-untyped-call]  # numba ships no types
        except (AttributeError, ImportError):
            return {}

    def load(self, key: Any) -> Any:
        """Return machine code: of this installation, or else of the wheel; None where there is none."""
        data = super().load(key)  # type: ignore[no-untyped-call]  # as above
        signature, (triple, *_), code = key
        if data is None and _runs_shipped():
            shipped: Any = IndexDataCacheFile(str(SHIPPED), Path(self._index_name).stem, self._source_stamp)  # type: ignore[no-untyped-call]
            data = shipped.load((signature, (triple, PROCESSOR, ""), code))
        return data

    def save(self, key: Any, data: Any) -> None:
        """Save machine code; one process at a time, for numba reads the index and then replaces it."""
        with ExitStack() as stack:
            with suppress(OSError):  # its file system has no locks
                file = stack.enter_context((Path(self._cache_path) / "optipmb.index.lock").open("a"))
                _lock(file)
            super().save(key, data)  # type: ignore[no-untyped-call]  # numba ships no types


@cache
def _runs_shipped() -> bool:
    """Tell whether there is machine code for this processor, and none for another one was asked for."""
    options: Any = config
    try:
        features = get_host_cpu_features()  # type: ignore[no-untyped-call]  # llvmlite ships no types
    except RuntimeError:  # of an unknown kind
        return False
    asked = options.CPU_NAME, options.CPU_FEATURES
    return SHIPPED.is_dir() and asked == (None, None) and all(features.get(name) for name in FEATURES)


class _PackageIndex(_Index):
    """An index of the package: where one kernel has no machine code, helper processes compile all that all need."""

    def load(self, key: Any) -> Any:
        """Return the machine code of one kernel, None where it has to be compiled here."""
        data = super().load(key)
        if data is None and progress.built is None and (count := _processes()):
            with _one_at_a_time(_package_folder(Path(self._cache_path))) as writable:
                data = super().load(key)
                if data is None and writable:
                    progress.built = set()
                    try:
                        _compile_all(count, progress.built)
                    except OSError as error:  # no right, no memory, too many processes, no interpreter any more
                        _log.warning("optipmb: cannot start other processes (%s): this one compiles alone", error)
                    data = super().load(key)
        return data


def _processes() -> int:
    """Return how many processes compile; none where Python is part of another program, which would start again.

    None either without optimization: numba then keeps calls by address, which it does not cache.
    """
    options: Any = config
    if not sys.executable or hasattr(sys, "frozen") or options.OPT == 0:
        return 0
    available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    wanted = os.environ.get(PROCESSES, "")
    return int(wanted) if wanted.isdecimal() else min(available, MOST_PROCESSES)


def _package_folder(folder: Path) -> Path:
    """Return the folder that numba gives to the modules of this file's folder, where it gives `folder` to others."""
    if folder.name == "__pycache__":
        return Path(__file__).parent / folder.name
    name: str = _CacheLocator.get_suitable_cache_subpath(__file__)  # type: ignore[no-untyped-call]  # as above; numba 0.61 has no public locator
    return folder.parent / name


def _lock(file: IO[str], *, wait: bool = True) -> None:
    """Keep other processes from locking a file until it is closed; without locks, on Windows, each compiles."""
    if fcntl is not None:
        fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))


@contextmanager
def _one_at_a_time(folder: Path) -> Iterator[bool]:
    """Hold the lock of a folder of machine code; yield whether the folder can be written to."""
    with ExitStack() as stack:
        with suppress(OSError):  # nothing can be written there, or its file system has no locks
            folder.mkdir(parents=True, exist_ok=True)
            file = stack.enter_context((folder / "optipmb.lock").open("a"))
            try:
                _lock(file, wait=False)
            except BlockingIOError:
                _log.warning("optipmb: waiting for another process, which compiles the tracker")
                _lock(file)
        yield os.access(folder, os.W_OK)


def _compile_all(count: int, built: set[str]) -> None:
    """Compile all kernels in `count` processes, and add their names to `built`; this process compiles the others.

    One process, which compiles nothing, runs the tracker to find out the types of arguments. It writes them to a file,
    and their numbers to a pipe, from which each of the others takes the next.
    """
    progress.announce()
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), PROCESSES: "0"}
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:

        def pipe() -> list[Any]:
            return [stack.enter_context(os.fdopen(end, mode)) for end, mode in zip(os.pipe(), "rw", strict=True)]

        def start(program: str, stdin: Any, stdout: Any, **also: str) -> None:
            command = [sys.executable, "-c", f"import optipmb.warm; optipmb.warm.{program}", str(Path(folder) / "plan")]
            process = subprocess.Popen(command, stdin=stdin, stdout=stdout, env=environment | also)  # noqa: S603 - our own
            stack.callback(process.wait)
            stack.callback(process.terminate)

        (waiting, numbers), (names, done) = pipe(), pipe()
        start("plan()", subprocess.DEVNULL, numbers, NUMBA_DISABLE_JIT="1")
        for _ in range(count):
            start("build()", waiting, done)
        for end in (waiting, numbers, done):  # the other processes have them, and a pipe ends with the last of those
            end.close()
        for name in names:
            built.add(name.strip())
            progress.count(name.strip())
    _log.warning("optipmb: compiled the kernels that every tracker needs, %d", len(built))


@cache
def _private_folder() -> str | None:
    """Return the folder for compiled kernels of a user who may write nowhere else, None where there can be none.

    Machine code is loaded from it: a folder that somebody else owns or may write to is not used.
    """
    if not hasattr(os, "getuid"):  # on Windows numba has a folder of the user, or none
        return None
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
