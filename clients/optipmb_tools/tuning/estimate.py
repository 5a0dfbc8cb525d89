"""Estimates of a class from training data, without tracking: noise, motion, births, detections and false ones.

Each figure comes from one place: R from detections minus labels, Q from the labels' trajectories, P^0 from the first
detection of each object, p_d0 and mu_c / A from the found labels and the false detections. Standard deviations are
winsorised (`spread`), for detections and labels are wrong in a few places by much. Estimates are where a search begins,
not where it must end: a detector's errors last over frames, labels have errors of their own, and a motion model has to
cover the rest.

Detections and labels belong together in the world frame: in each frame as many pairs as possible are made within a
distance, and of those ways the one of least total distance is taken.

The curve from a detector's scores to a reference detector's scores is of equal precision, the share of detections with
about this score that belong to a label. Detections are put into groups of neighbouring scores, equally many in each
where scores do not tie. Isotonic regression of the groups' precision on their mean log odds (pool adjacent violators:
Barlow et al., 1972) merges them into blocks of ascending precision, for both detectors. The curve has a knot for each
block of the detector: from its score to the score at which the reference, linear in log odds between its own blocks,
has the same precision. Outside the precisions that the reference reaches the curve has one knot at their end.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.optimize import isotonic_regression

from optipmb import Parameters, ScoreCalibration
from optipmb_tools.evaluation import Rules
from optipmb_tools.evaluation.cases import assign_frames, most_pairs, prepare
from optipmb_tools.evaluation.figures import ratio
from optipmb_tools.geometry import Bools, Floats, Ints, to_sensor, wrap_angle
from optipmb_tools.results import ResultTable
from optipmb_tools.tuning.clips import Clip
from optipmb_tools.tuning.values import Value, rounded, value_of

WINDOW_S = 1.0  # pieces of trajectories in which motion is fitted; at low frame rates four frames
PAIR_LIMIT = 2.0  # largest distance between a detection and its label, m; the gate where that is less
MOVING = 0.5  # speed from which an object moves, m/s
LEAST_PAIRS = 20  # with fewer detections on labels there is nothing to estimate from
_BINS = 10
_GAP_QUANTILE = 0.98
_SMALL = 1e-2
_NORMAL = 1.482602218505602  # standard deviation of a Gaussian in units of its median absolute value
_REACH = 3.0
_LEAST_POINTS = 4
GROUPS = 25
LEAST_TRUE = 50  # with fewer detections on labels, of either detector, there is no curve
_BOUND = 1e-6
_DIGITS = 3


@dataclass(frozen=True)
class Trajectory:
    """One labelled object."""

    frame: Ints  # (R,) ascending
    time: Floats  # (R,) s
    position: Floats  # (R, 2) m
    yaw: Floats  # (R,) rad
    velocity: Floats  # (R, 2) m/s; NaN where unknown
    ignored: Bools  # (R,)


def trajectories(clip: Clip, name: str) -> dict[int, Trajectory]:
    """Return the labelled objects of a class by id."""
    truth = clip.world.take(clip.world.names == name)
    stamps = clip.stamps
    found = {}
    for identity in np.unique(truth.id).tolist():
        rows = np.flatnonzero(truth.id == identity)
        rows = rows[np.argsort(truth.frame[rows], kind="stable")]
        frame = truth.frame[rows]
        found[identity] = Trajectory(
            frame=frame,
            time=(stamps[frame] - stamps[0]) * 1e-9,
            position=truth.center[rows, :2],
            yaw=truth.yaw[rows],
            velocity=_velocities(truth.velocity[rows], (stamps[frame] - stamps[0]) * 1e-9, truth.center[rows, :2]),
            ignored=truth.ignored[rows],
        )
    return found


def _velocities(given: Floats, time: Floats, position: Floats) -> Floats:
    """Return the labels' velocities; where they have none, from the positions before and after."""
    if len(time) < 3 or np.isfinite(given).all():  # noqa: PLR2004  one before, one after
        return given
    return np.where(np.isfinite(given), given, np.gradient(position, time, axis=0))


@dataclass(frozen=True)
class LabelledDetections:
    """Detections of one class, and which label each belongs to; rows are ordered by frame."""

    clip: str
    frame: Ints  # (M,)
    score: Floats  # (M,)
    place: Floats  # (M, 2) in the sensor frame, m
    position: Floats  # (M, 2)
    yaw: Floats  # (M,)
    velocity: Floats  # (M, 2); NaN where unknown
    object: Ints  # (M,) id of the label; -1 for none
    false: Bools  # (M,) belongs to no label and is not excused
    truth: int  # labels that count
    found: int  # labels that a detection belongs to
    frames: int


