"""Tuning of one class: estimate, search with folds left out, search on all sequences, report.

The sequences that score a result never chose it: for each fold that is left out
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
from optipmb_tools.tuning.calibrate import Ranking, calibrate, cross_calibration, rank
from optipmb_tools.tuning.clips import Degradation
from optipmb_tools.tuning.estimate import estimate
from optipmb_tools.tuning.scoring import MARGIN, Figures, Gain, Measured, Objective, folds_of, plain_figures
from optipmb_tools.tuning.search import Dimension, Search, Values, dimensions, penalty, repaired
from optipmb_tools.tuning.values import Value, only, value_of, with_calibration, with_heading_sign, with_values
from optipmb_tools.views.progress import TrialDisplay

PENALTY = 0.0005  # cost of a value that is a whole range away from its start
WORTH = 0.0002  # least gain in the score less the margin for which a changed value is kept
_EVIDENCE_WEIGHTS = (0.0, 0.5, 1.0)
_SETTLED = ("metric", "copies", "seed", "everything")
"""Settings of a plan on which the trials depend; their number is not among them, so there can be more later."""


@dataclass(frozen=True)
class Plan:
    """Options of a session."""

    metric: str = "combination"
    trials: int = 120  # of the search on all sequences
    fold_trials: int = 60  # of each search with a fold left out
    folds: int = 3
    copies: int = 1  # degraded copies of the detections, in addition to the plain ones
    seed: int = 0
    everything: bool = False  # search the values of the paper's table too


@dataclass(frozen=True)
class ChangedValue:
    """A value that the search changed, and its worth."""

    path: str
    start: Value
    value: Value
    gain: float  # of the objective, over putting it back
    error: float  # standard error of the gain
    positive: int  # in how many of `groups` choices of sequences, each without one fold, there is a gain
    groups: int


@dataclass(frozen=True)
class Scored:
    """Figures of some sequences with the parameters of one candidate."""

    figures: tuple[Figures, ...]  # of each variant of the detections
    value: float  # of the objective


@dataclass(frozen=True)
class FoldResult:
    """Scores of a fold that was left out, with the parameters before and those found without it."""

    sequences: tuple[str, ...]
    before: Scored
    after: Scored

    @property
    def gain(self) -> float:
        """Gain of the objective."""
        return self.after.value - self.before.value


@dataclass(frozen=True)
class Refined:
    """Result of a session for one class."""

    name: str
    plan: Plan
    sequences: tuple[str, ...]
    parameters: Parameters  # with this class only
    changes: tuple[ChangedValue, ...]
    before: Scored  # all sequences
    after: Scored  # the same with the new parameters; these sequences chose them
    folds: tuple[FoldResult, ...]
    crossed: Scored | None
    """All sequences together, each with the parameters that were found without it; None without folds."""
    calibration: CalibrationResult
    """Of all sequences, each with the calibration that the others give; one alone with its own."""
    ranking: tuple[Ranking, ...]  # scores that tracks could be ranked by; empty without a calibration
    trials: int

    def to_json(self) -> dict[str, Any]:
        """Return everything as plain values."""
        names = ("plain", *(f"degraded {i + 1}" for i in range(self.plan.copies)))

        def table(scored: Scored | None) -> dict[str, Any]:
            figures = scored.figures if scored else ()
            return {name: plain_figures(one) for name, one in zip(names, figures, strict=False)}

        held_out, gains = [fold.after.value for fold in self.folds], [fold.gain for fold in self.folds]
        return {
            "class": self.name,
            "plan": {**asdict(self.plan), "degradation": asdict(Degradation()), "penalty": PENALTY, "caution": MARGIN},
            "sequences": list(self.sequences),
            "trials": self.trials,
            "objective": {
                "before": self.before.value,
                "after": self.after.value,
                "cross-validated": self.crossed.value if self.crossed else None,
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
                    "objective": {"before": fold.before.value, "after": fold.after.value},
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
    objective: Objective,
    parameters: Parameters,
    plan: Plan,
    storage: Path,
    context: Mapping[str, Any],
    display: TrialDisplay,
) -> Refined:
    """Tune the class of an objective, whose clips have it only; the search begins at the parameters.

    The storage keeps the trials; `context` has other settings on which they depend, such as the names of the data.

    Raises:
        UsageError: the storage holds trials of another session.
    """
    clips, scorer, name = objective.variants[0], objective.scorer, objective.scorer.name
    base, everyone = only(parameters, name), tuple(range(len(clips)))
    groups = folds_of(objective.boxes, plan.folds)
    trials = len(groups) * plan.fold_trials + plan.trials
    display.begin(name, trials)
    display.note(f"calibrating {name}")
    first = calibrate(clips, scorer, base)
    session = _Session(objective, base, plan, storage, dict(context), display, first.memory if first else None)
    calibration = session.calibrated(base, everyone).classes[name].calibration
    session = replace(session, evidence_weight=calibration.score_of_evidence if calibration else 0.0)
    folds: list[FoldResult] = []
    left_out: dict[int, list[Measured]] = {}
    for number, group in enumerate(groups):
        rest = tuple(i for i in everyone if i not in group)
        candidates, values = session.choose(
            f"{name} without group {number + 1} of {len(groups)}", rest, plan.fold_trials
        )
        found = session.with_calibration(candidates.parameters(values), rest)
        names = tuple(objective.names[i] for i in group)
        folds.append(FoldResult(names, session.scored(base, group), session.scored(found, group)))
        left_out |= session.measured(found, group)
    candidates, values = session.choose(f"{name} all", everyone, plan.trials)
    found = session.with_calibration(candidates.parameters(values), everyone)
    changes = candidates.weigh(values)
    before, after = session.scored(base, everyone), session.scored(found, everyone)
    crossed = None
    if left_out:
        # Sequences in no fold have no truth of this class.
        left_out |= session.measured(base, tuple(i for i in everyone if i not in left_out))
        figures = objective.figures([[left_out[i][k] for i in everyone] for k in range(len(objective.variants))])
        crossed = Scored(figures, objective.value(figures, everyone))
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
        crossed=crossed,
        calibration=cross_calibration(clips, scorer, found),
        ranking=rank(clips, scorer, found, plan.metric) if found.classes[name].calibration is not None else (),
        trials=trials,
    )


@dataclass(frozen=True)
class Candidates:
    """Parameters that differ from a base in some values, and their gains on some sequences."""

    objective: Objective
    clips: Sequence[int]
    base: Parameters
    note: Callable[[str], None] = lambda _: None  # called with each step

    def parameters(self, values: Values) -> Parameters:
        """Return the parameters of a candidate from its changed values."""
        name = self.objective.scorer.name
        return with_values(self.base, name, repaired(values, self.base, name))

    def start(self, path: str) -> Value:
        """Return a value of the base."""
        return value_of(self.base, self.objective.scorer.name, path)

    def gain(self, values: Values) -> Gain:
        """Return the gain over the base."""
        return self.objective.gain(self.parameters(values), self.parameters({}), self.clips)

    def prune(self, values: Values) -> dict[str, Value]:
        """Return the changed values that pay.

        Values are put back one after the other, the paper's table first, and stay back unless the score and
        the score less the margin are both lower without.
        """
        chosen = {path: value for path, value in values.items() if value != self.start(path)}
        now = self.gain(chosen)
        best = now.score
        for path in reversed(list(chosen)):
            self.note(f"trying without {path}")
            rest = {one: value for one, value in chosen.items() if one != path}
            without = self.gain(rest)
            if without.score >= best - WORTH:
                chosen, now, best = rest, without, max(best, without.score)
            elif without.value >= now.value:  # nearer to the start and no worse, if not as sure
                chosen, now, best = rest, without, without.score
        return chosen

    def weigh(self, values: Values) -> tuple[ChangedValue, ...]:
        """Return the worth of each changed value together with the others, the most worth first."""
        found = []
        for path, value in values.items():
            self.note(f"weighing {path}")
            rest = {one: other for one, other in values.items() if one != path}
            one = self.objective.gain(self.parameters(values), self.parameters(rest), self.clips)
            found.append(ChangedValue(path, self.start(path), value, one.gain, one.error, one.positive, one.groups))
        return tuple(sorted(found, key=lambda one: -one.gain))


@dataclass(frozen=True)
class _Session:
    """Data and settings of the searches of one class."""

    objective: Objective
    base: Parameters
    plan: Plan
    storage: Path
    context: dict[str, Any]
    display: TrialDisplay
    memory: float | None  # of the evidence, for all searches; None where there is too little to calibrate
    evidence_weight: float | None = None
    """In the score, for all searches: tracks that are ranked by different scores cannot be ranked together."""

    @property
    def name(self) -> str:
        return self.objective.scorer.name

    def choose(self, title: str, clips: tuple[int, ...], trials: int) -> tuple[Candidates, dict[str, Value]]:
        """Return the candidates of a search on some sequences, and the values of the best one."""
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
        candidates = Candidates(self.objective, clips, base, self.display.note)

        def score(values: Values, guess: Callable[[float], None]) -> float:
            candidate, cost = candidates.parameters(values), penalty(space, values, PENALTY)
            for part in (*half, clips):
                guess(self.objective.plain_value(candidate, part) - cost)
            return candidates.gain(values).score - cost

        self.display.note(f"searching: {title}")
        found = search.run(trials, score, self.display.trial)
        return candidates, candidates.prune(repaired(found, base, self.name))

    def calibrated(self, base: Parameters, clips: tuple[int, ...]) -> Parameters:
        """Return the parameters with a calibration of their own, and with the score that ranks tracks better."""
        self.display.note("calibrating")
        best = self.with_calibration(with_calibration(base, self.name, None), clips)
        if best.classes[self.name].calibration is None:
            return best
        weights = _EVIDENCE_WEIGHTS if self.evidence_weight is None else (self.evidence_weight,)
        first, *others = (with_values(best, self.name, {"calibration.score_of_evidence": weight}) for weight in weights)
        for other in others:
            # No margin is needed for one choice of a few that were not made to fit.
            if other != first and self.objective.gain(other, first, clips).gain > 0.0:
                first = other
        return first

    def with_calibration(self, parameters: Parameters, clips: tuple[int, ...]) -> Parameters:
        """Return the parameters with the calibration of some sequences; a ranking score that they have stays."""
        before = parameters.classes[self.name].calibration
        plain = [self.objective.variants[0][i] for i in clips]
        found = calibrate(plain, self.objective.scorer, parameters, self.memory) if self.memory else None
        if found and before:
            found = found.model_copy(update={"score_of_evidence": before.score_of_evidence})
        return with_calibration(parameters, self.name, found)

    def scored(self, parameters: Parameters, clips: tuple[int, ...]) -> Scored:
        """Return the figures of each variant and the objective."""
        figures = self.objective.figures(self.objective.measure(parameters, clips))
        return Scored(figures, self.objective.value(figures, clips))

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
