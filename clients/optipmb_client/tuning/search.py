"""The search for better values: trials one after the other, kept in a file so that it can be taken up again.

Most trials are small moves away from the best one so far, which is what finds anything in many dimensions with few
trials; every sixth is proposed by Optuna's TPE sampler (Bergstra et al., 2011), which models where good values lie and
leaves a place that is only the best nearby. Before each trial the chance of both is seeded anew from the seed and the
number of trials done, so a search that was interrupted goes on as if it had not been.
"""

import json
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from optipmb_schemas.installation import install_command

from optipmb_client.errors import ClientError, UsageError
from optipmb_client.tuning.space import Dimension
from optipmb_client.tuning.values import Value

if TYPE_CHECKING:
    import optuna

__all__ = ["Outcome", "Search"]

_EVERY = 6
"""One trial in so many is proposed by TPE, the others are small moves."""
_WARMUP = 4
"""Trials before TPE has anything to model."""
_SPREAD = 0.15
"""Standard deviation of a small move, as a share of the range."""
_MOVED = 3
"""The most values that a small move changes."""
_OFTEN = (0.5, 0.3, 0.2)
"""How often a move changes one value, two, three."""


@dataclass(frozen=True)
class Outcome:
    """One trial."""

    number: int
    values: Mapping[str, Value]
    score: float


class Search:
    """One study in a storage.

    Args:
        storage: path of the SQLite file; several studies share it.
        name: of the study.
        settings: what the study depends on; taking it up again with other settings is refused.
        space: what is searched.
        starts: values that are tried first.
        seed: of all chance.

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
        starts: Sequence[Mapping[str, Value]],
        seed: int,
    ) -> None:
        self._optuna = _load_optuna()
        self._space = space
        self._starts = starts
        self._seed = seed
        self._distributions = {one.path: self._distribution(one) for one in space}
        storage.parent.mkdir(parents=True, exist_ok=True)
        from sqlalchemy.pool import NullPool  # noqa: PLC0415  of Optuna, an extra that only this needs

        # A connection for each access, closed after it: those of a pool would stay open for as long as the process.
        kept = self._optuna.storages.RDBStorage(f"sqlite:///{storage}", engine_kwargs={"poolclass": NullPool})
        self._study = self._optuna.create_study(
            storage=kept, study_name=name, direction="maximize", load_if_exists=True
        )
        text = json.dumps(settings, sort_keys=True)
        known = self._study.user_attrs.get("settings")
        if known is None:
            self._study.set_user_attr("settings", text)
        elif known != text:
            raise UsageError(f"{storage}: study {name!r} has other settings; choose another --out, or remove the file")
        # Asking a sampler takes a dozen writes; a study in memory is asked, and the file gets whole trials.
        self._memory = self._optuna.create_study(direction="maximize")
        self._memory.add_trials(self._study.get_trials(deepcopy=False))

    def _distribution(self, one: Dimension) -> "optuna.distributions.BaseDistribution":
        kinds = self._optuna.distributions
        found: optuna.distributions.BaseDistribution
        if one.kind == "whole":
            found = kinds.IntDistribution(int(one.low), int(one.high), log=one.low >= 1)
        else:
            found = kinds.FloatDistribution(one.low, one.high, log=one.kind == "log")
        return found

    def outcomes(self) -> list[Outcome]:
        """Return the trials that are done, in order."""
        found = []
        for number, trial in enumerate(self._memory.get_trials(deepcopy=False)):
            known = json.loads(trial.user_attrs["values"])
            values = {one.path: known[one.path] for one in self._space}  # what follows depends on their order
            found.append(Outcome(number, values, float(trial.value or 0.0)))
        return found

    def best(self) -> Outcome:
        """Return the best trial, the earliest of equals."""
        return max(self.outcomes(), key=_rank)

    def run(
        self,
        trials: int,
        score: Callable[[Mapping[str, Value], Outcome | None], float],
        on_trial: Callable[[Outcome], None] = lambda _outcome: None,
    ) -> Outcome:
        """Go on until there are `trials` trials; return the best.

        Args:
            trials: in all, with those of earlier sessions.
            score: the score of values, which may be a guess where it is below that of the best trial so far.
            on_trial: called with each new trial.

        """
        done = self.outcomes()[:trials]  # with more in the file the result is that of so many all the same
        while len(done) < trials:
            number = len(done)
            rng = np.random.Generator(np.random.PCG64([self._seed, number]))
            best = max(done, key=_rank, default=None)
            if number < len(self._starts):
                values = {one.path: one.value(float(self._starts[number][one.path])) for one in self._space}
            elif best is not None and number % _EVERY:
                values = self._moved(best.values, rng)
            else:
                values = {}
            outcome = self._trial(number, values, rng, partial(_against, score, best))
            done.append(outcome)
            on_trial(outcome)
        return max(done, key=_rank)

    def _moved(self, best: Mapping[str, Value], rng: np.random.Generator) -> dict[str, Value]:
        count = 1 + int(rng.choice(_MOVED, p=_OFTEN))
        chosen = set(rng.choice(len(self._space), size=min(count, len(self._space)), replace=False).tolist())
        # Wide and narrow moves take turns by chance: which of them helps changes on the way.
        steps = _SPREAD * 2.0 ** rng.uniform(-2.0, 0.5) * rng.standard_normal(len(self._space))
        return {
            one.path: one.moved(float(best[one.path]), float(steps[i])) if i in chosen else best[one.path]
            for i, one in enumerate(self._space)
        }

    def _trial(
        self,
        number: int,
        values: dict[str, Value],
        rng: np.random.Generator,
        score: Callable[[Mapping[str, Value]], float],
    ) -> Outcome:
        if values:  # TPE is not asked: it models all trials so far, which takes longer than most trials do
            found = score(values)
            moved = self._optuna.trial.create_trial(
                params=values, distributions=self._distributions, value=found, user_attrs={"values": json.dumps(values)}
            )
            self._memory.add_trial(moved)
            self._study.add_trial(moved)
            return Outcome(number, values, found)
        self._memory.sampler = self._optuna.samplers.TPESampler(
            seed=int(rng.integers(2**31)), n_startup_trials=_WARMUP, multivariate=True
        )
        trial = self._memory.ask(self._distributions)
        chosen = {one.path: one.value(trial.params[one.path]) for one in self._space}
        trial.set_user_attr("values", json.dumps(chosen))
        found = score(chosen)
        self._study.add_trial(self._memory.tell(trial, found))
        return Outcome(number, chosen, found)


def _against(
    score: Callable[[Mapping[str, Value], Outcome | None], float], best: Outcome | None, values: Mapping[str, Value]
) -> float:
    return score(values, best)


def _rank(outcome: Outcome) -> tuple[float, int]:
    return outcome.score, -outcome.number


def _load_optuna() -> Any:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            import optuna  # noqa: PLC0415  an extra that only this needs
    except ImportError as error:
        raise ClientError(f"tuning needs optuna, which is not installed: {install_command('tune')}") from error
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return optuna
