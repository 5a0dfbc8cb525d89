"""Tuning one class from beginning to end: estimate, search with sequences left out, search with all, weigh, report.

The parts that judge and the parts that choose never see the same sequences: for each group that is left out there is a
search of its own on the rest, and what it found is judged on the group. The profile comes from one more search, on all
sequences. Both are kept in one file; an interrupted session goes on where it was.
"""

import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial, reduce
from pathlib import Path
from typing import Any

import numpy as np

from optipmb import Parameters
from optipmb_client.bulk import Executor
from optipmb_client.evaluation.calibration import CalibrationResult
from optipmb_client.tuning.calibrate import calibrate, cross_calibration
from optipmb_client.tuning.caution import Jury
from optipmb_client.tuning.degrade import Degradation, degrade
from optipmb_client.tuning.estimate import estimate
from optipmb_client.tuning.evidence import Evidence, Made, prune, weigh
from optipmb_client.tuning.figures import Figures
from optipmb_client.tuning.folds import deal
from optipmb_client.tuning.material import Clip
from optipmb_client.tuning.objective import Bench
from optipmb_client.tuning.ranking import Ranking, rank
from optipmb_client.tuning.scoring import Measured, Scorer
from optipmb_client.tuning.search import Outcome, Search
from optipmb_client.tuning.space import Dimension, dimensions, penalty, repaired
from optipmb_client.tuning.values import Value, only, value_of, with_calibration, with_heading_sign, with_values
from optipmb_client.tuning.watch import Watch

__all__ = ["FoldResult", "Plan", "Refined", "refine"]


@dataclass(frozen=True)
class Plan:
    """How a session is run."""

    metric: str = "combination"
    trials: int = 120
    """Of the search on all sequences."""
    fold_trials: int = 60
    """Of each search with sequences left out."""
    folds: int = 3
    copies: int = 1
    """Degraded copies of the detections beside the plain ones."""
    degradation: Degradation = field(default_factory=Degradation)
    seed: int = 0
    everything: bool = False
    """Search the values of the paper's table too."""
    penalty: float = 0.0005
    """What a value costs when it is a whole range away from where it began."""
    caution: float = 1.0
    """Standard errors that are taken off a gain before it counts."""


@dataclass(frozen=True)
class FoldResult:
    """Sequences that were left out, judged with what was found without them."""

    sequences: tuple[str, ...]
    parameters: Parameters
    before: tuple[Figures, ...]
    """Of each variant of the detections, with the parameters before."""
    after: tuple[Figures, ...]
    value_before: float
    value_after: float


