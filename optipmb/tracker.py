"""The OptiPMB recursion, Algorithm 1 of the paper: a pure function from density and frame to density and tracks."""

from __future__ import annotations

from dataclasses import dataclass
from operator import sub
from typing import TYPE_CHECKING, Final

import numpy as np

from optipmb.association import associate
from optipmb.birth import first_detected_states
from optipmb.columns import check_fitting
from optipmb.density import NO_FRAME, STATE, Density, Poissons
from optipmb.detection_probability import detection_probability, over_time
from optipmb.effort import UNLIMITED, check_effort
from optipmb.errors import FrameError
from optipmb.extract import extract
from optipmb.field_of_view import detection_probability_in_view, follow_looks, look
from optipmb.hypotheses import enumerate_hypotheses
from optipmb.lightweight import light_weight_filter
from optipmb.paths import paths_of
from optipmb.predict import predict
from optipmb.preprocess import preprocess
from optipmb.prune import surviving_objects
from optipmb.records import record
from optipmb.table import ClassTable
from optipmb.undetected import update_undetected, with_measurement_births
from optipmb.update import update_states

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from optipmb.density import Bernoullis
    from optipmb.extract import Tracks
    from optipmb.field_of_view import Looks
    from optipmb.frame import Frame, PointCloud
    from optipmb.hypotheses import Hypotheses
    from optipmb.parameters import Parameters
    from optipmb.paths import PredictedPaths
    from optipmb.preprocess import Measurements
    from optipmb.prune import Survivors

    Array = NDArray[np.float64]


STAGES: Final = (
    "predict",
    "preprocess",
    "detection_probability",
    "hypotheses",
    "associate",
    "update",
    "undetected",
    "extract",
)
"""The stages of a step, in their order, as `Diagnostics.stage_ns` has them."""


def _no_clock() -> int:
    return 0


@dataclass(frozen=True, slots=True)
class Modules:
    """Which of the paper's modules are on; each one off is the baseline of its ablation (Section V.C).

    Attributes:
        adp: adaptive detection probability; off: p_d = p_d0.
        habm: hybrid adaptive birth model; off: every measurement adds a Poisson component before the update, as in
            GNN-PMB.
        rpp: redundant PPP pruning; off: all Poisson components are removed after each update, as in GNN-PMB.
        ote: two-threshold track extraction; off: tracks are extracted from eta_ext1 on.
    """

    adp: bool = True
    habm: bool = True
    rpp: bool = True
    ote: bool = True


@record
class Diagnostics:
    """What happened in a step, beside the tracks.

    Attributes:
        cloud_used: whether a point cloud took part in p_d.
        detections: detections in the frame.
        below_score: of these, removed by the score filter.
        suppressed: removed by non-maximum suppression.
        associated: measurements given to objects.
        born: new objects.
        repaired: covariances that had lost rank in rounding and were repaired.
        stage_ns: nanoseconds that each of `STAGES` took by the clock of the tracker; zeros without one.
    """

    cloud_used: bool
    detections: int
    below_score: int
    suppressed: int
    associated: int
    born: int
    repaired: int
    stage_ns: tuple[int, ...]


@record
class StepResult:
    """Posterior density, extracted tracks and diagnostics of one step; paths where the profile has horizons."""

    density: Density
    tracks: Tracks
    diagnostics: Diagnostics
    paths: PredictedPaths | None = None


