"""The parameters of the tracker: one table per class, as the paper's (Section V.A) has one column per class.

A profile is a TOML file: ``name``, ``nominal_period`` and a table ``[classes.NAME]`` per class; the order of the
tables is the order of the class indices. `profiles` names the profiles of the package; own files load the same way
(`load_profile`).

Beyond the paper's table there are the quantities that the paper uses and does not give (Q, R, P0, A) and two that a
filter with survival probability one needs to forget objects (`max_misses`, `min_existence`).
"""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass
from difflib import get_close_matches
from fnmatch import fnmatchcase
from importlib import resources
from itertools import pairwise
from operator import not_
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from optipmb.model.errors import ParameterError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pydantic_core import ErrorDetails

Probability = Annotated[float, Field(ge=0.0, le=1.0)]
OpenProbability = Annotated[float, Field(gt=0.0, lt=1.0)]
NonZeroProbability = Annotated[float, Field(gt=0.0, le=1.0)]
ModerateProbability = Annotated[float, Field(ge=1e-9, le=1.0 - 1e-9)]
"""Far enough from 0 and 1 that products stay above the smallest number."""
Positive = Annotated[float, Field(ge=1e-9, le=1e9)]
"""Far enough from zero and from infinity that squares and quotients of such numbers stay finite."""
NonNegative = Annotated[float, Field(ge=0.0, le=1e9)]
Periods = Annotated[int, Field(ge=0, le=10**9)]
"""Nominal periods of the stream; as many as that are for ever."""


def _printable(name: str) -> str:
    if not name.isprintable():
        raise ValueError("a name of printable characters")
    return name


MAX_HORIZON_S: Final = 30.0
"""Farthest horizon of a predicted path, s."""

MAX_HORIZONS: Final = 100
"""Most horizons of a predicted path."""

MAX_KNOTS: Final = 32
"""Most knots of a calibration."""

HORIZONS: Final = f"at most {MAX_HORIZONS} ascending times above 0 s up to {MAX_HORIZON_S:g} s"


def _ascending(horizons: tuple[float, ...]) -> tuple[float, ...]:
    ordered = all(before < later for before, later in pairwise((0.0, *horizons)))
    if len(horizons) > MAX_HORIZONS or not ordered or (horizons and horizons[-1] > MAX_HORIZON_S):
        raise ValueError(HORIZONS)
    return horizons


ClassName = Annotated[str, Field(min_length=1, max_length=64), AfterValidator(_printable)]
"""As messages take it."""


