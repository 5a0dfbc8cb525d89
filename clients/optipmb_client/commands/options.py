"""Options that several commands share, and how they print."""

import contextlib
import dataclasses
import json
import os
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Final

import typer
from optipmb_schemas.installation import install_command
from rich.console import Console, Group, RenderableType
from rich.table import Table

from optipmb_client.bulk import Executor, executor_for
from optipmb_client.columns import parts
from optipmb_client.datasets import DATASETS, DataSequence, Dataset, DatasetArguments, dataset_at
from optipmb_client.errors import ClientError, UsageError
from optipmb_client.table_files import SUFFIXES
from optipmb_client.zenoh import DEFAULT_ENDPOINT

__all__ = [
    "MANY",
    "RAY_ADDRESS",
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
    "Ray",
    "Root",
    "Sequences",
    "Source",
    "Speed",
    "Tracks",
    "Truth",
    "Wait",
    "Window",
    "asked_for",
    "executor_of",
    "mcap_needed",
    "open_sequences",
    "print_json",
    "print_table",
    "say",
    "warn",
]

WORTH_PROCESSES: Final = 3000
"""Frames from which further processes are faster than this one alone."""

WIDE = 200
MANY = ("--sequences", "--classes", "--class", "--streams")  # options that take several values after one flag

Source = Annotated[
    Path | None,
    typer.Argument(
        metavar="[DATA]",
        help="Your data: a table (CSV, Parquet, JSON Lines, Feather) or a folder of them, a bag of ROS 2, a recording "
        "(.mcap), or a folder of KITTI or nuScenes. In the place of --dataset and --root.",
        show_default=False,
    ),
]
DatasetName = Annotated[
    str | None,
    typer.Option("--dataset", help=f"Layout of the data: {', '.join(DATASETS)}.", show_default=False),
]
Truth = Annotated[
    Path | None,
    typer.Option("--truth", help="Table of the true objects, or a folder of one per recording.", show_default=False),
]
Root = Annotated[Path | None, typer.Option("--root", help="File or folder of the dataset; scenes need none.")]
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
    typer.Option(
        "--option", metavar="NAME=VALUE", help="Option of the dataset: frames=50 of a scene, yaw=degrees of a table."
    ),
]
Tracks = Annotated[
    Path, typer.Option("--tracks", help="Folder with the result files of track or replay, or a table of tracks.")
]


def _out(out: Path) -> Path:
    """Refuse a file in a format that is not written."""
    suffix = out.suffix.lower()
    if not out.is_dir() and suffix not in (*SUFFIXES, ".mcap") and re.fullmatch(r"\.[a-z]{2,}[a-z0-9]*", suffix):
        raise UsageError(f"--out {out}: expected a folder, or a table ({', '.join(SUFFIXES)})")
    return out


Out = Annotated[
    Path,
    typer.Option(
        "--out", callback=_out, help="Folder for the results, or one table: .csv, .parquet, .jsonl, .feather."
    ),
]
Full = Annotated[
    bool, typer.Option("--full", help="Also write all that is known of the tracks, with covariances, as .npz files.")
]
Profile = Annotated[
    str | None,
    typer.Option(
        "--profile", help="Parameter profile, or auto for a detector that nobody tuned; default: the dataset's own."
    ),
]
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
RAY_ADDRESS: Final = re.compile(r"auto|local|(ray://)?[^\s/]+:\d+")
"""What may follow --ray."""
Ray = Annotated[
    str | None,
    typer.Option(
        "--ray",
        metavar="[ADDRESS]",
        help="Work on a Ray cluster: HOST:PORT of its head, auto for the one of this machine; default: one that is "
        "started here and ends with the command.",
        show_default=False,
    ),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]


def asked_for(
    source: Path | None,
    dataset: str | None,
    root: Path | None,
    detections: str | None,
    options: list[str] | None,
    truth: Path | None = None,
) -> DatasetArguments:
    """Return which data the options of a command name.

    Raises:
        DatasetError: The source looks like no data that are known.
        UsageError: No data are named, or two, or an option is not `NAME=VALUE`.
    """
    if source is not None:
        if root is not None:
            raise UsageError(f"{source} and --root {root}: one of them names the data")
        dataset, root = dataset or dataset_at(source), source
    if dataset is None:
        raise UsageError("no data: name a table, a recording or a folder, or give --dataset and --root")
    chosen = dict(_option(text) for text in options or ())
    if truth is not None:
        if dataset != "table":
            raise UsageError(f"--truth: for tables; {dataset} has annotations of its own")
        chosen["truth"] = str(truth)
    return DatasetArguments(dataset, root, detections, tuple(chosen.items()))


def open_sequences(asked: DatasetArguments, sequences: list[str] | None) -> tuple[Dataset, list[DataSequence]]:
    """Open a dataset and the sequences asked for, all of them by default; say what was assumed about it.

    Raises:
        DatasetError: Any of it is not there; says what.
    """
    opened = asked.open()
    chosen = list(opened.sequences(sequences or ["all"]))
    for note in (note for one in (opened, *chosen) for note in getattr(one, "notes", ())):
        warn(note)
    return opened, chosen


def executor_of(jobs: int | None, ray: str | None, sequences: Sequence[DataSequence], tasks: int) -> Executor:
    """Return what runs so many tasks, or more: by default a process for each processor, for little data this one.

    Raises:
        ClientError: Ray is not installed, or no cluster answers.
    """
    if ray is not None:
        return executor_for(jobs or 0, ray)
    if jobs is None:
        jobs = len(os.sched_getaffinity(0)) if sum(map(len, sequences)) > WORTH_PROCESSES else 1
    return executor_for(min(jobs, tasks))


def warn(text: str) -> None:
    """Print a line on standard error."""
    typer.echo(f"optipmb: {text}", err=True)


def _option(text: str) -> tuple[str, float | str]:
    name, equals, value = text.partition("=")
    if not (name and equals and value):
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
        raise ClientError(f"recordings need mcap, which is not installed: {install_command('record')}") from error


def print_table(table: RenderableType) -> None:
    """Print something of rich on standard output.

    A table that is wider than the terminal is printed in parts, one below the other, each with the first columns.
    """
    console = Console()
    width = console.width if console.is_terminal or "COLUMNS" in os.environ else WIDE
    console = Console(width=width)
    for part in table.renderables if isinstance(table, Group) else (table,):
        for number, fitting in enumerate(parts(part, width) if isinstance(part, Table) else (part,)):
            if number:
                console.print()
            console.print(fitting)


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
