"""The slow twin of the tracker: Algorithm 1 of the paper with one Python object per component and no shortcuts.

Conventions as in `oracle_formulas`. Nothing here imports the tracker: `Oracle` reads parameters, modules and frames
by attribute. Where the paper is silent the tracker's docstrings decide.
"""
# ruff: noqa: N806 - Q and W are the names that the paper uses

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from oracle_formulas import (
    Array,
    Measurement,
    birth,
    calibrate,
    confidence,
    count_inside,
    follow_evidence,
    follow_sign,
    iou,
    log_likelihood,
    moment_match,
    periods,
    predict,
    report,
    ukf_update,
    with_history,
)
from scipy.optimize import linear_sum_assignment


@dataclass
class Bernoulli:
    """A potential object that was detected at least once: (r, N(m, P)) and the non-motion states."""

    mean: Array
    covariance: Array
    existence: float
    label: int
    auxiliary: Array
    born_ns: int
    seen_ns: int
    score: float
    evidence: float = 0.0
    heading_odds: float = 0.0
    id: int = 0
    extracted: bool = False
    confirmed: bool = False
    hits: int = 1
    looks: int = 1
    detection: int = -1
    measurement: Measurement | None = None
    pi: Array = field(default_factory=lambda: np.ones(1))  # over the classes of its group, in their order


@dataclass
class Poisson:
    """A component mu N(m, P) of the intensity of undetected objects."""

    mean: Array
    covariance: Array
    weight: float
    label: int
    auxiliary: Array
    born_ns: int
    newborn: bool = False


@dataclass
class NewObject:
    """First-time detection hypothesis: cost w, and the Bernoulli (r, m, P)."""

    w: float
    r: float
    mean: Array | None = None
    covariance: Array | None = None
    low: bool = False


@dataclass
class OracleTracks:
    """The extracted tracks in columns with the tracker's names."""

    columns: dict[str, Array] = field(default_factory=dict)