class ParameterTable(BaseModel):
    """A table of TOML, whose fields are all known and finite."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


_T = TypeVar("_T", bound=ParameterTable)


class ProcessNoise(ParameterTable):
    """Process noise Q_k of the CTRA model, as standard deviations that grow with the square root of time.

    ``Q_k = diag(q_x, q_x, q_v, q_phi, q_omega, q_a)^2 * dt``, so that two steps of dt/2 add as much as one of dt.
    The position entry is common to x and y: nothing may prefer an axis of the world.
    """

    position: Positive = Field(description="standard deviation of x and of y gained in one second, m")
    speed: Positive = Field(description="of v, m/s")
    heading: Positive = Field(description="of phi, rad")
    turn_rate: Positive = Field(description="of omega, rad/s")
    acceleration: Positive = Field(description="of a, m/s^2")


class MeasurementNoise(ParameterTable):
    """Measurement noise R_k of the detector, as standard deviations of z_M = [x, y, v_x, v_y, phi]."""

    position: Positive = Field(description="standard deviation of x and of y, m; its square fills R_xy")
    length: NonNegative = Field(
        default=0.0,
        exclude_if=not_,
        description="of the centre along the heading for each metre of the length, where that is more than `position`",
    )
    velocity: Positive = Field(description="of v_x and of v_y, m/s; unused where a detection has no velocity")
    heading: Positive = Field(description="of phi, rad")


class ReportedNoise(ParameterTable):
    """Noise of the detector for the boxes that tracks report (`optipmb.filter.calibration`).

    An entry that is not below its counterpart in `measurement_noise` reports the state as it is.
    """

    position: Positive = Field(description="standard deviation of x and of y, m")
    heading: Positive = Field(description="of phi, rad")


class BirthSpread(ParameterTable):
    """Birth covariance P^0 of a newborn object, as standard deviations."""

    position: Positive = Field(description="of x and of y, m")
    speed: Positive = Field(description="of v when the detection brings a velocity, m/s")
    unknown_speed: Positive = Field(description="of v when it does not (v starts at 0), m/s")
    heading: Positive = Field(description="of phi, rad")
    turn_rate: Positive = Field(description="of omega, rad/s")
    acceleration: Positive = Field(description="of a, m/s^2")


class HeadingSign(ParameterTable):
    """How it is found out which way an object faces, as log odds (`optipmb.filter.lightweight`)."""

    memory: OpenProbability = Field(
        default=0.9, description="lambda: weight that the log odds keep over one nominal period"
    )
    detection: NonNegative = Field(
        default=1.0, description="b_d: log odds of a detection of score 1 that faces the same way"
    )
    motion: NonNegative = Field(default=1.0, description="b_v: log odds of a frame of driving forwards")
    speed: NonNegative = Field(default=1.0, description="v_0: speed from which an object counts as driving, m/s")


class History(ParameterTable):
    """Weights of what is known of a whole track in its existence (`optipmb.filter.calibration`)."""

    offset: float = Field(description="o: log odds of a track of which nothing is known")
    existence: NonNegative = Field(description="w_e: of the log odds of the existence by the evidence")
    duration: NonNegative = Field(description="w_T: of ln(1 + T), T the time since the first detection, s")
    share: NonNegative = Field(description="w_s: of the share of detected looks, in units of the detector's recall")
    speed: NonNegative = Field(description="w_v: of the published speed, m/s, up to a fast walk")


class Calibration(ParameterTable):
    """How the tracks of a class turned out on training data, by their evidence (`optipmb.filter.calibration`).

    From evidence to across, the fields are columns of one table, a row for each knot; between the knots the curves are
    straight, and beyond the first and the last they are level.
    """

    memory: OpenProbability = Field(description="lambda: weight that the evidence keeps over one nominal period")
    missed: NonNegative = Field(description="l_miss: log odds against a track that a missed detection counts for")
    score_of_evidence: Probability = Field(
        default=0.0,
        description="w: weight of the evidence, brought to [0, 1], in the score; the rest is x_s of the paper",
    )
    evidence: Annotated[tuple[float, ...], Field(min_length=1, max_length=MAX_KNOTS)] = Field(
        description="mean log odds of the latest detections, ascending"
    )
    existence: tuple[Probability, ...] = Field(description="share of such tracks that are of an object, not descending")
    along: tuple[NonNegative, ...] = Field(
        description="lasting error of their position along the heading, standard deviation, m"
    )
    across: tuple[NonNegative, ...] = Field(description="across the heading, m")
    speed: Positive = Field(
        default=1.0, exclude_if=(1.0).__eq__, description="factor on the standard deviation of their speed"
    )
    turn_rate: Positive = Field(default=1.0, exclude_if=(1.0).__eq__, description="the same for their turn rate")
    history: History | None = Field(
        default=None, exclude_if=lambda value: value is None, description="how the whole track counts; None: not at all"
    )

    @model_validator(mode="after")
    def _columns(self) -> Calibration:
        rows = len(self.evidence)
        for name in ("existence", "along", "across"):
            if (count := len(getattr(self, name))) != rows:
                raise ValueError(f"as many values of {name} as of evidence, {rows}, received {count}")
        if any(later <= before for before, later in pairwise(self.evidence)):
            raise ValueError(f"ascending evidence, received {list(self.evidence)}")
        if any(later < before for before, later in pairwise(self.existence)):
            raise ValueError(f"existence that does not descend, received {list(self.existence)}")
        return self


Knots = Annotated[tuple[OpenProbability, ...], Field(min_length=2, max_length=MAX_KNOTS)]


class ScoreCalibration(ParameterTable):
    """Curve from the scores of a detector to the scale of the thresholds (`optipmb.model.frame`).

    The fields are columns of one table, a row for each knot; the curve is straight from knot to knot, from (0, 0) to
    the first and from the last to (1, 1).
    """

    detector: Knots = Field(description="scores of the detector, ascending")
    calibrated: Knots = Field(description="the same on the scale of the thresholds, ascending")

    @model_validator(mode="after")
    def _columns(self) -> ScoreCalibration:
        if (count := len(self.calibrated)) != len(self.detector):
            raise ValueError(f"as many values of calibrated as of detector, {len(self.detector)}, received {count}")
        for name in ("detector", "calibrated"):
            knots = getattr(self, name)
            if any(later <= before for before, later in pairwise(knots)):
                raise ValueError(f"ascending {name}, received {list(knots)}")
        return self


class ClassParameters(ParameterTable):
    """Everything the tracker knows of one object class; the paper's symbol stands first in each description."""

    score_filter: Probability = Field(description="eta_sf: detections with a lower score are removed")
    nms_iou: Probability = Field(description="eta_iou: of two detections that overlap more, the better scored stays")
    sure_nms_iou: Probability = Field(
        default=0.0,
        exclude_if=not_,
        description="where it is larger, eta_iou of two detections whose scores have a product of 0.64 or more; the "
        "paper: 0",
    )
    survival: NonZeroProbability = Field(description="p_s: survival probability per nominal period")
    gate: Positive = Field(description="eta_dist: gating distance on the ground plane, m")
    detection: OpenProbability = Field(description="p_d0: baseline detection probability")
    expected_points: Positive = Field(description="PTS_0: number of LiDAR points in the box of an object in full view")
    detection_floor: NonZeroProbability = Field(description="s_d: remaining share of p_d0 without points")
    birth_score: Probability = Field(description="eta_score: unused detections from this score on start a track")
    announce_score: Probability = Field(
        default=0.0, exclude_if=not_, description="lower scores continue tracks and announce none; the paper: 0"
    )
    adaptive_birth_rate: Positive = Field(description="mu_ab: Poisson weight of a low-scored detection")
    baseline_birth_rate: Positive = Field(
        default=0.1, exclude_if=(0.1).__eq__, description="Poisson weight of every detection where HABM is off"
    )
    undetected_birth_rate: Positive = Field(description="mu_b0: expected undetected objects in the observed region")
    clutter_rate: Positive = Field(description="mu_c: expected false detections in a frame")
    area: Positive = Field(description="A: area of the region of observation, m^2")
    poisson_steps: Periods = Field(description="eta_step: nominal periods a Poisson component survives")
    extract_new: Probability = Field(description="eta_ext1: existence from which a track is extracted first")
    extract_known: Probability = Field(description="eta_ext2: existence from which a known track is extracted again")
    extract_misses: Periods = Field(description="eta_cnt: missed periods from which a known track is not extracted")
    max_misses: Periods = Field(description="missed periods after which a Bernoulli is removed; the paper: never")
    min_existence: OpenProbability = Field(description="existence probability below which a Bernoulli is removed")
    birth_heading_speed: NonNegative = Field(
        default=0.0,
        description="measured speed, m/s, from which a birth heads along its velocity (the paper: 0), else as its box",
    )
    heading_sign: HeadingSign | None = Field(
        default=None, description="how the sign of the heading is found; without it the sign of the birth stays"
    )
    process_noise: ProcessNoise = Field(description="Q")
    measurement_noise: MeasurementNoise = Field(description="R")
    reported_noise: ReportedNoise | None = Field(
        default=None, description="R' of the boxes that tracks report; without it they report the state"
    )
    birth: BirthSpread = Field(description="P^0")
    default_size: tuple[Positive, Positive, Positive] | None = Field(
        default=None,
        exclude_if=not_,
        description="length, width and height, m, of an object of which no detection gave them; none: by the name of "
        "the class",
    )
    motion: Literal["ctra", "cv"] = Field(
        default="ctra",
        description="motion model: constant turn rate and acceleration (the paper's), or constant velocity",
    )
    acceleration_time: Positive | None = Field(
        default=None,
        description="time constant, s, with which the acceleration decays; none: it stays constant (the paper)",
    )
    attention: Probability = Field(
        default=1.0,
        exclude_if=(1.0).__eq__,
        description="part of its time that a miss counts for, less than 1 for a sensor that detects less than others; "
        "0: it does not show the class (`optipmb.Sensor`)",
    )
    gate_deviations: NonNegative = Field(
        default=0.0,
        description="the gate holds the way of so many standard deviations of the speed, or eta_dist where that is "
        "more; the paper: 0",
    )
    velocity_gate: NonNegative = Field(
        default=0.0,
        exclude_if=not_,
        description="standard deviations from the prediction, of the velocity or the position of a detection, from "
        "which its velocity is left out; 0: it never is (the paper)",
    )
    birth_over_clutter: bool = Field(
        default=False,
        description="true: a detection from eta_score on is born unless a Poisson component explains it better than "
        "clutter; false: any component in its gate forbids the birth (the paper)",
    )
    crowded: bool = Field(
        default=False,
        exclude_if=not_,
        description="true: more clutter is expected, and gates are narrower, where detections are near each other; "
        "false: both are as elsewhere (the paper)",
    )
    birth_overlap: Probability = Field(
        default=1.0,
        exclude_if=(1.0).__eq__,
        description="overlap with the box of a missed object from which a detection starts no track (the paper: 1)",
    )
    ground_clearance: NonNegative = Field(
        default=0.0,
        description="points so far above the bottom of a box, m, are of the ground and do not count in PTS; the "
        "paper: 0",
    )
    confirm_from: Probability = Field(
        default=0.0, description="existence from which a track is confirmed; 0: every extracted track is"
    )
    confirm_until: Probability = Field(
        default=0.0, description="existence below which a confirmed track is so no longer, at most confirm_from"
    )
    group: ClassName | None = Field(
        default=None,
        description="eta_iou and the class gate take classes with the same group for one, and a track has a posterior "
        "over them (`optipmb.filter.class_posterior`); none, the paper: the class alone",
    )
    suppress_in_group: bool = Field(
        default=True, exclude_if=bool, description="true: eta_iou compares detections of the group; false: of the class"
    )
    class_confusion: ModerateProbability = Field(
        default=0.05, exclude_if=(0.05).__eq__, description="kappa: probability of another label of the group"
    )
    class_memory: ModerateProbability = Field(
        default=0.95, exclude_if=(0.95).__eq__, description="lambda: what the posterior keeps per nominal period"
    )
    score_calibration: ScoreCalibration | None = Field(
        default=None,
        description="curve from the detector's scores to the scale of the thresholds; none: they stay",
    )
    calibration: Calibration | None = Field(
        default=None, description="what tracks say of themselves; without it existence is r and the covariance is P"
    )

    @model_validator(mode="after")
    def _ordered(self) -> ClassParameters:
        if self.extract_new > self.extract_known:
            raise ValueError(f"extract_new <= extract_known, received {self.extract_new} > {self.extract_known}")
        if self.confirm_until > self.confirm_from:
            raise ValueError(f"confirm_until <= confirm_from, received {self.confirm_until} > {self.confirm_from}")
        return self


