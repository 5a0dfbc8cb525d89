"""Progress of tuning on standard error: rate, time left and the best score so far.

On a terminal a bar; elsewhere (a log file, CI) a plain line every ten seconds.
"""

import sys
import time
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

PLAIN_PERIOD_S = 10.0


class TrialDisplay:
    """Shows the trials of one class after the other; trials that an earlier session has done take no time."""

    def __init__(self, *, terminal: bool | None = None) -> None:
        self._bar: Progress | None = None
        if sys.stderr.isatty() if terminal is None else terminal:
            columns = (
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TextColumn("{task.fields[rate]}"),
                TimeRemainingColumn(),
            )
            self._bar = Progress(*columns, console=Console(stderr=True), transient=True)
        self._name, self._total, self._done = "", 0, 0
        self._begun = self._shown = time.monotonic()

    def __enter__(self) -> Self:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def begin(self, name: str, trials: int) -> None:
        """Show that a class begins, with so many trials."""
        self._name, self._total, self._done = name, trials, 0
        self._begun = self._shown = time.monotonic()
        if self._bar is not None:
            for task in self._bar.task_ids:
                self._bar.remove_task(task)
            self._task = self._bar.add_task(name, total=trials, rate="")

    def trial(self, best: float) -> None:
        """Show that a trial is done, and the best value of its search so far."""
        self._done += 1
        now = time.monotonic()
        rate = self._done / max(now - self._begun, 1e-9)
        text = f"best {best:.4f}, {60.0 * rate:.1f} trials a minute"
        if self._bar is not None:
            self._bar.update(self._task, advance=1, rate=text)
        elif now - self._shown >= PLAIN_PERIOD_S or self._done == self._total:
            self._shown = now
            left = (self._total - self._done) / rate
            self._print(f"{self._name}: trial {self._done} of {self._total}, {text}, {left:.0f} s left")

    def note(self, text: str) -> None:
        """Show the current step."""
        if self._bar is not None:
            self._bar.update(self._task, description=text)
        else:
            self._print(text)

    def _print(self, text: str) -> None:
        print(text, file=sys.stderr, flush=True)  # noqa: T201  this is the display
