"""Tuning of one class: estimate, search with folds left out, search on all sequences, report.

The sequences that score a result and those that it was chosen on are never the same: for each fold that is left out
there is a search of its own on the rest, and its result is scored on the fold. The profile comes from one more search,
on all sequences. Both are kept in one file, from which an interrupted session continues.
"""

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from optipmb import Parameters
from optipmb_tools.evaluation.calibration import CalibrationResult
from optipmb_tools.run.bulk import Executor
from optipmb_tools.tuning.calibrate import Ranking, calibrate, cross_calibration, rank
from optipmb_tools.tuning.clips import Clip, Degradation, degrade
from optipmb_tools.tuning.display import TrialDisplay
from optipmb_tools.tuning.estimate import estimate
from optipmb_tools.tuning.objective import MARGIN, Objective, folds_of
from optipmb_tools.tuning.scoring import Figures, Measured, Scorer, plain_figures
from optipmb_tools.tuning.search import Dimension, Search, Values, dimensions, penalty, repaired
from optipmb_tools.tuning.values import Value, only, value_of, with_calibration, with_heading_sign, with_values

PENALTY = 0.0005
"""Cost of a value that is a whole range away from its start."""
WORTH = 0.0002
"""Least gain in the score less the margin for which a changed value is kept."""
_EVIDENCE_WEIGHTS = (0.0, 0.5, 1.0)
_SETTLED = ("metric", "copies", "seed", "everything")
"""Settings of a plan on which the trials depend; their number is not among them, so there can be more later."""

Made = Callable[[Values], Parameters]
"""From changed values to the parameters of the candidate."""


@dataclass(frozen=True)
class Plan:
    """Options of a session."""

    metric: str = "combination"
    trials: int = 120
    """Of the search on all sequences."""
    fold_trials: int = 60
    """Of each search with a fold left out."""
    folds: int = 3
    copies: int = 1
    """Degraded copies of the detections beside the plain ones."""
    seed: int = 0
    everything: bool = False
    """Search the values of the paper's table too."""


@dataclass(frozen=True)
class ChangedValue:
    """A value that the search changed, and its worth."""

    path: str
    start: Value
    value: Value
    gain: float
    """Of the objective, over putting it back."""
    error: float
    """Standard error of the gain."""
    positive: int
    """In how many of `groups` choices of sequences, each without one fold, there is a gain."""
    groups: int


@dataclass(frozen=True)
class FoldResult:
    """Figures of a fold that was left out, with the parameters found without it."""

    sequences: tuple[str, ...]
    parameters: Parameters
    before: tuple[Figures, ...]
    """Of each variant of the detections, with the parameters before."""
    after: tuple[Figures, ...]
    value_before: float
    value_after: float


@dataclass(frozen=True)
class Refined:
    """Result of a session for one class."""

    name: str
    plan: Plan
    sequences: tuple[str, ...]
    parameters: Parameters
    """With this class only."""
    changes: tuple[ChangedValue, ...]
    before: tuple[Figures, ...]
    """All sequences, of each variant of the detections."""
    after: tuple[Figures, ...]
    """The same with the new parameters; these sequences chose them."""
    folds: tuple[FoldResult, ...]
    crossed: tuple[Figures, ...]
    """All sequences together, each with the parameters that were found without it; empty without folds."""
    value_before: float
    value_after: float
    value_crossed: float | None
    calibration: CalibrationResult
    """Of all sequences, each with the calibration that the others give; one alone with its own."""
    ranking: tuple[Ranking, ...]
    """Scores that tracks could be ranked by; empty without a calibration."""
    trials: int

    def to_json(self) -> dict[str, Any]:
        """Return everything as plain values."""
        names = ("plain", *(f"degraded {i + 1}" for i in range(self.plan.copies)))
        held_out = [fold.value_after for fold in self.folds]
        gains = [fold.value_after - fold.value_before for fold in self.folds]

        def table(figures: tuple[Figures, ...]) -> dict[str, Any]:
            return {name: plain_figures(one) for name, one in zip(names, figures, strict=False)}

        return {
            "class": self.name,
            "plan": {**asdict(self.plan), "degradation": asdict(Degradation()), "penalty": PENALTY, "caution": MARGIN},
            "sequences": list(self.sequences),
            "trials": self.trials,
            "objective": {
                "before": self.value_before,
                "after": self.value_after,
                "cross-validated": self.value_crossed,
                "held out, mean": _mean(held_out),
                "held out, spread": _spread(held_out),
                "held out, gain": _mean(gains),
                "held out, spread of the gain": _spread(gains),
            },
            "before": table(self.before),
            "after": table(self.after),
            "cross-validated": table(self.crossed),
            "folds": [
                {
                    "sequences": list(fold.sequences),
                    "objective": {"before": fold.value_before, "after": fold.value_after},
                    "before": table(fold.before),
                    "after": table(fold.after),
                }
                for fold in self.folds
            ],
            "evidence": [asdict(one) for one in self.changes],
            "calibration": {"held out": len(self.sequences) > 1, **self.calibration.summary()},
            "ranking": [{**asdict(one), "figures": plain_figures(one.figures)} for one in self.ranking],
        }


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None


