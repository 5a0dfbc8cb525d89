"""One task: what is called, and what comes of it. All of it can be sent to another process."""

import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Generic, TypeAlias, TypeVar

from optipmb_schemas import MessageError

from optipmb_client.errors import ClientError, UsageError
from optipmb_client.files import DatasetError

T = TypeVar("T")

Function: TypeAlias = Callable[[Any, Any], Any]  # a function of a module: (what all tasks share, the task) -> a value
_INPUT: Final = (UsageError, DatasetError, MessageError, OSError)


class WorkerDiedError(Exception):
    """The process or the machine that ran a task is gone, and nothing of the task came back."""


@dataclass(frozen=True)
class Done(Generic[T]):
    """A task that ended well."""

    value: T


@dataclass(frozen=True)
class Failed:
    """A task that ended with an error.

    Attributes:
        reason: One line.
        wrong_input: Whether the data or an option were wrong, not the program or its surroundings.
        trace: Where an error was raised that nobody expected; empty for others.
    """

    reason: str
    wrong_input: bool = False
    trace: str = ""

    def error(self) -> UsageError | ClientError:
        """Return the error to raise for it, with the trace as a note."""
        error = UsageError(self.reason) if self.wrong_input else ClientError(self.reason)
        if self.trace:
            error.add_note(self.trace)
        return error


def attempt(function: Function, shared: Any, task: Any) -> Done[Any] | Failed:
    """Run a task; return what it gave or how it failed."""
    try:
        return Done(function(shared, task))
    except _INPUT as error:
        return Failed(str(error), wrong_input=True)
    except ClientError as error:
        return Failed(str(error))
    except Exception as error:  # noqa: BLE001  reported with its trace; other tasks go on
        return Failed(f"{type(error).__name__}: {error}", trace=traceback.format_exc())