@dataclass(frozen=True)
class Refined:
    """What a session found out about one class."""

    name: str
    plan: Plan
    sequences: tuple[str, ...]
    parameters: Parameters
    """With this class only."""
    evidence: tuple[Evidence, ...]
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

        def table(figures: tuple[Figures, ...]) -> dict[str, Any]:
            return {name: one.to_json() for name, one in zip(names, figures, strict=False)}

        return {
            "class": self.name,
            "plan": asdict(self.plan),
            "sequences": list(self.sequences),
            "trials": self.trials,
            "objective": {
                "before": self.value_before,
                "after": self.value_after,
                "cross-validated": self.value_crossed,
                "held out, mean": _mean([fold.value_after for fold in self.folds]),
                "held out, spread": _spread([fold.value_after for fold in self.folds]),
                "held out, gain": _mean([fold.value_after - fold.value_before for fold in self.folds]),
                "held out, spread of the gain": _spread([f.value_after - f.value_before for f in self.folds]),
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
            "evidence": [asdict(one) for one in self.evidence],
            "calibration": {"held out": len(self.sequences) > 1, **self.calibration.summary()},
            "ranking": [{**asdict(one), "figures": one.figures.to_json()} for one in self.ranking],
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
    watch: Watch | None = None,
    executor: Executor | None = None,
) -> Refined:
    """Tune one class.

    Args:
        clips: with this class only.
        scorer: of this class.
        parameters: where the search begins; other classes in them do not matter.
        plan: how.
        storage: the file that keeps the trials.
        context: what else the trials depend on, such as the names of the data.
        watch: called with how far it has come.
        executor: where sequences are tracked; by default in this process.

    Raises:
        UsageError: the storage holds trials of another session.

    """
    name, watch = scorer.name, watch or Watch()
    base = only(parameters, name)
    variants = [clips, *([degrade(clip, plan.degradation, plan.seed, i) for clip in clips] for i in range(plan.copies))]
    everyone = tuple(range(len(clips)))
    bench = Bench(variants, scorer, plan.metric, executor, watch.note)
    groups = deal([bench.boxes(i) for i in everyone], plan.folds)
    trials = len(groups) * plan.fold_trials + plan.trials
    watch.begin(name, trials)
    watch.note(f"calibrating {name}")
    first = calibrate(clips, scorer, base)
    work = _Work(bench, base, plan, storage, dict(context), watch, first.memory if first else None)
    calibration = work.calibrated(base, everyone).classes[name].calibration
    work = replace(work, evidence_weight=calibration.score_of_evidence if calibration else 0.0)
    folds: list[FoldResult] = []
    crossed: dict[int, list[Measured]] = {}
    for number, group in enumerate(groups):
        title = f"{name} without group {number + 1} of {len(groups)}"
        rest = tuple(i for i in everyone if i not in group)
        folds.append(work.judge(work.choose(title, rest, plan.fold_trials).parameters, group, crossed))
    chosen = work.choose(f"{name} all", everyone, plan.trials)
    evidence = weigh(chosen.jury, chosen.made, chosen.start, chosen.values, watch)
    found = chosen.parameters
    before, value_before = work.figures(base, everyone)
    after, value_after = work.figures(found, everyone)
    together = work.together(crossed, everyone) if crossed else ()
    watch.note(f"calibrating {name}")
    known = value_of(found, name, "calibration") is not None
    return Refined(
        name=name,
        plan=plan,
        sequences=bench.names,
        parameters=found,
        evidence=evidence,
        before=before,
        after=after,
        folds=tuple(folds),
        crossed=together,
        value_before=value_before,
        value_after=value_after,
        value_crossed=bench.value(together, everyone) if together else None,
        calibration=cross_calibration(clips, scorer, found),
        ranking=rank(clips, scorer, found, plan.metric) if known else (),
        trials=trials,
    )


def _starts(
    base: Parameters, name: str, space: Sequence[Dimension], estimated: Mapping[str, Value]
) -> list[dict[str, Value]]:
    """Return the values that are tried first: of the profile, estimated, half-way, and with the estimate of R only."""
    known = {one.path: value_of(base, name, one.path) for one in space}
    guess = {path: estimated.get(path, value) for path, value in known.items()}
    noise = {path: guess[path] if path.startswith("measurement_noise") else value for path, value in known.items()}
    between = {one.path: one.moved(one.start, 0.5 * one.offset(float(guess[one.path]))) for one in space}
    return [known, guess, between, noise]


@dataclass(frozen=True)
class _Work:
    """What the searches of one class share."""

    bench: Bench
    base: Parameters
    plan: Plan
    storage: Path
    context: dict[str, Any]
    watch: Watch
    memory: float | None
    """Of the evidence, for all searches; None where there is too little to calibrate."""
    evidence_weight: float | None = None
    """In the score, for all searches: tracks that are ranked by different scores cannot be ranked together."""

    @property
    def name(self) -> str:
        return self.bench.scorer.name

    def choose(self, title: str, clips: tuple[int, ...], trials: int) -> "_Choice":
        """Return what is best on some sequences, which alone are looked at."""
        plain = [self.bench.variants[0][i] for i in clips]
        estimated = estimate(plain, self.name, self.base, self.bench.scorer.rules).values
        base = self.calibrated(with_heading_sign(self.base, self.name), clips)
        space = dimensions(base, self.name, estimated, plain, everything=self.plan.everything)
        plan = asdict(self.plan)
        settings = {
            **self.context,
            **{key: plan[key] for key in _SETTLED},
            "sequences": [clip.name for clip in plain],
            "base": zlib.crc32(base.model_dump_json().encode()),
            "space": [list(asdict(one).values()) for one in space],
        }
        starts = _starts(base, self.name, space, estimated)
        search = Search(self.storage, title, settings, space, starts, zlib.crc32(f"{self.plan.seed} {title}".encode()))
        self.watch.note(f"searching: {title}")
        best = -math.inf
        for outcome in search.outcomes()[:trials]:
            best = max(best, outcome.score)
            self.watch.trial(best)

        def heard(outcome: Outcome) -> None:
            nonlocal best
            best = max(best, outcome.score)
            self.watch.trial(best)

        def made(values: Mapping[str, Value]) -> Parameters:
            return with_values(base, self.name, repaired(values, base, self.name))

        jury = Jury(self.bench, clips, base)

        def score(values: Mapping[str, Value], rival: Outcome | None) -> float:
            cost = penalty(space, values, self.plan.penalty)
            if rival is not None:
                behind = self._behind(made(values), made(rival.values), clips)
                if behind is not None:
                    return rival.score - behind - cost
            return jury.score(made(values), self.plan.caution) - cost

        found = search.run(trials, score, heard).values
        start = {one.path: value_of(base, self.name, one.path) for one in space}
        values = prune(jury, made, start, repaired(found, base, self.name), self.plan.caution, self.watch)
        return _Choice(jury, made, start, values, self._calibrated(made(values), clips))

    def _calibrated(self, parameters: Parameters, clips: tuple[int, ...]) -> Parameters:
        """Return the parameters with the calibration that sequences give; what ranks tracks stays if there is one."""
        before = parameters.classes[self.name].calibration
        plain = [self.bench.variants[0][i] for i in clips]
        found = calibrate(plain, self.bench.scorer, parameters, self.memory) if self.memory else None
        if found and before:
            found = found.model_copy(update={"score_of_evidence": before.score_of_evidence})
        return with_calibration(parameters, self.name, found)

    def _better(self, one: Parameters, other: Parameters, clips: tuple[int, ...]) -> Parameters:
        """Return the better of two, the first of equals.

        It is one choice of two, and neither was made to fit: no caution is needed as for the best of a hundred trials.
        """
        return other if other != one and Jury(self.bench, clips, one).gain(other).gain > 0.0 else one

    def calibrated(self, base: Parameters, clips: tuple[int, ...]) -> Parameters:
        """Return the parameters with a calibration of their own, and with the score that ranks tracks better."""
        self.watch.note("calibrating")
        plain = self._calibrated(with_calibration(base, self.name, None), clips)
        if plain.classes[self.name].calibration is None:
            return plain
        weights = _EVIDENCE_WEIGHTS if self.evidence_weight is None else (self.evidence_weight,)
        each = [with_values(plain, self.name, {"calibration.score_of_evidence": weight}) for weight in weights]
        return reduce(partial(self._better, clips=clips), each)

    def _behind(self, parameters: Parameters, rival: Parameters, clips: tuple[int, ...]) -> float | None:
        """Return by how much parameters lose to the best so far where that shows early; None where it does not.

        A race: first on half of the sequences, then on all, both on the detections as they are. Most trials end here,
        and cost a fraction of a whole one.
        """
        halves = deal([self.bench.boxes(i) if i in clips else 0 for i in range(len(self.bench.names))], 2)
        for part, margin in ((halves[0], _EARLY), (clips, _LATE)) if halves else ((clips, _LATE),):
            values = []
            for one in (parameters, rival):
                figures = self.bench.figures(self.bench.measure(one, part, (0,)))
                values.append(self.bench.value(figures, part))
            if values[0] < values[1] - margin:
                return values[1] - values[0]
        return None

    def figures(self, parameters: Parameters, clips: tuple[int, ...]) -> tuple[tuple[Figures, ...], float]:
        """Return the figures of each variant and the objective."""
        figures = self.bench.figures(self.bench.measure(parameters, clips))
        return figures, self.bench.value(figures, clips)

    def judge(self, found: Parameters, group: tuple[int, ...], crossed: dict[int, list[Measured]]) -> FoldResult:
        """Judge parameters by sequences that did not choose them; keep what tracking those gave in `crossed`."""
        before, value_before = self.figures(self.base, group)
        after, value_after = self.figures(found, group)
        measured = self.bench.measure(found, group)
        for place, clip in enumerate(group):
            crossed[clip] = [variant[place] for variant in measured]
        names = tuple(self.bench.names[i] for i in group)
        return FoldResult(names, found, before, after, value_before, value_after)

    def together(self, crossed: Mapping[int, list[Measured]], clips: tuple[int, ...]) -> tuple[Figures, ...]:
        """Return the figures of all sequences, each with the parameters found without it.

        Those in no group have no truth of this class; they are tracked with the parameters before.
        """
        rest = tuple(i for i in clips if i not in crossed)
        own = self.bench.measure(self.base, rest)
        parts = {**crossed, **{clip: [variant[place] for variant in own] for place, clip in enumerate(rest)}}
        return self.bench.figures([[parts[i][variant] for i in clips] for variant in range(len(self.bench.variants))])


@dataclass(frozen=True)
class _Choice:
    """What a search chose."""

    jury: Jury
    made: Made
    start: Mapping[str, Value]
    values: Mapping[str, Value]
    parameters: Parameters


_EVIDENCE_WEIGHTS = (0.0, 0.5, 1.0)
_EARLY, _LATE = 0.004, 0.002
"""By how much a trial may be behind, on half of the sequences and on all, and still be tried on degraded detections."""
_SETTLED = ("metric", "copies", "degradation", "seed", "everything", "penalty", "caution")
"""What of a plan the trials depend on; their number is not in it, so there can be more later."""
