"""The command `optipmb`. An error is one line on standard error and a status: 2 for what was asked, 1 for the rest."""

import inspect
import re
import signal
import sys
from collections.abc import Sequence
from importlib.metadata import version
from types import FrameType
from typing import Annotated, Any, NoReturn

import typer
from optipmb_schemas import MessageError
from typer.core import TyperCommand, TyperGroup

from optipmb_client.arguments import filled, spread
from optipmb_client.commands.ablate import ablate
from optipmb_client.commands.check import check
from optipmb_client.commands.demo import demo
from optipmb_client.commands.drain import drain
from optipmb_client.commands.evaluate import evaluate
from optipmb_client.commands.load import load
from optipmb_client.commands.move import move
from optipmb_client.commands.options import MANY, RAY_ADDRESS, grouped
from optipmb_client.commands.play import play
from optipmb_client.commands.plot import plot
from optipmb_client.commands.profiles import profiles
from optipmb_client.commands.record import record
from optipmb_client.commands.replay import replay
from optipmb_client.commands.set import set_profile
from optipmb_client.commands.status import status
from optipmb_client.commands.sweep import sweep
from optipmb_client.commands.track import track
from optipmb_client.commands.tracks import tracks
from optipmb_client.commands.tune import tune
from optipmb_client.commands.warm_up import warm_up
from optipmb_client.commands.watch import watch
from optipmb_client.datasets import DatasetError
from optipmb_client.errors import ClientError, UsageError
from optipmb_client.extras import to_install

__all__ = ["app", "main", "run"]

FAILED = 1
WRONG = 2
INTERRUPTED = 128 + signal.SIGINT
TERMINATED = 128 + signal.SIGTERM

# What the option parser raises for a wrong option: the base of its public subclass, as it has no public name itself.
_OptionError: Any = typer.BadParameter.__base__


class _Command(TyperCommand):
    def get_params(self, ctx: Any) -> list[Any]:  # the context and the parameters have no public types
        return _without_types_of_flags(super().get_params(ctx))


class _Group(TyperGroup):
    def get_params(self, ctx: Any) -> list[Any]:  # as above
        return _without_types_of_flags(super().get_params(ctx))


def _without_types_of_flags(parameters: list[Any]) -> list[Any]:
    """Let the help show no type beside a flag, because a flag takes no value."""
    for one in parameters:
        if getattr(one, "is_flag", False):
            one.metavar = ""
    return parameters


app = typer.Typer(
    name="optipmb",
    cls=_Group,
    help="Track objects in 3D: offline, or through a tracking service.",
    add_completion=False,
)
for command in (
    demo,
    check,
    track,
    replay,
    record,
    play,
    watch,
    evaluate,
    tune,
    ablate,
    sweep,
    plot,
    status,
    tracks,
    profiles,
    load,
    set_profile,
    move,
    drain,
    warm_up,
):
    paragraphs = inspect.cleandoc(command.__doc__ or "").split("\n\n")
    name = "set" if command is set_profile else None  # a function of that name would hide Python's own
    app.command(name, cls=_Command, help="\n\n".join(" ".join(part.split()) for part in paragraphs))(grouped(command))


def _version(value: bool) -> None:  # noqa: FBT001  the parser calls it so
    if value:
        typer.echo(f"optipmb {version('optipmb')}")
        raise typer.Exit


@app.callback()
def _options(
    *,
    _show: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Options before the command."""


def run(arguments: Sequence[str]) -> int:
    """Run one command line, without the program's name; return the exit status."""
    try:
        words = filled(spread(arguments, MANY), "--ray", RAY_ADDRESS, "local")
        words = filled(words, "--submission", re.compile(r"\d*\.?\d+"), "default")
        result = app(words or ["--help"], prog_name="optipmb", standalone_mode=False)
        return int(result or 0)
    except _OptionError as error:
        return _fail(WRONG, error.format_message())
    except ModuleNotFoundError as error:
        text = to_install(error.name or "", f"optipmb {arguments[0]}")
        if text is None:
            raise
        return _fail(FAILED, text)
    except (UsageError, DatasetError, MessageError, ClientError) as error:
        return _fail(FAILED if isinstance(error, ClientError) else WRONG, str(error))
    except OSError as error:
        return _fail(WRONG, f"{error.filename}: {error.strerror}" if error.filename else str(error))
    except (KeyboardInterrupt, typer.Abort):
        return _fail(INTERRUPTED, "interrupted")


def main() -> NoReturn:
    """Run the command line of this process and exit."""
    signal.signal(signal.SIGTERM, _terminate)
    sys.exit(run(sys.argv[1:]))


def _terminate(_number: int, _frame: FrameType | None) -> NoReturn:
    sys.exit(TERMINATED)  # as an exception, so that every session is closed and every child ended


def _fail(status: int, text: str) -> int:
    print("optipmb: " + " ".join(text.split()), file=sys.stderr)  # noqa: T201  this is the error line
    return status