class Oracle:
    """Keeps the density as lists of components; `step` is one pass of Algorithm 1."""

    def __init__(self, parameters: Any, modules: Any) -> None:
        self.classes = list(parameters.classes.values())
        self.nominal: float = parameters.nominal_period
        self.detection_time: float = parameters.detection_time
        self.dt = self.nominal
        self.modules = modules
        self.bernoulli: list[Bernoulli] = []
        self.poisson: list[Poisson] = []
        self.stamp_ns = -1
        self.next_id = 1
        self.costs = np.zeros((0, 0))  # the cost matrix of the last step, for tests of the scenes

    def step(self, frame: Any) -> OracleTracks:
        """One frame: predict, preprocess, update, associate, prune, light-weight filter, extract."""
        now = int(frame.stamp_ns)
        since = (now - self.stamp_ns) * 1e-9 / self.nominal  # periods since the last frame
        self.dt = self.nominal
        if self.stamp_ns >= 0:
            self.dt = (now - self.stamp_ns) * 1e-9
            self._predict(now)
        self.stamp_ns = now
        measurements = self._preprocess(frame)
        self._look_round(measurements)
        world = None
        if frame.cloud is not None and self.modules.adp:
            pose = frame.cloud.pose
            world = np.asarray(frame.cloud.xyz, dtype=np.float64) @ pose.rotation.T + pose.translation
        if not self.modules.habm:
            for z in measurements:
                mean, covariance = birth(z, self.classes[z.label])
                weight = self.classes[z.label].baseline_birth_rate
                self.poisson.append(Poisson(mean, covariance, weight, z.label, z.auxiliary.copy(), now, newborn=True))
        p_d = [self._detection_probability(b, world) for b in self.bernoulli]
        p_du = [self._detection_probability(u, world) for u in self.poisson]
        for b in self.bernoulli:
            self._halt(b, measurements, now)
        gates = [[j for j, u in enumerate(self.poisson) if self._in_gate(u, z)] for z in measurements]  # J^m
        p_a = [self._association_probability(z) for z in measurements]
        new = [self._first_detection(z, gates[m], p_du, p_a[m]) for m, z in enumerate(measurements)]
        chosen = self._associate(measurements, p_d, new)
        self._forbid_births(measurements, chosen, new, now)
        newborn = self._newborn_poisson(measurements, new, p_a, now)
        self._update_bernoulli(measurements, chosen, p_d, now, since)
        self._append_new(measurements, new, set(chosen.values()), now)
        self._update_poisson(p_du, {j for gate in gates for j in gate}, newborn, now)
        return self._extract(now)

    def _predict(self, now: int) -> None:
        """Eqs. (PPP_prediction), (MB_prediction); first goes what the silence of the stream put past its limit.

        What the last frame has seen stays for one more.
        """
        dt, last = self.dt, self.stamp_ns
        self.bernoulli = [
            b
            for b in self.bernoulli
            if periods(b.seen_ns, now, self.nominal) - 1 <= self.classes[b.label].max_misses
            or (b.seen_ns == last and dt <= 6.0)
        ]
        self.poisson = [
            u
            for u in self.poisson
            if periods(u.born_ns, now, self.nominal) - 1 <= self.classes[u.label].poisson_steps or u.born_ns == last
        ]
        components: list[Bernoulli | Poisson] = [*self.bernoulli, *self.poisson]
        for component in components:
            c = self.classes[component.label]
            q = c.process_noise
            Q = np.diag(np.square([q.position, q.position, q.speed, q.heading, q.turn_rate, q.acceleration]))
            tau, straight = c.acceleration_time or math.inf, c.motion == "cv"
            component.mean, component.covariance = predict(
                component.mean, component.covariance, Q, dt, tau, straight=straight
            )
            survival = c.survival ** (dt / self.nominal)
            if isinstance(component, Bernoulli):
                component.existence *= survival
                memory = c.class_memory ** (dt / self.nominal)
                component.pi = memory * component.pi + (1 - memory) / len(component.pi)
            else:
                component.weight *= survival

    def _preprocess(self, frame: Any) -> list[Measurement]:
        """Score filter (eta_sf) and suppression per group of classes (eta_iou, of pairs), in the canonical order."""
        rows = []
        for i in range(len(frame.score)):
            x, y, z = (float(value) for value in frame.center[i])
            length, width, height = (float(value) for value in frame.size[i])
            key = (-float(frame.score[i]), x, y, z, length, width, height, float(frame.yaw[i]), int(frame.source[i]))
            rows.append((key, i))
        standing: list[tuple[Array, Measurement]] = []
        kept: list[Measurement] = []
        for (minus_score, x, y, z, length, width, height, yaw, source), i in sorted(rows):
            label = int(frame.label[i])
            box = np.array([x, y, length, width, yaw])
            if -minus_score < self.classes[label].score_filter:
                continue
            c = self.classes[label]
            rivals = [
                (iou(box, other), known)
                for other, known in standing
                if known.label == label or self._suppressed_together(known.label, label)
            ]
            if any(overlap > max(c.nms_iou, c.sure_nms_iou) for overlap, _ in rivals):
                continue
            velocity = None if np.isnan(frame.velocity[i]).any() else np.array(frame.velocity[i])
            auxiliary = np.array([length, width, height, z])
            found = Measurement(np.array([x, y]), velocity, yaw, auxiliary, label, -minus_score, source)
            standing.append((box, found))
            doubtful = [known for overlap, known in rivals if overlap > c.nms_iou and known.score * found.score < 0.64]
            if not any(known is one for known in doubtful for one in kept):
                kept.append(found)
        return kept

    def _look_round(self, zs: list[Measurement]) -> None:
        """Where a class is crowded, each measurement's distance to the next of its class, and clutter among them."""
        for z in zs:
            c = self.classes[z.label]
            others = [one for one in zs if one is not z and one.label == z.label and c.crowded]
            near = [one for one in others if math.dist(one.xy, z.xy) <= c.gate]
            z.spacing = min((math.dist(one.xy, z.xy) for one in near), default=math.inf)
            z.clutter = c.clutter_rate / c.area + 0.05 * sum(one.score for one in near) / (math.pi * c.gate**2)

    def _detection_probability(self, component: Bernoulli | Poisson, world: Array | None) -> float:
        """ADP: p_d = p_d0 min[1, (1 - s_d) PTS / PTS_0 + s_d], without the points of the ground; over dt, if asked."""
        c = self.classes[component.label]
        p_d = float(c.detection)
        if world is not None:
            box = component.auxiliary.copy()
            cut = min(c.ground_clearance, box[2])
            box[2:] += -cut, cut / 2
            points = count_inside(world, component.mean[:2], component.mean[3], box)
            scale = (1 - c.detection_floor) * points / c.expected_points + c.detection_floor
            p_d *= min(1.0, scale)
        share = self.dt / self.detection_time if self.detection_time else 1.0
        return float(1 - (1 - p_d) ** max(share, 0.02)) if share < 1 else p_d

    def _halt(self, b: Bernoulli, zs: list[Measurement], now: int) -> None:
        """A new speed is given up where a sure parallel box without velocity is at the last place, within 0.75 s."""
        c, passed = self.classes[b.label], (now - b.seen_ns) * 1e-9
        if b.seen_ns - b.born_ns > 0.75e9 or passed > 0.75 or abs(b.mean[2] * passed) <= c.gate:
            return
        phi, noise = b.mean[3] - b.mean[4] * passed / 2, c.measurement_noise
        axes = np.array([[math.cos(phi), math.sin(phi)], [-math.sin(phi), math.cos(phi)]])
        place = b.mean[:2] - b.mean[2] * passed * axes[0]
        variance = 2 * noise.position**2 + np.array([(0.5 * passed) ** 2, 0.0])
        for z in zs:
            turn = (z.yaw - phi + math.pi / 2) % math.pi - math.pi / 2
            near = np.sum((axes @ (z.xy - place)) ** 2 / variance) <= 9.21
            sure = z.score >= c.birth_score and z.velocity is None
            if sure and z.label in self._group(b.label) and near and abs(turn) <= 1.5 * noise.heading:
                p = c.birth
                b.mean = np.array([*place, 0.0, phi, 0.0, 0.0])
                b.covariance = np.diag([p.position, p.position, 0.5, p.heading, p.turn_rate, p.acceleration]) ** 2
                return

    def _in_gate(self, component: Bernoulli | Poisson, z: Measurement) -> bool:
        """Class gate, open to the group of a detected object, and distance gate."""
        known = self._group(component.label) if isinstance(component, Bernoulli) else [component.label]
        if z.label not in known:
            return False
        distance, c = math.hypot(*(component.mean[:2] - z.xy)), self.classes[component.label]
        spread = math.sqrt(component.covariance[2, 2])
        if distance > c.gate and isinstance(component, Bernoulli):
            turn = (z.yaw - component.mean[3] + math.pi / 2) % math.pi - math.pi / 2
            if turn**2 > 1.5**2 * (component.covariance[3, 3] + c.measurement_noise.heading**2):
                return False
        return distance <= max(c.gate, c.gate_deviations * spread * self.dt)

    def _log_likelihood(self, component: Bernoulli | Poisson, z: Measurement) -> float:
        position = self.classes[z.label].measurement_noise.position
        value = log_likelihood(z.xy, component.mean, component.covariance, position)
        if isinstance(component, Bernoulli) and math.dist(component.mean[:2], z.xy) > z.spacing:
            off, S = z.xy - component.mean[:2], component.covariance[:2, :2] + position**2 * np.eye(2)
            value = -math.inf if off @ np.linalg.solve(S, off) > 9.21 else value
        return value + (math.log(component.pi @ self._called(z, 1.0)) if isinstance(component, Bernoulli) else 0.0)

    def _suppressed_together(self, one: int, other: int) -> bool:
        """Whether eta_iou compares detections of two classes: both are of one group, and suppressed in it."""
        first, second = self.classes[one], self.classes[other]
        return first.group == second.group is not None and first.suppress_in_group and second.suppress_in_group

    def _group(self, label: int) -> list[int]:
        """The classes that share the group of a class, itself among them."""
        group = self.classes[label].group
        return [c for c, one in enumerate(self.classes) if c == label or one.group == group is not None]

    def _called(self, z: Measurement, s: float) -> Array:
        """p(d | c) of the classes c of the group of a measurement: s Lambda_cd + (1 - s) / G."""
        group = self._group(z.label)
        if len(group) == 1:
            return np.ones(1)
        kappa = np.array([self.classes[c].class_confusion for c in group])
        meant = np.where([c == z.label for c in group], 1 - kappa, kappa / (len(group) - 1))
        return s * meant + (1 - s) / len(group)

    def _follow_class(self, b: Bernoulli, z: Measurement) -> None:
        """Bayes; the class reported changes to one that is three times as probable."""
        likely, group = b.pi * self._called(z, z.score), self._group(z.label)
        b.pi = likely / likely.sum()
        best = int(np.argmax(b.pi))
        if b.pi[best] >= 3 * b.pi[group.index(b.label)]:
            b.label = group[best]

    def _association_probability(self, z: Measurement) -> float:
        """Eq. (Association Probability)."""
        return min(1.0, sum(math.exp(self._log_likelihood(b, z)) for b in self.bernoulli if self._in_gate(b, z)))

    def _first_detection(self, z: Measurement, gate: list[int], p_d: list[float], p_a: float) -> NewObject:
        """Eqs. (First-Time Detection Hypothesis Update 1, 2), (Clutter Hypothesis), (Newborn Hypothesis)."""
        c = self.classes[z.label]
        clutter = z.clutter  # lambda_c
        if gate:
            members = [self.poisson[j] for j in gate]
            log_e = np.array(
                [math.log(u.weight * p_d[j]) + self._log_likelihood(u, z) for j, u in zip(gate, members, strict=True)]
            )
            log_sum = log_e.max() + math.log(np.sum(np.exp(log_e - log_e.max())))
            log_total = np.logaddexp(log_sum, math.log(clutter))
            weights = [float(w) for w in np.exp(log_e - log_sum)]
            parts = [ukf_update(u.mean, u.covariance, z, c) for u in members]
        shadowed = c.birth_over_clutter and z.score >= c.birth_score
        if gate and not (shadowed and log_sum < math.log(clutter)):
            return NewObject(-log_total, math.exp(log_sum - log_total), *moment_match(weights, parts))
        if z.score < c.birth_score:
            return NewObject(-math.log(clutter), 0.0, low=True)
        return NewObject(-math.log(c.undetected_birth_rate * (1 - p_a) / c.area + clutter), 1.0, *birth(z, c))

    def _associate(self, zs: list[Measurement], p_d: list[float], new: list[NewObject]) -> dict[int, int]:
        """The cost matrix of Fig. 3, eq. (Detection Hypothesis Update), inf where impossible: object -> measurement."""
        n = len(self.bernoulli)
        W = np.full((len(zs), n + len(zs)), np.inf)
        for m, z in enumerate(zs):
            W[m, n + m] = new[m].w
            for i, b in enumerate(self.bernoulli):
                if self._in_gate(b, z):
                    r = b.existence
                    w = -math.log(r * p_d[i] / (1 - r + r * (1 - p_d[i]))) - self._log_likelihood(b, z)
                    W[m, i] = w if w < new[m].w else np.inf  # used only when strictly cheaper
        self.costs = W
        rows, columns = linear_sum_assignment(W)
        return {int(i): int(m) for m, i in zip(rows, columns, strict=True) if i < n}

    def _forbid_births(self, zs: list[Measurement], chosen: dict[int, int], new: list[NewObject], now: int) -> None:
        """No second track on the box of a missed one: for a nominal period, fewer than eta_cnt if it is ten old."""
        for i, b in enumerate(self.bernoulli):
            c = self.classes[b.label]
            longest = max(c.extract_misses - 1, 1) if periods(b.born_ns, now, self.nominal) >= 10 else 1
            misses = periods(b.seen_ns, now, self.nominal)
            if c.birth_overlap < 1 and b.extracted and i not in chosen and misses <= longest:
                box = np.array([*b.mean[:2], *b.auxiliary[:2], b.mean[3]])
                for m, z in enumerate(zs):
                    other = np.array([*z.xy, *z.auxiliary[:2], z.yaw])
                    if m not in chosen.values() and self._in_gate(b, z) and iou(box, other) > c.birth_overlap:
                        new[m] = NewObject(new[m].w, 0.0, low=True)

    def _update_bernoulli(
        self, zs: list[Measurement], chosen: dict[int, int], p_d: list[float], now: int, since: float
    ) -> None:
        """Eqs. (UKF Update), (Misdetect Hypothesis Update) for the hypotheses chosen; light-weight filter; pruning."""
        survivors = []
        for i, b in enumerate(self.bernoulli):
            c = self.classes[b.label]
            b.looks, b.hits = b.looks + 1, b.hits + (i in chosen)
            if i in chosen:
                z = zs[chosen[i]]
                b.mean, b.covariance = ukf_update(b.mean, b.covariance, z, self.classes[z.label])
                b.existence = 1.0
                self._follow_class(b, z)
                c = self.classes[b.label]
                b.auxiliary = (1 - z.score) * b.auxiliary + z.score * z.auxiliary
                length = 1 + (now - b.born_ns) * 1e-9 / self.nominal
                b.score = (1 - math.exp(-length)) * z.score  # eq. (Confidence Score)
                periods_since = 1.0 if b.born_ns == now else since
                b.evidence = follow_evidence(c, b.evidence, periods_since, z.score)
                b.heading_odds, b.mean, b.covariance = follow_sign(
                    c, b.heading_odds, periods_since, z, b.mean, b.covariance
                )
                b.seen_ns, b.detection, b.measurement = now, z.source, z
            else:
                r = b.existence
                b.existence = r * (1 - p_d[i]) / (1 - r + r * (1 - p_d[i]))
                b.score, b.detection, b.measurement = 0.0, -1, None
                b.evidence = follow_evidence(c, b.evidence, 1.0 if b.born_ns == now else since, None)
            if b.existence >= c.min_existence and periods(b.seen_ns, now, self.nominal) <= c.max_misses:
                survivors.append(b)
        self.bernoulli = survivors

    def _append_new(self, zs: list[Measurement], new: list[NewObject], used: set[int], now: int) -> None:
        """First-time detections that the best global hypothesis contains become Bernoullis with new ids."""
        for m, (z, h) in enumerate(zip(zs, new, strict=True)):
            if m in used or h.mean is None or h.covariance is None or h.r < self.classes[z.label].min_existence:
                continue
            score = (1 - math.exp(-1.0)) * z.score
            b = Bernoulli(h.mean, h.covariance, h.r, z.label, z.auxiliary.copy(), now, now, score)
            b.evidence = follow_evidence(self.classes[z.label], 0.0, 1.0, z.score)
            b.heading_odds, b.mean, b.covariance = follow_sign(self.classes[z.label], 0.0, 1.0, z, b.mean, b.covariance)
            b.id, b.detection, b.measurement = self.next_id, z.source, z
            b.pi = self._called(z, z.score) / self._called(z, z.score).sum()
            self.bernoulli.append(b)
            self.next_id += 1

    def _newborn_poisson(
        self, zs: list[Measurement], new: list[NewObject], p_a: list[float], now: int
    ) -> list[Poisson]:
        """Eq. (HABM): one component per low-scored measurement."""
        newborn = []
        for z, h, probability in zip(zs, new, p_a, strict=True):
            weight = self.classes[z.label].adaptive_birth_rate * (1 - probability)
            if self.modules.habm and h.low and weight > 0:
                newborn.append(Poisson(*birth(z, self.classes[z.label]), weight, z.label, z.auxiliary.copy(), now))
        return newborn

    def _update_poisson(self, p_d: list[float], marked: set[int], newborn: list[Poisson], now: int) -> None:
        """Eq. (PPP Update) with mu+ (1 - p_d); redundant PPP pruning, or with RPP off all of it."""
        survivors = []
        for j, u in enumerate(self.poisson):
            u.weight *= 1 - p_d[j]
            expired = periods(u.born_ns, now, self.nominal) > self.classes[u.label].poisson_steps
            if (j not in marked or u.newborn) and not expired:
                u.newborn = False
                survivors.append(u)
        self.poisson = [*survivors, *newborn] if self.modules.rpp else []

    def _extract(self, now: int) -> OracleTracks:
        """Optimized track extraction with eta_ext1, eta_ext2, eta_cnt."""
        rows: list[dict[str, Any]] = []
        for b in self.bernoulli:
            c = self.classes[b.label]
            if b.extracted and self.modules.ote:
                count = periods(b.seen_ns, now, self.nominal)
                taken = b.existence >= c.extract_known and count < c.extract_misses
            else:
                taken = b.existence >= c.extract_new
            b.extracted = b.extracted or taken
            if not taken:
                continue
            mean, covariance = report(c, b.measurement, b.mean, b.covariance)
            x, y, v, phi, omega, a = mean
            existence, score, covariance = calibrate(c, b, mean, covariance)
            told = v if c.calibration is None or v == 0.0 else v**5 / (v**4 + (3 * covariance[2, 2]) ** 2)
            sign, doubt = confidence(c, b.heading_odds)
            covariance = covariance + np.diag([0.0, 0.0, 0.0, doubt, 0.0, 0.0])
            if c.calibration is not None and c.calibration.history is not None:
                existence = with_history(c.calibration.history, existence, b, (now - b.born_ns) * 1e-9, abs(told))
            stays = b.confirmed and (b.detection >= 0 or existence >= c.confirm_until)
            b.confirmed = stays or existence >= c.confirm_from
            rows.append(
                {
                    "id": b.id, "label": b.label, "center": [x, y, b.auxiliary[3]], "size": b.auxiliary[:3], "yaw": phi,
                    "heading_confidence": sign,
                    "velocity": [told * math.cos(phi), told * math.sin(phi)], "yaw_rate": omega, "acceleration": a,
                    "existence": existence, "score": score, "covariance": covariance,
                    "age": (now - b.born_ns) * 1e-9, "time_since_detection": (now - b.seen_ns) * 1e-9,
                    "detection": b.detection, "confirmed": b.confirmed,
                }
            )  # fmt: skip
        return OracleTracks({name: np.array([row[name] for row in rows]) for name in (rows[0] if rows else ())})
