"""The search for better values: the search space, and trials one after the other in an Optuna study.

By default only the values that the paper's table of parameters lacks are searched: Q, R, P^0, the area and the two
limits of forgetting. Bounds lie around the values that a search begins from: the profile's and the estimated
ones.

Most candidates are small moves away from the best one so far, which finds more in many dimensions with few trials;
every sixth is proposed by Optuna's TPE sampler (Bergstra et al., 2011). Optuna's percentile pruner ends trials that
fall behind early. Before each trial the random generator is seeded from the seed and the number of trials done, so a
search that was interrupted continues as if it had not been.
"""

import json
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from optipmb_client.errors import UsageError

from optipmb import Parameters
from optipmb_tools.extras import needed
from optipmb_tools.tuning.clips import Clip
from optipmb_tools.tuning.values import Value, rounded, value_of

if TYPE_CHECKING:
    import optuna

Kind = Literal["log", "linear", "whole"]

_FACTOR = 4.0
_OWN: tuple[tuple[str, Kind, float, float], ...] = (
    ("area", "log", 10.0, 1e6),
    ("max_misses", "whole", 1, 100),
    ("min_existence", "log", 1e-4, 0.3),
    ("process_noise.position", "log", 0.005, 2.0),
    ("process_noise.speed", "log", 0.01, 10.0),
    ("process_noise.heading", "log", 0.003, 3.0),
    ("process_noise.turn_rate", "log", 0.003, 3.0),
    ("process_noise.acceleration", "log", 0.01, 10.0),
    ("measurement_noise.position", "log", 0.01, 3.0),
    ("measurement_noise.velocity", "log", 0.05, 10.0),
    ("measurement_noise.heading", "log", 0.01, 3.0),
    ("birth.position", "log", 0.01, 5.0),
    ("birth.speed", "log", 0.05, 30.0),
    ("birth.unknown_speed", "log", 0.1, 50.0),
    ("birth.heading", "log", 0.01, 3.0),
    ("birth.turn_rate", "log", 0.005, 3.0),
    ("birth.acceleration", "log", 0.01, 10.0),
)
_PAPER: tuple[tuple[str, Kind, float, float], ...] = (
    ("score_filter", "linear", 0.0, 0.6),
    ("nms_iou", "linear", 0.01, 0.5),
    ("survival", "linear", 0.95, 1.0),
    ("gate", "log", 0.5, 20.0),
    ("detection", "linear", 0.4, 0.99),
    ("expected_points", "log", 1.0, 200.0),
    ("detection_floor", "linear", 0.1, 1.0),
    ("birth_score", "linear", 0.05, 0.95),
    ("adaptive_birth_rate", "log", 0.01, 20.0),
    ("undetected_birth_rate", "log", 0.01, 20.0),
    ("clutter_rate", "log", 0.05, 50.0),
    ("poisson_steps", "whole", 0, 6),
    ("extract_new", "linear", 0.3, 0.95),
    ("extract_known", "linear", 0.3, 0.99),
    ("extract_misses", "whole", 1, 15),
)
_VELOCITY = ("measurement_noise.velocity", "birth.speed")
_NO_VELOCITY = ("birth.unknown_speed",)
_CLOUD = ("expected_points", "detection_floor")

_TPE_EVERY = 6
_TPE_WARMUP = 4
_SPREAD = 0.15  # standard deviation of a small move, as a share of the range
_MOVED = (0.5, 0.3, 0.2)  # probabilities that a move changes one value, two, three
_KEPT_PERCENT = 25.0  # a trial continues while its score is among the best so many percent


