"""Values in a temporary file, so that memory does not hold them all."""

import functools
import pickle
import tempfile
import threading
import weakref
from typing import IO, Any


class Spool:
    """Values by their places, from 0. The file has no name, and ends with the process."""

    def __init__(self) -> None:
        self._start: list[int] = []
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._start)

    def __getitem__(self, place: int) -> Any:
        with self._lock:
            self._file.seek(self._start[place])
            return pickle.load(self._file)  # noqa: S301  of this process

    def append(self, value: object) -> int:
        """Take a value; return its place."""
        with self._lock:
            self._start.append(self._file.seek(0, 2))
            pickle.dump(value, self._file, protocol=5)
            return len(self._start) - 1

    @functools.cached_property
    def _file(self) -> IO[bytes]:
        file = tempfile.TemporaryFile()  # noqa: SIM115  as long as this object
        weakref.finalize(self, file.close)
        return file