class Parameters(ParameterTable):
    """A profile: the classes to track, in the order of their indices, and the nominal period of the stream."""

    name: Annotated[str, Field(min_length=1, max_length=64, description="name of the profile, repeated in results")]
    nominal_period: Positive = Field(
        description="seconds between frames for which p_s and the counted limits hold; with another dt they are scaled"
    )
    detection_time: NonNegative = Field(
        default=0.0,
        description="time, s, that p_d holds for: a miss weighs by its share of it where frames come faster; 0: p_d "
        "holds per frame (the paper)",
    )
    self_calibration: bool = Field(
        default=False, exclude_if=not_, description="true: scores are calibrated by `optipmb.learning.self_calibration`"
    )
    unseen_time: Positive = Field(
        default=6.0,
        exclude_if=(6.0).__eq__,
        description="time, s, since its last detection from which an object out of view is missed",
    )
    starts_tracks: bool = Field(
        default=True, exclude_if=bool, description="false: detections continue tracks, and start and announce none"
    )
    trust_size: bool = Field(
        default=True, exclude_if=bool, description="false: sizes and heights of detections count as unknown"
    )
    trust_heading: bool = Field(
        default=True, exclude_if=bool, description="false: headings of detections count as unknown"
    )
    sensor_motion: bool = Field(
        default=False,
        exclude_if=not_,
        description="true: the motion of a sensor without poses is estimated (`optipmb.learning.sensor_motion`)",
    )
    horizons: Annotated[tuple[float, ...], AfterValidator(_ascending)] = Field(
        default=(),
        exclude_if=not_,  # a profile without is the document that it was before there were horizons
        description=f"times ahead, s, at which tracks carry their predicted path, {HORIZONS}; none: no paths",
    )
    provenance: str = Field(default="", max_length=10_000, description="where the values come from")
    classes: Annotated[dict[ClassName, ClassParameters], Field(min_length=1, max_length=256)] = Field(
        description="one table per class; a detection of any other class is left out and counted"
    )

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the classes in the order of their indices."""
        return tuple(self.classes)


def profiles() -> tuple[str, ...]:
    """Names of the profiles that come with the package."""
    folder = resources.files("optipmb.model").joinpath("profiles")
    return tuple(sorted(entry.name.removesuffix(".toml") for entry in folder.iterdir() if entry.name.endswith(".toml")))


def profile_source(profile: str | Path) -> str:
    """Return the text of a profile by the name of one that comes with the package, or by the path of a TOML file.

    Raises:
        ParameterError: no such profile.
    """
    if isinstance(profile, str) and profile in profiles():
        text = resources.files("optipmb.model").joinpath("profiles", f"{profile}.toml").read_text(encoding="utf-8")
    else:
        try:
            text = Path(profile).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            near = get_close_matches(str(profile).lower(), profiles(), 1, 0.6)
            meant = f" (is {near[0]} meant?)" if near else ""
            expected = f"one of {', '.join(profiles())} or a readable TOML file{meant}"
            raise ParameterError("profile", expected, f"{str(profile)!r} ({type(error).__name__})") from error
    return text


def load_profile(profile: str | Path) -> Parameters:
    """Read a profile by the name of one that comes with the package, or by the path of a TOML file.

    Raises:
        ParameterError: no such profile, no TOML, or a value that is not allowed; `path` names the field.
    """
    text = profile_source(profile)
    try:
        document = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ParameterError("profile", "TOML", f"{str(profile)!r}: {error}") from error
    return parse_parameters(document)


def parse_parameters(document: dict[str, Any]) -> Parameters:
    """Check a profile that is already in memory, as nested dictionaries.

    Raises:
        ParameterError: for the first value that is not allowed.
    """
    return checked(Parameters, document, "profile")


def checked(table: type[_T], document: Mapping[str, Any], name: str) -> _T:
    """Return a table of nested dictionaries; `name` is the path of the whole.

    Raises:
        ParameterError: for the first value that is not allowed.
    """
    try:
        return table.model_validate(document)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        path = ".".join(str(part) for part in first["loc"])
        inner = first.get("ctx", {}).get("error")
        if isinstance(inner, ParameterError):  # raised by a validator of the model
            raise ParameterError(".".join(filter(None, (path, inner.path))), inner.expected, inner.received) from None
        raise ParameterError(path or name, *_explained(first)) from error


MEASUREMENT: Final = (
    "score_filter", "nms_iou", "sure_nms_iou", "suppress_in_group", "class_confusion", "score_calibration", "gate",
    "detection", "expected_points", "detection_floor", "ground_clearance", "measurement_noise", "reported_noise",
    "clutter_rate", "area", "birth_score", "announce_score", "adaptive_birth_rate", "baseline_birth_rate",
    "undetected_birth_rate", "birth_heading_speed", "birth",
)  # fmt: skip
"""What a sensor has of its own profile, of each class."""

FLAGS: Final = ("starts_tracks", "trust_size", "trust_heading")


@dataclass(frozen=True)
class Sensor:
    """How the frames of one of several sensors of a session are used (not in the paper).

    The density does not depend on parameters other than the classes, so the frames of a sensor go through a `Tracker`
    with the parameters of the session and the measurement side of another profile (`MEASUREMENT`).
    Motion, survival, extraction and limits are not replaced.

    A miss of a sensor that detects less says less. With p the detection probability of a class in the profile of the
    session and q in the sensor's, it says as much as so many misses of the session's:

        attention a = min[1, ln(1 - q) / ln(1 - p)]

    It counts for that part of its time in the evidence of a track and in its counters, and the rest is left for the
    next frame. So a sensor that detects nothing changes nothing. A class that the profile of the sensor lacks has a =
    0: its detections are left out, and nothing of it is missed.

    Attributes:
        profile: whose measurement side holds; None: the session's own.
        starts_tracks: whether its detections start and announce tracks.
        trust_size: whether sizes and heights of its boxes are used; else they count as unknown.
        trust_heading: whether their headings are used.
    """

    profile: Parameters | None = None
    starts_tracks: bool = True
    trust_size: bool = True
    trust_heading: bool = True

    def parameters(self, session: Parameters) -> Parameters:
        """Return the parameters of its frames in a session."""
        if self == Sensor():
            return session
        values: dict[str, Any] = {name: getattr(session, name) and getattr(self, name) for name in FLAGS}
        if (own := self.profile) is not None:
            values |= {"detection_time": own.detection_time, "classes": dict(session.classes)}
            for label, known in session.classes.items():
                measured: dict[str, Any] = {"attention": 0.0}
                if (other := own.classes.get(label)) is not None:
                    measured = {name: getattr(other, name) for name in MEASUREMENT}
                    share = math.log1p(-other.detection) / math.log1p(-known.detection)
                    measured["attention"] = min(1.0, share) * other.attention
                values["classes"][label] = known.model_copy(update=measured)
        return session.model_copy(update=values)

    def shown(self) -> dict[str, Any]:
        """Return what differs from an ordinary sensor, with the name of the profile."""
        values = {name: False for name in FLAGS if not getattr(self, name)}
        return values if self.profile is None else {"profile": self.profile.name, **values}


@dataclass(frozen=True)
class Sensors:
    """How the frames of the sensors of a session are used.

    Attributes:
        uses: pairs of a pattern of streams, `site/node/sensor` with `*` for any text, and the use; the first that
            matches holds. A name without a slash is compared with the part behind the last slash of a pattern.
    """

    uses: tuple[tuple[str, Sensor], ...] = ()

    @classmethod
    def read(cls, tables: Mapping[str, Mapping[str, Any]]) -> Sensors:
        """Return what settings say, `[sensors."site/node/sensor"]` with the fields of `Sensor`, and read the profiles.

        Raises:
            ParameterError: a profile cannot be read, or a value is not allowed.
        """
        if not isinstance(tables, dict):
            raise ParameterError("sensors", "a table for each pattern of streams", repr(tables)[:80])
        return cls(tuple((pattern, _sensor(f"sensors.{pattern}", table)) for pattern, table in tables.items()))

    def parameters(self, session: Parameters, sensor: str) -> Parameters:
        """Return the parameters of the frames of a sensor; an ordinary one has the session's."""
        for pattern, use in self.uses:
            if fnmatchcase(sensor, pattern if "/" in sensor else pattern.rpartition("/")[2]):
                return use.parameters(session)
        return session

    def shown(self) -> dict[str, dict[str, Any]]:
        """Return the uses by pattern; none where all sensors are ordinary ones."""
        shown = {pattern: use.shown() for pattern, use in self.uses}
        return shown if any(shown.values()) else {}


