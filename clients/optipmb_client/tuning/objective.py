"""What is maximised: one figure of tracks over some sequences, of the detections as they are and of worse ones.

Tracking one sequence is a task; the same parameters give the same figure with any executor.
"""

from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from optipmb import Parameters, warm_up
from optipmb_client.bulk import Executor, Here, values
from optipmb_client.datasets import Truth
from optipmb_client.tuning.figures import Figures
from optipmb_client.tuning.material import Clip, track_clip
from optipmb_client.tuning.scoring import Measured, Scorer

__all__ = ["METRICS", "Bench", "metric"]

METRICS: Mapping[str, str] = {
    "combination": "mean of sAMOTA, AMOTA, MOTA and HOTA, less a tenth of the switches per object",
    "samota": "sAMOTA",
    "amota": "AMOTA",
    "mota": "MOTA at the best threshold",
    "hota": "HOTA of centres at that threshold",
    "both": "three parts AMOTA, one part the HOTA of all tracks, less a tenth of the switches per object",
}
_SWITCH = 0.1
_REMEMBERED = 6


def metric(name: str, figures: Figures, objects: int) -> float:
    """Return one of `METRICS`; figures that are not defined count zero."""
    values = {"samota": figures.samota, "amota": figures.amota, "mota": figures.mota, "hota": figures.hota}
    if name == "both":
        mean = 0.75 * _defined(figures.amota) + 0.25 * _defined(figures.hota_all)
    elif name == "combination":
        mean = sum(_defined(value) for value in values.values()) / len(values)
    else:
        return _defined(values[name])
    return mean - _SWITCH * _defined(figures.ids) / max(1, objects)


def _defined(value: float) -> float:
    return value if value == value else 0.0  # noqa: PLR0124  NaN is not itself


class Bench:
    """Sequences of one class, in one or more variants of their detections, and what tracks them.

    Args:
        variants: the same sequences once or several times: plain, degraded.
        scorer: what compares tracks with the truth.
        metric: one of `METRICS`.
        executor: where they are tracked; by default in this process.
        note: hears of processes that died.
    """

    def __init__(
        self,
        variants: Sequence[Sequence[Clip]],
        scorer: Scorer,
        metric: str,
        executor: Executor | None = None,
        note: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.variants = variants
        self.scorer = scorer
        self.metric = metric
        self.names = tuple(clip.name for clip in variants[0])
        self.frames = sum(len(clip.frames) for clips in variants for clip in clips)
        self._known: OrderedDict[tuple[str, int, int], Measured] = OrderedDict()
        self._note = note
        self._executor = executor or Here()
        self._executor.start(_measure, (variants, scorer))
        warm_up()

    def objects(self, clips: Sequence[int] | None = None) -> int:
        """Return how many objects the truth of some sequences has."""
        chosen = range(len(self.names)) if clips is None else clips
        return sum(len(set(self._own(i).id[~self._own(i).ignored].tolist())) for i in chosen)

    def boxes(self, clip: int) -> int:
        """Return how many boxes the truth of a sequence has that count."""
        return int((~self._own(clip).ignored).sum())

    def _own(self, clip: int) -> Truth:
        truth = self.variants[0][clip].truth
        return truth.take(truth.names == self.scorer.name)

    def measure(
        self, parameters: Parameters, clips: Sequence[int], variants: Sequence[int] | None = None
    ) -> list[list[Measured]]:
        """Return what tracking some sequences gave, for each variant, or each of some."""
        key = parameters.model_dump_json()
        chosen = range(len(self.variants)) if variants is None else variants
        wanted = [(key, variant, clip) for variant in chosen for clip in clips]
        missing = [place for place in wanted if place not in self._known]
        tasks = [_Measurement(self.names[clip], variant, clip, parameters) for _, variant, clip in missing]
        found: list[Measured] = values(self._executor, tasks, lambda task: f"sequence {task.name}", self._note)
        self._known.update(zip(missing, found, strict=True))
        for place in wanted:
            self._known.move_to_end(place)
        result = [[self._known[(key, variant, clip)] for clip in clips] for variant in chosen]
        while len(self._known) > _REMEMBERED * len(self.variants) * len(self.names):
            self._known.popitem(last=False)
        return result

    def figures(self, measured: Sequence[Sequence[Measured]]) -> tuple[Figures, ...]:
        """Return the figures of each variant."""
        return tuple(self.scorer.figures(one) for one in measured)

    def value(self, figures: Sequence[Figures], clips: Sequence[int]) -> float:
        """Return the mean of the metric over the variants."""
        objects = self.objects(clips)
        return sum(metric(self.metric, one, objects) for one in figures) / len(figures)


@dataclass(frozen=True)
class _Measurement:
    """A task: one sequence in one variant, with some parameters."""

    name: str
    variant: int
    clip: int
    parameters: Parameters


def _measure(shared: tuple[Sequence[Sequence[Clip]], Scorer], task: _Measurement) -> Measured:
    variants, scorer = shared
    clip = variants[task.variant][task.clip]
    return scorer.measure(clip, track_clip(clip, task.parameters))
