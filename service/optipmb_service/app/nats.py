"""One NATS server with what the service needs of it: for trying a cluster, and for one that may do without replicas.

The process becomes the server, so signals and exit status are the server's own.
"""

from __future__ import annotations

import os
import shutil
import sysconfig
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from pathlib import Path

NAME: Final = "nats-server"

PAYLOAD_MB: Final = 8
"""Largest message; a checkpoint may have three quarters of it. NATS' default, one, is too little for many objects."""

FILE: Final = "nats.conf"


def configuration(listen: str, folder: Path) -> str:
    """Return the configuration of a server.

    Args:
        listen: where it listens, as `127.0.0.1:4222`.
        folder: where its files are.
    """
    return f"""listen: "{listen}"
max_payload: {PAYLOAD_MB}MB
jetstream {{ store_dir: "{folder}" }}
"""


def program() -> str | None:
    """Return the path of the server, from the package beside this one or else from the system; None without one."""
    return shutil.which(NAME, path=sysconfig.get_path("scripts")) or shutil.which(NAME)


def become(server: str, listen: str, folder: Path) -> None:
    """Replace this process by the server.

    Raises:
        OSError: the folder cannot be written to.
    """
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / FILE
    file.write_text(configuration(listen, folder), encoding="utf-8")
    os.execv(server, [server, "--config", str(file)])  # noqa: S606 - no shell is wanted
