"""The command `optipmb`. An error is one line on standard error and a status: 2 for wrong input, 1 for the rest.

An unexpected error is one line too, with the input that was being read; `--debug` shows its traceback.
"""

import atexit
import inspect
import os
import re
import signal
import sys
import threading
import traceback
from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from importlib import import_module
from importlib.metadata import version
from types import FrameType
from typing import Annotated, Any, NoReturn

import typer
from optipmb_client.errors import ClientError, UsageError
from optipmb_schemas import MessageError
from rich.markup import escape
from typer.core import TyperCommand, TyperGroup

from optipmb_tools.commands.options import MANY, RAY_ADDRESS, grouped
from optipmb_tools.extras import to_install
from optipmb_tools.files import DatasetError, unexpected

FAILED = 1
WRONG = 2
INTERRUPTED = 128 + signal.SIGINT
TERMINATED = 128 + signal.SIGTERM

# Module of each command, and its function where that has another name; in the order of the help
COMMANDS = {
    "demo": "demo",
    "check": "check",
    "track": "track",
    "replay": "replay",
    "record": "recordings",
    "play": "recordings",
    "watch": "view",
    "evaluate": "evaluate",
    "tune": "tune",
    "ablate": "ablate",
    "sweep": "ablate",
    "plot": "view",
    "camera": "camera",
    "status": "service",
    "tracks": "service",
    "links": "links",
    "profiles": "profiles",
    "set": "service",
    "move": "service",
    "drain": "service",
    "warm-up": "profiles",
}
FUNCTIONS = {"set": "set_profile", "warm-up": "warm_up"}

# Arguments of each command, for the end of its help
EXAMPLES = {
    "demo": ("--live", "--out out/demo"),
    "check": ("detections.csv", "detections.csv --option yaw=degrees"),
    "track": ("detections.csv --out tracks.csv", "--dataset kitti --root KITTI --detections pointrcnn --out tracks"),
    "replay": ("detections.csv --speed 1 --out tracks.csv", "bag --connect tcp/10.0.0.7:7447 --out tracks"),
    "record": ("--out site.mcap", "--streams 'garage/*/*' --duration 60 --out garage.mcap"),
    "play": ("site.mcap", "site.mcap --speed 1"),
    "watch": ("--web", "site.mcap --save site.rrd"),
    "evaluate": (
        "detections.csv --truth truth.csv --tracks tracks.csv",
        "--dataset kitti --root KITTI --tracks tracks --class Car",
    ),
    "tune": ("detections.csv --truth truth.csv --name mine", "--dataset kitti --root KITTI --name mine --trials 4"),
    "ablate": ("--dataset kitti --root KITTI --detections pointrcnn", "--dataset scene --classes Car"),
    "sweep": (
        "--dataset scene --parameter detection=0.7,0.8,0.9",
        "detections.csv --truth truth.csv --parameter gate=3,5",
    ),
    "plot": (
        "detections.csv --tracks tracks.csv --out tracks.png",
        "detections.csv --tracks tracks.csv --out tracks.gif",
    ),
    "camera": ("fit points.csv --image 1920x1080 --out gate.toml", "ground gate.toml 812,640 960,700"),
    "status": ("", "--watch"),
    "tracks": ("garage/robot-1/lidar --last 10", "garage/robot-1/lidar --last 60 --out tracks.csv"),
    "links": ("campus", "campus --json"),
    "profiles": ("", "generic --copy mine.toml"),
    "load": ("--streams 10 --seconds 30", "--streams 100 --rate 10"),
    "set": ("garage/robot-1/lidar --profile kitti", "garage/robot-1/lidar --profile kitti --restart"),
    "move": ("garage/robot-1/lidar --to 1", "garage/robot-1/lidar --to 0 --instance host-7"),
    "drain": ("", "host-7 --undo"),
    "warm-up": ("", "--json"),
}

# The option parser's error for a wrong option: the base of its public subclass, as it has no public name itself.
_OptionError: Any = typer.BadParameter.__base__


class _Command(TyperCommand):
    def get_params(self, ctx: Any) -> list[Any]:  # the context and the parameters have no public types
        return _shown_as_written(super().get_params(ctx))