def pair_detections(clip: Clip, name: str, least: float, limit: float, rules: Rules) -> LabelledDetections:
    """Pair the detections of a class with its labels.

    Args:
        clip: with this class only.
        name: the class.
        least: lowest score of the detections that are used.
        limit: largest distance of a pair, m.
        rules: which labels are ignored, and which detections are excused.
    """
    frames = clip.frames
    when: Ints = np.repeat(np.arange(len(frames)), [len(frame.score) for frame in frames]).astype(np.int64)
    columns: dict[str, Floats] = {key: np.concatenate([getattr(frame, key) for frame in frames]) for key in _COLUMNS}
    use = columns["score"] >= least
    when = when[use]
    center, size, yaw, velocity, score = (columns[key][use] for key in _COLUMNS)
    local, turned = to_sensor(clip.rotation[when], clip.translation[when], center, yaw)
    image = clip.camera.boxes(local, size, turned)[0] if clip.camera else np.full((len(when), 4), np.nan)
    rows = np.arange(len(when))
    table = ResultTable((name,), when, rows, np.zeros_like(rows), local, size, turned, score, image)
    near = Rules("distance", limit, neighbours=rules.neighbours, min_height=rules.min_height, regions=rules.regions)
    case = prepare(clip.truth, table, name, near)
    pairs = assign_frames(case.pair_frame, case.truth_row, case.track_row, case.cost, most_pairs)
    label, matched = case.truth_row[pairs], case.track_row[pairs]
    owner = np.full(len(when), -1, dtype=np.int64)
    # Labels of a class alike are ignored, and no examples of this one.
    names = clip.truth.take(np.argsort(clip.truth.frame, kind="stable")).names
    same = names[label] == name
    owner[matched[same]] = case.truth_id[label[same]]
    false = ~case.excused
    false[matched] = False
    return LabelledDetections(
        clip=clip.name,
        frame=when,
        score=score,
        place=local[:, :2],
        position=center[:, :2],
        yaw=yaw,
        velocity=velocity,
        object=owner,
        false=false,
        truth=int((~case.ignored).sum()),
        found=int((~case.ignored[label]).sum()),
        frames=len(frames),
    )


_COLUMNS = ("center", "size", "yaw", "velocity", "score")


@dataclass(frozen=True)
class Residuals:
    """Detections against their labels, ordered by object and then by frame."""

    gap: Floats  # (H,) s since the detection before of the same object; NaN for the first
    position: Floats  # (H, 2) m
    heading: Floats  # (H,) rad in [-pi, pi)
    velocity: Floats  # (H, 2) m/s; NaN where one of the two is unknown

    @property
    def first(self) -> Bools:
        """(H,) the first detection of an object."""
        return np.isnan(self.gap)


