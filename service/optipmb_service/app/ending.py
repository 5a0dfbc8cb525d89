"""The bound on the end of a process, one for all of the service: whatever hangs, the process ends and says what hung.

Zenoh's `session.close` may hang, and so may any call into a library at the end; whoever waits for the process may have
nothing that kills it. So a bound runs from the moment when the end begins, beside the end itself:

- A thread counts most of it, logs where every thread is, and ends the process with status 1.
- What hangs with the interpreter's lock held lets no other Python run. For that case a thread of `faulthandler`,
  which needs no lock, does the same at the end of the bound, with tracebacks in place of the log line.

The time for which the process is frozen (SIGSTOP, `docker pause`) does not count, as long as it does not outlast what
is left: else the thread of `faulthandler`, which wakes up first and cannot know of it, ends the process.

A step that may hang before the last checkpoints are written is done on a thread of its own (`Steps`), and left there.
"""

from __future__ import annotations

import contextlib
import faulthandler
import math
import os
import sys
import threading
import time
import traceback
from typing import TYPE_CHECKING, Final

import structlog

from optipmb_service.observability import logs

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import FrameType

HANDOVER_S: Final = 4.0
"""At the end, how long other members may take to have the streams; it takes a second."""

CLOSE_S: Final = 3.0
"""At the end, how long a process may take to close, beyond handover and grace."""

SPARE_S: Final = 1.0
"""Beyond these, before a process that has not ended is ended."""

LAST_S: Final = 0.5
"""Of the bound, what is kept for saying what hung."""

STEP_S: Final = 1.0
"""How long the other steps of an end wait for one that may hang."""

SLICE_S: Final = 0.25
"""The time of an end is counted in slices of so long."""

LATE_S: Final = 2.0
"""What wakes up so late was frozen, or starved, with all of its process."""

END_HUNG: Final = 1
"""Exit status of a process in which a step of the end hung."""

RESTART: Final = 75
"""Exit status of a process that has ended in order to begin again (sysexits.h: try again)."""

STDERR: Final = 2
CALLS: Final = 6
"""Calls that are logged of a thread: the innermost one, and those of these packages."""

PACKAGES: Final = ("optipmb_service", "optipmb_client")

log = structlog.get_logger("optipmb_service")


def longest_end_s(grace_s: float) -> float:
    """Return how long a process may take to end.

    Args:
        grace_s: for frames already received.
    """
    return HANDOVER_S + grace_s + CLOSE_S + SPARE_S


class Deadline:
    """A time by which several stages end, each of which may take what those before it have left.

    Args:
        seconds: from now on.
    """

    def __init__(self, seconds: float) -> None:
        self._ends = time.monotonic() + seconds

    def left(self, most: float = math.inf) -> float:
        """Return the seconds that are left, at most so many."""
        return max(0.0, min(most, self._ends - time.monotonic()))


class EndBound:
    """Ends this process when its end takes too long.

    Args:
        seconds: how long it may take.
    """

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._lock = threading.RLock()  # a signal may interrupt who holds it, and begin too
        self._begun = False
        self._left_s = seconds - LAST_S

    def begin(self) -> bool:
        """The end begins; by any thread or signal handler, and again without effect.

        Returns:
            Whether it has a bound: False where no thread can be started.
        """
        with self._lock:
            if not self._begun:
                self._begun = True
                try:
                    self._arm()
                    threading.Thread(target=self._watch, name="end", daemon=True).start()
                except RuntimeError:
                    self._begun = False
            return self._begun

    def left(self) -> float:
        """Return the seconds that are left for the steps of the end."""
        return self._left_s

    def _arm(self) -> None:
        """Have the thread that needs no lock end the process, when so long has passed as is left."""
        faulthandler.dump_traceback_later(self._left_s + LAST_S, exit=True, file=STDERR)

    def _watch(self) -> None:
        before = time.monotonic()
        while self._left_s > 0.0:
            time.sleep(min(SLICE_S, self._left_s))
            now = time.monotonic()
            if now - before < LATE_S:
                self._left_s = max(0.0, self._left_s - (now - before))
            else:
                self._arm()
            before = now
        # Not on this thread: nobody may be reading the log.
        logging = threading.Thread(target=_log_threads, args=(self._seconds,), name="end", daemon=True)
        with contextlib.suppress(RuntimeError):  # no thread can be started
            logging.start()
            logging.join(0.8 * LAST_S)
        os._exit(END_HUNG)


class Steps:
    """Steps of an end that may hang, and behind which others must be done."""

    def __init__(self) -> None:
        self._threads: list[threading.Thread] = []

    def do(self, name: str, step: Callable[[], object]) -> None:
        """Do a step; one that hangs, or raises, keeps the next ones waiting for `STEP_S` at most."""

        def work() -> None:
            try:
                step()
            except Exception:
                log.exception("internal_error", step=name)

        thread = threading.Thread(target=work, name=name, daemon=True)
        self._threads.append(thread)
        with contextlib.suppress(RuntimeError):  # no thread can be started: it remains unfinished
            thread.start()
            thread.join(STEP_S)

    def unfinished(self, seconds: float) -> bool:
        """Whether one has not ended after so long, or could not begin, which is logged."""
        deadline = Deadline(seconds)
        for thread in self._threads:
            if thread.is_alive():
                thread.join(deadline.left())
        names = [thread.name for thread in self._threads if thread.is_alive() or thread.ident is None]
        if names:
            log.error("step_hangs", steps=names)
        return bool(names)


def leave_or_restart(status: int) -> None:
    """End the process, or begin it again in its place, with its id and what it was started with."""
    if status == RESTART:
        sys.stdout.flush()
        logs.finish()
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])  # noqa: S606 - the command line of this process itself
    leave(status)


def leave(status: int) -> None:
    """End the process; at once where a thread is left that nobody waits for.

    It may be stuck in machine code, which would crash an orderly end. The one of a bound is among them: once an end has
    been in order there is nothing left to wait for.
    """
    sys.stdout.flush()
    logs.finish()
    if any(thread.daemon and thread.is_alive() for thread in threading.enumerate()):
        os._exit(status)
    sys.exit(status)


def _log_threads(seconds: float) -> None:
    names = {thread.ident: thread.name for thread in threading.enumerate() if thread.name != "end"}
    frames = sys._current_frames()  # noqa: SLF001 - the documented way to see what threads do
    threads = {names[ident]: calls for ident, frame in frames.items() if ident in names and (calls := _calls(frame))}
    log.error("end_hangs", bound_s=seconds, threads=threads)
    logs.finish()


def _calls(frame: FrameType) -> str:
    """Return what a thread does; nothing where that is nothing of these packages."""
    stack = [(one.f_globals.get("__name__", ""), one, line) for one, line in traceback.walk_stack(frame)]
    ours = [one for one in stack if one[0].partition(".")[0] in PACKAGES]
    calls = [*stack[:1], *(one for one in ours if one is not stack[0])][:CALLS] if ours else []
    return " < ".join(f"{module}.{one.f_code.co_name}:{line}" for module, one, line in calls)
