"""Tuning of one class: an Optuna study on some sequences, measured on held-out ones.

By default only the values that the paper's table of parameters lacks are searched: Q, R, P^0, the area and the two
limits of forgetting. Bounds lie around the values that the study begins from: the profile's and the estimated
ones. The others are proposed by Optuna's TPE sampler (Bergstra et al., 2011), which is seeded before each trial from
the seed and the number of the trial, so a study that was interrupted continues as if it had not been.
"""

import json
import math
import warnings
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from optipmb_client.errors import UsageError

from optipmb import Parameters
from optipmb_tools.evaluation.calibration import CalibrationResult
from optipmb_tools.extras import needed
from optipmb_tools.tuning.calibrate import calibrate, cross_calibration
from optipmb_tools.tuning.clips import Clip
from optipmb_tools.tuning.estimate import estimate
from optipmb_tools.tuning.scoring import Figures, Objective, folds_of, plain_figures
from optipmb_tools.tuning.values import (
    Value,
    only,
    rounded,
    value_of,
    with_calibration,
    with_heading_sign,
    with_values,
)
from optipmb_tools.views.progress import TrialDisplay

if TYPE_CHECKING:
    import optuna

Kind = Literal["log", "linear", "whole"]
Values = Mapping[str, Value]

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

_EVIDENCE_WEIGHTS = (0.0, 0.5, 1.0)


@dataclass(frozen=True)
class Plan:
    """Options of a study."""

    metric: str = "combination"
    trials: int = 120
    folds: int = 3  # groups of sequences, of which the first is held out; 0: none
    seed: int = 0
    everything: bool = False  # search the values of the paper's table too


@dataclass(frozen=True)
class Scored:
    """Figures of some sequences with some parameters."""

    figures: Figures
    value: float  # of the objective


@dataclass(frozen=True)
class ChangedValue:
    """A value that the study changed."""

    path: str
    start: Value
    value: Value


@dataclass(frozen=True)
class Tuned:
    """Result of a study of one class."""

    name: str
    plan: Plan
    sequences: tuple[str, ...]  # of the study
    held_out: tuple[str, ...]
    parameters: Parameters  # with this class only
    changes: tuple[ChangedValue, ...]
    before: Scored
    after: Scored  # of the sequences that chose the parameters
    held_out_before: Scored | None
    held_out_after: Scored | None
    calibration: CalibrationResult
    """Of all sequences, each with the calibration that the others give; one alone with its own."""

    def to_json(self) -> dict[str, Any]:
        """Return everything as plain values."""
        parts = {
            "before": self.before,
            "after": self.after,
            "held out, before": self.held_out_before,
            "held out, after": self.held_out_after,
        }
        return {
            "class": self.name,
            "plan": asdict(self.plan),
            "sequences": list(self.sequences),
            "held out": list(self.held_out),
            "objective": {name: one and one.value for name, one in parts.items()},
            "figures": {name: one and plain_figures(one.figures) for name, one in parts.items()},
            "changes": [asdict(one) for one in self.changes],
            "calibration": {"held out": len(self.sequences + self.held_out) > 1, **self.calibration.summary()},
        }


def tune(
    objective: Objective,
    parameters: Parameters,
    plan: Plan,
    storage: Path,
    context: Mapping[str, Any],
    display: TrialDisplay,
) -> Tuned:
    """Tune the class of an objective, whose clips have it only; the study begins at the parameters.

    The storage keeps the trials; `context` has other settings on which they depend, such as the names of the data.

    Raises:
        ClientError: Optuna is not installed.
        UsageError: the storage holds trials of another study.
    """
    name, before = objective.scorer.name, only(parameters, objective.scorer.name)
    held_out, *_ = *folds_of(objective.boxes, plan.folds), ()
    clips = tuple(i for i in range(len(objective.clips)) if i not in held_out)
    plain = [objective.clips[i] for i in clips]
    display.begin(name, plan.trials)
    display.note(f"calibrating {name}")
    base = _calibrated(objective, with_heading_sign(before, name), clips)
    estimated = estimate(plain, name, before, objective.scorer.rules).values
    space = dimensions(base, name, estimated, plain, everything=plan.everything)
    settings = {
        **context,
        "plan": {**asdict(plan), "trials": None},  # there can be more later
        "sequences": [clip.name for clip in plain],
        "base": zlib.crc32(base.model_dump_json().encode()),
        "space": [list(asdict(one).values()) for one in space],
    }
    display.note(f"searching: {name}")

    def score(values: Values) -> float:
        candidate = with_values(base, name, repaired(values, base, name))
        return objective.value(objective.figures(candidate, clips), clips)

    kept = opened(storage, name, settings)
    best = repaired(search(kept, space, [{}, estimated], score, plan, display.trial), base, name)
    chosen = {path: value for path, value in best.items() if value != value_of(base, name, path)}
    display.note(f"calibrating {name}")
    found = _calibrated(objective, with_values(base, name, chosen), clips)

    def scored(parameters: Parameters, some: tuple[int, ...]) -> Scored:
        figures = objective.figures(parameters, some)
        return Scored(figures, objective.value(figures, some))

    return Tuned(
        name=name,
        plan=plan,
        sequences=tuple(clip.name for clip in plain),
        held_out=tuple(objective.clips[i].name for i in held_out),
        parameters=found,
        changes=tuple(ChangedValue(path, value_of(base, name, path), value) for path, value in chosen.items()),
        before=scored(before, clips),
        after=scored(found, clips),
        held_out_before=scored(before, held_out) if held_out else None,
        held_out_after=scored(found, held_out) if held_out else None,
        calibration=cross_calibration(objective.clips, objective.scorer, found),
    )


