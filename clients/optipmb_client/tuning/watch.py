"""How far a session has come."""

__all__ = ["Watch"]


class Watch:
    """Told how far a session has come; this one says nothing."""

    def begin(self, name: str, trials: int) -> None:
        """Hear that a class begins, with so many trials."""

    def trial(self, best: float) -> None:
        """Hear that a trial is done, and the best value of its search so far."""

    def note(self, text: str) -> None:
        """Hear what is being done."""
