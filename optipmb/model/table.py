"""The parameters as a table with a row for each class, as kernels take them."""

from __future__ import annotations

import math
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, Protocol, TypeAlias

import numpy as np

from optipmb.compiled import kernel
from optipmb.model.class_names import common_name
from optipmb.model.parameters import MAX_KNOTS
from optipmb.model.rows import record

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from optipmb.model.parameters import ClassParameters, Parameters
    from optipmb.model.rows import Array, Index

    Size = Array
    Spread = Array
    Curve = Array


class ClassRow(Protocol):
    """Parameters of a class for kernels; `optipmb.ClassParameters` describes those of the same names.

    Attributes:
        group: the first class of the group, the class itself without one.
        group_size: G, how many classes the group has.
        suppressed_with: the first of the classes that eta_iou compares with it.
        clutter_intensity: lambda_c = mu_c / A, 1/m^2.
        birth_intensity: mu_b0 / A, 1/m^2.
        acceleration_time: time constant of the acceleration, s, infinite where it is constant.
        constant_velocity: whether the motion model is constant velocity.
        default_size: (3,) length, width and height of an object of which they are unknown, m.
        process_noise: (6,) standard deviations in state order, per square root of a second.
        noise_position: standard deviation of z_x and z_y.
        noise_length: that of the centre of a long object along its heading, for each metre of its length.
        noise_velocity: of z_vx and z_vy.
        noise_heading: of z_phi.
        reported_position: variance that R_x of `optipmb.filter.calibration` leaves for z_x and z_y; zero without it.
        reported_heading: for z_phi.
        birth_known: (6,) standard deviations of P^0 when the detection brings a velocity.
        birth_unknown: (6,) when it does not.
        sign_known: whether the sign of the heading is followed; the next four are zero where not.
        sign_memory: lambda of the sign.
        sign_detection: b_d.
        sign_motion: b_v.
        sign_speed: v_0.
        memory: lambda; one without a calibration, and so the evidence stays zero.
        missed_evidence: l_miss.
        score_of_evidence: weight of the evidence in the score.
        factor_speed: on the standard deviation of the published speed.
        factor_turn_rate: on the standard deviation of the published turn rate.
        recall: share of looks in which the surest objects are detected; learned with `self_calibration`.
        history_known: whether the whole track counts in its existence; the next five are zero where not.
        history_offset: o.
        history_existence: w_e.
        history_duration: w_T.
        history_share: w_s.
        history_speed: w_v.
        knots: number of knots of the calibration, zero without one.
        knot_evidence: (`MAX_KNOTS`,) where its curves bend, ascending; this and the next are zero from `knots` on.
        knot_existence: (`MAX_KNOTS`,) existence probability there.
        knot_along: (`MAX_KNOTS`,) standard deviation of the lasting error along the heading, m.
        knot_across: (`MAX_KNOTS`,) across it, m.
    """

    score_filter: float
    nms_iou: float
    sure_nms_iou: float
    survival: float
    gate: float
    gate_deviations: float
    velocity_gate: float
    detection: float
    expected_points: float
    detection_floor: float
    ground_clearance: float
    announce_score: float
    birth_score: float
    birth_over_clutter: bool
    crowded: bool
    birth_overlap: float
    birth_heading_speed: float
    adaptive_birth_rate: float
    baseline_birth_rate: float
    poisson_steps: int
    extract_new: float
    extract_known: float
    extract_misses: int
    confirm_from: float
    confirm_until: float
    max_misses: int
    min_existence: float
    group: int
    group_size: int
    suppressed_with: int
    class_memory: float
    clutter_intensity: float
    birth_intensity: float
    acceleration_time: float
    constant_velocity: bool
    default_size: Size
    process_noise: Spread
    noise_position: float
    noise_length: float
    noise_velocity: float
    noise_heading: float
    reported_position: float
    reported_heading: float
    birth_known: Spread
    birth_unknown: Spread
    sign_known: bool
    sign_memory: float
    sign_detection: float
    sign_motion: float
    sign_speed: float
    memory: float
    missed_evidence: float
    score_of_evidence: float
    factor_speed: float
    factor_turn_rate: float
    recall: float
    history_known: bool
    history_offset: float
    history_existence: float
    history_duration: float
    history_share: float
    history_speed: float
    knots: int
    knot_evidence: Curve
    knot_existence: Curve
    knot_along: Curve
    knot_across: Curve


