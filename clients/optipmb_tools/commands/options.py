"""Options that several commands share, and printing."""

import dataclasses
import inspect
import json
import os
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryFile
from typing import Annotated, Any

import typer
from optipmb_client.errors import UsageError
from rich.console import Console, Group, RenderableType
from rich.status import Status
from rich.table import Table

from optipmb_tools.datasets import DATASETS, DataSequence, Dataset, dataset_at, open_dataset
from optipmb_tools.datasets.interface import Assumption
from optipmb_tools.results.exports import FEATURES, OPENLABEL, is_openlabel
from optipmb_tools.run.bulk import Executor, executor_for, processors
from optipmb_tools.table_files import SUFFIXES

WORTH_PROCESSES = 3000  # frames from which further processes are faster than this one alone
WIDE = 200
MANY = ("--sequences", "--classes", "--class", "--streams")  # options that take several values after one flag
RAY_ADDRESS = re.compile(r"auto|local|(ray://)?[^\s/]+:\d+")  # values of --ray

Classes = Annotated[
    list[str] | None,
    typer.Option("--classes", metavar="NAME...", help="Only objects of these classes.", show_default=False),
]


def reading(root: Path | None) -> Status:
    """Say on a terminal, while the context lasts, that data are read, which takes seconds for millions of rows."""
    return Console(stderr=True).status(f"reading {'a scene' if root is None else root.name}")


def _out(out: Path) -> Path:
    """Refuse a file in a format that is not written, and a place where none can be, before anything is computed."""
    suffix = out.suffix.lower()
    place = next(one for one in (out, *out.absolute().parents) if one.exists())
    folder = place if place.is_dir() else place.parent
    if place != out and not place.is_dir():
        raise UsageError(f"--out {out}: expected a place in a folder, but {place} is a file")
    try:
        with TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise UsageError(f"--out {out}: {folder} cannot be written to: {error.strerror}") from None
    known = suffix in (*SUFFIXES, *FEATURES, ".mcap") or is_openlabel(out)
    if not out.is_dir() and not known and re.fullmatch(r"\.[a-z]{2,}[a-z0-9]*", suffix):
        raise UsageError(f"--out {out}: expected a folder, or a table ({', '.join((*SUFFIXES, *FEATURES, OPENLABEL))})")
    return out