ALIKE: Final = Sensors()
"""Sensors that do not differ."""


def _sensor(path: str, table: object) -> Sensor:
    if not isinstance(table, dict):
        raise ParameterError(path, "a table", repr(table))
    values: dict[str, Any] = {}
    for name, value in table.items():
        if name == "profile" and isinstance(value, str):
            values[name] = _sensor_profile(f"{path}.profile", value) if value else None
        elif name in FLAGS and isinstance(value, bool):
            values[name] = value
        else:
            expected = {"profile": "the name of a profile or a TOML file"} | dict.fromkeys(FLAGS, "true or false")
            if name not in expected:
                raise ParameterError(f"{path}.{name}", f"one of {', '.join(expected)}", repr(name))
            raise ParameterError(f"{path}.{name}", expected[name], repr(value))
    return Sensor(**values)


def _sensor_profile(path: str, name: str) -> Parameters:
    try:
        return load_profile(name)
    except ParameterError as error:
        where = path if error.path == "profile" else f"{path} {name}: {error.path}"
        raise ParameterError(where, error.expected, error.received) from error


def _explained(problem: ErrorDetails) -> tuple[str, str]:
    """Return the expected and the received value, without the words of the library that checks."""
    if problem["type"] == "missing":
        return "a value", "none"
    if problem["type"] == "extra_forbidden":
        known = sorted({name for model in ParameterTable.__subclasses__() for name in model.model_fields})
        near = get_close_matches(str(problem["loc"][-1]), known, 3, 0.5)
        return "a known field" + (f", such as {' or '.join(near)}" if near else ""), repr(problem["loc"][-1])
    text = problem["msg"].removeprefix("Input should be ").removeprefix("Value error, ")
    return text, repr(problem["input"])[:80]
