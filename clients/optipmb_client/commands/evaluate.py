"""`optipmb evaluate`: result files against the truth."""

from collections.abc import Callable
from collections.abc import Sequence as Many
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from optipmb_client.bulk import Executor, values
from optipmb_client.commands.options import (
    AsJson,
    LabelledOptions,
    Ray,
    executor_of,
    open_sequences,
    print_json,
    print_table,
    warn,
)
from optipmb_client.datasets import DataSequence, DatasetArguments
from optipmb_client.errors import UsageError
from optipmb_client.extras import needed

if TYPE_CHECKING:
    from rich.console import RenderableType

    from optipmb_client.evaluation import ClassResult, Rules
    from optipmb_client.evaluation.figures import ClassFigures


def evaluate(  # noqa: PLR0913  these are the command's options
    data: LabelledOptions,
    *,
    tracks: Annotated[
        list[Path],
        typer.Option(
            "--tracks",
            help="Folder with the result files of track or replay, or a table of tracks; several times: compared.",
        ),
    ],
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
    cutoff: Annotated[float, typer.Option(min=0.01, help="Cut-off distance of GOSPA and OSPA, in metres.")] = 2.0,
    order: Annotated[float, typer.Option(min=1.0, help="Order of GOSPA and OSPA.")] = 2.0,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Classes at once; default: one for each processor.", show_default=False)
    ] = None,
    ray: Ray = None,
    as_json: AsJson = False,
) -> None:
    """Compare result files with the truth, per class.

    CLEAR MOT figures, HOTA of centres in the plane, GOSPA and OSPA; of KITTI, AB3DMOT's protocol and the HOTA of image
    boxes. Tracks that were written with --full are tested for calibration too.

    No detections are needed; where they are named, or there is just one detector, only its classes are evaluated.

    The best threshold is the one on the mean score of a track that gives the highest MOTA.
    """
    needed("optipmb evaluate", "evaluation", "scipy")
    from optipmb_client.commands.tables import comparison_tables  # noqa: PLC0415  loads the solvers of scipy

    asked = data.asked()
    if asked.name == "table":
        asked = replace(asked, options=(*asked.options, ("tracks", " ".join(map(str, tracks)))))
    _, chosen = open_sequences(asked, data.sequences)
    labels = labels_of(chosen)
    spelt = {label.lower(): label for label in labels}
    names = tuple(one if one in labels else spelt.get(one.lower(), one) for one in classes or labels)
    how = _How(iou, distance, cutoff, order, cache(warn))
    with executor_of(jobs, ray, chosen, max(1, len(names))) as executor:
        reports = {str(one): _judge(asked, chosen, one, names, how, executor) for one in tracks}
    for tables in (one.tables for one in chosen if hasattr(one, "tables")):
        tables.check()
    report = {"command": "evaluate", "dataset": asked.name, "sequences": [sequence.name for sequence in chosen]}
    (first, *others) = reports.values()
    if as_json and others:
        print_json({**report, "trackers": {place: one.parts for place, one in reports.items()}})
    elif as_json:
        print_json({**report, "tracks": tracks[0], **first.parts})
    else:
        tables = comparison_tables({place: one.figures for place, one in reports.items()}) if others else first.tables
        for table in tables:
            print_table(table)


@dataclass(frozen=True)
class _How:
    """What the options say about comparing."""

    iou: float | None
    distance: float | None
    cutoff: float
    order: float
    warn: Callable[[str], None]  # prints each assumption once


@dataclass(frozen=True)
class _Judgement:
    """What was found out about the tracks of one tracker: for programs, for tables beside each other, and as tables."""

    parts: dict[str, Any]
    figures: "Many[ClassFigures]"
    tables: "Many[RenderableType]"


def _judge(
    asked: DatasetArguments,
    chosen: "Many[DataSequence]",
    tracks: Path,
    names: tuple[str, ...],
    how: _How,
    executor: Executor,
) -> _Judgement:
    from optipmb_client.commands.tables import clear_table, figure_tables, nuscenes_table  # noqa: PLC0415  loads the solvers of scipy
    from optipmb_client.evaluation import evaluate_files  # noqa: PLC0415  as above
    from optipmb_client.evaluation.figures import Settings, class_average  # noqa: PLC0415  as above
    from optipmb_client.evaluation.jobs import Evaluation, FiguresTask, figures_of  # noqa: PLC0415  as above
    from optipmb_client.evaluation.nuscenes import evaluate_nuscenes  # noqa: PLC0415  as above

    head: list[RenderableType] = []
    overall: dict[str, Any] = {}
    settings = Settings((how.iou,), how.cutoff, how.order) if how.iou else Settings(cutoff=how.cutoff, order=how.order)
    if asked.name == "nuscenes" and asked.root is not None:
        if how.iou is not None or how.distance is not None:
            raise UsageError("--iou and --distance: the benchmark of nuScenes has its own rules")
        scores = evaluate_nuscenes(asked.root, tracks, [sequence.name for sequence in chosen])
        head = [nuscenes_table(scores, names)]
        overall = {"overall": scores.to_json()["overall"]}
        parts = {name: {"nuscenes": one.to_json()} for name, one in scores.classes.items() if name in names}
        best = {name: scores.classes[name].best.threshold for name in parts}
    else:
        results = evaluate_files(chosen, tracks, names, _rules(asked.name, how.iou, how.distance), how.warn)
        parts = {one.name: _figures(one) for one in results}
        best = {} if asked.name == "kitti" else {one.name: one.sweep.thresholds[one.sweep.best] for one in results}
        if asked.name != "kitti" or how.distance is not None:  # AB3DMOT's protocol gives them at its own threshold
            head = [clear_table(results, metres=how.iou is None)]
    recordings = tuple(sequence.name for sequence in chosen)
    executor.start(figures_of, Evaluation(asked, recordings, settings, names, chosen if executor.here else None))
    tasks = [FiguresTask(tracks, name, best.get(name)) for name in names]
    figures = [one for found in values(executor, tasks, str, warn) for one in found]
    if not figures:
        raise UsageError(f"{tracks}: neither the truth nor the tracks have objects of these classes")
    by_class = {one.name: {**parts.get(one.name, {}), **one.summary()} for one in figures}
    average = class_average(figures) if overall else None
    if average is not None:
        overall["overall"]["hota_centre"] = average
    tables = (*head, *figure_tables(figures, how.cutoff, average))
    return _Judgement({**overall, "classes": by_class}, figures, tables)


def labels_of(sequences: Many[DataSequence]) -> tuple[str, ...]:
    """Return the classes of some sequences, in their order."""
    return tuple(dict.fromkeys(label for sequence in sequences for label in sequence.labels))


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
