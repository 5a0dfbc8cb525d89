"""Values in a temporary file, so that memory does not hold them all: of any kind, and tracks of a recording."""

import functools
import pickle
import tempfile
import threading
import weakref
from collections.abc import Callable, Iterator, Mapping
from typing import IO, Any, Final, Self

import numpy as np
from numpy.typing import NDArray
from optipmb_schemas import Tracks

BLOCK: Final = 512
"""Frames of tracks that are written and read together."""


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


class SpooledTracks(Mapping[int, Tracks]):
    """Tracks by frame index, in blocks of joined columns; the block that was used last is in memory."""

    def __init__(self) -> None:
        self._blocks = Spool()
        self._place: dict[int, tuple[int, int]] = {}  # block, and place in it, of each frame
        self._rows: list[int] = [0]  # before each frame, in the order in which they were added
        self._last: list[Tracks] = []  # of the block that is not written yet
        self._held: tuple[int, list[Tracks]] = (-1, [])
        self._changed: Mapping[str, NDArray[Any]] = {}

    def __len__(self) -> int:
        return len(self._place)

    def __iter__(self) -> Iterator[int]:
        return iter(sorted(self._place))

    def __getitem__(self, index: int) -> Tracks:
        block, place = self._place[index]
        if block == len(self._blocks):
            found = self._last[place]
        else:
            if self._held[0] != block:
                self._held = block, self._read(block)
            found = self._held[1][place]
        row = block * BLOCK + place
        rows = slice(self._rows[row], self._rows[row + 1])
        changed = {name: values[rows] for name, values in self._changed.items()}
        return found.model_copy(update=changed) if changed else found

    def add(self, index: int, tracks: Tracks) -> None:
        """Take the tracks of a frame."""
        self._place[index] = len(self._blocks), len(self._last)
        self._rows.append(self._rows[-1] + len(tracks.id))
        self._last.append(tracks)
        if len(self._last) == BLOCK:
            self._write()

    def columns(
        self, wanted: Mapping[str, Callable[[Tracks], NDArray[Any]]], rows: NDArray[np.bool_] | None = None
    ) -> dict[str, NDArray[Any]]:
        """Return values of all rows, or of these, in the order in which their frames were added."""
        parts: dict[str, list[NDArray[Any]]] = {name: [] for name in wanted}
        for block in range(len(self._blocks) + bool(self._last)):
            last = min((block + 1) * BLOCK, len(self._rows) - 1)
            of_block = None if rows is None else rows[self._rows[block * BLOCK] : self._rows[last]]
            if of_block is not None and not of_block.any():
                continue
            frames = self._read(block) if block < len(self._blocks) else self._last
            for name, value in wanted.items():
                values = np.concatenate([value(one) for one in frames])
                parts[name].append(values if of_block is None else values[of_block])
        return {name: np.concatenate(part) for name, part in parts.items() if part}

    def with_columns(self, columns: Mapping[str, NDArray[Any]]) -> Self:
        """Return the same tracks with other values of some columns, in the order of `columns`."""
        changed = object.__new__(type(self))
        vars(changed).update(vars(self) | {"_changed": columns})
        return changed

    def _write(self) -> None:
        of_tracks = Tracks.arrays["id"].rows
        columns = {
            name: [getattr(one, name) for one in self._last]
            for name, array in Tracks.arrays.items()
            if array.rows == of_tracks
        }
        joined = {
            name: np.concatenate(parts) for name, parts in columns.items() if all(one is not None for one in parts)
        }
        rest = [
            ({name: value for name, value in vars(one).items() if name not in joined}, one.model_fields_set)
            for one in self._last
        ]
        self._blocks.append((joined, rest))
        self._last = []

    def _read(self, block: int) -> list[Tracks]:
        joined, rest = self._blocks[block]
        ends = np.array(self._rows[block * BLOCK :][: len(rest) + 1]) - self._rows[block * BLOCK]
        return [
            Tracks.of_valid(values | {name: one[first:last] for name, one in joined.items()}, given)
            for (values, given), first, last in zip(rest, ends[:-1].tolist(), ends[1:].tolist(), strict=True)
        ]
