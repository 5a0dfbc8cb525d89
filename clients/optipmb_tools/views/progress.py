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


class _Bar:
    """A bar on a terminal, with a column of its own for the rate; None elsewhere."""

    def __init__(self, rate: ProgressColumn, *, terminal: bool | None) -> None:
        self._begun = self._shown = time.monotonic()
        self._bar: Progress | None = None
        if sys.stderr.isatty() if terminal is None else terminal:
            columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), rate, TimeRemainingColumn())
            self._bar = Progress(*columns, console=Console(stderr=True), transient=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def _begin(self) -> None:
        self._begun = self._shown = time.monotonic()
        if self._bar is not None:
            self._bar.start()


class FrameProgress(_Bar):
    """Counts frames up to a total; shows itself from the first frame on. Safe to use from several threads.

    Args:
        title: Name of the work, in a word or two.
        total: Number of frames.
        terminal: Whether to draw a bar; default: whether standard error is a terminal.
    """

    def __init__(self, title: str, total: int, *, terminal: bool | None = None) -> None:
        super().__init__(_FrameRate(), terminal=terminal)
        self._title = title
        self._total = total
        self._done = 0
        self._lock = threading.Lock()
        if self._bar is not None:
            self._task = self._bar.add_task(title, total=total)

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
                _print(f"{self._title}: {self._done} of {self._total} frames, {rate:.0f} per second, {left:.0f} s left")

    def note(self, text: str) -> None:
        """Show a line of text."""
        if self._bar is not None:
            self._bar.console.print(text, markup=False, highlight=False)
        else:
            _print(text)


class TrialDisplay(_Bar):
    """Shows the trials of one class after the other; trials that an earlier session has done take no time."""

    def __init__(self, *, terminal: bool | None = None) -> None:
        super().__init__(TextColumn("{task.fields[rate]}"), terminal=terminal)
        self._name, self._total, self._done = "", 0, 0

    def begin(self, name: str, trials: int) -> None:
        """Show that a class begins, with so many trials."""
        self._name, self._total, self._done = name, trials, 0
        self._begin()
        if self._bar is not None:
            for task in self._bar.task_ids:
                self._bar.remove_task(task)
            self._task = self._bar.add_task(name, total=trials, rate="")

    def trial(self, best: float) -> None:
        """Show that a trial is done, and the best value of its search so far."""
        self._done += 1
        now = time.monotonic()
        rate = self._done / max(now - self._begun, 1e-9)
        text = f"best {100 * best:.2f} %, {60.0 * rate:.1f} trials a minute"
        if self._bar is not None:
            self._bar.update(self._task, advance=1, rate=text)
        elif now - self._shown >= PLAIN_PERIOD_S or self._done == self._total:
            self._shown = now
            left = (self._total - self._done) / rate
            _print(f"{self._name}: trial {self._done} of {self._total}, {text}, {left:.0f} s left")

    def note(self, text: str) -> None:
        """Show the current step."""
        if self._bar is not None:
            self._bar.update(self._task, description=text)
        else:
            _print(text)


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
            _print(text)


class _FrameRate(ProgressColumn):
    def render(self, task: Task) -> Text:
        """Return the rate as text; nothing before there is one."""
        return Text("" if task.speed is None else f"{task.speed:.0f} frames/s", style="progress.data.speed")


def _print(text: str) -> None:
    print(text, file=sys.stderr, flush=True)  # noqa: T201  this is the display
