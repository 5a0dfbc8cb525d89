"""A folder of this process alone, for its lifetime and not beyond: what a killed process left, the next one removes.

Who lives holds a lock on a file in its folder; the kernel lets go of it however the process ends. The file gets its
name when it is locked already, so nobody finds one that is not locked yet.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterator

PREFIX: Final = "optipmb-"
HELD: Final = "held"


@contextlib.contextmanager
def private_folder() -> Iterator[Path]:
    """Make a folder that only this user may enter, and remove it at the end."""
    sweep(Path(tempfile.gettempdir()))
    with tempfile.TemporaryDirectory(prefix=PREFIX, ignore_cleanup_errors=True) as name:
        folder = Path(name)
        with (folder / "new").open("x") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            (folder / "new").rename(folder / HELD)
            yield folder


def sweep(place: Path) -> None:
    """Remove this user's folders whose processes are gone."""
    for held in place.glob(f"{PREFIX}*/{HELD}"):
        with contextlib.suppress(OSError):  # of another user, held by a process that lives, or removed meanwhile
            if held.parent.stat().st_uid != os.geteuid():
                continue
            with held.open() as file:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(held.parent)