def _spread(values: Sequence[float]) -> float | None:
    return float(np.std(values, ddof=1)) if len(values) > 1 else None


def refine(
    clips: Sequence[Clip],
    scorer: Scorer,
    parameters: Parameters,
    plan: Plan,
    storage: Path,
    context: Mapping[str, Any],
    display: TrialDisplay,
    executor: Executor | None = None,
) -> Refined:
    """Tune one class.

    Args:
        clips: with this class only.
        scorer: of this class.
        parameters: where the search begins; other classes in them do not matter.
        plan: options.
        storage: the file that keeps the trials.
        context: other settings that the trials depend on, such as the names of the data.
        display: shows the progress.
        executor: where sequences are tracked; by default in this process.

    Raises:
        UsageError: the storage holds trials of another session.

    """
    name, base, everyone = scorer.name, only(parameters, scorer.name), tuple(range(len(clips)))
    copies = [[degrade(clip, Degradation(), plan.seed, i) for clip in clips] for i in range(plan.copies)]
    objective = Objective([clips, *copies], scorer, plan.metric, executor, display.note)
    groups = folds_of(objective.boxes, plan.folds)
    trials = len(groups) * plan.fold_trials + plan.trials
    display.begin(name, trials)
    display.note(f"calibrating {name}")
    first = calibrate(clips, scorer, base)
    session = _Session(objective, base, plan, storage, dict(context), display, first.memory if first else None)
    calibration = session.calibrated(base, everyone).classes[name].calibration
    session = replace(session, evidence_weight=calibration.score_of_evidence if calibration else 0.0)
    folds: list[FoldResult] = []
    crossed: dict[int, list[Measured]] = {}
    for number, group in enumerate(groups):
        rest = tuple(i for i in everyone if i not in group)
        choice = session.choose(f"{name} without group {number + 1} of {len(groups)}", rest, plan.fold_trials)
        (before, value_before), (after, value_after) = (
            session.figures(one, group) for one in (base, choice.parameters)
        )
        names = tuple(objective.names[i] for i in group)
        folds.append(FoldResult(names, choice.parameters, before, after, value_before, value_after))
        crossed |= session.measured(choice.parameters, group)
    choice = session.choose(f"{name} all", everyone, plan.trials)
    changes = weigh(objective, everyone, choice.made, choice.start, choice.values, display.note)
    found = choice.parameters
    (before, value_before), (after, value_after) = (session.figures(one, everyone) for one in (base, found))
    together: tuple[Figures, ...] = ()
    if crossed:
        # Sequences in no fold have no truth of this class.
        crossed |= session.measured(base, tuple(i for i in everyone if i not in crossed))
        together = objective.figures([[crossed[i][k] for i in everyone] for k in range(len(objective.variants))])
    display.note(f"calibrating {name}")
    return Refined(
        name=name,
        plan=plan,
        sequences=objective.names,
        parameters=found,
        changes=changes,
        before=before,
        after=after,
        folds=tuple(folds),
        crossed=together,
        value_before=value_before,
        value_after=value_after,
        value_crossed=objective.value(together, everyone) if together else None,
        calibration=cross_calibration(clips, scorer, found),
        ranking=rank(clips, scorer, found, plan.metric) if found.classes[name].calibration is not None else (),
        trials=trials,
    )


@dataclass(frozen=True)
class _Choice:
    """Result of a search."""

    made: Made
    start: Values
    values: Values
    parameters: Parameters


