"""The OptiPMB recursion, Algorithm 1 of the paper: a pure function from density and frame to density and tracks."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from optipmb.compiled import kernel
from optipmb.filter.association import associate, forbid_births, surviving_objects
from optipmb.filter.class_posterior import UNGROUPED, Groups, update_classes
from optipmb.filter.detection_probability import detection_probability
from optipmb.filter.extract import extract
from optipmb.filter.field_of_view import follow_looks, look
from optipmb.filter.hypotheses import UNLIMITED, check_effort, halt, local_hypotheses
from optipmb.filter.lightweight import light_weight_filter
from optipmb.filter.paths import paths_of
from optipmb.filter.predict import predict
from optipmb.filter.preprocess import preprocess
from optipmb.filter.undetected import update_undetected, with_measurement_births
from optipmb.filter.unknown_heading import all_measured, measured_bits
from optipmb.filter.update import first_detected_states, ukf_updates
from optipmb.joining.decision import Kinds, Rejoin, rejoin_tracks
from optipmb.learning.self_calibration import calibrated, followed
from optipmb.learning.sensor_motion import follow_sensor
from optipmb.model.attributes import MOST_OBJECTS, read
from optipmb.model.density import (
    NO_FRAME,
    OBJECT,
    Bernoullis,
    Density,
    Moment,
    Poissons,
    check_fitting,
    components_in,
    fits,
    misses_counted_from,
    objects_in,
)
from optipmb.model.errors import FrameError, ParameterError
from optipmb.model.parameters import Parameters, load_profile
from optipmb.model.rows import record
from optipmb.model.stages import Measurements, Update
from optipmb.model.table import ClassTable
from optipmb.model.tracks import Tracks

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb.filter.paths import PredictedPaths
    from optipmb.joining.decision import Joined
    from optipmb.model.attributes import Attributes
    from optipmb.model.frame import Frame
    from optipmb.model.rows import Array, Columns, Index
    from optipmb.model.table import Classes


class Prior(NamedTuple):
    """Prediction in the form of kernels.

    Attributes:
        objects: array of the predicted objects.
        missed_from_ns: `Density.missed_from_ns` of them.
        class_probability: (N, C) their class posteriors, (N, 0) where no classes have a group in common.
        components: array of the predicted Poisson components; without HABM the measurements' are behind them.
        n_predicted: how many of them were predicted.
        next_id: id of the first new object.
    """

    objects: Array
    missed_from_ns: Index
    class_probability: Array
    components: Array
    n_predicted: int
    next_id: int


@kernel
def update(
    prior: Columns, p_d: Array, measurements: Columns, moment: Columns, confusion: Array, classes: Classes, still: bool
) -> Columns:
    """Update the prediction with the measurements: from the fields of the named tuples to the fields of `Update`.

    `p_d` (N + J,) is of the objects and, behind them, of the components; `confusion` as in `ClassTable`;
    `still` says whether the sensor stands, or its poses are known.
    """
    given, z, now = Prior(*prior), Measurements(*measurements), Moment(*moment)
    objects, components = objects_in(given.objects), components_in(given.components)
    since_ns, count = misses_counted_from(objects, given.missed_from_ns), objects.label.shape[0]
    groups = Groups(given.class_probability, confusion)

    # Local hypotheses: missed, detected, first-time detected; HABM
    if still:
        halt(objects, z, now, classes)
    hypotheses = local_hypotheses(objects, components, p_d, z, groups, now.dt, classes)

    # Data association: the best global hypothesis, and the objects that outlive the pruning of the MB
    row, measurement, cost = hypotheses.row, hypotheses.measurement, hypotheses.detection_cost
    assigned = associate(row, measurement, cost, hypotheses.first_cost, count)
    forbid_births(objects, assigned, hypotheses, z, since_ns, now, classes)
    kept = surviving_objects(objects, p_d[:count], assigned, hypotheses, z.label, since_ns, now, classes)

    # Motion states: detected and missed objects by the UKF, then the births of first-time detections
    known, words = kept.known, np.empty(kept.row.shape[0] * OBJECT)
    posterior = objects_in(words)
    mean, covariance = posterior.mean, posterior.covariance
    repaired = ukf_updates(kept.row, kept.measurement, objects.mean, objects.covariance, z, classes, mean, covariance)
    repaired += first_detected_states(
        kept.measurement[known:], hypotheses, components, z, classes, mean[known:], covariance[known:]
    )

    # Other states: class, light-weight filter
    class_probability = update_classes(kept, objects.label, posterior.label, z, groups, classes)
    light_weight_filter(kept, posterior, objects, given.next_id, z, now, classes)

    # Undetected objects: PPP update, RPP, and the births of HABM
    undetected, fate = update_undetected(components, p_d[count:], given.n_predicted, hypotheses, z, now, classes)
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
    """Counts of one step.

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
    """Result of a step.

    Attributes:
        density: the posterior.
        tracks: the extracted tracks.
        diagnostics: counts.
        paths: predicted paths of the tracks, where the profile has horizons.
        class_probability: (N, C) of each track and class, where classes have a group in common.
        measured: (N,) uint8, the known parts of each track: 1 the heading, by a detection or by its motion, 2 the size,
            4 the height, added up; defaults stand for the others. None: everything of all tracks is known.
        joined: the objects of the tracks; None where the tracker does not join them.
    """

    density: Density
    tracks: Tracks
    diagnostics: Diagnostics
    paths: PredictedPaths | None = None
    class_probability: Array | None = None
    measured: NDArray[np.uint8] | None = None
    joined: Joined | None = None


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

    Args:
        profile: parameters, or the name or file of a profile.
        rejoin: how tracks are joined over gaps; None: they are not.

    Attributes:
        parameters: the profile.
        modules: which modules of the paper are on.

    `max_pairs` bounds the pairs of a step that are near each other: detections that may overlap, and detections in the
    gates of objects. What a step costs is nearly proportional to them, about a microsecond each.
    """

    def __init__(
        self,
        profile: Parameters | str,
        modules: Modules | None = None,
        *,
        max_pairs: int = UNLIMITED,
        rejoin: Rejoin | None = None,
    ) -> None:
        if profile == "auto":
            expected = "'generic', which is auto at 10 Hz, or generic_parameters(labels, period)"
            raise ParameterError("profile", expected, "'auto', which needs a whole recording")
        self._max_pairs = max_pairs
        self._rejoin = rejoin
        self.parameters = parameters = profile if isinstance(profile, Parameters) else load_profile(profile)
        self.modules = modules if modules is not None else Modules()
        self._labels = parameters.labels
        self._table = ClassTable.of(parameters)
        self._kinds = Kinds.of(parameters, rejoin)
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
            FrameError: the frame is older than the density, or the classes of the frame or of the density differ from
                those in the parameters, or vectors have another length than earlier ones of the same model.
            DensityError: the parts of the density do not fit together, or a label is of no class.
            EffortError: the frame needs more than `max_pairs` pairs looked at; nothing costly was done yet.
        """
        moment, table, modules = self._moment(density, frame), self._table, self.modules
        cloud = frame.cloud if modules.adp else None
        if not fits(density, len(self._labels)):
            check_fitting(density, self._labels)
        sensor = density.sensor
        if self.parameters.sensor_motion:
            density, sensor = follow_sensor(density, frame, table)

        # PMB prediction
        predicted, repaired = predict(density, moment, table)

        # Measurements
        scores, score = None, frame.score
        if self.parameters.self_calibration:
            scores, table = calibrated(density, frame, table)
            table.restrict(self.parameters)
            score = scores.lasting
        z, chosen, below_score, suppressed = preprocess(frame, table, self._max_pairs, score)
        if scores is not None:
            scores.meant.take(chosen, out=z.score)
        if not self.parameters.trust_size:
            z.auxiliary[:] = np.nan
        if not self.parameters.trust_heading:
            z.yaw[:] = np.nan
        check_effort(predicted, z, moment.dt, table, self._max_pairs)

        # Detection probabilities p_d(x_+), zero out of view
        announces = not modules.habm and self.parameters.starts_tracks
        prior = with_measurement_births(predicted, z, table) if announces else predicted
        looks, prior = look(frame.field_of_view, prior, z, moment, table)
        p_d = detection_probability(prior, cloud, looks, moment, table)

        # PMB update: hypotheses, association, states, births
        since_ns = prior.missed_from_ns if looks is None else looks.misses.missed_from_ns
        likely = UNGROUPED if prior.class_probability is None else prior.class_probability
        given = prior.bernoulli.words, since_ns, likely, prior.poisson.words, len(predicted.poisson), prior.next_id
        still = sensor is None  # poses are known, or not needed
        after = Update(*update(given, p_d, tuple(z), tuple(moment), table.confusion, table.classes, still))
        objects = Bernoullis.of(after.objects)
        poisson = Poissons.of(after.components) if modules.rpp else Poissons.empty()
        misses = None if looks is None else follow_looks(looks, after, prior.bernoulli, objects, z, moment, table)
        pi = None if prior.class_probability is None else after.class_probability
        born = len(objects) - after.known
        next_id, labels = prior.next_id + born, density.labels
        own = None
        if scores is not None:
            own = followed(scores, predicted, poisson, misses, after, z, chosen, moment, table)
        posterior = Density(moment.stamp_ns, next_id, objects, poisson, labels, misses, pi, own, sensor)

        if frame.readings is not None or density.attributes is not None:
            hit = after.measurement >= 0
            detection = frame.source[chosen[after.measurement[hit]]]
            texts = read(density.attributes, frame.readings, objects.id[hit], detection)
            posterior = replace(posterior, attributes=texts)

        # Track extraction
        shown = objects.words, posterior.missed_from_ns, after.measurement, tuple(z), tuple(moment)
        words, rows = extract(*shown, modules.ote, table.classes)
        tracks, joined = Tracks.of(words), None
        if self._rejoin is not None:
            before = density.rejoining, posterior, tracks, self._rejoin, self._kinds
            joined = rejoin_tracks(*before, frame.embedding, (chosen, after.measurement))
            posterior = joined.density
            if joined.tracks is not tracks:
                tracks, objects, pi = joined.tracks, posterior.bernoulli, posterior.class_probability
                rows = np.searchsorted(objects.id, tracks.id)
        if posterior.attributes is not None:
            posterior = replace(posterior, attributes=_of_present(posterior.attributes, posterior))
        paths = paths_of(tracks, self._horizons, table) if self._horizons.size else None
        pi = None if pi is None else pi[rows]
        removed, repaired = (frame.score.shape[0], below_score, suppressed), repaired + after.repaired
        diagnostics = Diagnostics(cloud is not None, *removed, after.detected, born, repaired)
        measured = None if all_measured(objects.words) else measured_bits(objects, rows)
        return StepResult(posterior, tracks, diagnostics, paths, pi, measured, joined)

    def _moment(self, density: Density, frame: Frame) -> Moment:
        """Return the time of a frame; refuse the past, and other classes, for which kernels read out of bounds."""
        labels = self._labels
        for path, given in (("labels", frame.labels), ("density.labels", density.labels)):
            if given != labels:
                raise FrameError(path, f"the classes of profile {self.parameters.name}, {labels}", str(given)[:200])
        if density.stamp_ns != NO_FRAME and frame.stamp_ns < density.stamp_ns:
            raise FrameError("stamp_ns", f"a stamp from {density.stamp_ns} on", str(frame.stamp_ns))
        period = self._table.period
        dt = period if density.stamp_ns == NO_FRAME else (frame.stamp_ns - density.stamp_ns) * 1e-9
        return Moment(frame.stamp_ns, density.stamp_ns, dt, period)


def _of_present(attributes: Attributes, density: Density) -> Attributes | None:
    """Return the attributes of the newest objects of a density and of lost ones; None: there are none."""
    known = density.bernoulli.id
    if density.rejoining is not None:
        known = np.concatenate((known, density.rejoining.lost.id))
    newest = np.intersect1d(attributes.id, known)[-MOST_OBJECTS:]
    return attributes.take(np.isin(attributes.id, newest)) if len(newest) else None
