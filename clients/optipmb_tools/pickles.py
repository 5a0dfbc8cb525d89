"""Results of OpenPCDet (`result.pkl`), read without running anything of the file.

A pickle is a program that calls functions by their names. This reader admits the few that numpy's arrays need, and each
of them is a stand-in of its own that makes no more than the bytes of the file: `numpy.ndarray` itself would make 4 GB
from 30 bytes.
"""

import io
import pickle
import pickletools
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np

from optipmb_tools.files import DatasetError

LARGEST: Final = 2 << 30
"""Bytes of a file from which it is refused."""
_LISTS: Final = ("name", "score", "boxes_lidar")
_REFUSED: Final = frozenset({"PERSID", "BINPERSID", "EXT1", "EXT2", "EXT4", "NEXT_BUFFER", "READONLY_BUFFER"})
_EXPECTED: Final = "a result.pkl of OpenPCDet: a list of frames with name, score and boxes_lidar"


class _Type:
    """Type of an array, of numbers or texts."""

    def __init__(self, code: str) -> None:
        self.dtype = np.dtype(code)
        if self.dtype.kind not in "biufSU":
            raise ValueError(f"an array of type {code}")

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        if state[1] in {"<", ">"} and state[3] is None:
            self.dtype = self.dtype.newbyteorder(state[1])


class _Array:
    """Array that gets its shape, type and bytes after it was made."""

    def __init__(self) -> None:
        self.values: np.ndarray = np.empty(0)

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _, shape, kind, fortran, data = state
        self.values = _filled(data, kind, shape, "F" if fortran else "C").values


class _Function:
    """Function that a file may call; it cannot be changed."""

    __slots__ = ("_call",)

    def __init__(self, call: Callable[..., Any]) -> None:
        self._call = call

    def __call__(self, *arguments: Any) -> Any:
        return self._call(*arguments)


_MARK: Final = object()
"""Stands for `numpy.ndarray`."""


def _empty(mark: object, shape: tuple[int, ...], _: bytes) -> _Array:
    if mark is not _MARK or shape != (0,):
        raise ValueError("an array that is not empty")
    return _Array()


def _filled(data: Any, kind: _Type, shape: tuple[int, ...], order: Any) -> _Array:
    if not isinstance(data, bytes | bytearray) or not isinstance(kind, _Type):
        raise TypeError("an array without bytes")
    found = _Array()
    size = kind.dtype.itemsize
    values = np.frombuffer(data, kind.dtype) if size else np.zeros(len(data), kind.dtype)
    found.values = values.reshape(shape, order=order)
    return found


def _encoded(text: str, encoding: str) -> bytes:
    if encoding != "latin1":
        raise ValueError(f"the encoding {encoding!r}")
    return text.encode("latin1")


def _functions() -> dict[tuple[str, str], Any]:
    numbers: dict[tuple[str, str], Any] = {}
    for core in ("numpy.core", "numpy._core"):
        numbers |= {
            (f"{core}.multiarray", "_reconstruct"): _Function(_empty),
            (f"{core}.multiarray", "scalar"): _Function(lambda kind, data: _filled(data, kind, (), "C").values.item()),
            (f"{core}.numeric", "_frombuffer"): _Function(_filled),
        }
    return numbers | {
        ("numpy", "ndarray"): _MARK,
        ("numpy", "dtype"): _Function(lambda code, *_: _Type(code)),
        ("collections", "OrderedDict"): _Function(dict),
        ("_codecs", "encode"): _Function(_encoded),
        ("builtins", "bytes"): _Function(lambda: b""),
        ("__builtin__", "bytes"): _Function(lambda: b""),
    }


class _Reader(pickle.Unpickler):
    def __init__(self, data: bytes, path: Path) -> None:
        super().__init__(io.BytesIO(data))
        self._path, self._functions = path, _functions()

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in self._functions:
            how = "the folder preds of its JSON files is read" if module.startswith("torch") else "convert it"
            received = f"{module}.{name}: {how}, see docs/detectors.md"
            raise DatasetError(self._path, f"{_EXPECTED}, of arrays alone", received)
        return self._functions[module, name]


def read_pickle(path: Path) -> list[dict[str, Any]]:
    """Return a record with the lists of boxes for each frame.

    Raises:
        DatasetError: The file is another pickle, or none; names its content.
    """
    if path.stat().st_size > LARGEST:
        raise DatasetError(path, f"at most {LARGEST >> 30} GB", f"{path.stat().st_size} bytes")
    data = path.read_bytes()
    try:
        _check(data)
        frames = _Reader(data, path).load()
    except DatasetError:
        raise
    except Exception as error:  # noqa: BLE001  anything may be raised by what a file holds
        raise DatasetError(path, _EXPECTED, f"{error}"[:120] or type(error).__name__) from None
    if not isinstance(frames, list) or not all(isinstance(one, dict) for one in frames):
        raise DatasetError(path, _EXPECTED, type(frames).__name__)
    return [{"frame": number} | _lists(path, place, one) for place, (number, one) in enumerate(_numbered(frames))]


def _check(data: bytes) -> None:
    """Raise for operations that no result has, cut data, and places in memory beyond the length of the file."""
    for count, (operation, argument, _) in enumerate(pickletools.genops(data)):
        if operation.name in _REFUSED:
            raise ValueError(f"an object elsewhere ({operation.name})")
        if operation.name in {"PUT", "BINPUT", "LONG_BINPUT"} and int(argument or 0) > count:
            raise ValueError("a damaged pickle")


def _numbered(frames: list[dict[str, Any]]) -> list[tuple[int, dict[str, Any]]]:
    """Return the frames with their numbers, their places where the file has none."""
    texts = [str(one.get("frame_id", "")) for one in frames]
    numbers = [int(text) for text in texts] if all(text.isdecimal() for text in texts) else range(len(frames))
    return list(zip(numbers, frames, strict=True))


def _lists(path: Path, place: int, frame: dict[str, Any]) -> dict[str, Any]:
    found = {}
    for name in _LISTS:
        if not isinstance(frame.get(name), _Array):
            raise DatasetError(path, f"{_EXPECTED}, of arrays", f"frame {place} with {name} = {frame.get(name)!r:.40}")
        found[name] = frame[name].values.tolist()
    if len({len(one) for one in found.values()}) > 1:
        raise DatasetError(path, f"arrays of one length in frame {place}", str({n: len(v) for n, v in found.items()}))
    return found
