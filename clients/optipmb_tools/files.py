"""Reading files with errors that name the place, and writing files that appear complete or not at all."""

import os
import tempfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray


class DatasetError(ValueError):
    """Raised when data on disk, or an option that selects them, cannot be used.

    `path` is the file, folder or option; `line` counts from 1 and is None where no line is meant; `expected` and
    `received` describe the content. The text of the error is one line.
    """

    def __init__(self, path: Path | str, expected: str, received: str, *, line: int | None = None) -> None:
        self.path = str(path)
        self.line = line
        self.expected = expected
        self.received = received
        place = self.path if line is None else f"{self.path}:{line}"
        super().__init__(f"{place}: expected {expected}, received {received}")


def read_text(path: Path, what: str) -> str:
    """Return the text of a file; `what` names its content in the error when it cannot be read."""
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise DatasetError(path, what, error.strerror or "an unreadable file") from error
    except UnicodeDecodeError as error:
        raise DatasetError(path, what, "bytes that are not text") from error


def read_points(path: Path, what: str, columns: int) -> NDArray[np.float32]:
    """Return x, y, z (P, 3) of a file of 32-bit numbers, `columns` per point.

    Raises:
        DatasetError: The file cannot be read, or its size fits no number of points.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DatasetError(path, what, error.strerror or "an unreadable file") from error
    if len(data) % (4 * columns):
        raise DatasetError(path, f"{4 * columns} bytes per point", f"{len(data)} bytes")
    return np.ascontiguousarray(np.frombuffer(data, dtype="<f4").reshape(-1, columns)[:, :3])


def read_rows(path: Path, what: str, separator: str | None = None) -> list[tuple[int, list[str]]]:
    """Return (line number from 1, fields) of every line of a file that is not blank."""
    lines = enumerate(read_text(path, what).splitlines(), start=1)
    return [(number, line.split(separator)) for number, line in lines if line.strip()]


def numbers(path: Path, rows: Iterable[tuple[int, list[str]]], columns: int, what: str) -> NDArray[np.float64]:
    """Return fields as finite numbers (R, columns).

    Raises:
        DatasetError: A line has another number of fields, or a field is not a finite number; names the line.
    """
    values = np.empty((0, columns))
    taken = list(rows)
    for line, fields in taken:
        if len(fields) != columns:
            raise DatasetError(path, f"{columns} fields ({what})", f"{len(fields)} fields", line=line)
    if taken:
        try:
            values = np.array([fields for _, fields in taken], dtype=np.float64)
        except ValueError:
            values = np.array([[_number(path, line, field) for field in fields] for line, fields in taken])
    bad = np.argwhere(~np.isfinite(values))
    if len(bad):
        row, column = bad[0]
        line, fields = taken[row]
        raise DatasetError(path, "a finite number", repr(fields[column]), line=line)
    return values


def _number(path: Path, line: int, field: str) -> float:
    try:
        return float(field)
    except ValueError as error:
        raise DatasetError(path, "a number", repr(field), line=line) from error


def write_whole(path: Path, content: bytes | Iterable[str]) -> None:
    """Write a file of bytes, or of texts one after the other; it appears under its name complete, or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    temporary = Path(name)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.writelines([content] if isinstance(content, bytes) else map(str.encode, content))
            file.flush()
            os.fsync(file.fileno())
        # A temporary file is private to its owner; the finished one is to be as readable as any other new file.
        mask = os.umask(0)
        os.umask(mask)
        temporary.chmod(0o666 & ~mask)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def remove_unfinished(paths: Iterable[Path]) -> None:
    """Remove temporary files that killed writers of these files left in their folders."""
    names: dict[Path, set[str]] = {}
    for path in paths:
        names.setdefault(path.parent, set()).add(path.name)
    for folder, finished in names.items():
        for entry in folder.glob(".*"):
            if entry.name[1:].rpartition(".")[0] in finished:
                entry.unlink(missing_ok=True)
