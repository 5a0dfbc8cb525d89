"""The OptiPMB recursion, Algorithm 1 of the paper: a pure function from density and frame to density and tracks."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from optipmb.association import associate
from optipmb.birth import first_detected_states
from optipmb.births_beside import forbid_births
from optipmb.class_posterior import UNGROUPED, update_classes
from optipmb.compiled import kernel
from optipmb.density import (
    NO_FRAME,
    OBJECT,
    Bernoullis,
    Density,
    Poissons,
    SelfCalibration,
    components_in,
    misses_counted_from,
    objects_in,
)
from optipmb.detection_probability import detection_probability, over_time
from optipmb.effort import UNLIMITED, check_effort
from optipmb.errors import FrameError
from optipmb.extract import extract
from optipmb.field_of_view import detection_probability_in_view, follow_looks, look
from optipmb.hypotheses import local_hypotheses
from optipmb.lightweight import light_weight_filter
from optipmb.paths import paths_of
from optipmb.predict import predict
from optipmb.preprocess import Measurements, preprocess
from optipmb.prune import Survivors, surviving_objects
from optipmb.records import read_only, record
from optipmb.self_calibration import calibrate, followed
from optipmb.sensor_motion import follow_sensor
from optipmb.table import ClassTable
from optipmb.undetected import update_undetected, with_measurement_births
from optipmb.update import ukf_updates

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from optipmb.extract import Tracks
    from optipmb.field_of_view import Looks
    from optipmb.frame import Frame, PointCloud
    from optipmb.parameters import Parameters
    from optipmb.paths import PredictedPaths
    from optipmb.records import Columns
    from optipmb.table import ClassRow

    Array = NDArray[np.float64]
    Index = NDArray[np.int64]


@kernel
def update(
    object_words: Array,
    class_probability: Array,
    detection: Array,
    by_class: bool,
    missed_from_ns: Index,
    component_words: Array,
    n_predicted: int,
    measurements: Columns,
    dt: float,
    stamp_ns: int,
    before_ns: int,
    next_id: int,
    adaptive: bool,
    period: float,
    confusion: Array,
    classes: Sequence[ClassRow],
) -> tuple[Array, Array, Array, Index, Index, Index, int, int, int]:
    """Update the prediction with the measurements: the PMB update of Algorithm 1.

    Args:
        object_words: array of the predicted objects.
        class_probability: (N, C) their class posteriors, (0, 0) where no classes have a group in common.
        detection: (N + J,) detection probabilities of the objects and, behind them, of the components.
        by_class: whether it has those of the classes instead, (C,).
        missed_from_ns: `Density.missed_from_ns` of the prediction.
        component_words: array of the predicted Poisson components; behind them, without HABM, are those of the
            measurements.
        n_predicted: how many of them were predicted.
        measurements: Z_k.
        dt: s since the frame before.
        stamp_ns: stamp of the frame.
        before_ns: stamp of the frame before.
        next_id: id of the first new object.
        adaptive: whether HABM is on.
        period: nominal period, s.
        confusion: (C, C) Lambda of `optipmb.class_posterior`, (0, 0) likewise.
        classes: (C,) parameters.

    Returns:
        The array of the objects, their class posteriors, the array of the Poisson components and their fates; the other
        fields of `Survivors`; how many covariances had to be repaired.
    """
    z = Measurements(*measurements)
    objects, components = objects_in(object_words), components_in(component_words)
    since_ns, count = misses_counted_from(objects, missed_from_ns), objects.label.shape[0]
    p_d, p_d_poisson = detection[:count], detection[count:]
    if by_class:
        p_d, p_d_poisson = detection[objects.label], detection[components.label]

    # Local hypotheses: missed, detected, first-time detected; HABM
    hypotheses = local_hypotheses(objects, class_probability, p_d, components, p_d_poisson, z, dt, confusion, classes)

    # Data association: the best global hypothesis, and what of it outlives the pruning of the MB
    row, measurement, cost = hypotheses.row, hypotheses.measurement, hypotheses.detection_cost
    assigned = associate(row, measurement, cost, hypotheses.first_cost, p_d.shape[0])
    forbid_births(objects, assigned, hypotheses, z, since_ns, stamp_ns, period, classes)
    kept = surviving_objects(objects, p_d, assigned, hypotheses, z.label, since_ns, stamp_ns, period, classes)

    # Motion states: detected and missed objects by the UKF, then the births of first-time detections
    known, words = kept.known, np.empty(kept.row.shape[0] * OBJECT)
    posterior = objects_in(words)
    mean, covariance = posterior.mean, posterior.covariance
    repaired = ukf_updates(kept.row, kept.measurement, objects.mean, objects.covariance, z, classes, mean, covariance)
    repaired += first_detected_states(
        kept.measurement[known:], hypotheses, components, z, classes, mean[known:], covariance[known:]
    )

    # Other states: class, light-weight filter
    label, class_probability = update_classes(kept, objects.label, class_probability, z, confusion, classes)
    light_weight_filter(kept, label, posterior, objects, next_id, z, stamp_ns, before_ns, period, classes)

    # Undetected objects: PPP update, RPP, and the births of HABM
    undetected, fate = update_undetected(
        components, p_d_poisson, n_predicted, hypotheses, z, stamp_ns, period, classes, adaptive
    )
    return words, class_probability, undetected, fate, kept.row, kept.measurement, known, kept.detected, repaired


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
    """

    cloud_used: bool
    detections: int
    below_score: int
    suppressed: int
    associated: int
    born: int
    repaired: int


