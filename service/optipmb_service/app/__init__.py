"""The command line, and how the service is started, supervised and ended."""

import signal
from typing import Final

ENDING: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2)
"""Signals that end a process in order."""

WRONG_USE: Final = 2
"""Exit status of a command with wrong options or settings."""