class Tracker:
    """The OptiPMB filter of one set of parameters. It holds no state: a density goes in, a density comes out.

        lambda_u, {(r, p)} at k-1
            │ predict            eq. PPP_prediction, MB_prediction
            │ preprocess         eta_sf, NMS
            │ hypotheses         eq. Misdetect, Detection, First-Time Detection Hypothesis Update; HABM
            │ associate          shortest augmenting paths
            │ prune              r, misses
            │ update             UKF for the pairs of the best global hypothesis, light-weight filter
            ▼ extract, calibrate eta_ext1, eta_ext2, eta_cnt
        lambda_u, {(r, p)} at k, tracks

    Attributes:
        parameters: the profile.
        modules: which modules of the paper are on.

    `max_pairs` bounds the pairs of a step that are near each other: detections that may overlap, and detections in the
    gates of objects. What a step costs is nearly proportional to them, about a microsecond each.

    `clock` returns nanoseconds and is read between the stages of a step for `Diagnostics.stage_ns`, as
    `time.perf_counter_ns`; nothing else depends on it.
    """

    def __init__(
        self,
        parameters: Parameters,
        modules: Modules | None = None,
        *,
        max_pairs: int = UNLIMITED,
        clock: Callable[[], int] = _no_clock,
    ) -> None:
        self._max_pairs = max_pairs
        self.parameters = parameters
        self.modules = modules if modules is not None else Modules()
        self._clock = clock
        self._table = ClassTable.of(parameters)
        self._horizons = np.array(parameters.horizons, np.float64)

    def initial(self, next_id: int = 1) -> Density:
        """Return the density before the first frame."""
        return Density.empty(self.parameters.labels, next_id)

    def step(self, density: Density, frame: Frame) -> StepResult:
        """Run one recursion of Algorithm 1.

        Args:
            density: posterior of the last frame, or `initial()`.
            frame: detections, and possibly a cloud, of the new stamp; made by `make_frame` for the same parameters.

        Returns:
            The posterior, the tracks and diagnostics. The same arguments give the same bytes.

        Raises:
            FrameError: the stamp of the frame is before that of the density, or the classes of the frame or of the
                density are not those of the parameters.
            DensityError: the columns of the density do not fit together.
            EffortError: the frame needs more than `max_pairs` pairs looked at; nothing costly was done yet.
        """
        self._check(density, frame)
        if density.stamp_ns != NO_FRAME and frame.stamp_ns < density.stamp_ns:
            raise FrameError("stamp_ns", f"a stamp from {density.stamp_ns} on", str(frame.stamp_ns))
        now, table, modules, clock = frame.stamp_ns, self._table, self.modules, self._clock
        dt = table.period if density.stamp_ns == NO_FRAME else (now - density.stamp_ns) * 1e-9
        times = [clock()]

        # PMB prediction
        predicted, repaired = predict(density, now, table)
        bernoulli, poisson = predicted.bernoulli, predicted.poisson
        times.append(clock())

        # PMB update: measurements, detection probabilities, local hypotheses
        measurements, below_score, suppressed = preprocess(frame, table, self._max_pairs)
        check_effort(bernoulli, poisson, measurements, dt, table, self._max_pairs)
        n_predicted = len(poisson)
        if not modules.habm:
            poisson = with_measurement_births(poisson, measurements, now, table)
        times.append(clock())
        cloud = frame.cloud if modules.adp else None
        looks, poisson = look(frame.field_of_view, predicted, poisson, density.stamp_ns, table)
        p_d, p_d_poisson = self._detection_probabilities(bernoulli, poisson, cloud, looks, dt)
        times.append(clock())
        hypotheses = enumerate_hypotheses(bernoulli, p_d, poisson, p_d_poisson, measurements, dt, table)
        times.append(clock())

        # Data association: the best global hypothesis, and what of it outlives the pruning of the MB
        missed_from_ns = predicted.missed_from_ns if looks is None else looks.misses.missed_from_ns
        assigned = associate(hypotheses, len(bernoulli))
        survivors = surviving_objects(bernoulli, p_d, assigned, hypotheses, measurements, missed_from_ns, now, table)
        times.append(clock())

        # Detected, missed and new objects: motion states, then the light-weight filter
        mean, covariance, repaired_now = self._update_states(survivors, bernoulli, poisson, hypotheses, measurements)
        objects = light_weight_filter(
            survivors, mean, covariance, bernoulli, predicted.next_id, measurements, now, density.stamp_ns, table
        )
        times.append(clock())

        # PPP update and redundant PPP pruning
        undetected = (
            update_undetected(
                poisson, p_d_poisson, n_predicted, hypotheses, measurements, now, table, adaptive=modules.habm
            )
            if modules.rpp
            else Poissons.empty()
        )
        times.append(clock())

        # Track extraction
        misses = None
        if looks is not None:
            misses = follow_looks(looks, survivors, bernoulli, objects, measurements, now, table)
        born = len(survivors) - survivors.known
        posterior = Density(now, predicted.next_id + born, objects, undetected, density.labels, misses)
        since_ns = posterior.missed_from_ns
        tracks = extract(objects, since_ns, survivors.measurement, measurements, now, table, two_thresholds=modules.ote)
        paths = paths_of(tracks, self._horizons, table) if self._horizons.size else None
        times.append(clock())

        diagnostics = Diagnostics(
            cloud is not None,
            frame.score.shape[0],
            below_score,
            suppressed,
            survivors.detected,
            born,
            repaired + repaired_now,
            tuple(map(sub, times[1:], times)),  # stage_ns
        )
        return StepResult(posterior, tracks, diagnostics, paths)

    def _check(self, density: Density, frame: Frame) -> None:
        """Refuse what kernels would read or write out of bounds for."""
        labels = self.parameters.labels
        for path, given in (("labels", frame.labels), ("density.labels", density.labels)):
            if given != labels:
                raise FrameError(path, f"the classes of profile {self.parameters.name}, {labels}", str(given)[:200])
        check_fitting(density, labels)

    def _detection_probabilities(
        self, bernoulli: Bernoullis, poisson: Poissons, cloud: PointCloud | None, looks: Looks | None, dt: float
    ) -> tuple[Array, Array]:
        """Compute p_d(x_+) of objects and of Poisson components, in one pass over the cloud if there is one."""
        share = dt / self._table.period if self._table.detection_over_time else 1.0
        if cloud is None and looks is None:
            p_d0 = over_time(self._table.detection, share)
            return p_d0[bernoulli.label], p_d0[poisson.label]
        p_d = detection_probability(
            np.concatenate((bernoulli.mean, poisson.mean)),
            np.concatenate((bernoulli.auxiliary, poisson.auxiliary)),
            np.concatenate((bernoulli.label, poisson.label)),
            cloud,
            self._table,
        )
        p_d = over_time(p_d, share) if looks is None else detection_probability_in_view(p_d, looks, share, self._table)
        return p_d[: len(bernoulli)], p_d[len(bernoulli) :]

    def _update_states(
        self,
        survivors: Survivors,
        bernoulli: Bernoullis,
        poisson: Poissons,
        hypotheses: Hypotheses,
        measurements: Measurements,
    ) -> tuple[Array, Array, int]:
        """Compute the motion states of the posterior: by the UKF for known objects, as births for new ones."""
        count, known = len(survivors), survivors.known
        mean, covariance = np.empty((count, STATE)), np.empty((count, STATE, STATE))
        repaired = update_states(survivors, bernoulli, measurements, self._table, mean, covariance)
        if known < count:
            rows = survivors.measurement[known:]
            repaired += first_detected_states(
                rows, measurements, hypotheses, poisson, self._table, mean[known:], covariance[known:]
            )
        return mean, covariance, repaired