@record
class StepResult:
    """What a step gives.

    Attributes:
        density: the posterior.
        tracks: the extracted tracks.
        diagnostics: what happened.
        paths: predicted paths of the tracks, where the profile has horizons.
        class_probability: (N, C) of each track and class, where classes have a group in common.
    """

    density: Density
    tracks: Tracks
    diagnostics: Diagnostics
    paths: PredictedPaths | None = None
    class_probability: Array | None = None


class Tracker:
    """The OptiPMB filter of one set of parameters. It holds no state: a density goes in, a density comes out.

        lambda_u, {(r, p)} at k-1
            │ predict                     eq. PPP_prediction, MB_prediction
            │ preprocess                  eta_sf, NMS
            │ update
            │     local_hypotheses        eq. Misdetect, Detection, First-Time Detection Hypothesis Update; HABM
            │     associate               shortest augmenting paths
            │     forbid_births           no second track on a missed object
            │     surviving_objects       r, misses
            │     ukf_updates             eq. UKF Update, for the pairs of the best global hypothesis
            │     first_detected_states   eq. Newborn Hypothesis, First-Time Detection Hypothesis Update 1
            │     update_classes          class gate; with groups of classes, Bayes
            │     light_weight_filter     eq. Confidence Score
            │     update_undetected       eq. PPP Update; RPP, HABM
            ▼ extract                     eta_ext1, eta_ext2, eta_cnt; calibration
        lambda_u, {(r, p)} at k, tracks

    Attributes:
        parameters: the profile.
        modules: which modules of the paper are on.

    `max_pairs` bounds the pairs of a step that are near each other: detections that may overlap, and detections in the
    gates of objects. What a step costs is nearly proportional to them, about a microsecond each.
    """

    def __init__(
        self,
        parameters: Parameters,
        modules: Modules | None = None,
        *,
        max_pairs: int = UNLIMITED,
    ) -> None:
        self._max_pairs = max_pairs
        self.parameters = parameters
        self.modules = modules if modules is not None else Modules()
        self._labels = parameters.labels
        self._table = ClassTable.of(parameters)
        self._detection = self._table["detection"].copy()
        self._horizons = np.array(parameters.horizons, np.float64)

    def initial(self, next_id: int = 1) -> Density:
        """Return the density before the first frame."""
        return Density.empty(self._labels, next_id)

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
            DensityError: the parts of the density do not fit together, or a label is of no class.
            EffortError: the frame needs more than `max_pairs` pairs looked at; nothing costly was done yet.
        """
        self._check(density, frame)
        now, table, modules = frame.stamp_ns, self._table, self.modules
        dt = table.period if density.stamp_ns == NO_FRAME else (now - density.stamp_ns) * 1e-9
        if self.parameters.sensor_motion:
            density = follow_sensor(density, frame, self._table)

        # PMB prediction
        predicted, repaired = predict(density, now, table)
        bernoulli, poisson = predicted.bernoulli, predicted.poisson

        # Measurements, and the detection probabilities p_d(x_+) of what is in view
        own, score = None, frame.score
        if self.parameters.self_calibration:
            own, table = SelfCalibration.of(density), table.copy()
            score = read_only(calibrate(own.classes, score, frame.label, table.classes))
        measurements, chosen, below_score, suppressed = preprocess(frame, table, self._max_pairs, score)
        check_effort(bernoulli, poisson, measurements, dt, table, self._max_pairs)
        if not modules.habm:
            poisson = with_measurement_births(poisson, measurements, now, table)
        looks, poisson = look(frame.field_of_view, predicted, poisson, density.stamp_ns, table)
        cloud = frame.cloud if modules.adp else None
        by_class = cloud is None and looks is None
        p_d = self._detection_probabilities(bernoulli, poisson, cloud, looks, dt)

        # PMB update: hypotheses, association, states, births
        missed_from_ns = predicted.missed_from_ns if looks is None else looks.misses.missed_from_ns
        pi = predicted.class_probability
        words, class_probability, undetected, fate, row, hits, known, detected, repaired_now = update(
            bernoulli.words,
            UNGROUPED if pi is None else pi,
            p_d,
            by_class,
            missed_from_ns,
            poisson.words,
            len(predicted.poisson),
            tuple(measurements),
            dt,
            now,
            density.stamp_ns,
            predicted.next_id,
            modules.habm,
            table.period,
            table.confusion,
            table.classes,
        )
        objects, misses = Bernoullis.of(words), None
        if looks is not None:
            survivors = Survivors(row, hits, objects.existence, known, detected)
            misses = follow_looks(looks, survivors, bernoulli, objects, measurements, now, table)
        born = len(objects) - known
        poisson = Poissons.of(undetected) if modules.rpp else Poissons.empty()
        pi = None if pi is None else class_probability
        posterior = Density(now, predicted.next_id + born, objects, poisson, density.labels, misses, pi)
        if own is not None:
            objects.score[hits >= 0] *= (frame.score / score)[chosen[hits[hits >= 0]]]
            given = frame.score, frame.label, chosen
            own = followed(own, density, predicted, posterior, hits, fate, *given, table)
            posterior = replace(posterior, self_calibration=own)
        if density.sensor is not None:
            posterior = replace(posterior, sensor=density.sensor)

        # Track extraction
        tracks = extract(objects, posterior.missed_from_ns, hits, measurements, now, table, two_thresholds=modules.ote)
        paths = paths_of(tracks, self._horizons, table) if self._horizons.size else None

        diagnostics = Diagnostics(
            cloud is not None,
            frame.score.shape[0],
            below_score,
            suppressed,
            detected,
            born,
            repaired + repaired_now,
        )
        pi = None if pi is None else pi[np.searchsorted(objects.id, tracks.id)]
        return StepResult(posterior, tracks, diagnostics, paths, pi)

    def _check(self, density: Density, frame: Frame) -> None:
        """Refuse other classes, which kernels would read out of bounds for, and frames of the past."""
        labels = self._labels
        for path, given in (("labels", frame.labels), ("density.labels", density.labels)):
            if given != labels:
                raise FrameError(path, f"the classes of profile {self.parameters.name}, {labels}", str(given)[:200])
        if density.stamp_ns != NO_FRAME and frame.stamp_ns < density.stamp_ns:
            raise FrameError("stamp_ns", f"a stamp from {density.stamp_ns} on", str(frame.stamp_ns))

    def _detection_probabilities(
        self, bernoulli: Bernoullis, poisson: Poissons, cloud: PointCloud | None, looks: Looks | None, dt: float
    ) -> Array:
        """Compute p_d(x_+) of objects and, behind them, of Poisson components, in one pass over the cloud.

        Without a cloud and a field of view it is that of the class: then of each class.
        """
        share = dt / self._table.detection_time if self._table.detection_time > 0.0 else 1.0
        if cloud is None and looks is None:
            return over_time(self._detection, share)
        p_d = detection_probability(
            np.concatenate((bernoulli.mean, poisson.mean)),
            np.concatenate((bernoulli.auxiliary, poisson.auxiliary)),
            np.concatenate((bernoulli.label, poisson.label)),
            cloud,
            self._table,
        )
        if looks is None:
            return over_time(p_d, share)
        return detection_probability_in_view(p_d, looks, share, self._table)
