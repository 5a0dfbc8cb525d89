"""Progress of long work, shown on standard error so that standard output stays for results.

On a terminal: a bar with rate and time left. Elsewhere (a log file, CI): a plain line every ten seconds.
"""

import sys
import threading
import time
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.text import Text

PLAIN_PERIOD_S = 10.0


class FrameProgress:
    """Counts frames up to a total; shows itself from the first frame on. Safe to use from several threads.

    Args:
        title: Name of the work, in a word or two.
        total: Number of frames.
        terminal: Whether to draw a bar; default: whether standard error is a terminal.
    """

    def __init__(self, title: str, total: int, *, terminal: bool | None = None) -> None:
        self._title = title
        self._total = total
        self._done = 0
        self._lock = threading.Lock()
        self._bar: Progress | None = None
        self._begun = self._shown = time.monotonic()
        if sys.stderr.isatty() if terminal is None else terminal:
            self._bar = Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                _RateColumn(),
                TimeRemainingColumn(),
                console=Console(stderr=True),
                transient=True,
            )
            self._task = self._bar.add_task(title, total=total)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def advance(self, frames: int = 1) -> None:
        """Count `frames` more as done."""
        with self._lock:
            if not self._done:
                self._begin()
            self._done += frames
            if self._bar is not None:
                self._bar.advance(self._task, frames)
                return
            now = time.monotonic()
            if now - self._shown >= PLAIN_PERIOD_S:
                self._shown = now
                rate = self._done / (now - self._begun)
                left = (self._total - self._done) / rate
                text = f"{self._title}: {self._done} of {self._total} frames, {rate:.0f} per second, {left:.0f} s left"
                print(text, file=sys.stderr, flush=True)  # noqa: T201  this is the display

    def note(self, text: str) -> None:
        """Show a line of text."""
        if self._bar is not None:
            self._bar.console.print(text, markup=False, highlight=False)
        else:
            print(text, file=sys.stderr, flush=True)  # noqa: T201  this is the display

    def _begin(self) -> None:
        self._begun = self._shown = time.monotonic()
        if self._bar is not None:
            self._bar.start()


class StatusLine:
    """One line about work that has no known end; on a terminal it is overwritten, elsewhere added every ten seconds."""

    def __init__(self, *, terminal: bool | None = None) -> None:
        self._shown = time.monotonic()
        self._status = (
            Console(stderr=True).status("") if (sys.stderr.isatty() if terminal is None else terminal) else None
        )

    def __enter__(self) -> Self:
        if self._status is not None:
            self._status.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._status is not None:
            self._status.stop()

    def show(self, text: str) -> None:
        """Show how things stand."""
        if self._status is not None:
            self._status.update(text)
        elif time.monotonic() - self._shown >= PLAIN_PERIOD_S:
            self._shown = time.monotonic()
            print(text, file=sys.stderr, flush=True)  # noqa: T201  this is the display


class _RateColumn(ProgressColumn):
    """Frames per second."""

    def render(self, task: Task) -> Text:
        """Return the rate as text; nothing before there is one."""
        return Text("" if task.speed is None else f"{task.speed:.0f} frames/s", style="progress.data.speed")