def residuals(pairs: Sequence[LabelledDetections], paths: Sequence[dict[int, Trajectory]]) -> Residuals:
    """Return detection minus label of all pairs."""
    parts = [(np.empty(0), np.empty((0, 2)), np.empty(0), np.empty((0, 2)))]
    parts += [
        (
            np.diff(path.time[at], prepend=np.nan),
            found.position[rows] - path.position[at],
            wrap_angle(found.yaw[rows] - path.yaw[at]),
            found.velocity[rows] - path.velocity[at],
        )
        for found, path, rows, at in detected(pairs, paths)
    ]
    return Residuals(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def detected(
    pairs: Sequence[LabelledDetections], paths: Sequence[dict[int, Trajectory]]
) -> Iterator[tuple[LabelledDetections, Trajectory, Ints, Ints]]:
    """Yield each detected object: its recording, its path, and the rows of its detections in both."""
    for found, objects in zip(pairs, paths, strict=True):
        for identity, path in objects.items():
            rows = np.flatnonzero(found.object == identity)
            if len(rows):
                yield found, path, rows, np.searchsorted(path.frame, found.frame[rows])


@dataclass(frozen=True)
class ScoreBin:
    """Detections with scores in a range."""

    low: float
    high: float
    detections: int
    score: float  # mean
    precision: float  # share that belongs to a label


@dataclass(frozen=True)
class Estimate:
    """Estimates of one class; NaN where there is too little data."""

    name: str
    labels: int
    objects: int
    detections: int
    pairs: int
    values: dict[str, Value]  # by path in the profile
    flip_rate: float  # share of detections whose heading is nearer to the opposite of the label's
    lasting: float  # correlation of the position errors of neighbouring detections of one object
    usual_position: float  # standard deviation of the usual position error, by the median, m
    detection: float  # share of labels found, from the score filter on
    clutter: float  # false detections per frame, from the score filter on
    clutter_area: float  # area that false detections come from, m^2
    longest_gap: float  # nominal periods within which 98 of 100 breaks between detections of an object end
    bins: tuple[ScoreBin, ...]
    score_scale: float
    score_shift: float
    """Log odds that a detection is true = scale * logit(score) + shift; 1 and 0 when scores are calibrated."""

    def to_json(self) -> dict[str, Any]:
        """Return it as plain values; None for NaN."""
        return {key: _plain(value) for key, value in asdict(self).items()}


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and math.isnan(value) else value


def estimate(clips: Sequence[Clip], name: str, parameters: Parameters, rules: Rules) -> Estimate:
    """Return the estimates of one class from clips with this class only."""
    table = parameters.classes[name]
    paths = [trajectories(clip, name) for clip in clips]
    everything = pair_all(clips, name, parameters, rules)
    pairs = [pair_detections(clip, name, table.score_filter, min(PAIR_LIMIT, table.gate), rules) for clip in clips]
    errors = residuals(pairs, paths)
    count = len(errors.heading)
    values: dict[str, float] = {}
    clutter_area = _area(pairs)
    clutter = ratio(sum(int(one.false.sum()) for one in pairs), sum(one.frames for one in pairs))
    gap = _longest_gap(pairs, paths, parameters.nominal_period)
    if count >= LEAST_PAIRS:
        values |= _measurement(errors)
        values |= _process([path for objects in paths for path in objects.values()], parameters.nominal_period)
        values |= _birth(errors, pairs, paths)
        values["area"] = table.clutter_rate * clutter_area / clutter if clutter > 0 else math.nan
        values["max_misses"] = math.ceil(gap) if math.isfinite(gap) else math.nan
    flips = float((np.abs(errors.heading) > 0.5 * np.pi).mean()) if count else math.nan
    kept: dict[str, Value] = {
        path: _fitting(parameters, name, path, value)
        for path, value in values.items()
        if math.isfinite(value) and value > 0
    }
    bins, scale, shift = _scores(everything)
    return Estimate(
        name=name,
        labels=sum(one.truth for one in pairs),
        objects=sum(len(objects) for objects in paths),
        detections=sum(len(one.score) for one in pairs),
        pairs=count,
        values=kept,
        flip_rate=flips,
        lasting=_lasting(errors, parameters.nominal_period),
        usual_position=usual(errors.position),
        detection=ratio(sum(one.found for one in pairs), sum(one.truth for one in pairs)),
        clutter=clutter,
        clutter_area=clutter_area,
        longest_gap=gap,
        bins=bins,
        score_scale=scale,
        score_shift=shift,
    )


def pair_all(clips: Sequence[Clip], name: str, parameters: Parameters, rules: Rules) -> list[LabelledDetections]:
    """Return the detections of all scores of a class, paired with its labels; arguments as in `estimate`."""
    limit = min(PAIR_LIMIT, parameters.classes[name].gate)
    return [pair_detections(clip, name, 0.0, limit, rules) for clip in clips]


def _fitting(parameters: Parameters, name: str, path: str, value: float) -> Value:
    """Return a value of the kind that the profile has at a path."""
    kind = value_of(parameters, name, path)
    return round(value) if isinstance(kind, int) else rounded(max(value, _SMALL))


def _measurement(errors: Residuals) -> dict[str, float]:
    return {
        "measurement_noise.position": spread(errors.position),
        "measurement_noise.heading": spread(wrap_angle(2.0 * errors.heading) / 2.0),
        "measurement_noise.velocity": spread(errors.velocity[np.isfinite(errors.velocity).all(axis=1)]),
    }


def _process(paths: Sequence[Trajectory], period: float) -> dict[str, float]:
    """Return Q: how much speed, acceleration, heading and turn rate change between neighbouring pieces.

    The change of each over a time tau has the variance q^2 tau, in addition to the model's prediction and the fit's own
    error; position follows the model within the error of labels, and keeps what the profile has.
    """
    window = max(WINDOW_S, 4.0 * period)
    parts = [part for path in paths for part in _unbroken(path, 1.5 * period)]
    motions = [fit_motion(part.time, part.position, part.yaw, window) for part in parts]
    changes = [motion.changes() for motion in motions if len(motion.time) > 1]
    if sum(len(rates) for rates, _ in changes) < LEAST_PAIRS:
        return {}
    rates, variances = (np.concatenate(one) for one in zip(*changes, strict=True))
    fitted = np.median(variances, axis=0).tolist()
    found = {}
    for key, rate, own in zip(("speed", "acceleration", "heading", "turn_rate"), rates.T, fitted, strict=True):
        square = spread(rate) ** 2
        # A tenth remains in any case: that the fit explains all of it is chance.
        found[f"process_noise.{key}"] = math.sqrt(max(square - own, 0.1 * square))
    return found


def _unbroken(path: Trajectory, longest: float) -> list[Trajectory]:
    """Return the pieces of a trajectory without gaps in time."""
    cuts = np.flatnonzero(np.diff(path.time) > longest) + 1
    rows = np.split(np.arange(len(path.time)), cuts)
    return [
        Trajectory(*(getattr(path, key)[part] for key in ("frame", "time", "position", "yaw", "velocity", "ignored")))
        for part in rows
    ]


def _birth(
    errors: Residuals, pairs: Sequence[LabelledDetections], paths: Sequence[dict[int, Trajectory]]
) -> dict[str, float]:
    """Return P^0 from the first detection of each object, and from what objects do."""
    first = errors.first
    velocity = errors.velocity[first]
    starts = [path.velocity[at[0]] for _, path, _, at in detected(pairs, paths)]
    speeds = np.linalg.norm(np.array(starts).reshape(-1, 2), axis=1)
    speeds = speeds[np.isfinite(speeds)]
    return {
        "birth.position": spread(errors.position[first]),
        "birth.heading": spread(wrap_angle(2.0 * errors.heading[first]) / 2.0),
        "birth.speed": spread(velocity[np.isfinite(velocity).all(axis=1)]),
        # Most objects of many classes stand; the moving ones need it.
        "birth.unknown_speed": float(np.sqrt(np.mean(speeds**2))) if len(speeds) else math.nan,
    }


def _lasting(errors: Residuals, period: float) -> float:
    """Return the correlation of position errors of neighbouring frames; NaN of too few, or of none but zeros."""
    pair = np.flatnonzero(errors.gap < 1.5 * period)  # NaN is not less
    if len(pair) < LEAST_PAIRS:
        return math.nan
    limit = 3.0 * usual(errors.position)
    here = np.clip(errors.position, -limit, limit)
    squared = float((here[pair] ** 2).sum())
    return float((here[pair] * here[pair - 1]).sum()) / squared if squared else math.nan


def _longest_gap(pairs: Sequence[LabelledDetections], paths: Sequence[dict[int, Trajectory]], period: float) -> float:
    """Return the nominal periods within which nearly all breaks between detections of an object end."""
    between = [one for _, path, _, at in detected(pairs, paths) for one in np.diff(path.time[at]).tolist()]
    gaps = [one / period - 1.0 for one in between if one > 1.5 * period]
    return float(np.quantile(gaps, _GAP_QUANTILE)) if gaps else math.nan


def _area(pairs: Sequence[LabelledDetections], cell: float = 5.0) -> float:
    """Return the area of the cells around the sensor in which there are detections."""
    cells = {tuple(row) for one in pairs for row in np.floor(one.place / cell).astype(np.int64).tolist()}
    return cell * cell * len(cells)


def _scores(pairs: Sequence[LabelledDetections]) -> tuple[tuple[ScoreBin, ...], float, float]:
    """Return how often detections of each score are true, and the fit of the log odds (Platt, 1999)."""
    score, true = counted_scores(pairs)
    edges = np.linspace(0.0, 1.0, _BINS + 1)
    which = np.clip(np.digitize(score, edges) - 1, 0, _BINS - 1)
    bins = tuple(
        ScoreBin(
            low=float(edges[i]),
            high=float(edges[i + 1]),
            detections=int((which == i).sum()),
            score=float(score[which == i].mean()),
            precision=float(true[which == i].mean()),
        )
        for i in range(_BINS)
        if (which == i).any()
    )
    scale, shift = _platt(score, true) if true.any() and not true.all() else (math.nan, math.nan)
    return bins, scale, shift


def _platt(score: Floats, true: np.ndarray) -> tuple[float, float]:
    """Fit log odds = scale * logit(score) + shift by Newton's method, held by a weak prior at scale 1, shift 0."""
    clipped = np.clip(score, 1e-4, 1.0 - 1e-4)
    design = np.column_stack([np.log(clipped / (1.0 - clipped)), np.ones(len(score))])
    weights, prior = np.array([1.0, 0.0]), np.array([1.0, 0.0])
    for _ in range(50):
        odds = 1.0 / (1.0 + np.exp(-np.clip(design @ weights, -30.0, 30.0)))
        slope = design.T @ (true - odds) - 0.1 * (weights - prior)
        bend = (design * (odds * (1.0 - odds))[:, None]).T @ design + 0.1 * np.eye(2)
        step = np.linalg.solve(bend, slope)
        weights = weights + np.clip(step, -1.0, 1.0)
        if np.abs(step).max() < 1e-9:  # noqa: PLR2004  far below the digits shown
            break
    return float(weights[0]), float(weights[1])


def usual(errors: Floats) -> float:
    """Return the standard deviation that a Gaussian with the same median absolute value has; NaN without errors."""
    return float(_NORMAL * np.median(np.abs(errors))) if errors.size else float("nan")


def spread(errors: Floats) -> float:
    """Return the root mean square of errors of which none counts for more than three usual ones; NaN without errors."""
    if not errors.size:
        return float("nan")
    limit = _REACH * usual(errors)
    return float(np.sqrt(np.mean(np.minimum(np.abs(errors), limit) ** 2)))


@dataclass(frozen=True)
class WindowMotion:
    """Motion of an object at the middles of windows of time that do not overlap."""

    time: Floats  # (W,) s
    speed: Floats  # (W,) along the heading, m/s
    acceleration: Floats  # (W,) along the heading, m/s^2
    heading: Floats  # (W,) rad, unwrapped
    turn_rate: Floats  # (W,) rad/s
    variance: Floats
    """(W, 4) of the errors of speed, acceleration, heading and turn rate that the scatter of the points leaves"""

    def changes(self) -> tuple[Floats, Floats]:
        """Return the changes between neighbouring windows that the motion does not predict, and their variances.

        Windows between which the object stands are left out: most cars stand, most of the time.

        Returns:
            (N, 4) of speed, acceleration, heading and turn rate, over the root of the time between the windows; and
            (N, 4) variances of these by the fit.
        """
        tau = np.diff(self.time)
        acceleration = 0.5 * (self.acceleration[1:] + self.acceleration[:-1])
        turn_rate = 0.5 * (self.turn_rate[1:] + self.turn_rate[:-1])
        changes = np.column_stack(
            [
                np.diff(self.speed) - acceleration * tau,
                np.diff(self.acceleration),
                np.diff(self.heading) - turn_rate * tau,
                np.diff(self.turn_rate),
            ]
        )
        variances = (self.variance[1:] + self.variance[:-1]) / tau[:, None]
        moves = np.maximum(np.abs(self.speed[1:]), np.abs(self.speed[:-1])) > MOVING
        return (changes / np.sqrt(tau)[:, None])[moves], variances[moves]


def fit_motion(time: Floats, position: Floats, yaw: Floats, window: float) -> WindowMotion:
    """Fit polynomials to pieces of a trajectory: quadratic ones to the position, straight lines to the heading.

    Args:
        time: (R,) s, ascending.
        position: (R, 2) m.
        yaw: (R,) rad.
        window: length of a piece, s; pieces with fewer than four points are left out.
    """
    turned = np.unwrap(yaw)
    piece: Ints = np.floor((time - time[0]) / window + 1e-9).astype(np.int64)
    rows = []
    for which in np.unique(piece).tolist():
        use = piece == which
        if use.sum() < _LEAST_POINTS:
            continue
        middle = time[0] + (which + 0.5) * window
        rows.append((middle, *_fit(time[use] - middle, position[use], turned[use])))
    table = np.array(rows, dtype=np.float64).reshape(len(rows), 9)
    return WindowMotion(table[:, 0], table[:, 1], table[:, 2], table[:, 3], table[:, 4], table[:, 5:])


def _fit(time: Floats, position: Floats, yaw: Floats) -> tuple[float, ...]:
    """Return speed, acceleration, heading, turn rate at time 0, and the variances of the four."""
    count = len(time)
    square = np.column_stack([np.ones(count), time, 0.5 * time**2])
    inverse = np.linalg.inv(square.T @ square)
    path = inverse @ square.T @ position
    scatter = float(((position - square @ path) ** 2).sum()) / max(1, 2 * (count - 3))
    straight = square[:, :2]
    inverse_yaw = np.linalg.inv(straight.T @ straight)
    turn = inverse_yaw @ straight.T @ yaw
    scatter_yaw = float(((yaw - straight @ turn) ** 2).sum()) / max(1, count - 2)
    ahead = np.array([np.cos(turn[0]), np.sin(turn[0])])
    return (
        float(path[1] @ ahead),
        float(path[2] @ ahead),
        float(turn[0]),
        float(turn[1]),
        scatter * float(inverse[1, 1]),
        scatter * float(inverse[2, 2]),
        scatter_yaw * float(inverse_yaw[0, 0]),
        scatter_yaw * float(inverse_yaw[1, 1]),
    )


def counted_scores(pairs: Sequence[LabelledDetections]) -> tuple[Floats, Bools]:
    """Return the scores of the detections that belong to a label or to none without excuse, and which do."""
    score = np.concatenate([one.score for one in pairs]) if pairs else np.empty(0)
    true = np.concatenate([one.object >= 0 for one in pairs]) if pairs else np.empty(0, dtype=np.bool_)
    counted = true | (np.concatenate([one.false for one in pairs]) if pairs else true)
    return score[counted], true[counted]


def score_curve(own: Sequence[LabelledDetections], reference: Sequence[LabelledDetections]) -> ScoreCalibration | None:
    """Return the curve from a detector's scores to the reference's; None where there is too little to measure it.

    Both have all detections of one class, paired with its labels.
    """
    samples = [counted_scores(pairs) for pairs in (own, reference)]
    if min(int(true.sum()) for _, true in samples) < LEAST_TRUE:
        return None
    (odds, precision), (known_odds, known) = (_blocks(score, true) for score, true in samples)
    # Of the knots at or beyond an end of the reference's precisions, the innermost.
    first = max(int(np.searchsorted(precision, known[0], side="right")) - 1, 0)
    last = int(np.searchsorted(precision, known[-1], side="left"))
    within = slice(first, last + 1)
    meant = np.interp(precision[within], known, known_odds)
    knots: list[tuple[float, float]] = []
    for pair in zip(_rounded_scores(odds[within]), _rounded_scores(meant), strict=True):
        if not knots or (pair[0] > knots[-1][0] and pair[1] > knots[-1][1]):  # equal only by rounding
            knots.append(pair)
    if len(knots) <= 1:  # a curve has two
        return None
    return ScoreCalibration(detector=tuple(one for one, _ in knots), calibrated=tuple(one for _, one in knots))


def _blocks(score: Floats, true: Bools) -> tuple[Floats, Floats]:
    """Return the mean log odds and the precision of blocks of scores; both ascend strictly."""
    bounded = np.clip(score, _BOUND, 1.0 - _BOUND)
    odds = np.log(bounded / (1.0 - bounded))
    edges = np.unique(np.quantile(odds, np.linspace(0.0, 1.0, GROUPS + 1)[1:-1], method="nearest"))
    _, group = np.unique(np.searchsorted(edges, odds, side="right"), return_inverse=True)
    count = np.bincount(group).astype(np.float64)
    found = isotonic_regression(np.bincount(group, true) / count, weights=count)
    starts = found.blocks[:-1]
    weight = np.add.reduceat(count, starts)
    return np.add.reduceat(np.bincount(group, odds), starts) / weight, np.asarray(found.x[starts], dtype=np.float64)


def _rounded_scores(odds: Floats) -> list[float]:
    """Return the scores of log odds, with as many digits as the smaller of score and rest needs."""
    scores = 1.0 / (1.0 + np.exp(-odds))
    places = _DIGITS - 1 - np.floor(np.log10(np.minimum(scores, 1.0 - scores))).astype(np.int64)
    return [round(score, place) for score, place in zip(scores.tolist(), places.tolist(), strict=True)]
