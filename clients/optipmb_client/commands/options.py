"""Options that several commands share, and how they print."""

import contextlib
import dataclasses
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console, RenderableType

from optipmb_client.datasets import DATASETS, DataSequence, Dataset, open_dataset
from optipmb_client.errors import ClientError, UsageError
from optipmb_client.transport import DEFAULT_ENDPOINT

__all__ = [
    "MANY",
    "AsJson",
    "Classes",
    "Config",
    "Connect",
    "DatasetName",
    "Detections",
    "Full",
    "Options",
    "Out",
    "Patience",
    "Prefix",
    "Profile",
    "Root",
    "Sequences",
    "Speed",
    "Tracks",
    "Wait",
    "Window",
    "mcap_needed",
    "open_sequences",
    "print_json",
    "print_table",
    "say",
]

WIDE = 200
MANY = ("--sequences", "--classes", "--class", "--streams")  # options that take several values after one flag

DatasetName = Annotated[str, typer.Option("--dataset", help=f"Layout of the data: {', '.join(DATASETS)}.")]
Root = Annotated[Path | None, typer.Option("--root", help="Folder of the dataset; generated scenes need none.")]
Detections = Annotated[
    str | None, typer.Option("--detections", help="Detector: name of a folder in detections/, or a path.")
]
Sequences = Annotated[
    list[str] | None,
    typer.Option("--sequences", metavar="NAME...", help="Sequences, splits, or all.", show_default=False),
]
Classes = Annotated[
    list[str] | None,
    typer.Option("--classes", metavar="NAME...", help="Only objects of these classes.", show_default=False),
]
Options = Annotated[
    list[str] | None,
    typer.Option("--option", metavar="NAME=VALUE", help="Option of the dataset, such as frames=50 of a scene."),
]
Tracks = Annotated[Path, typer.Option("--tracks", help="Folder with the result files of track or replay.")]
Out = Annotated[Path, typer.Option("--out", help="Folder for the results; made if needed.")]
Full = Annotated[
    bool, typer.Option("--full", help="Also write all that is known of the tracks, with covariances, as .npz files.")
]
Profile = Annotated[str | None, typer.Option("--profile", help="Parameter profile; default: the dataset's own.")]
Connect = Annotated[
    list[str] | None,
    typer.Option(
        "--connect",
        metavar="ENDPOINT",
        help=f"Router or service, several times for several; default: {DEFAULT_ENDPOINT}, or what --config says.",
        show_default=False,
    ),
]
Config = Annotated[Path | None, typer.Option("--config", help="Zenoh configuration file, for TLS and passwords.")]
Speed = Annotated[
    str, typer.Option("--speed", help="1: as recorded, 10: ten times as fast, max: as fast as tracks come back.")
]
Window = Annotated[int, typer.Option("--window", min=1, help="Frames under way at most, with --speed max.")]
Wait = Annotated[float, typer.Option("--wait", min=0.0, help="Seconds to wait for a service at the start.")]
Patience = Annotated[float, typer.Option("--patience", min=1.0, help="End when no tracks come for so many seconds.")]
Prefix = Annotated[str, typer.Option("--prefix", help="First part of all keys, as the service has it.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]


def open_sequences(
    dataset: str, root: Path | None, detections: str | None, sequences: list[str] | None, options: list[str] | None
) -> tuple[Dataset, list[DataSequence]]:
    """Open a dataset and the sequences asked for; all of them by default.

    Raises:
        DatasetError: Any of it is not there; says what.
        UsageError: An option is not `NAME=VALUE`.
    """
    opened = open_dataset(dataset, root, detections, **dict(_option(text) for text in options or ()))
    return opened, list(opened.sequences(sequences or ["all"]))


def _option(text: str) -> tuple[str, float | str]:
    name, equals, value = text.partition("=")
    if not name or not equals:
        raise UsageError(f"--option: expected NAME=VALUE, received {text!r}")
    try:
        number = float(value)
    except ValueError:
        return name, value
    return name, int(number) if number.is_integer() else number


@contextlib.contextmanager
def mcap_needed() -> Iterator[None]:
    """Say what to install where the packages for recordings are not."""
    try:
        yield
    except ImportError as error:
        raise ClientError("recordings need mcap, which is not installed: pip install 'optipmb[record]'") from error


def print_table(table: RenderableType) -> None:
    """Print something of rich on standard output; off a terminal lines are long enough that nothing is cut."""
    console = Console()
    (console if console.is_terminal else Console(width=WIDE)).print(table)


def print_json(result: Any) -> None:
    """Print a result on standard output as JSON: dataclasses as maps, paths as text."""
    typer.echo(json.dumps(result, default=_plain))


def say(text: str) -> None:
    """Print a line for people on standard output, at once."""
    typer.echo(text)
    sys.stdout.flush()


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    return str(value)