@dataclass(frozen=True)
class _Session:
    """Data and settings of the searches of one class."""

    objective: Objective
    base: Parameters
    plan: Plan
    storage: Path
    context: dict[str, Any]
    display: TrialDisplay
    memory: float | None
    """Of the evidence, for all searches; None where there is too little to calibrate."""
    evidence_weight: float | None = None
    """In the score, for all searches: tracks that are ranked by different scores cannot be ranked together."""

    @property
    def name(self) -> str:
        return self.objective.scorer.name

    def choose(self, title: str, clips: tuple[int, ...], trials: int) -> _Choice:
        """Return the best candidate on some sequences."""
        plain = [self.objective.variants[0][i] for i in clips]
        estimated = estimate(plain, self.name, self.base, self.objective.scorer.rules).values
        base = self.calibrated(with_heading_sign(self.base, self.name), clips)
        space = dimensions(base, self.name, estimated, plain, everything=self.plan.everything)
        settings = {
            **self.context,
            **{key: getattr(self.plan, key) for key in _SETTLED},
            "sequences": [clip.name for clip in plain],
            "base": zlib.crc32(base.model_dump_json().encode()),
            "space": [list(asdict(one).values()) for one in space],
        }
        starts = _starts(base, self.name, space, estimated)
        search = Search(self.storage, title, settings, space, starts, zlib.crc32(f"{self.plan.seed} {title}".encode()))
        half = folds_of([boxes if i in clips else 0 for i, boxes in enumerate(self.objective.boxes)], 2)[:1]

        def made(values: Values) -> Parameters:
            return with_values(base, self.name, repaired(values, base, self.name))

        def score(values: Values, guess: Callable[[float], None]) -> float:
            candidate, cost = made(values), penalty(space, values, PENALTY)
            for part in (*half, clips):
                guess(self.objective.plain_value(candidate, part) - cost)
            return self.objective.gain(candidate, base, clips).score - cost

        self.display.note(f"searching: {title}")
        found = repaired(search.run(trials, score, self.display.trial), base, self.name)
        start = {one.path: value_of(base, self.name, one.path) for one in space}
        values = prune(self.objective, clips, made, start, found, self.display.note)
        return _Choice(made, start, values, self._with_calibration(made(values), clips))

    def calibrated(self, base: Parameters, clips: tuple[int, ...]) -> Parameters:
        """Return the parameters with a calibration of their own, and with the score that ranks tracks better."""
        self.display.note("calibrating")
        best = self._with_calibration(with_calibration(base, self.name, None), clips)
        if best.classes[self.name].calibration is None:
            return best
        weights = _EVIDENCE_WEIGHTS if self.evidence_weight is None else (self.evidence_weight,)
        first, *others = (with_values(best, self.name, {"calibration.score_of_evidence": weight}) for weight in weights)
        for other in others:
            # No margin is needed for one choice of a few that were not made to fit.
            if other != first and self.objective.gain(other, first, clips).gain > 0.0:
                first = other
        return first

    def _with_calibration(self, parameters: Parameters, clips: tuple[int, ...]) -> Parameters:
        """Return the parameters with the calibration of some sequences; a ranking score that they have stays."""
        before = parameters.classes[self.name].calibration
        plain = [self.objective.variants[0][i] for i in clips]
        found = calibrate(plain, self.objective.scorer, parameters, self.memory) if self.memory else None
        if found and before:
            found = found.model_copy(update={"score_of_evidence": before.score_of_evidence})
        return with_calibration(parameters, self.name, found)

    def figures(self, parameters: Parameters, clips: tuple[int, ...]) -> tuple[tuple[Figures, ...], float]:
        """Return the figures of each variant and the objective."""
        figures = self.objective.figures(self.objective.measure(parameters, clips))
        return figures, self.objective.value(figures, clips)

    def measured(self, parameters: Parameters, clips: tuple[int, ...]) -> dict[int, list[Measured]]:
        """Return the measured tracks of each variant, by sequence."""
        variants = self.objective.measure(parameters, clips)
        return {clip: [variant[place] for variant in variants] for place, clip in enumerate(clips)}


def _starts(base: Parameters, name: str, space: Sequence[Dimension], estimated: Values) -> list[dict[str, Value]]:
    """Return the candidates tried first: the profile, the estimates, half-way, and with the estimate of R only."""
    known = {one.path: value_of(base, name, one.path) for one in space}
    guess = {path: estimated.get(path, value) for path, value in known.items()}
    noise = {path: guess[path] if path.startswith("measurement_noise") else value for path, value in known.items()}
    between = {one.path: one.moved(one.start, 0.5 * one.offset(float(guess[one.path]))) for one in space}
    return [known, guess, between, noise]


def prune(
    objective: Objective,
    clips: Sequence[int],
    made: Made,
    start: Values,
    values: Values,
    note: Callable[[str], None] = lambda _: None,
) -> dict[str, Value]:
    """Return those of the changed values that pay.

    Values are put back one after the other, those of the paper's table first, and stay back unless the score and the
    score less the margin are both lower without.

    Args:
        objective: of all sequences.
        clips: the sequences that the values were chosen on.
        made: gives the parameters of changed values.
        start: the values before, by path.
        values: the values that the search chose.
        note: is called with each step.

    """
    chosen = {path: value for path, value in values.items() if value != start[path]}
    base = made({})
    now = objective.gain(made(chosen), base, clips)
    best = now.score
    for path in reversed(list(chosen)):
        note(f"trying without {path}")
        rest = {one: value for one, value in chosen.items() if one != path}
        without = objective.gain(made(rest), base, clips)
        if without.score >= best - WORTH:
            chosen, now, best = rest, without, max(best, without.score)
        elif without.value >= now.value:  # nearer to the start and no worse, if not as sure
            chosen, now, best = rest, without, without.score
    return chosen


def weigh(
    objective: Objective,
    clips: Sequence[int],
    made: Made,
    start: Values,
    values: Values,
    note: Callable[[str], None] = lambda _: None,
) -> tuple[ChangedValue, ...]:
    """Return the worth of each changed value beside the others, the most worth first; arguments as in `prune`."""
    found = []
    for path in values:
        note(f"weighing {path}")
        rest = {one: value for one, value in values.items() if one != path}
        one = objective.gain(made(values), made(rest), clips)
        found.append(ChangedValue(path, start[path], values[path], one.gain, one.error, one.positive, one.groups))
    return tuple(sorted(found, key=lambda one: -one.gain))
