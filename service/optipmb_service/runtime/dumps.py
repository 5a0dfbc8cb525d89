"""Where the dumps of sessions whose step raised are kept."""

from __future__ import annotations

import os
import re
import tempfile
from pathlib import Path
from typing import Final

import structlog

log = structlog.get_logger("optipmb_service")

FOLDER: Final = "quarantine"
SUFFIX: Final = ".dump"
MOST: Final = 32


def save(state: Path | None, stream: str, dump: bytes) -> str:
    """Write a dump into the folder of the state, whole or not at all; of too many the oldest go.

    Returns:
        The file: the name of the stream and a number that counts up. Empty where nothing is kept or can be written.
    """
    if state is None:
        return ""
    try:
        return str(_save(state / FOLDER, stream, dump))
    except OSError as error:
        log.warning("store_failed", error=str(error))
        return ""


def _save(folder: Path, stream: str, dump: bytes) -> Path:
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
    for old in sorted(folder.glob(f"*{SUFFIX}"), key=_number)[:-MOST]:
        old.unlink(missing_ok=True)
    return target


def _number(file: Path) -> int:
    match = re.search(r"-(\d+)$", file.name.removesuffix(SUFFIX))
    return int(match[1]) if match else 0
