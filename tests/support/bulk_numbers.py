"""A task over numbers, in a module that imports quickly: every process of a pool imports it."""

import os
import signal

from optipmb_client.errors import UsageError


def double(shared: int, task: int) -> int:
    """A task: multiply, refuse one number, fail at another, and be killed at a third."""
    if task == 13:
        raise UsageError("thirteen")
    if task == 14:
        raise ZeroDivisionError("fourteen")
    if task == 15:
        os.kill(os.getpid(), signal.SIGKILL)
    return shared * task
