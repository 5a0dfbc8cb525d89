"""`optipmb evaluate`: result files against the truth."""

from collections.abc import Sequence as Many
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from optipmb_client.commands.options import (
    AsJson,
    DatasetName,
    Detections,
    Options,
    Root,
    Sequences,
    Tracks,
    open_sequences,
    print_json,
    print_table,
)
from optipmb_client.datasets import DataSequence
from optipmb_client.errors import UsageError

if TYPE_CHECKING:
    from optipmb_client.evaluation import ClassResult, Rules

SHOWN = ("MOTA", "MOTP", "precision", "recall", "GT", "FP", "FN", "IDS", "FRAG")


def evaluate(  # noqa: PLR0913  these are the command's options
    *,
    dataset: DatasetName,
    tracks: Tracks,
    root: Root = None,
    detections: Detections = None,
    sequences: Sequences = None,
    option: Options = None,
    classes: Annotated[
        list[str] | None,
        typer.Option("--class", "--classes", metavar="NAME...", help="Classes to evaluate.", show_default=False),
    ] = None,
    iou: Annotated[
        float | None, typer.Option(min=0.0, max=1.0, help="Boxes match from this 3D intersection over union on.")
    ] = None,
    distance: Annotated[
        float | None, typer.Option(min=0.0, help="Boxes match up to this distance of their centres, in metres.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Compare result files with the truth: CLEAR MOT figures per class, for all tracks and for the best threshold.

    The best threshold is the one on the mean score of a track that gives the highest MOTA.
    """
    from optipmb_client.evaluation import evaluate_files  # noqa: PLC0415  loads the solvers of scipy

    _, chosen = open_sequences(dataset, root, detections, sequences, option)
    results = evaluate_files(chosen, tracks, classes or labels_of(chosen), _rules(dataset, iou, distance))
    if not results:
        raise UsageError("neither the truth nor the tracks have objects of these classes")
    if as_json:
        print_json(
            {
                "command": "evaluate",
                "dataset": dataset,
                "tracks": tracks,
                "sequences": [sequence.name for sequence in chosen],
                "classes": {result.name: _figures(result) for result in results},
            }
        )
    else:
        print_table(_table(results))


def labels_of(sequences: Many[DataSequence]) -> tuple[str, ...]:
    """Return the classes of the detections of some sequences, in their order."""
    return tuple(dict.fromkeys(label for sequence in sequences for label in next(sequence.frames()).labels))


def _rules(dataset: str, iou: float | None, distance: float | None) -> "Rules":
    from optipmb_client.evaluation import default_rules  # noqa: PLC0415  as above

    if iou is not None and distance is not None:
        raise UsageError("--iou and --distance: one of them at most")
    if iou is not None:
        return default_rules(dataset, "iou_3d", iou)
    if distance is not None:
        return default_rules(dataset, "distance", distance)
    return default_rules(dataset)


def _figures(result: "ClassResult") -> dict[str, Any]:
    best = result.sweep.best
    return {
        "all": result.total.summary(),
        "best": {"score": result.sweep.thresholds[best], **result.sweep.results[best].summary()},
        "sequences": {name: single.summary() for name, single in result.sequences.items()},
    }


def _table(results: Many["ClassResult"]) -> Table:
    table = Table(box=None, pad_edge=False)
    for name in ("class", "score from", *SHOWN):
        table.add_column(name, justify="left" if name == "class" else "right", no_wrap=True)
    for result in results:
        best = result.sweep.best
        for name, threshold, figures in (
            (result.name, "all", result.total.summary()),
            ("", f"{result.sweep.thresholds[best]:.3f}", result.sweep.results[best].summary()),
        ):
            table.add_row(name, threshold, *(_shown(figures[column]) for column in SHOWN))
    return table


def _shown(value: float | None) -> str:
    if value is None:
        return "-"
    return str(value) if isinstance(value, int) else f"{value:.4f}"
