"""`optipmb tune`: from detections and labels to a parameter profile."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from optipmb_client.errors import UsageError
from rich.console import Group
from rich.table import Table
from rich.text import Text

from optipmb_tools.commands.ablate import cells_of
from optipmb_tools.commands.options import (
    AsJson,
    Classes,
    JobOptions,
    LabelledOptions,
    Out,
    Profile,
    plain_table,
    print_json,
    print_table,
    say,
)
from optipmb_tools.extras import needed
from optipmb_tools.views.progress import TrialDisplay

if TYPE_CHECKING:
    from collections.abc import Mapping

    from optipmb_tools.tuning import Curves, Estimate, Tuned

SHOWN = ("sAMOTA", "AMOTA", "MOTA", "MOTP", "HOTA", "IDS", "FP", "FN", "GT")
LEAST_SHOWN = 100  # boxes of tracks from which a tenth of the probabilities is shown
METRICS = ("combination", "samota", "amota", "mota", "hota", "both")


@dataclass(frozen=True, kw_only=True)
class TuneOptions:
    """Options of the new profile, of the estimate and of the search."""

    profile: Profile = None
    classes: Classes = None
    out: Out = Path("out/tune")
    name: Annotated[str | None, typer.Option(help="Name of the new profile.", show_default=False)] = None
    estimate_only: Annotated[bool, typer.Option("--estimate-only", help="Estimate, and search nothing.")] = False
    reference: Annotated[
        str | None,
        typer.Option(
            help="With --estimate-only: the detector that the thresholds of the profile were chosen with; its scores on"
            " the same data are what those of --detections are brought to.",
            show_default=False,
        ),
    ] = None
    metric: Annotated[str, typer.Option(help=f"What is maximised: {', '.join(METRICS)}.")] = "combination"
    trials: Annotated[int, typer.Option(min=1, help="Trials of the search.")] = 120
    folds: Annotated[
        int, typer.Option(min=0, help="Groups of sequences, of which the first is held out; 0: none is.")
    ] = 3
    everything: Annotated[bool, typer.Option("--all", help="Search the parameters of the paper's table too.")] = False
    seed: Annotated[int, typer.Option(min=0, help="Seed of every random choice.")] = 0


@dataclass(frozen=True, kw_only=True)
class TuneJobs(JobOptions):
    """Options of tuning in several processes."""

    jobs: Annotated[int, typer.Option(min=1, help="Sequences tracked at once.")] = 1


def tune(data: LabelledOptions, *, how: TuneOptions, jobs: TuneJobs, as_json: AsJson = False) -> None:
    """Estimate the parameters of each class from labelled data, then refine them by tracking.

    A second call with the same --out continues where the first one ended.
    """
    from optipmb_tools import tuning  # noqa: PLC0415  loads the tracker and its compiler
    from optipmb_tools.run.profiles import profile_compared  # noqa: PLC0415  as above

    reference, out = how.reference, how.out
    if not how.estimate_only:
        needed("optipmb tune", "tune", "optuna")
    if how.metric not in METRICS:
        raise UsageError(f"--metric: one of {', '.join(METRICS)}, received {how.metric!r}")
    if reference is not None and not how.estimate_only:
        raise UsageError("--reference: with --estimate-only, which writes a profile that --profile then tunes")
    opened = data.open()
    asked, chosen = opened.dataset.arguments, opened.sequences
    parameters = profile_compared(how.profile or opened.dataset.profile, chosen)
    curves: tuning.Curves = {}
    if reference is not None:
        parameters, curves = tuning.calibrate_scores(asked, reference, chosen, parameters, how.classes, out, how.name)
    source = tuning.TuningData.of(asked.name, asked.detections, chosen, parameters, how.classes)
    estimates = tuning.estimate_all(source, parameters, out)
    if not as_json:
        for one in estimates.values():
            print_table(_estimate(one, {path: tuning.value_of(parameters, one.name, path) for path in one.values}))
    if how.estimate_only:
        _say_estimates(estimates, curves, reference, out, as_json=as_json)
        return
    plan = tuning.Plan(
        metric=how.metric,
        trials=how.trials,
        folds=how.folds,
        seed=how.seed,
        everything=how.everything,
    )
    with jobs.executor(opened.frames, jobs.jobs) as executor, TrialDisplay() as display:
        tuned = tuning.tune_all(source, parameters, plan, out, display, how.name, executor)
    if as_json:
        results: Mapping[str, Any] = {name: one.to_json() for name, one in tuned.items()}
        print_json({"command": "tune", "profile": out / "tuned.toml", "classes": results})
        return
    for result in tuned.values():
        print_table(_report(result, opened.name))
    say(f"profile in {out / 'tuned.toml'}")


def _say_estimates(
    estimates: "Mapping[str, Estimate]", curves: "Curves", reference: str | None, out: Path, *, as_json: bool
) -> None:
    if as_json:
        found = {"estimates": {name: one.to_json() for name, one in estimates.items()}}
        shown = {"score_calibration": {name: one and one.model_dump() for name, one in curves.items()}}
        print_json({"command": "tune", "out": out, **found, **(shown if reference else {})})
        return
    for name, curve in curves.items():
        knots = zip(curve.detector, curve.calibrated, strict=True) if curve else ()
        shown_knots = "  ".join(f"{score:g} -> {meant:g}" for score, meant in knots)
        say(f"{name}: score -> score of {reference}: {shown_knots or 'too few detections on labels'}")
    if reference:
        say(f"the profile with the scores of {reference} in {out}/calibrated.toml")
    say(f"estimates in {out}/estimate.json, as a profile in {out}/estimated.toml")


def _estimate(found: "Estimate", before: "Mapping[str, object]") -> Group:
    table = _table(found.name, "profile", "estimate")
    for path, value in found.values.items():
        table.add_row(path, str(before[path]), str(value))
    facts = (
        f"{found.labels} boxes of {found.objects} objects, {found.detections} detections, {found.pairs} on labels; "
        f"found {_share(found.detection)}, {found.clutter:.2f} false a frame; "
        f"turned round {_share(found.flip_rate)}; errors of neighbouring frames correlate {found.lasting:.2f}"
    )
    scores = "score -> true: " + "  ".join(f"{one.score:.2f} -> {one.precision:.2f}" for one in found.bins)
    return Group(table, Text(facts), Text(scores), Text())


def _table(first: str, *others: str) -> Table:
    return plain_table((first,), others, folded=(first, *others))


def _share(value: float) -> str:
    return f"{100.0 * value:.1f} %"


def _report(tuned: "Tuned", dataset: str) -> Group:
    figures = _table(tuned.name, *SHOWN)
    for title, one in (
        ("before", tuned.before),
        ("after (on the tuning data)", tuned.after),
        (f"held out ({' '.join(tuned.held_out)}), before", tuned.held_out_before),
        (f"held out ({' '.join(tuned.held_out)}), after", tuned.held_out_after),
    ):
        if one is not None:
            figures.add_row(title, *cells_of(one.figures, SHOWN, dataset))
    changes = _table("changed", "from", "to")
    for change in tuned.changes:
        changes.add_row(change.path, str(change.start), str(change.value))
    shown = changes if tuned.changes else Text("no value was better than that of the initial profile")
    return Group(figures, Text(), shown, Text(_objective(tuned)), Text(), Text(_calibration(tuned)), Text())


def _calibration(tuned: "Tuned") -> str:
    """Say how well existence and covariance are calibrated."""
    found = tuned.calibration
    low, high = found.interval
    shown = "  ".join(
        f"{one.predicted:.2f} -> {one.observed:.2f} ({one.count})" for one in found.deciles if one.count >= LEAST_SHOWN
    )
    whose = (
        "each with the calibration of the others"
        if len(tuned.sequences + tuned.held_out) > 1
        else "that gave the calibration"
    )
    return (
        f"sequences, {whose}: NEES {found.mean:.2f} ({low:.2f} to {high:.2f}, objects being independent), "
        f"{100.0 * found.coverage:.1f} % of errors in the 95 % ellipse; existence predicted -> observed: {shown}"
    )


def _objective(tuned: "Tuned") -> str:
    text = f"{tuned.plan.metric} in percent: before {100 * tuned.before.value:.2f}, after {100 * tuned.after.value:.2f}"
    if tuned.held_out_before is None or tuned.held_out_after is None:
        return f"{text}; no sequences were held out, so how much of it holds elsewhere is not known"
    return f"{text}; held out {100 * tuned.held_out_before.value:.2f} and {100 * tuned.held_out_after.value:.2f}"