@dataclass(frozen=True)
class Dimension:
    """One value that is searched."""

    path: str
    kind: Kind
    low: float
    high: float
    start: float

    def value(self, raw: float) -> Value:
        """Return a number as the profile has it: within the bounds, with few digits."""
        bounded = min(max(raw, self.low), self.high)
        return round(bounded) if self.kind == "whole" else rounded(bounded)

    def offset(self, value: float) -> float:
        """Return how far a value is from the start, in units of the range: logarithms where the range is large."""
        if self.kind == "linear":
            return (value - self.start) / (self.high - self.low)
        shift = 1.0 if self.kind == "whole" else 0.0
        return math.log((value + shift) / (self.start + shift)) / math.log((self.high + shift) / (self.low + shift))

    def moved(self, value: float, step: float) -> Value:
        """Return a value moved by a share of the range."""
        if self.kind == "linear":
            return self.value(value + step * (self.high - self.low))
        shift = 1.0 if self.kind == "whole" else 0.0
        factor = ((self.high + shift) / (self.low + shift)) ** step
        return self.value((value + shift) * factor - shift)

    def suggest(self, trial: "optuna.Trial") -> Value:
        """Return the value that a trial has, or the sampler proposes."""
        if self.kind == "whole":
            return self.value(trial.suggest_int(self.path, int(self.low), int(self.high), log=self.low >= 1))
        return self.value(trial.suggest_float(self.path, self.low, self.high, log=self.kind == "log"))


def dimensions(
    parameters: Parameters, name: str, estimated: Mapping[str, Value], clips: Sequence[Clip], *, everything: bool
) -> tuple[Dimension, ...]:
    """Return the search space of a class.

    Args:
        parameters: the values to begin with.
        name: the class.
        estimated: other values to begin with, by path.
        clips: values that have no effect on them, such as those about velocities without any, are left out.
        everything: also the values of the paper's table.
    """
    known = [np.isfinite(frame.velocity).all(axis=1) for clip in clips for frame in clip.frames]
    velocities = any(row.any() for row in known)
    idle = set() if velocities else set(_VELOCITY)
    if velocities and all(row.all() for row in known):
        idle |= set(_NO_VELOCITY)
    if all(frame.cloud is None for clip in clips for frame in clip.frames):
        idle |= set(_CLOUD)
    found = []
    for path, kind, least, most in (*_OWN, *(_PAPER if everything else ())):
        if path in idle:
            continue
        start = float(value_of(parameters, name, path))
        known_values = [start, float(estimated.get(path, start))]
        low, high = (least, most) if kind == "linear" else _around(known_values, kind, least, most)
        found.append(Dimension(path, kind, min(low, start), max(high, start), start))
    return tuple(found)


def _around(values: Sequence[float], kind: Kind, least: float, most: float) -> tuple[float, float]:
    low, high = max(least, min(values) / _FACTOR), min(most, max(values) * _FACTOR)
    if kind == "whole":
        return float(math.floor(low)), float(math.ceil(high))
    return rounded(low), rounded(high)


def repaired(values: Mapping[str, Value], parameters: Parameters, name: str) -> dict[str, Value]:
    """Return values that a profile allows: a track is never harder to extract again than for the first time."""
    fixed = dict(values)
    new = fixed.get("extract_new", value_of(parameters, name, "extract_new"))
    known = fixed.get("extract_known", value_of(parameters, name, "extract_known"))
    if new > known:
        fixed["extract_new" if "extract_new" in fixed else "extract_known"] = known if "extract_new" in fixed else new
    return fixed


def penalty(space: Sequence[Dimension], values: Mapping[str, Value], weight: float) -> float:
    """Return the cost of leaving the start, so that a value without effect on the tracks stays where it was."""
    return weight * sum(one.offset(float(values[one.path])) ** 2 for one in space if one.path in values)


Values = Mapping[str, Value]
Score = Callable[[Values, Callable[[float], None]], float]
"""Return the score of values; early guesses of it go to the second argument, which ends the trial if they are bad."""


