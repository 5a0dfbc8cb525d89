"""`optipmb evaluate`: result files against the truth."""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from optipmb_client.errors import UsageError

from optipmb_tools.commands.options import (
    All,
    AsJson,
    Data,
    JobOptions,
    LabelledOptions,
    print_json,
    print_table,
    warn,
)
from optipmb_tools.extras import needed
from optipmb_tools.run import bulk

if TYPE_CHECKING:
    from rich.console import RenderableType

    from optipmb_tools.evaluation import ClassResult, Rules
    from optipmb_tools.evaluation.evaluate import ClassFigures
    from optipmb_tools.evaluation.tracks import By


@dataclass(frozen=True, kw_only=True)
class MatchingOptions:
    """Options of how tracks and boxes are compared, and figures drawn."""

    iou: Annotated[
        float | None, typer.Option(min=0.0, max=1.0, help="Boxes match from this 3D intersection over union on.")
    ] = None
    distance: Annotated[
        float | None, typer.Option(min=0.0, help="Boxes match up to this distance of their centres, in metres.")
    ] = None
    cutoff: Annotated[float, typer.Option(min=0.01, help="Cut-off distance of GOSPA and OSPA, in metres.")] = 2.0
    order: Annotated[float, typer.Option(min=1.0, help="Order of GOSPA and OSPA.")] = 2.0
    by: Annotated[
        str,
        typer.Option(
            "--by",
            metavar="id|object",
            help="Column of a table of tracks that names them: with object, tracks that track --rejoin joined are one.",
        ),
    ] = "id"
    plot: Annotated[
        Path | None, typer.Option("--plot", help="With several --tracks: also draw their figures, as a .png.")
    ] = None

    def rules(self, dataset: str) -> "Rules":
        """Return the rules of CLEAR MOT."""
        from optipmb_tools.evaluation import default_rules  # noqa: PLC0415  loads the solvers of scipy

        if self.iou is not None and self.distance is not None:
            raise UsageError("--iou and --distance: one of them at most")
        if self.iou is not None:
            return default_rules(dataset, "iou_3d", self.iou)
        if self.distance is not None:
            return default_rules(dataset, "distance", self.distance)
        return default_rules(dataset)

    def column(self) -> "By":
        """Return the column of a table that names its tracks."""
        if self.by == "object":
            return "object"
        if self.by != "id":
            raise UsageError(f"--by: expected id or object, received {self.by}")
        return "id"


@dataclass(frozen=True, kw_only=True)
class EvaluationJobs(JobOptions):
    """Options of evaluation in several processes."""

    jobs: Annotated[
        int | None, typer.Option(min=1, help="Classes at once; default: one for each processor.", show_default=False)
    ] = None


def evaluate(
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
    how: MatchingOptions,
    jobs: EvaluationJobs,
    every: All = False,
    as_json: AsJson = False,
) -> None:
    """Compare result files with the truth, per class: first the tracks that are shown, the confirmed ones.

    CLEAR MOT figures, HOTA of centres in the plane, GOSPA and OSPA; of KITTI, AB3DMOT's protocol and the HOTA of image
    boxes. Tracks that were written with --full are tested for calibration too.

    No detections are needed; where they are named, or there is just one detector, only its classes are evaluated.

    The best threshold is the one on the mean score of a track that gives the highest MOTA.
    """
    needed("optipmb evaluate", "evaluation", "scipy")
    from optipmb_tools.commands.tables import comparison_tables, shares  # noqa: PLC0415  loads the solvers of scipy

    if how.plot is not None and (len(tracks) == 1 or how.plot.suffix != ".png"):
        raise UsageError(f"--plot {how.plot}: expected a .png of several --tracks, received {len(tracks)} of them")
    if data.truth is not None and (data.data, data.dataset, data.root) == (None, None, None):
        data = dataclasses.replace(data, data=data.truth, truth=None)  # a table of objects is its own truth
    more = {"tracks": " ".join(map(str, tracks))} if data.named()[0] == "table" else {}
    opened = data.open(**more)
    spelt = {label.lower(): label for label in opened.labels}
    names = tuple(one if one in opened.labels else spelt.get(one.lower(), one) for one in classes or opened.labels)
    note = cache(warn)  # prints each assumption once
    with jobs.executor(opened.frames, max(1, len(names))) as executor:
        reports = {str(one): _evaluated(opened, one, names, how, executor, note, every=every) for one in tracks}
    for tables in (one.tables for one in opened.sequences if hasattr(one, "tables")):
        tables.check()
    report = {"command": "evaluate", "dataset": opened.name, "sequences": opened.names}
    (first, *others) = reports.values()
    if as_json and others:
        print_json({**report, "trackers": {place: one.parts for place, one in reports.items()}})
    elif as_json:
        print_json({**report, "tracks": tracks[0], **first.parts})
    distinct = len({one.name for one in tracks}) == len(reports)
    compared = {Path(one).name if distinct else one: (each.clear, each.figures) for one, each in reports.items()}
    if how.plot is not None:
        from optipmb_tools.views.comparison import draw_comparison  # noqa: PLC0415  an extra

        found = shares(compared)
        switches = {
            name: {tracker: clear[name]["IDS"] if name in clear else None for tracker, (clear, _) in compared.items()}
            for name in found
        }
        draw_comparison(how.plot, found, switches)
    if not as_json:
        shown = comparison_tables(compared) if others else first.tables
        for table in shown:
            print_table(table)


