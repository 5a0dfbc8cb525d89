"""Sensors of one session that differ in what they detect and what may be believed of it (not in the paper).

Several sensors can feed one density. It does not depend on parameters other than the classes, so the frames of each
sensor go through a `Tracker` with parameters of their own: those of the session, with the measurement side of another
profile (`MEASUREMENT`). Motion, survival, extraction and limits stay those of the session.

A miss of a sensor that detects less says less. With p the detection probability of a class in the profile of the
session and q in that of the sensor, it says as much as so many misses of the session's:

    attention a = min[1, ln(1 - q) / ln(1 - p)]

It counts for that part of its time in the evidence of a track and in its counters, and the rest is left for the next
frame. So a sensor that detects nothing changes nothing. A class that the profile of the sensor lacks has a = 0: its
detections are left out, and nothing of it is missed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any, Final

from optipmb.errors import ParameterError
from optipmb.parameters import Parameters, load_profile

if TYPE_CHECKING:
    from collections.abc import Mapping

MEASUREMENT: Final = (
    "score_filter",
    "nms_iou",
    "suppress_in_group",
    "class_confusion",
    "score_calibration",
    "gate",
    "detection",
    "expected_points",
    "detection_floor",
    "ground_clearance",
    "measurement_noise",
    "reported_noise",
    "clutter_rate",
    "area",
    "birth_score",
    "announce_score",
    "adaptive_birth_rate",
    "baseline_birth_rate",
    "undetected_birth_rate",
    "birth_heading_speed",
    "birth",
)
"""What a sensor has of its own profile."""

FLAGS: Final = ("starts_tracks", "trust_size", "trust_heading")


@dataclass(frozen=True)
class Sensor:
    """How the frames of a sensor are used.

    Attributes:
        profile: whose measurement side holds; None: that of the session.
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
        return cls(tuple((pattern, _read(f"sensors.{pattern}", table)) for pattern, table in tables.items()))

    def parameters(self, session: Parameters, sensor: str) -> Parameters:
        """Return the parameters of the frames of a sensor; those of the session where it is an ordinary one."""
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


def _read(path: str, table: object) -> Sensor:
    if not isinstance(table, dict):
        raise ParameterError(path, "a table", repr(table))
    values: dict[str, Any] = {}
    for name, value in table.items():
        if name == "profile" and isinstance(value, str):
            values[name] = _loaded(f"{path}.profile", value) if value else None
        elif name in FLAGS and isinstance(value, bool):
            values[name] = value
        else:
            expected = "true or false" if name in FLAGS else f"one of profile, {', '.join(FLAGS)}"
            raise ParameterError(f"{path}.{name}", expected, repr(value) if name in FLAGS else repr(name))
    return Sensor(**values)


def _loaded(path: str, name: str) -> Parameters:
    try:
        return load_profile(name)
    except ParameterError as error:
        where = path if error.path == "profile" else f"{path} {name}: {error.path}"
        raise ParameterError(where, error.expected, error.received) from error
