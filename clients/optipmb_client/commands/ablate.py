"""`optipmb ablate`: what each module of the tracker is worth on a dataset."""

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from optipmb_client.commands.options import (
    AsJson,
    Classes,
    LabelledOptions,
    Profile,
    open_sequences,
    print_json,
    print_table,
    say,
)
from optipmb_client.progress import FrameProgress

if TYPE_CHECKING:
    from collections.abc import Sequence as Many

    from optipmb_client import tuning
    from optipmb_client.tuning import Figures, Row, Variant

MODULES = ("adp", "habm", "rpp", "ote")
SHOWN = ("AMOTA", "AMOTP", "FN", "FP", "IDS", "sAMOTA", "MOTA", "MOTP", "HOTA", "HOTA, all")


def ablate(
    data: LabelledOptions,
    *,
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

    asked = data.asked()
    opened, chosen = open_sequences(asked, data.sequences)
    name = profile or opened.profile
    parameters = profile_compared(name, chosen)
    source = tuning.Source.of(asked.name, asked.detections, chosen, parameters, classes)
    rows = measured("ablation", source, tuning.ablation(parameters))
    if as_json:
        print_json(
            {
                "command": "ablate",
                "dataset": asked.name,
                "profile": name,
                "sequences": [sequence.name for sequence in chosen],
                "rows": [{"modules": asdict(row.variant.modules)} | row.to_json() for row in rows],
            }
        )
        return
    marks = [[("x" if getattr(row.variant.modules, one) else "") for one in MODULES] for row in rows]
    speed = [f"{row.frames_per_second:.0f}" for row in rows]
    for title, figures in by_class(rows):
        cells = [[*left, *cells_of(one, SHOWN), fps] for left, one, fps in zip(marks, figures, speed, strict=True)]
        print_rows(title, [one.upper() for one in MODULES], [*SHOWN, "FPS"], cells, markdown=markdown)


def measured(title: str, source: "tuning.Source", variants: "Many[Variant]") -> "list[Row]":
    """Measure variants of the tracker, with a progress bar."""
    from optipmb_client.tuning import measure_variants  # noqa: PLC0415  as above

    with FrameProgress(title, sum(len(clip.frames) for clip in source.clips) * len(variants)) as progress:
        return list(measure_variants(source, variants, progress.advance))


def by_class(rows: "Many[Row]") -> "list[tuple[str, list[Figures]]]":
    """Return the figures of all rows for each class, and of all classes where there are several."""
    tables = [(label, [row.classes[label] for row in rows]) for label in rows[0].classes]
    return tables if len(tables) == 1 else [*tables, ("all classes", [row.overall for row in rows])]


def cells_of(figures: "Figures", names: "Many[str]") -> list[str]:
    """Return figures as the cells of a table."""
    from optipmb_client.evaluation.figures import number  # noqa: PLC0415  as above

    return [number(figures[name]) for name in names]


def print_rows(
    title: str, left: "Many[str]", right: "Many[str]", cells: "Many[Many[str]]", *, markdown: bool = False
) -> None:
    """Print a table; the columns named in `left` say what a row is, the others are figures."""
    if markdown:
        lines = [f"{title}:", "", "| " + " | ".join([*left, *right]) + " |"]
        lines.append("|" + " --- |" * len(left) + " ---: |" * len(right))
        say("\n".join([*lines, *("| " + " | ".join(row) + " |" for row in cells), ""]))
        return
    table = Table(title=title, title_justify="left", box=None, pad_edge=False)
    for name in (*left, *right):
        table.add_column(name, justify="right", no_wrap=True)
    for row in cells:
        table.add_row(*row)
    print_table(table)
