"""Reading files with errors that name the place, and writing files that appear complete or not at all."""

import codecs
import contextlib
import os
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from optipmb_schemas import MessageError


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


LARGEST: Final = 1e15  # numbers beyond it are none of a data set: their squares and nanoseconds overflow
_FOREIGN: Final = {
    b"version https://git-lfs": "a pointer of Git LFS: git lfs pull fetches the file",
    b"<!doctype html": "a page of HTML, as a download gives that asks for a login",
    b"<html": "a page of HTML, as a download gives that asks for a login",
    b"pk\x03\x04": "a ZIP archive or a spreadsheet: unpack it, or save it as CSV",
    b"\x1f\x8b": "a file compressed by gzip: unpack it, or name it *.gz",
    b"\x28\xb5\x2f\xfd": "a file compressed by Zstandard: unpack it, or name it *.zst",
    b"par1": "a Parquet file: name it *.parquet",
    b"arrow1": "a Feather file: name it *.feather",
    b"feather": "a Feather file of version 1: write it again as Parquet",
    b"\x89hdf": "an HDF5 file: write it as Parquet",
    b"\x89mcap": "a recording: name it *.mcap",
    b"sqlite format 3": "a database of SQLite: name a bag *.db3, export a table as CSV",
    b"\x93numpy": "an array of numpy: write it as a table",
}
"""First bytes of files, in lower case, and what these are."""


def refuse_foreign(path: Path, what: str, data: bytes, *own: bytes) -> None:
    """Raise a `DatasetError` where data begin like another kind of file than `own`."""
    head = data[:64].removeprefix(codecs.BOM_UTF8).lstrip().lower()
    for magic, found in _FOREIGN.items():
        if head.startswith(magic) and magic not in own:
            raise DatasetError(path, what, found)


@contextlib.contextmanager
def reading(path: Path | str) -> Iterator[None]:
    """Name a file or folder in the unexpected errors that are raised while it is read."""
    try:
        yield
    except Exception as error:
        error.add_note(f"{path} was being read")
        raise


@contextlib.contextmanager
def damage(path: Path | str, what: str) -> Iterator[None]:
    """Report any exception of a library on the bytes of a file as damage: their types are not documented."""
    try:
        yield
    except (DatasetError, MessageError):
        raise
    except Exception as error:
        if isinstance(error, OSError) and error.filename is not None:
            raise
        raise DatasetError(path, what, f"{type(error).__name__}: {error}") from error


def unexpected(error: BaseException) -> str:
    """Return the line that reports an unexpected error and the input that was being read."""
    notes = "; ".join(dict.fromkeys(getattr(error, "__notes__", ())))
    text = f"{type(error).__name__}: {error}" + (f" ({notes})" if notes else "")
    return f"unexpected {text}: please report this line, with the file if you can; --debug shows the traceback"


def decode_text(path: Path, data: bytes, what: str, encoding: str | None = None) -> str:
    r"""Return the text of a file without byte order mark, its lines ended by ``\n``.

    Args:
        path: The file, for errors.
        data: Its bytes.
        what: Expected content, for errors.
        encoding: Of the user; None: UTF-8, or UTF-16 where the first bytes are its mark.

    Raises:
        DatasetError: The bytes are no text in the encoding.
    """
    marked = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    used = encoding or ("utf-16" if marked else "utf-8-sig")
    text, wrong = "", data.find(0) if used == "utf-8-sig" else -1
    try:
        text = data.decode(used)
    except LookupError as error:
        raise DatasetError("--option encoding", "latin-1, cp1252, utf-8, utf-16-le …", repr(encoding)) from error
    except UnicodeDecodeError as error:
        wrong = error.start
    if wrong >= 0:
        raise DatasetError(path, what, f"byte 0x{data[wrong]:02x}", line=data[:wrong].count(b"\n") + 1)
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_text(path: Path, what: str) -> str:
    """Return the text of a file; `what` names its content in the error when it cannot be read."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DatasetError(path, what, error.strerror or "an unreadable file") from error
    refuse_foreign(path, what, data)
    return decode_text(path, data, f"{what} as text in UTF-8")


def read_points(path: Path, what: str, columns: int) -> NDArray[np.float32]:
    """Return x, y, z (P, 3) of a file of 32-bit numbers, `columns` per point.

    Raises:
        DatasetError: The file cannot be read, or its size fits no number of points.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DatasetError(path, what, error.strerror or "an unreadable file") from error
    refuse_foreign(path, what, data)
    if len(data) % (4 * columns):
        raise DatasetError(path, f"{4 * columns} bytes per point", f"{len(data)} bytes")
    return np.ascontiguousarray(np.frombuffer(data, dtype="<f4").reshape(-1, columns)[:, :3])


def read_rows(path: Path, what: str) -> list[tuple[int, list[str]]]:
    """Return (line number from 1, fields) of every line that is not blank; commas and blanks divide fields."""
    lines = enumerate(read_text(path, what).replace(",", " ").split("\n"), start=1)
    return [(number, fields) for number, line in lines if (fields := line.split())]


def numbers(path: Path, rows: Iterable[tuple[int, list[str]]], columns: int, what: str) -> NDArray[np.float64]:
    """Return fields as finite numbers (R, columns) up to `LARGEST`.

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
    bad = np.argwhere(~(np.abs(values) <= LARGEST))
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


def write_whole(path: Path, content: bytes | memoryview | Iterable[str | bytes]) -> None:
    """Write a file of bytes, or of parts one after the other; it appears under its name complete, or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    temporary = Path(name)
    try:
        with os.fdopen(descriptor, "wb") as file:
            parts = [content] if isinstance(content, bytes | memoryview) else content
            file.writelines(part.encode() if isinstance(part, str) else part for part in parts)
            file.flush()
            os.fsync(file.fileno())
        # A temporary file is private to its owner; the finished one is to be as readable as any other new file.
        mask = os.umask(0)
        os.umask(mask)
        temporary.chmod(0o666 & ~mask)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def remove_unfinished(folder: Path, names: Iterable[str]) -> None:
    """Remove temporary files that killed writers of files with these stems left in a folder."""
    stems = set(names)
    for entry in folder.glob(".*"):
        if entry.name[1:].rpartition(".")[0].rpartition(".")[0] in stems:
            entry.unlink(missing_ok=True)


def is_number(text: str) -> bool:
    """Tell whether a text is a number, which for Python also 1_000 is."""
    try:
        float(text)
    except ValueError:
        return False
    return "_" not in text