Out = Annotated[
    Path,
    typer.Option(
        "--out",
        callback=_out,
        help="Folder for the results, or a file: .csv, .parquet, .jsonl, .feather, .geojson, .mfjson, .openlabel.json.",
    ),
]
Full = Annotated[
    bool, typer.Option("--full", help="Also write all that is known of the tracks, with covariances, as .npz files.")
]
Digits = Annotated[
    str,
    typer.Option(
        "--digits", metavar="unit|full", help="Of numbers in tables as text: 1e-4 m, rad and so on, or every bit."
    ),
]
Profile = Annotated[
    str | None,
    typer.Option(
        "--profile", help="Parameter profile, or auto for a detector that nobody tuned; default: the dataset's own."
    ),
]
Origin = Annotated[
    str | None,
    typer.Option(
        "--origin",
        metavar="LAT,LON,HEIGHT[,X_HEADING]",
        help="Place of the world frame on WGS84, and its x axis in degrees clockwise from true north (90: x is east): "
        "tables get the columns lat, lon, alt and heading, and may have lat and lon in the place of x and y.",
        show_default=False,
    ),
]
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
All = Annotated[bool, typer.Option("--all", help="Also tracks that are not confirmed.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]


@dataclass(frozen=True)
class Data:
    """A data set that was opened, and the sequences that were chosen."""

    dataset: Dataset
    sequences: list[DataSequence]

    @property
    def name(self) -> str:
        """Name of the data set, as `--dataset` gives it."""
        return self.dataset.name

    @property
    def frames(self) -> int:
        return sum(map(len, self.sequences))

    @property
    def names(self) -> list[str]:
        return [sequence.name for sequence in self.sequences]

    @property
    def labels(self) -> tuple[str, ...]:
        """Classes of the sequences, in their order."""
        return tuple(dict.fromkeys(label for sequence in self.sequences for label in sequence.labels))


@dataclass(frozen=True, kw_only=True)
class DatasetOptions:
    """Options that name a data set and its sequences."""

    data: Path | None = field(default=None, init=False)
    dataset: Annotated[
        str | None, typer.Option("--dataset", help=f"Layout of the data: {', '.join(DATASETS)}.", show_default=False)
    ] = None
    root: Annotated[Path | None, typer.Option("--root", help="File or folder of the dataset; scenes need none.")] = None
    detections: Annotated[
        str | None, typer.Option("--detections", help="Detector: name of a folder in detections/, or a path.")
    ] = None
    sequences: Annotated[
        list[str] | None,
        typer.Option("--sequences", metavar="NAME...", help="Sequences, splits, or all.", show_default=False),
    ] = None
    option: Annotated[
        list[str] | None,
        typer.Option(
            "--option",
            metavar="NAME=VALUE",
            help="Option of the dataset: frames=50 of a scene, yaw=degrees of a table.",
        ),
    ] = None
    verbose: Annotated[bool, typer.Option("--verbose", help="Say all that is assumed about the data.")] = False
    truth: Path | None = field(default=None, init=False)
    camera: Path | None = field(default=None, init=False)

    def named(self) -> tuple[str, Path | None]:
        """Return the name of the data set and its root.

        Raises:
            DatasetError: The argument looks like no data that are known.
            UsageError: No data are named, or two.
        """
        dataset, root = self.dataset, self.root
        if self.data is not None:
            if root is not None:
                raise UsageError(f"{self.data} and --root {root}: one of them names the data")
            dataset, root = dataset or dataset_at(self.data), self.data
        if dataset is None:
            raise UsageError("no data: name a table, a recording or a folder, or give --dataset and --root")
        return dataset, root

    def options(self, dataset: str) -> dict[str, float | str]:
        """Return the options of the data set.

        Raises:
            UsageError: An option is not `NAME=VALUE`, or not for this data set.
        """
        found = dict(_option(text) for text in self.option or ())
        if self.truth is not None:
            if dataset != "table":
                raise UsageError(f"--truth: for tables; {dataset} has annotations of its own")
            found["truth"] = str(self.truth)
        if self.camera is not None:
            if dataset != "table":
                raise UsageError(f"--camera: for tables of pixel boxes, not for {dataset}")
            found["camera"] = str(self.camera)
        return found

    def open(self, **more: float | str) -> Data:
        """Open the data set, with further options, and the chosen sequences, all by default; print the assumptions.

        Raises:
            DatasetError, UsageError: Any of it is not there, or not allowed.
        """
        name, root = self.named()
        with reading(root):
            opened = open_dataset(name, root, self.detections, **self.options(name) | more)
            chosen = list(opened.sequences(self.sequences or ["all"]))
        notes = [*opened.notes, *(note for one in chosen for note in one.notes)]
        for note in notes if self.verbose else in_short(notes):
            warn(note)
        return Data(opened, chosen)


@dataclass(frozen=True, kw_only=True)
class DataOptions(DatasetOptions):
    """Options of a data set, which an argument may name too."""

    data: Annotated[
        Path | None,
        typer.Argument(
            metavar="[DATA]",
            help="Your data: a table (CSV, Parquet, JSON Lines, Feather) or a folder of them, a bag of ROS 2, a "
            "recording (.mcap), or a folder of KITTI or nuScenes. In the place of --dataset and --root.",
            show_default=False,
        ),
    ] = None
    camera: Annotated[
        Path | None,
        typer.Option(
            "--camera",
            help="Calibration (TOML) that places the pixel boxes of a table on the ground.",
            show_default=False,
        ),
    ] = None


@dataclass(frozen=True, kw_only=True)
class LabelledOptions(DataOptions):
    """Options of data whose truth is needed."""

    truth: Annotated[
        Path | None,
        typer.Option(
            "--truth", help="Table of the true objects, or a folder of one per recording.", show_default=False
        ),
    ] = None


@dataclass(frozen=True, kw_only=True)
class JobOptions:
    """Options of work in several processes."""

    jobs: Annotated[
        int | None, typer.Option(min=1, help="Recordings at once; default: one for each processor.", show_default=False)
    ] = None
    ray: Ray = None

    def executor(self, frames: int, tasks: int) -> Executor:
        """Return an executor of `tasks` tasks; by default a process for each processor, for few frames this one.

        Raises:
            ClientError: Ray is not installed, or no cluster answers.
        """
        if self.ray is not None:
            return executor_for(self.jobs or 0, self.ray)
        jobs = self.jobs
        if jobs is None:
            jobs = processors() if frames > WORTH_PROCESSES else 1
        return executor_for(min(jobs, tasks))


def grouped(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command with the options of its groups as parameters of its own, which is how typer reads them."""
    given = inspect.signature(command, eval_str=True).parameters
    groups = {name: one.annotation for name, one in given.items() if hasattr(one.annotation, "__dataclass_fields__")}
    members = {
        name: list(inspect.signature(group, eval_str=True).parameters.values()) for name, group in groups.items()
    }

    def call(**values: Any) -> None:
        for name, group in groups.items():
            values[name] = group(**{one.name: values.pop(one.name) for one in members[name]})
        try:
            command(**values)
        except KeyboardInterrupt as interrupt:  # the parser would end without a word
            raise typer.Abort(*interrupt.args) from None

    spread = [one for name, whole in given.items() for one in members.get(name, [whole])]
    own = [one.replace(kind=inspect.Parameter.KEYWORD_ONLY) for one in spread]
    call.__dict__["__signature__"] = inspect.Signature(own)
    call.__name__, call.__doc__ = command.__name__, command.__doc__
    return call


def in_short(notes: Sequence[str]) -> list[str]:
    """Return the first clauses of assumptions, `PLACE: TEXT: MORE (--option NAME=VALUE)`, as a line, then the rest.

    Data and truth that are read in different ways have a line each, with the name of the file.
    """
    assumed = [note for note in notes if isinstance(note, Assumption)]
    if len(assumed) <= 1:
        return list(notes)
    of_place: dict[str, dict[str, None]] = {}
    for place, _, text in (note.partition(": ") for note in assumed):
        of_place.setdefault(place, {})[re.split(r": | \(--|; ", text)[0]] = None
    places: dict[str, list[str]] = {}
    for place, clauses in of_place.items():
        places.setdefault(", ".join(clauses), []).append(place)
    lines = [
        f"{clauses if len(places) == 1 else f'{alike[0]}{_more(alike)}: {clauses}'} (--verbose says more)"
        for clauses, alike in places.items()
    ]
    return [*lines, *(note for note in notes if not isinstance(note, Assumption))]


def _more(places: Sequence[str]) -> str:
    return f" and {len(places) - 1} more" if len(places) > 1 else ""


def _option(text: str) -> tuple[str, float | str]:
    name, equals, value = text.partition("=")
    if not (name and equals and value):
        raise UsageError(f"--option: expected NAME=VALUE, received {text!r}")
    return name, number_or_text(value)


def number_or_text(value: str) -> float | str:
    """Return the value of an option of a data set as a number, if it is one."""
    try:
        number = float(value)
    except ValueError:
        return value
    return int(number) if number.is_integer() else number


def plain_table(
    left: Sequence[str], right: Sequence[str] = (), *, title: str | None = None, folded: Sequence[str] = ()
) -> Table:
    """Return a table without lines; columns `right`, of numbers, are aligned to the right, `folded` ones may wrap."""
    table = Table(title=title, title_justify="left", box=None, pad_edge=False)
    for name in (*left, *right):
        table.add_column(name, justify="right" if name in right else "left", no_wrap=name not in folded)
    return table


def print_table(table: RenderableType) -> None:
    """Print something of rich on standard output.

    A table that is wider than the terminal is printed in parts, one below the other, each with the first columns.
    """
    from optipmb_tools.views.terminal import parts  # noqa: PLC0415  most commands print no table

    console = Console()
    width = console.width if console.is_terminal or "COLUMNS" in os.environ else WIDE
    console = Console(width=width)
    for part in table.renderables if isinstance(table, Group) else (table,):
        for number, fitting in enumerate(parts(part, width) if isinstance(part, Table) else (part,)):
            if number:
                console.print()
            console.print(fitting)


def report(result: dict[str, Any], *lines: str, as_json: bool) -> None:
    """Print a result as JSON, or the lines for people."""
    if as_json:
        print_json(result)
    else:
        for line in lines:
            say(line)


def print_json(result: Any) -> None:
    """Print a result on standard output as JSON: dataclasses as maps, paths as text."""
    typer.echo(json.dumps(result, default=_plain))


def say(text: str) -> None:
    """Print a line for people on standard output, at once."""
    typer.echo(text)
    sys.stdout.flush()


def warn(text: str) -> None:
    """Print a line on standard error."""
    typer.echo(f"optipmb: {text}", err=True)


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    return str(value)