Classes: TypeAlias = "Sequence[ClassRow]"
"""(C,) rows of a table, for kernels."""

_TYPES: Final = MappingProxyType(
    {
        "float": np.float64,
        "int": np.int64,
        "bool": np.bool_,
        "Size": (np.float64, (3,)),
        "Spread": (np.float64, (6,)),
        "Curve": (np.float64, (MAX_KNOTS,)),
    }
)

CLASS: Final = np.dtype([(name, _TYPES[kind]) for name, kind in ClassRow.__annotations__.items()], align=True)
"""A row of the table; the same for all profiles, so that kernels are compiled once."""


OUT_OF_REACH: Final = 2.0
"""A threshold above all scores."""


@record
class ClassTable:
    """The classes of a profile and the parameters common to them.

    Attributes:
        classes: (C,) array of `CLASS`, for kernels; `table["gate"]` is a column of it.
        period: nominal period, s.
        detection_time: s that p_d holds for, zero per frame (`optipmb.filter.detection_probability.over_time`).
        unseen_time: s since its last detection from which an object out of view is missed.
        confusion: (C, C) Lambda of `optipmb.filter.class_posterior`; (0, 0) where no two classes share a group.
        attention: (C,) of `optipmb.Sensor`; None where all are 1.
    """

    classes: Sequence[ClassRow]
    period: float
    detection_time: float
    unseen_time: float
    confusion: Array
    attention: Array | None

    def __getitem__(self, name: str) -> NDArray[Any]:
        column: NDArray[Any] = np.asarray(self.classes)[name]
        return column

    def known_boxes(self, label: Index, auxiliary: Array) -> Array:
        """Return x_A of objects (N, 4), with the usual values of their classes in place of unknown ones."""
        unknown = np.isnan(auxiliary)
        if not unknown.any():
            return auxiliary
        usual = self["default_size"][label]
        size: Array = np.where(unknown[:, :3], usual, auxiliary[:, :3])
        return np.column_stack((size, np.where(unknown[:, 3], 0.5 * size[:, 2], auxiliary[:, 3])))

    def copy(self) -> ClassTable:
        """Return a table whose classes may be written: copied as bytes, for numpy would copy field by field."""
        given: Any = self.classes
        classes: Any = np.frombuffer(bytearray(given.tobytes()), CLASS)
        times = self.period, self.detection_time, self.unseen_time
        return ClassTable(classes, *times, self.confusion, self.attention)

    def restrict(self, parameters: Parameters) -> None:
        """Put thresholds out of reach of scores, where detections start no tracks or a class has no attention."""
        if not parameters.starts_tracks:
            self["announce_score"][:] = self["birth_score"][:] = OUT_OF_REACH
        if self.attention is not None:
            self["score_filter"][self.attention == 0.0] = OUT_OF_REACH

    @classmethod
    def of(cls, parameters: Parameters) -> ClassTable:
        """Lay out the classes of a profile as a table."""
        rows = tuple(parameters.classes.values())
        groups = [(p.group,) if p.group is not None else row for row, p in enumerate(rows)]
        suppressed = [
            group if p.suppress_in_group else row for row, (p, group) in enumerate(zip(rows, groups, strict=True))
        ]
        classes: Any = np.zeros(len(rows), CLASS)
        sizes = [p.default_size or usual_size(name) for name, p in parameters.classes.items()]
        for c, (p, group) in enumerate(zip(rows, groups, strict=True)):
            shared: dict[str, Any] = {"group": groups.index(group), "group_size": groups.count(group)}
            shared |= {"suppressed_with": suppressed.index(suppressed[c]), "default_size": sizes[c]}
            if not (parameters.trust_size and parameters.trust_heading):
                shared["noise_length"] = 0.0
            for name, value in (_values(p) | shared).items():
                classes[name][c] = value
        confusion = _confusion(classes, np.array([p.class_confusion for p in rows]))
        attention = np.array([p.attention for p in rows])
        narrow = None if (attention == 1.0).all() else attention
        times = parameters.nominal_period, parameters.detection_time, parameters.unseen_time
        table = cls(classes, *times, confusion, narrow)
        table.restrict(parameters)
        return table


