"""The OptiPMB recursion, Algorithm 1 of the paper: a pure function from density and frame to density and tracks."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from optipmb.association import UNASSIGNED, associate
from optipmb.birth import adaptive_births, measurement_births, new_objects
from optipmb.density import NO_FRAME, Bernoullis, Density, Poissons
from optipmb.detection_probability import detection_probability
from optipmb.errors import FrameError
from optipmb.extract import extraction, tracks_of
from optipmb.hypotheses import enumerate_hypotheses
from optipmb.lightweight import light_weight_filter
from optipmb.predict import predict
from optipmb.preprocess import preprocess
from optipmb.prune import surviving_components, surviving_objects
from optipmb.table import ClassTable
from optipmb.update import update_states

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb.extract import Tracks
    from optipmb.frame import Frame, PointCloud
    from optipmb.hypotheses import Hypotheses
    from optipmb.parameters import Parameters
    from optipmb.preprocess import Measurements

    Array = NDArray[np.float64]
    Index = NDArray[np.int64]


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


@dataclass(frozen=True, slots=True)
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
    """

    cloud_used: bool
    detections: int
    below_score: int
    suppressed: int
    associated: int
    born: int
    repaired: int


@dataclass(frozen=True, slots=True)
class StepResult:
    """Posterior density, extracted tracks and diagnostics of one step."""

    density: Density
    tracks: Tracks
    diagnostics: Diagnostics


