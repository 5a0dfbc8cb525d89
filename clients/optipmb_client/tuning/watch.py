"""How far a session has come."""

from typing import Protocol

__all__ = ["Quiet", "Watch"]


class Watch(Protocol):
    """Told how far a session has come."""

    def begin(self, name: str, trials: int) -> None:
        """Hear that a class begins, with so many trials."""

    def trial(self, best: float) -> None:
        """Hear that a trial is done, and the best value of its search so far."""

    def note(self, text: str) -> None:
        """Hear what is being done."""


class Quiet:
    """Listens and says nothing."""

    def begin(self, name: str, trials: int) -> None:
        """Hear that a class begins."""

    def trial(self, best: float) -> None:
        """Hear that a trial is done."""

    def note(self, text: str) -> None:
        """Hear what is being done."""