def _calibrated(objective: Objective, parameters: Parameters, clips: tuple[int, ...]) -> Parameters:
    """Return the parameters with the calibration of some sequences, and with the score that ranks tracks best."""
    name = objective.scorer.name
    found = calibrate([objective.clips[i] for i in clips], objective.scorer, with_calibration(parameters, name, None))
    calibrated = with_calibration(parameters, name, found)
    if found is None:
        return calibrated
    choices = [with_values(calibrated, name, {"calibration.score_of_evidence": one}) for one in _EVIDENCE_WEIGHTS]
    return max(choices, key=lambda one: objective.value(objective.figures(one, clips), clips))


def search(
    kept: "optuna.Study",
    space: Sequence["Dimension"],
    starts: Sequence[Values],
    score: Callable[[Values], float],
    plan: Plan,
    on_trial: Callable[[float], None] = lambda _best: None,
) -> dict[str, Value]:
    """Continue a study until it has the trials of the plan; return the values of the best, the earliest of equals.

    Args:
        kept: the study in its file, which gets whole trials only: each takes a dozen writes, which go to memory.
        space: the values that are searched.
        starts: the candidates tried first; a value that one lacks is the start's.
        score: is maximised.
        plan: has the number of trials and the seed.
        on_trial: gets the best score after each trial.
    """
    optuna = _load_optuna()
    study = optuna.create_study(direction="maximize")
    study.add_trials(kept.get_trials(deepcopy=False))

    def scored(trial: Any) -> float:
        return score({one.path: one.suggest(trial) for one in space})

    for number in range(len(study.trials), plan.trials):
        if number < len(starts):
            study.enqueue_trial({one.path: one.value(float(starts[number].get(one.path, one.start))) for one in space})
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # multivariate has been experimental for years
            study.sampler = optuna.samplers.TPESampler(
                seed=zlib.crc32(f"{plan.seed} {kept.study_name} {number}".encode()), multivariate=True
            )
        study.optimize(scored, n_trials=1)
        kept.add_trial(study.trials[-1])
        on_trial(study.best_value)
    best = max(study.trials[: plan.trials], key=lambda trial: trial.value)
    return {one.path: one.value(best.params[one.path]) for one in space}


def opened(storage: Path, name: str, settings: Mapping[str, Any]) -> Any:
    """Return the study of a name in a file, which several studies share; its trials depend on the settings.

    Raises:
        ClientError: Optuna is not installed.
        UsageError: the file has a study of this name with other settings.
    """
    optuna = _load_optuna()
    storage.parent.mkdir(parents=True, exist_ok=True)
    from sqlalchemy.pool import NullPool  # noqa: PLC0415  of Optuna, an extra that only this needs

    # A connection for each access, closed after it: a pool would keep them open as long as the process.
    file = optuna.storages.RDBStorage(f"sqlite:///{storage}", engine_kwargs={"poolclass": NullPool})
    kept = optuna.create_study(storage=file, study_name=name, direction="maximize", load_if_exists=True)
    text = json.dumps(settings, sort_keys=True)
    if kept.user_attrs.setdefault("settings", text) != text:
        raise UsageError(f"{storage}: study {name!r} has other settings; choose another --out, or remove the file")
    kept.set_user_attr("settings", text)
    return kept


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


def _load_optuna() -> Any:
    needed("tuning", "tune", "optuna")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import optuna  # noqa: PLC0415  an extra that only this needs

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return optuna
