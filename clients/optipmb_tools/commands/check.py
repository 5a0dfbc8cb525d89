"""`optipmb check`: findings of the readers about data, before tracking."""

import itertools
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from optipmb_tools.commands.options import AsJson, DataOptions, plain_table, print_json, print_table, reading, say
from optipmb_tools.datasets.interface import class_like
from optipmb_tools.datasets.motion import headings_along
from optipmb_tools.datasets.table.findings import Finding, Understood
from optipmb_tools.files import DatasetError

# Kinds of objects that a profile for unknown detectors tells apart
KINDS = ("car", "truck", "bus", "trailer", "pedestrian", "bicycle", "motorcycle")

if TYPE_CHECKING:
    from collections.abc import Sequence as Many

    from optipmb_tools.datasets import DataSequence
    from optipmb_tools.geometry import Floats


def check(
    data: DataOptions,
    *,
    plot: Annotated[
        Path | None, typer.Option("--plot", help="Picture of the first seconds from above to write (.png).")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Show how your data are read, without tracking.

    Units, rate, classes, headings against the motion of the boxes, suspicious rows, and the options that read them
    otherwise. Status 1: track would refuse the data; the findings marked as WRONG say why. Where tracks may be wrong, a
    finding is doubtful; where none is, the last line of the findings is "all right". The last table shows how each
    column of a table is read, with a row of it; --plot shows whether an axis is mirrored or a heading is wrong.
    """
    name, root = data.named()
    chosen: Many[DataSequence] = []
    findings: list[dict[str, Any]] = []
    columns: list[dict[str, Any]] = []
    if name == "table" and root is not None:
        from optipmb_tools.datasets.table import TableDataset  # noqa: PLC0415  packages of an extra

        options = {option: str(value) for option, value in data.options(name).items()}
        found: list[Finding] = []
        understood: list[Understood] = []
        try:
            with reading(root):
                table = TableDataset(root, options, lenient=True, findings=found, understood=understood)
                chosen = list(table.sequences(data.sequences or ["all"]))
        except DatasetError as error:
            if error.path.startswith("--"):
                raise
            found.append(Finding("data", str(error), wrong=True))
        findings = [asdict(one) for one in found]
        columns = [asdict(one) for one in understood]
    else:
        chosen = data.open().sequences
        share, moves = headings_along(chosen)
        text = f"{share:.0%} of {moves} moves are along the heading" if moves else "no box moves far enough to compare"
        findings = [asdict(Finding("yaw", text))]
    recordings = [_recording(one) for one in chosen]
    classes = _classes(chosen)
    if not classes and not any(one["wrong"] for one in findings):
        received = f"received none in {len(chosen)} recordings"
        findings.append(asdict(Finding("data", f"expected boxes, {received}", wrong=True)))
    if as_json:
        print_json(
            {"command": "check", "findings": findings, "recordings": recordings, "classes": classes, "columns": columns}
        )
    else:
        shown = [{"read as": one["role"] or "(not used)", **one} for one in columns]
        _print(findings, recordings, classes, [{k: v for k, v in one.items() if k != "role"} for one in shown])
    if plot is not None and chosen:
        from optipmb_tools.views.first_seconds import draw_first_seconds  # noqa: PLC0415  an extra

        draw_first_seconds(plot, chosen[0].name, chosen[0].frames())
        say(f"picture in {plot}")
    if any(one["wrong"] for one in findings):
        raise typer.Exit(1)


def _recording(sequence: "DataSequence") -> dict[str, Any]:
    steps = np.diff(sequence.stamps) / 1e9
    return {
        "recording": sequence.name,
        "frames": len(sequence),
        "Hz": round(1.0 / float(np.median(steps)), 3) if len(steps) and np.median(steps) else None,
        "seconds": round(float(steps.sum()), 3),
        "longest_gap_s": round(float(steps.max(initial=0.0)), 3),
        "boxes": sum(len(frame) for frame in sequence.frames()),
    }


def _classes(sequences: "Many[DataSequence]") -> list[dict[str, Any]]:
    rows: dict[str, list[Floats]] = {}
    for frame in itertools.chain.from_iterable(one.frames() for one in sequences):
        for label in np.unique(frame.label).tolist():
            mine = frame.label == label
            rows.setdefault(frame.labels[label], []).append(np.column_stack([frame.size, frame.score])[mine])
    found = []
    for name, parts in rows.items():
        values = np.concatenate(parts)
        known = [side[~np.isnan(side)] for side in values[:, :3].T]
        size = (
            " x ".join(f"{np.median(side):.3g}" if len(side) else "?" for side in known)
            if any(map(len, known))
            else "unknown"
        )
        scores = f"{values[:, 3].min():.3g} to {values[:, 3].max():.3g}"
        tracked = class_like(name, KINDS) or "other"
        found.append({"class": name, "kind": tracked, "boxes": len(values), "size": size, "scores": scores})
    return found


def _print(findings: "Many[dict[str, Any]]", *tables: "Many[dict[str, Any]]") -> None:
    table = plain_table(("", "finding", "change with"), folded=("finding", "change with"))
    for one in findings:
        mark = "WRONG " if one["wrong"] else "doubtful: " if one["doubt"] else ""
        table.add_row(one["topic"], mark + one["text"], one["option"])
    print_table(table)
    if not any(one["wrong"] or one["doubt"] for one in findings):
        print_table("all right")
    for rows in tables:
        if not rows:
            continue
        print_table("")
        names = [name.replace("_", " ") for name in rows[0]]
        table = plain_table(names[:1], names[1:], folded=names[:1])
        for row in rows:
            table.add_row(*("-" if value is None else str(value) for value in row.values()))
        print_table(table)