class _Commands(TyperGroup):
    """The commands; the module of one is imported when it is called, or listed in the help."""

    def get_params(self, ctx: Any) -> list[Any]:  # as above
        return _shown_as_written(super().get_params(ctx))

    def list_commands(self, ctx: Any) -> list[str]:  # noqa: ARG002  as click calls it
        return list(COMMANDS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:  # noqa: ARG002  as click calls it
        if cmd_name not in COMMANDS:
            return None
        module = import_module(f"optipmb_tools.commands.{COMMANDS[cmd_name]}")
        command = getattr(module, FUNCTIONS.get(cmd_name, cmd_name))
        paragraphs = inspect.cleandoc(command.__doc__ or "").split("\n\n")
        text = "\n\n".join(" ".join(part.split()) for part in paragraphs)
        alone = typer.Typer(add_completion=False)
        lines = (f"optipmb {cmd_name} {arguments}".strip() for arguments in EXAMPLES[cmd_name])
        epilog = "Examples:\n\n" + "\n\n".join(map(escape, lines))
        alone.command(cmd_name, cls=_Command, help=escape(text), epilog=epilog)(grouped(command))
        return typer.main.get_command(alone)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the command that the first word names; for an unknown one, the error names those like it."""
        try:
            return super().resolve_command(ctx, args)
        except _OptionError as error:
            if alike := get_close_matches(args[0], COMMANDS, n=1):
                error.message += f" Did you mean {alike[0]}?"
            else:
                error.message += " optipmb help lists the commands."
            raise


def _shown_as_written(parameters: list[Any]) -> list[Any]:
    """Show brackets of the help as they are, and no type of flags, because a flag takes no value."""
    for one in parameters:
        if getattr(one, "help", None) and "\\[" not in one.help:  # the help asks several times
            one.help = escape(one.help)
        if getattr(one, "is_flag", False):
            one.metavar = ""
    return parameters


app = typer.Typer(
    name="optipmb",
    cls=_Commands,
    help="Track objects in 3D: offline, or through a tracking service.",
)


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
    _debug: Annotated[
        bool, typer.Option("--debug", help="Show the traceback of an error; also after a command.")
    ] = False,
) -> None:
    """Options before the command."""


def run(arguments: Sequence[str]) -> int:
    """Run one command line, without the program's name; return the exit status."""
    end = arguments.index("--") if "--" in arguments else len(arguments)
    debug = "--debug" in arguments[:end]
    try:
        words = [one for place, one in enumerate(arguments) if one != "--debug" or place > end]
        return _run(words)
    except (KeyboardInterrupt, typer.Abort) as error:
        return _fail(INTERRUPTED, f"interrupted{': ' if error.args else ''}{error}")
    except Exception as error:  # noqa: BLE001  the last handler: no traceback reaches a user who did not ask for it
        status, text = _line_of(error, " ".join(arguments[:1]))
        if debug:
            traceback.print_exc()
        return _fail(status, text)


def _run(arguments: list[str]) -> int:
    words = filled(spread(arguments, MANY), "--ray", RAY_ADDRESS, "local")
    words = filled(words, "--submission", re.compile(r"\d*\.?\d+"), "default")
    words = filled(words, "--rejoin", re.compile(r"-?\d*\.?\d+"), "60")
    if words[:1] == ["help"]:
        words = [*words[1:], "--help"]
    return int(app(words or ["--help"], prog_name="optipmb", standalone_mode=False) or 0)


def _line_of(error: Exception, command: str) -> tuple[int, str]:
    """Return the exit status and the line of an error."""
    if isinstance(error, _OptionError):
        return WRONG, error.format_message()
    if isinstance(error, ModuleNotFoundError) and (text := to_install(error.name or "", f"optipmb {command}")):
        return FAILED, text
    if isinstance(error, UsageError | DatasetError | MessageError | ClientError):
        return FAILED if isinstance(error, ClientError) else WRONG, str(error)
    if isinstance(error, OSError):
        return WRONG, f"{error.filename}: {error.strerror}" if error.filename else str(error)
    return FAILED, unexpected(error)


def main() -> NoReturn:
    """Run the command line of this process and exit."""
    signal.signal(signal.SIGTERM, _terminate)
    status = TERMINATED
    atexit.register(lambda: _leave(status))  # the first one, which is called last
    try:
        status = run(sys.argv[1:])
    finally:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)  # the status stands; an exception would only be a traceback
    sys.exit(status)


def _leave(status: int) -> None:
    """End the process at once where a daemon thread is left, such as one that opens a session.

    It may be in machine code: to return from there to an interpreter that ends aborts the process.
    """
    if any(one.daemon for one in threading.enumerate()):
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def _terminate(_number: int, _frame: FrameType | None) -> NoReturn:
    sys.exit(TERMINATED)  # as an exception, so that every session is closed and every child ended


def _fail(status: int, text: str) -> int:
    print("optipmb: " + " ".join(text.split()), file=sys.stderr)  # noqa: T201  this is the error line
    return status


def filled(arguments: Sequence[str], option: str, values: re.Pattern[str], default: str) -> list[str]:
    """Rewrite `--x` as `--x=DEFAULT` where none of the values that the option takes follows."""
    end = arguments.index("--") if "--" in arguments else len(arguments)
    return [
        f"{one}={default}"
        if one == option and place < end and not values.fullmatch("".join(arguments[place + 1 : place + 2]))
        else one
        for place, one in enumerate(arguments)
    ]


def spread(arguments: Sequence[str], options: Iterable[str]) -> list[str]:
    """Rewrite `--x a b,c` as `--x a --x b --x c` for each of the `options`.

    The values of an option are the arguments after it up to the next one that begins with a dash. A flag without a
    value stays alone, for the parser to complain about.
    """
    many = set(options)
    result: list[str] = []
    flag = ""
    for position, argument in enumerate(arguments):
        if argument == "--":
            return [*result, *arguments[position:]]
        name, equals, value = argument.partition("=")
        if name in many:
            flag = name
            following = arguments[position + 1 : position + 2]
            if equals:
                result += _pairs(flag, value)
            elif not following or following[0].startswith("-"):
                result.append(flag)
        elif argument.startswith("-"):
            flag = ""
            result.append(argument)
        else:
            result += _pairs(flag, argument) if flag else [argument]
    return result


def _pairs(flag: str, values: str) -> list[str]:
    names = [name for name in values.split(",") if name]
    return [part for name in names or [""] for part in (flag, name)]
