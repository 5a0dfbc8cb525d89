"""A process that tracks: alone, or as one of the workers of a parent (`python -m optipmb_service.app.worker`).

Parent and worker talk in lines of JSON. The parent writes to the worker's stdin what it is to run with; when stdin
ends, so does the worker: the parent wants it, or is dead. The worker writes events to its stdout: `ready`, and a beat
twice a second. Logs go to stderr, which both share.
"""

from __future__ import annotations

import asyncio
import fcntl
import json
import signal
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Final

import structlog

import optipmb
from optipmb_service.app.control_loop import run
from optipmb_service.app.ending import leave
from optipmb_service.app.kernels import warm_up
from optipmb_service.observability import logs
from optipmb_service.runtime.profiles import Profiles
from optipmb_service.settings.model import Settings

if TYPE_CHECKING:
    from optipmb_service.app.loops import StopRequest
    from optipmb_service.app.service import Service

log = structlog.get_logger("optipmb_service")

WRONG_USE: Final = 2
LOCK: Final = "lock"
"""File that one worker at a time holds while it compiles."""


class SupervisingParent:
    """The parent, as a worker sees it.

    Args:
        index: which worker.
        private: folder that the workers share.
    """

    announces: Final = False  # to the network the workers are one instance, and the parent speaks for it

    def __init__(self, index: int, private: Path) -> None:
        self.index = index
        self.private = private
        self._service: Service | None = None
        self._writing = threading.Lock()

    def begin(self, asked: StopRequest) -> None:
        """End when the parent says so, or is gone."""
        threading.Thread(target=self._listen, args=(asked,), name="parent", daemon=True).start()

    def warm_up(self) -> None:
        """Compile the kernels, or load them: after an installation one worker compiles, and the others wait for it."""
        with (self.private / LOCK).open("a") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            warm_up()

    def ready(self, service: Service) -> None:
        """Say that streams are served."""
        self._service = service
        self._say(event="ready")

    def beat(self) -> None:
        """Give a sign of life, unless the tracking thread is stuck: then the parent is to replace this process."""
        if self._service is not None and not self._service.stuck:
            self._say(event="beat")

    def _listen(self, asked: StopRequest) -> None:
        for _ in sys.stdin:
            pass
        asked.ask_threadsafe("parent")

    def _say(self, **event: object) -> None:
        try:
            with self._writing:
                print(json.dumps(event), flush=True)  # noqa: T201 - the parent reads it
        except BrokenPipeError:
            log.warning("parent_gone")  # stdin has ended too, or will


def run_alone(settings: Settings) -> int:
    """Track all streams in this process; returns the exit status."""
    return _run(settings, None)


def main() -> int:
    """Be a worker; returns the exit status."""
    signal.signal(signal.SIGPIPE, signal.SIG_IGN)
    line = sys.stdin.readline()
    if not line:
        return 0  # the parent died at once
    order = json.loads(line)
    settings = Settings(**order["settings"])
    logs.configure(settings.log_format, settings.log_level, order["index"])
    return _run(settings, SupervisingParent(order["index"], Path(order["private"])))


def _run(settings: Settings, parent: SupervisingParent | None) -> int:
    try:
        profiles = Profiles.read(settings.profile, settings.profiles)
    except optipmb.ParameterError as error:
        if parent is None or parent.index == 0:  # of all workers one says it
            logs.say(f"optipmb-service: {' '.join(str(error).split())}")
        return WRONG_USE
    return asyncio.run(run(settings, profiles, parent))


if __name__ == "__main__":
    leave(main())
