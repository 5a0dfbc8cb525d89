"""`optipmb ablate`: what each module of the tracker is worth on a dataset."""

from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from optipmb_client.commands.options import (
    AsJson,
    Classes,
    DatasetName,
    Detections,
    Options,
    Profile,
    Root,
    Sequences,
    Source,
    Truth,
    asked_for,
    open_sequences,
    print_json,
    print_table,
    say,
)
from optipmb_client.progress import FrameProgress

if TYPE_CHECKING:
    from collections.abc import Sequence as Many

    from optipmb_client.tuning import Figures, Row

MODULES = ("adp", "habm", "rpp", "ote")
SHOWN = ("AMOTA", "AMOTP", "FN", "FP", "IDS", "sAMOTA", "MOTA", "MOTP", "HOTA", "HOTA, all")


def ablate(  # noqa: PLR0913  these are the command's options
    data: Source = None,
    *,
    dataset: DatasetName = None,
    root: Root = None,
    detections: Detections = None,
    sequences: Sequences = None,
    option: Options = None,
    truth: Truth = None,
    profile: Profile = None,
    classes: Classes = None,
    markdown: Annotated[bool, typer.Option("--markdown", help="Print the tables as Markdown.")] = False,
    as_json: AsJson = False,
) -> None:
    """Track a dataset with every choice of the four modules on and off: the sixteen rows of the paper's ablation.

    All classes of the profile are tracked, those named are shown. FPS are frames per second of the tracker alone.
    """
    from optipmb_client import tuning  # noqa: PLC0415  loads the tracker and its compiler
    from optipmb_client.offline import profile_compared  # noqa: PLC0415  as above

    asked = asked_for(data, dataset, root, detections, option, truth)
    opened, chosen = open_sequences(asked, sequences)
    name = profile or opened.profile
    parameters = profile_compared(name, chosen)
    source = tuning.Source.of(asked.name, asked.detections, chosen, parameters, classes)
    lengths = [len(clip.frames) for clip in source.clips] * len(tuning.ROWS)
    done = iter(lengths)
    with FrameProgress("ablation", sum(lengths)) as progress:
        rows = list(
            tuning.ablate(
                asked.name, chosen, source.clips, parameters, source.classes, lambda: progress.advance(next(done))
            )
        )
    if as_json:
        print_json(
            {
                "command": "ablate",
                "dataset": asked.name,
                "profile": name,
                "sequences": [sequence.name for sequence in chosen],
                "rows": [row.to_json() for row in rows],
            }
        )
        return
    tables = [(label, [row.classes[label] for row in rows]) for label in source.classes]
    if len(source.classes) > 1:
        tables.append(("all classes", [row.overall for row in rows]))
    for title, figures in tables:
        if markdown:
            say(_markdown(title, rows, figures))
        else:
            print_table(_table(title, rows, figures))


def _cells(row: "Row", figures: "Figures") -> list[str]:
    values = figures.to_json()
    return [
        *("x" if getattr(row.modules, module) else "" for module in MODULES),
        *(_shown(values[name]) for name in SHOWN),
        f"{row.frames_per_second:.0f}",
    ]


def _markdown(title: str, rows: "Many[Row]", figures: "Many[Figures]") -> str:
    names = (*(module.upper() for module in MODULES), *SHOWN, "FPS")
    lines = [f"{title}:", "", "| " + " | ".join(names) + " |"]
    lines.append("|" + " --- |" * len(MODULES) + " ---: |" * (len(names) - len(MODULES)))
    lines += ["| " + " | ".join(_cells(row, one)) + " |" for row, one in zip(rows, figures, strict=True)]
    return "\n".join([*lines, ""])


def _table(title: str, rows: "Many[Row]", figures: "Many[Figures]") -> Table:
    table = Table(title=title, title_justify="left", box=None, pad_edge=False)
    for name in (*(module.upper() for module in MODULES), *SHOWN, "FPS"):
        table.add_column(name, justify="right", no_wrap=True)
    for row, one in zip(rows, figures, strict=True):
        table.add_row(*_cells(row, one))
    return table


def _shown(value: float | None) -> str:
    if value is None:
        return "-"
    return str(int(value)) if value == int(value) else f"{value:.4f}"
