"""What is saved of a session whose step raised, and where."""

from __future__ import annotations

import os
import platform
import re
import tempfile
import traceback
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Final

import optipmb_schemas as schemas

import optipmb
from optipmb_service.stepping import begins_with

if TYPE_CHECKING:
    from collections.abc import Sequence

    from optipmb_service.moments import Entry, Moment
    from optipmb_service.stepping import Stepper

SUFFIX: Final = ".dump"
MAX_TRACE: Final = 100_000


def dump_of(stepper: Stepper, base: Moment, placed: Sequence[Entry], error: Exception) -> bytes:
    """Return what `optipmb track --dump` replays to the same error.

    Args:
        stepper: of the session.
        base: the moment before the window.
        placed: the frames of the window with the one that failed, in the order of processing.
        error: what was raised.
    """
    frames: list[schemas.DumpedFrame] = []
    moment = base
    for entry in placed:
        anew = begins_with(moment, entry)
        try:
            moment, outcome = stepper.step(moment, entry)
        except Exception:  # noqa: BLE001 - the very one
            frames.append(schemas.DumpedFrame(entry.message, entry.points, anew))
            break
        if outcome.tracks is not None:
            begun = outcome.begins is not None and outcome.begins.reason != "first"
            frames.append(schemas.DumpedFrame(entry.message, entry.points, begun))
    return schemas.encode_dump(
        schemas.Dump(
            stream=stepper.stream,
            error=f"{type(error).__name__}: {error}",
            trace="".join(traceback.format_exception(error))[-MAX_TRACE:],
            versions={name: version(name) for name in ("optipmb", "numpy", "numba")}
            | {"python": platform.python_version()},
            parameters=stepper.parameters.model_dump(mode="json"),
            stamp_ns=base.density.stamp_ns,
            next_id=base.density.next_id,
            density=optipmb.columns_of(base.density),
            frames=tuple(frames),
        )
    )


def save(folder: Path, stream: str, dump: bytes, *, most: int) -> Path:
    """Write a dump into a folder, whole or not at all; the oldest dumps go when there are more than `most`.

    Returns:
        The file: the name of the stream and a number that counts up.

    Raises:
        OSError: the folder cannot be written to.
    """
    folder.mkdir(parents=True, exist_ok=True)
    number = 1 + max((_number(file) for file in folder.glob(f"*{SUFFIX}")), default=0)
    name = re.sub(r"[^A-Za-z0-9_.-]", "_", stream)
    handle, temporary = tempfile.mkstemp(dir=folder)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(dump)
            file.flush()
            os.fsync(file.fileno())
        target = folder / f"{name}-{number:06d}{SUFFIX}"
        Path(temporary).replace(target)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
    for old in sorted(folder.glob(f"*{SUFFIX}"), key=_number)[:-most]:
        old.unlink(missing_ok=True)
    return target


def _number(file: Path) -> int:
    match = re.search(r"-(\d+)$", file.name.removesuffix(SUFFIX))
    return int(match[1]) if match else 0