class Search:
    """One study in a SQLite file, which several studies share; a study of other settings is refused.

    Raises:
        ClientError: Optuna is not installed.
        UsageError: The file has this study with other settings.
    """

    def __init__(
        self,
        storage: Path,
        name: str,
        settings: Mapping[str, Any],
        space: Sequence[Dimension],
        starts: Sequence[Values],
        seed: int,
    ) -> None:
        self._optuna = _load_optuna()
        self._space = space
        self._starts = starts
        self._seed = seed
        storage.parent.mkdir(parents=True, exist_ok=True)
        from sqlalchemy.pool import NullPool  # noqa: PLC0415  of Optuna, an extra that only this needs

        # A connection for each access, closed after it: a pool would keep them open as long as the process.
        kept = self._optuna.storages.RDBStorage(f"sqlite:///{storage}", engine_kwargs={"poolclass": NullPool})
        self._file = self._optuna.create_study(storage=kept, study_name=name, direction="maximize", load_if_exists=True)
        text = json.dumps(settings, sort_keys=True)
        known = self._file.user_attrs.get("settings")
        if known is None:
            self._file.set_user_attr("settings", text)
        elif known != text:
            raise UsageError(f"{storage}: study {name!r} has other settings; choose another --out, or remove the file")
        # A trial takes a dozen writes; they go to memory, and the file has whole trials only.
        pruner = self._optuna.pruners.PercentilePruner(_KEPT_PERCENT, n_startup_trials=len(starts))
        self._study = self._optuna.create_study(direction="maximize", pruner=pruner)
        self._study.add_trials(self._file.get_trials(deepcopy=False))

    @property
    def trials(self) -> "list[optuna.trial.FrozenTrial]":
        """The trials that are done, in order."""
        trials: list[optuna.trial.FrozenTrial] = self._study.get_trials(deepcopy=False)
        return trials

    def run(
        self, trials: int, score: Score, on_trial: Callable[[float], None] = lambda _best: None
    ) -> dict[str, Value]:
        """Continue until there are `trials` trials, of earlier sessions too; return the best values.

        After each trial `on_trial` gets the best score so far.
        """
        for number in range(len(self.trials), trials):
            rng = np.random.Generator(np.random.PCG64([self._seed, number]))
            if number < len(self._starts):
                start = self._starts[number]
                self._study.enqueue_trial({one.path: one.value(float(start[one.path])) for one in self._space})
            elif number % _TPE_EVERY:
                self._study.enqueue_trial(self._moved(self._best(number), rng))
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # multivariate has been experimental for years
                self._study.sampler = self._optuna.samplers.TPESampler(
                    seed=int(rng.integers(2**31)), n_startup_trials=_TPE_WARMUP, multivariate=True
                )
            self._study.optimize(lambda trial: self._scored(trial, score), n_trials=1)
            self._file.add_trial(self.trials[-1])
            on_trial(self._study.best_value)
        return self._best(trials)

    def _best(self, trials: int) -> dict[str, Value]:
        """Return the values of the best of the first trials, the earliest of equals."""
        complete = self._optuna.trial.TrialState.COMPLETE
        done = [trial for trial in self.trials[:trials] if trial.state == complete]
        best = max(done, key=lambda trial: trial.values[0])
        return {one.path: one.value(best.params[one.path]) for one in self._space}

    def _scored(self, trial: "optuna.Trial", score: Score) -> float:
        values = {one.path: one.suggest(trial) for one in self._space}
        steps = count()

        def guess(value: float) -> None:
            trial.report(value, next(steps))
            if trial.should_prune():
                raise self._optuna.TrialPruned

        return score(values, guess)

    def _moved(self, best: Values, rng: np.random.Generator) -> dict[str, Value]:
        changed = 1 + int(rng.choice(len(_MOVED), p=_MOVED))
        chosen = set(rng.choice(len(self._space), size=min(changed, len(self._space)), replace=False).tolist())
        # Wide and narrow moves take turns by chance: which of them helps changes on the way.
        steps = _SPREAD * 2.0 ** rng.uniform(-2.0, 0.5) * rng.standard_normal(len(self._space))
        return {
            one.path: one.moved(float(best[one.path]), float(steps[i])) if i in chosen else best[one.path]
            for i, one in enumerate(self._space)
        }


def _load_optuna() -> Any:
    needed("tuning", "tune", "optuna")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import optuna  # noqa: PLC0415  an extra that only this needs

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return optuna
