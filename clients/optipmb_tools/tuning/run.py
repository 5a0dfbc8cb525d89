"""Tuning of a dataset: its classes one after the other, and the files in the output folder.

In the output folder: `estimate.json` and `estimated.toml` (without tracking), `calibrated.toml` (the profile with the
curves of scores alone, where a reference was given), `trials.db` (every trial, to continue from), `report.json`
(figures, changed values) and `tuned.toml`, the profile. The same data, options and versions give the same bytes
of all but `trials.db`.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from optipmb_client.errors import UsageError

from optipmb import Parameters, ScoreCalibration
from optipmb_tools.datasets import DataSequence, DatasetArguments
from optipmb_tools.files import write_whole
from optipmb_tools.run.bulk import Executor
from optipmb_tools.tuning.clips import Clip, load, of_class
from optipmb_tools.tuning.estimate import Estimate, estimate, pair_all, score_curve
from optipmb_tools.tuning.scoring import Objective, rules_of, scorer_of
from optipmb_tools.tuning.study import Plan, Tuned, tune
from optipmb_tools.tuning.values import only, with_classes, with_score_calibration, with_values, write_profile
from optipmb_tools.views.progress import TrialDisplay

Curves = dict[str, ScoreCalibration | None]  # by class; None where there was too little to measure one


@dataclass(frozen=True)
class TuningData:
    """The data."""

    dataset: str
    detections: str  # name of the detector
    sequences: Sequence[DataSequence]
    clips: Sequence[Clip]
    classes: tuple[str, ...]

    @classmethod
    def of(
        cls,
        dataset: str,
        detections: str | None,
        sequences: Sequence[DataSequence],
        parameters: Parameters,
        classes: Sequence[str] | None,
    ) -> "TuningData":
        """Read the sequences; by default the classes of the parameters that have labels.

        Raises:
            DatasetError: a sequence has no truth.
            UsageError: a class is not in the parameters, or has no labels.
        """
        clips = [load(sequence, parameters, rules_of(dataset)) for sequence in sequences]
        labelled = {name for clip in clips for name in set(clip.truth.names[~clip.truth.ignored].tolist())}
        wanted = tuple(classes or (name for name in parameters.labels if name in labelled))
        for name in wanted:
            if name not in parameters.labels:
                raise UsageError(
                    f"--classes: the profile has no class {name!r} (it has: {', '.join(parameters.labels)})"
                )
            if name not in labelled:
                raise UsageError(f"--classes: nothing in these sequences is labelled {name!r}")
        if not wanted:
            raise UsageError("nothing in these sequences is labelled with a class of the profile")
        return cls(dataset, detections or "", sequences, clips, wanted)

    def of_class(self, name: str) -> list[Clip]:
        return [of_class(clip, name, rules_of(self.dataset)) for clip in self.clips]

    @property
    def title(self) -> str:
        """The data in a few words."""
        detections = f", detections {Path(self.detections).name}" if self.detections else ""
        return f"{self.dataset}{detections}, sequences {' '.join(one.name for one in self.sequences)}"


def estimate_all(source: TuningData, parameters: Parameters, out: Path) -> dict[str, Estimate]:
    """Estimate every class, and write `estimate.json` and `estimated.toml`."""
    found, tables = {}, {}
    for name in source.classes:
        clips, base = source.of_class(name), only(parameters, name)
        found[name] = estimate(clips, name, base, rules_of(source.dataset))
        tables[name] = with_values(base, name, found[name].values)
    out.mkdir(parents=True, exist_ok=True)
    _write_json(out / "estimate.json", {name: one.to_json() for name, one in found.items()})
    provenance = f"{_from(parameters)}\n{_by('estimate')}: {source.title}; classes {' '.join(source.classes)}."
    write_profile(out / "estimated.toml", with_classes(parameters, tables, _named(parameters, "estimated"), provenance))
    return found


def calibrate_scores(
    data: DatasetArguments,
    reference: str,
    sequences: Sequence[DataSequence],
    parameters: Parameters,
    classes: Sequence[str] | None,
    out: Path,
    name: str | None = None,
) -> tuple[Parameters, Curves]:
    """Measure the curves from a detector's scores to a reference detector's, and write `calibrated.toml`.

    Sequences count where the reference has them too; score calibrations of the parameters are replaced.

    Returns:
        The profile with the curves, and the curve of each class, None where there is too little to measure one.

    Raises:
        DatasetError: there is no such detector, or a sequence has no truth.
        UsageError: the reference has none of the sequences, or a class is not there.
    """
    names = {one.name for one in sequences}
    known = [one for one in replace(data, detections=reference).open().sequences(["all"]) if one.name in names]
    if not known:
        raise UsageError(f"--reference {reference}: detections of one of the sequences, received none")
    common = {one.name for one in known}
    plain = with_score_calibration(parameters, dict.fromkeys(parameters.labels))
    source = TuningData.of(data.name, data.detections, sequences, plain, classes)
    other = TuningData.of(data.name, reference, known, plain, None)
    curves: Curves = {}
    for label in source.classes:
        base, rules = only(plain, label), rules_of(data.name)
        own = [clip for clip in source.of_class(label) if clip.name in common]
        curves[label] = score_curve(
            pair_all(own, label, base, rules), pair_all(other.of_class(label), label, base, rules)
        )
    measured = " ".join(label for label, curve in curves.items() if curve) or "none"
    provenance = (
        f"{_from(parameters, name)}\n{_by('score calibration')}: {replace(source, sequences=known).title}, to the"
        f" scores of {Path(reference).name}; classes {measured}."
    )
    calibrated = with_score_calibration(plain, curves)
    out.mkdir(parents=True, exist_ok=True)
    title = name or _named(parameters, "calibrated")
    write_profile(out / "calibrated.toml", with_classes(calibrated, {}, title, provenance))
    return calibrated, curves


def tune_all(
    source: TuningData,
    parameters: Parameters,
    plan: Plan,
    out: Path,
    display: TrialDisplay,
    name: str | None = None,
    executor: Executor | None = None,
) -> dict[str, Tuned]:
    """Tune every class, and write `report.json` and `tuned.toml`, a profile with a name of one's own or the old one's.

    Raises:
        UsageError: the folder has trials of other data or options.
    """
    out.mkdir(parents=True, exist_ok=True)
    results = {}
    for label in source.classes:
        scorer = scorer_of(source.dataset, label, source.sequences)
        context = {
            "version": version("optipmb"),
            "dataset": source.dataset,
            "detections": source.detections,
            "detected": _sum(source.of_class(label)),
        }
        objective = Objective(source.of_class(label), scorer, plan.metric, executor, display.note)
        results[label] = tune(objective, parameters, plan, out / "trials.db", context, display)
    _write_json(out / "report.json", {name: one.to_json() for name, one in results.items()})
    scope = "all parameters" if plan.everything else "noise, birth spread, area, forgetting"
    held_out = "; ".join(" ".join(one.held_out) for one in results.values() if one.held_out) or "none"
    provenance = (
        f"{_from(parameters, name)}\n{_by('tune')}: {source.title}; classes {' '.join(source.classes)}; {scope}; metric"
        f" {plan.metric}; {plan.trials} trials; held out {held_out}; seed {plan.seed}."
    )
    tables = {name: one.parameters for name, one in results.items()}
    title = name or _named(parameters, "tuned")
    write_profile(out / "tuned.toml", with_classes(parameters, tables, title, provenance))
    return results


def _sum(clips: Sequence[Clip]) -> list[float]:
    """Return a few numbers that other detections would not have."""
    frames = [frame for clip in clips for frame in clip.frames]
    return [
        len(frames),
        sum(len(frame.score) for frame in frames),
        float(sum(float(frame.score.sum()) for frame in frames)),
        float(sum(float(frame.center.sum()) for frame in frames)),
    ]


def _named(parameters: Parameters, suffix: str) -> str:
    return parameters.name if parameters.name.endswith(suffix) else f"{parameters.name}-{suffix}"


def _from(parameters: Parameters, name: str | None = None) -> str:
    """Return where the values came from that it began with; a profile that is tuned again loses the last time."""
    before = parameters.provenance or "No provenance."
    if parameters.name == name:
        return "\n".join(line for line in before.strip().split("\n") if not line.startswith("optipmb "))
    return f"{before} (profile {parameters.name})"


def _by(step: str) -> str:
    return f"optipmb {version('optipmb')}, {step}"


def _write_json(path: Path, content: Any) -> None:
    write_whole(path, [json.dumps(content, indent=1, allow_nan=False) + "\n"])