@kernel
def known_length(length: float, s: int, own: ClassRow) -> float:
    """Return entry `s` of a size, m; of the class's default size where it is unknown, NaN."""
    return own.default_size[s] if math.isnan(length) else length


_USUAL: Final = MappingProxyType({
    "car": (4.5, 1.9, 1.6), "truck": (8.0, 2.6, 3.2), "bus": (11.0, 2.8, 3.3), "trailer": (11.0, 2.8, 3.8),
    "pedestrian": (0.7, 0.7, 1.75), "bicycle": (1.8, 0.6, 1.7), "motorcycle": (2.1, 0.8, 1.6),
})  # fmt: skip


def usual_size(name: str) -> tuple[float, float, float]:
    """Return length, width and height of an object, m, by the meaning of its class name."""
    return _USUAL.get(common_name(name) or "", (1.5, 1.5, 1.5))


def _confusion(classes: Any, kappa: Array) -> Array:
    """Return Lambda: 1 - kappa_c on the diagonal, kappa_c / (G - 1) for the other classes of the group of c."""
    group, size = classes["group"], classes["group_size"]
    if not (size > 1).any():
        return np.zeros((0, 0))
    kappa = np.where(size > 1, kappa, 0.0)
    confusion = np.where(group[:, None] == group, (kappa / np.maximum(size - 1, 1))[:, None], 0.0)
    np.fill_diagonal(confusion, 1.0 - kappa)
    return confusion


def _values(p: ClassParameters) -> dict[str, Any]:
    """Return the row of a class but for what depends on the other classes of its group."""
    q, noise, birth, sign, calibration = p.process_noise, p.measurement_noise, p.birth, p.heading_sign, p.calibration
    values = {name: getattr(p, name) for name in ClassRow.__annotations__ if hasattr(p, name)}
    values |= {
        "clutter_intensity": p.clutter_rate / p.area,
        "birth_intensity": p.undetected_birth_rate / p.area,
        "acceleration_time": math.inf if p.acceleration_time is None else p.acceleration_time,
        "constant_velocity": p.motion == "cv",
        "process_noise": (q.position, q.position, q.speed, q.heading, q.turn_rate, q.acceleration),
        "noise_position": noise.position,
        "noise_length": noise.length,
        "noise_velocity": noise.velocity,
        "noise_heading": noise.heading,
        "reported_position": _left_over(p, "position"),
        "reported_heading": _left_over(p, "heading"),
        "memory": 1.0,
        "recall": 1.0,
    }
    for name, speed in (("birth_known", birth.speed), ("birth_unknown", birth.unknown_speed)):
        values[name] = (birth.position, birth.position, speed, birth.heading, birth.turn_rate, birth.acceleration)
    if sign is not None:
        values |= {"sign_known": True, "sign_memory": sign.memory, "sign_detection": sign.detection}
        values |= {"sign_motion": sign.motion, "sign_speed": sign.speed}
    if calibration is not None:
        values |= {
            "memory": calibration.memory,
            "missed_evidence": calibration.missed,
            "knots": len(calibration.evidence),
            "score_of_evidence": calibration.score_of_evidence,
            "factor_speed": calibration.speed,
            "factor_turn_rate": calibration.turn_rate,
        }
        if calibration.history is not None:
            values["history_known"] = True
            values |= {f"history_{name}": value for name, value in calibration.history.model_dump().items()}
        for name in ("evidence", "existence", "along", "across"):
            curve = getattr(calibration, name)
            values[f"knot_{name}"] = (*curve, *(0.0,) * (MAX_KNOTS - len(curve)))
    return values


def _left_over(parameters: ClassParameters, name: str) -> float:
    """R_x of `optipmb.filter.calibration`: 1 / (1 / R' - 1 / R), zero where boxes are reported as they are."""
    if parameters.reported_noise is None:
        return 0.0
    reported, measured = getattr(parameters.reported_noise, name), getattr(parameters.measurement_noise, name)
    precision = _precision(reported) - _precision(measured)
    return float(1.0 / precision) if precision > 0.0 else 0.0


def _precision(deviation: float) -> float:
    """1 / R; infinite where it is larger than any number."""
    try:
        return float(deviation**-2)
    except OverflowError:
        return math.inf