@dataclass(frozen=True)
class _Evaluated:
    """Result for the tracks of one tracker: for programs, for comparison, and as tables."""

    parts: dict[str, Any]
    figures: "Sequence[ClassFigures]"
    tables: "Sequence[RenderableType]"

    @property
    def clear(self) -> dict[str, dict[str, float | None]]:
        """MOTA and identity switches by class, of confirmed tracks where the files tell, else at the best threshold."""
        found = {}
        for one in self.figures:
            parts = self.parts["classes"][one.name]
            official = parts.get("nuscenes")
            known = official or parts["confirmed"] or (one.ab3dmot[0].summary() if one.ab3dmot else parts["best"])
            found[one.name] = {
                title: known.get(title.lower() if official else title) for title in ("MOTA", "IDS", "AMOTA")
            }
        return found


@dataclass(frozen=True)
class _Protocol:
    """Figures of one tracker by the protocol of its data set."""

    parts: dict[str, dict[str, Any]]
    """Figures of each class, for programs."""
    best: dict[str, float]
    """Threshold of the tracks that are also evaluated without the others, by class."""
    tables: "Sequence[RenderableType]" = ()
    overall: dict[str, Any] = field(default_factory=dict)
    """Figures over all classes, where the protocol has them."""


def _evaluated(
    opened: Data,
    tracks: Path,
    names: tuple[str, ...],
    how: MatchingOptions,
    executor: bulk.Executor,
    note: Callable[[str], None],
    *,
    every: bool,
) -> _Evaluated:
    from optipmb_tools.commands.tables import figure_tables, shown_table  # noqa: PLC0415  as above
    from optipmb_tools.evaluation import evaluate_files  # noqa: PLC0415  as above
    from optipmb_tools.evaluation.evaluate import (  # noqa: PLC0415  as above
        Evaluation,
        FigureOptions,
        class_average,
        figures_of,
    )

    asked, by = opened.dataset.arguments, how.column()
    settings = (
        FigureOptions((how.iou,), how.cutoff, how.order)
        if how.iou
        else FigureOptions(cutoff=how.cutoff, order=how.order)
    )
    if opened.name == "nuscenes" and asked.root is not None:
        protocol = _nuscenes(asked.root, opened.names, tracks, names, how)
    else:
        results = evaluate_files(opened.sequences, tracks, names, how.rules(opened.name), note, by=by)
        protocol = (_kitti if opened.name == "kitti" else _clear_mot)(results, how, every=every)
    here = opened.sequences if executor.here else None
    executor.start(figures_of, Evaluation(asked, tuple(opened.names), tracks, settings, names, here, by))
    tasks = [(name, protocol.best.get(name)) for name in names]
    found = bulk.values(executor, tasks, lambda task: f"{task[0]} of {tracks}", warn)
    figures = [one for each in found for one in each]
    if not figures:
        raise UsageError(f"{tracks}: neither the truth nor the tracks have objects of these classes")
    by_class = {one.name: {**protocol.parts.get(one.name, {}), **one.summary()} for one in figures}
    average = class_average(figures) if protocol.overall else None
    overall = {"overall": {**protocol.overall, "hota_centre": average}} if average is not None else {}
    first = shown_table(figures) if how.distance is None and opened.name in {"kitti", "nuscenes"} else ()
    tables = (*first, *protocol.tables, *figure_tables(figures, how.cutoff, average, every=every))
    return _Evaluated({**overall, "classes": by_class}, figures, tables)


def _figures(result: "ClassResult") -> dict[str, Any]:
    best = result.sweep.best
    return {
        "all": result.total.summary(),
        "confirmed": None if result.confirmed is None else result.confirmed.summary(),
        "best": {"score": result.sweep.thresholds[best], **result.sweep.results[best].summary()},
        "sequences": {name: single.summary() for name, single in result.sequences.items()},
    }


def _clear_mot(results: "Sequence[ClassResult]", how: MatchingOptions, *, every: bool) -> _Protocol:
    from optipmb_tools.commands.tables import clear_table  # noqa: PLC0415  as above

    best = {one.name: one.sweep.thresholds[one.sweep.best] for one in results}
    return _Protocol(
        {one.name: _figures(one) for one in results}, best, [clear_table(results, metres=how.iou is None, every=every)]
    )


def _kitti(results: "Sequence[ClassResult]", how: MatchingOptions, *, every: bool) -> _Protocol:
    """Return CLEAR MOT figures, without what AB3DMOT's protocol gives: thresholds, and figures by its own measure."""
    found = _clear_mot(results, how, every=every)
    return replace(found, best={}, tables=found.tables if how.distance is not None else ())


def _nuscenes(
    root: Path, sequences: list[str], tracks: Path, names: tuple[str, ...], how: MatchingOptions
) -> _Protocol:
    from optipmb_tools.commands.tables import nuscenes_table  # noqa: PLC0415  as above
    from optipmb_tools.evaluation.nuscenes import evaluate_nuscenes  # noqa: PLC0415  as above

    if how.iou is not None or how.distance is not None:
        raise UsageError("--iou and --distance: the benchmark of nuScenes has its own rules")
    if how.column() != "id":
        raise UsageError(f"--by {how.by}: the result files of nuScenes have no such column")
    scores = evaluate_nuscenes(root, tracks, sequences)
    parts = {name: {"nuscenes": one.to_json()} for name, one in scores.classes.items() if name in names}
    best = {name: scores.classes[name].best.threshold for name in parts}
    return _Protocol(parts, best, [nuscenes_table(scores, names)], scores.to_json()["overall"])