class Tracker:
    """The OptiPMB filter of one set of parameters. It holds no state: a density goes in, a density comes out.

        lambda_u, {(r, p)} at k-1
            │ predict            eq. PPP_prediction, MB_prediction
            │ preprocess         eta_sf, NMS
            │ hypotheses         eq. Misdetect, Detection, First-Time Detection Hypothesis Update; HABM
            │ associate          Hungarian algorithm on clusters
            │ update             UKF for the pairs of the best global hypothesis
            │ light-weight filter, prune
            ▼ extract, calibrate eta_ext1, eta_ext2, eta_cnt
        lambda_u, {(r, p)} at k, tracks

    Attributes:
        parameters: the profile.
        modules: which modules of the paper are on.
    """

    def __init__(self, parameters: Parameters, modules: Modules | None = None) -> None:
        self.parameters = parameters
        self.modules = modules if modules is not None else Modules()
        self._table = ClassTable.of(parameters)

    @staticmethod
    def initial(next_id: int = 1) -> Density:
        """Return the density before the first frame."""
        return Density.empty(next_id)

    def step(self, density: Density, frame: Frame) -> StepResult:
        """Run one recursion of Algorithm 1.

        Args:
            density: posterior of the last frame, or `initial()`.
            frame: detections, and possibly a cloud, of the new stamp; made by `make_frame` for the same parameters.

        Returns:
            The posterior, the tracks and diagnostics. The same arguments give the same bytes.

        Raises:
            FrameError: the stamp of the frame is before that of the density.
        """
        if density.stamp_ns != NO_FRAME and frame.stamp_ns < density.stamp_ns:
            raise FrameError("stamp_ns", f"a stamp from {density.stamp_ns} on", str(frame.stamp_ns))
        now, table, modules = frame.stamp_ns, self._table, self.modules

        # PMB prediction
        predicted, repaired = predict(density, now, table)
        bernoulli, poisson = predicted.bernoulli, predicted.poisson

        # PMB update: measurements, detection probabilities, local hypotheses
        measurements, below_score, suppressed = preprocess(frame, table)
        n_predicted = len(poisson)
        if not modules.habm:
            poisson = poisson.join(measurement_births(measurements, now, table))
        cloud = frame.cloud if modules.adp else None
        p_d, p_d_poisson = self._detection_probabilities(bernoulli, poisson, cloud)
        hypotheses = enumerate_hypotheses(bernoulli, p_d, poisson, p_d_poisson, measurements, table)

        # Data association
        assigned = associate(hypotheses, len(bernoulli))

        # The hypotheses of the best global hypothesis: detected and missed objects, new objects
        old, repaired_old = self._update_objects(bernoulli, p_d, assigned, measurements)
        free = np.ones(len(measurements), np.bool_)
        free[assigned[assigned != UNASSIGNED]] = False
        new, new_measurement, repaired_new = new_objects(measurements, free, hypotheses, poisson, now, table)

        # Light-weight filter, then pruning of the MB: what was seen now was not missed
        ids = predicted.next_id + np.arange(len(new))
        objects = old.join(replace(new, id=ids))
        measurement = np.concatenate((assigned, new_measurement))
        objects = light_weight_filter(objects, measurement, measurements, now, density.stamp_ns, table)
        alive = surviving_objects(objects, now, table)
        objects, measurement = objects.take(alive), measurement[alive]

        # PPP update and redundant PPP pruning
        undetected = self._update_poisson(poisson, p_d_poisson, hypotheses, measurements, n_predicted, now)

        # Track extraction
        extracted = extraction(objects, now, table, two_thresholds=modules.ote)
        objects = replace(objects, extracted=objects.extracted | extracted)
        source = np.append(measurements.source, -1)[measurement]
        tracks = tracks_of(objects.take(extracted), source[extracted], now, table)

        posterior = Density(stamp_ns=now, next_id=predicted.next_id + len(new), bernoulli=objects, poisson=undetected)
        diagnostics = Diagnostics(
            cloud_used=cloud is not None,
            detections=frame.score.shape[0],
            below_score=below_score,
            suppressed=suppressed,
            associated=int(np.count_nonzero(assigned != UNASSIGNED)),
            born=len(new),
            repaired=repaired + repaired_old + repaired_new,
        )
        return StepResult(posterior, tracks, diagnostics)

    def _detection_probabilities(
        self, bernoulli: Bernoullis, poisson: Poissons, cloud: PointCloud | None
    ) -> tuple[Array, Array]:
        """Compute p_d(x_+) of objects and of Poisson components in one pass over the cloud."""
        p_d = detection_probability(
            np.concatenate((bernoulli.mean, poisson.mean)),
            np.concatenate((bernoulli.auxiliary, poisson.auxiliary)),
            np.concatenate((bernoulli.label, poisson.label)),
            cloud,
            self._table,
        )
        return p_d[: len(bernoulli)], p_d[len(bernoulli) :]

    def _update_objects(
        self, bernoulli: Bernoullis, p_d: Array, assigned: Index, measurements: Measurements
    ) -> tuple[Bernoullis, int]:
        """Update detected objects (r = 1, UKF) and missed ones (eq. Misdetect Hypothesis Update)."""
        mean, covariance, repaired = update_states(
            bernoulli.mean, bernoulli.covariance, assigned, measurements, self._table
        )
        r = bernoulli.existence
        missed = r * (1.0 - p_d) / (1.0 - r + r * (1.0 - p_d))
        existence = np.where(assigned != UNASSIGNED, 1.0, missed)
        return replace(bernoulli, mean=mean, covariance=covariance, existence=existence), repaired

    def _update_poisson(
        self,
        poisson: Poissons,
        p_d: Array,
        hypotheses: Hypotheses,
        measurements: Measurements,
        n_predicted: int,
        now: int,
    ) -> Poissons:
        """Update the PPP and prune it.

        The weight of an undetected object is ``mu_+ (1 - p_d)``. The paper's eq. PPP Update prints ``mu_+ p_d``,
        which is the weight of an object that was detected; the standard PMBM recursion, and the sense of the
        sentence around it, is the former.
        """
        if not self.modules.rpp:
            return Poissons.empty()
        updated = replace(poisson, weight=poisson.weight * (1.0 - p_d))
        announced = hypotheses.announced.row
        # A component is not used up by the very measurement that has just made it (only without HABM are there such).
        keep = surviving_components(updated, announced[announced < n_predicted], now, self._table)
        updated = updated.take(keep)
        if self.modules.habm:
            updated = updated.join(adaptive_births(measurements, hypotheses, now, self._table))
        return updated
