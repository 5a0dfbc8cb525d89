"""Collective Perception Messages (CPM, ETSI TS 103 324 V2.1.1) of confirmed tracks, for MQTT and ROS 2.

A message is a map with the names of the JSON form of Orange's its-client; both edges are written from it. Positions are
in metres east, north and up of the site's origin, angles counter-clockwise from east. The reference time is the time
of the states, so the same tracks give the same messages.
"""

from __future__ import annotations

import json
import math
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import structlog
from optipmb_schemas import json_form

from optipmb_service.edges.queues import Pace

if TYPE_CHECKING:
    from collections import Counter
    from collections.abc import Iterator

    from numpy.typing import NDArray
    from optipmb_schemas import Detections, Tracks

    from optipmb_service.settings import CpmSettings, Settings

    Values = NDArray[np.float64]

SEGMENTS: Final = 8
"""Most messages of one reference time."""

EPOCH_S: Final = 1_072_915_200
"""Beginning of TimestampIts, 2004-01-01, in seconds of UTC."""
LEAPS_S: Final = (1_136_073_600, 1_230_768_000, 1_341_100_800, 1_435_708_800, 1_483_228_800)
"""Ends of the leap seconds since then: 2006, 2009, July 2012, July 2015, 2017."""

PERIOD_S: Final = 1.0
"""Longest time between two messages that include a vehicle, and between two that name the sensors."""
VRU_S: Final = 0.5
"""The same of vulnerable road users (VRU)."""
MOVED_M: Final = 4.0
FASTER: Final = 0.5  # m/s
TURNED: Final = math.radians(4.0)
FAR_M: Final = 1310.7
NEAR_M: Final = 327.67
"""Farthest coordinate of a sensor."""
TURN: Final = 2.0 * math.pi - 1e-6
NUMBERS: Final = 2**16  # of objects
SOON: Final = 1e-6  # of a second: times are compared as floating point numbers

VEHICLES: Final = {"car": 5, "van": 5, "bus": 6, "truck": 8, "trailer": 9}
VRUS: Final = {
    "pedestrian": {"pedestrian": 1},
    "bicycle": {"bicyclist_and_light_vru_vehicle": 1},
    "cyclist": {"bicyclist_and_light_vru_vehicle": 1},
    "motorcycle": {"motorcylist": 2},  # so spelt in the schema
}
LARGE: Final = -131_071, 131_070
SIGMAS: Final = 1.96
"""Half width of the interval of 95 % of a normal distribution, in standard deviations."""

_NEVER: Final = (-math.inf, 0.0, 0.0, 0.0, 0.0)

log = structlog.get_logger("optipmb_service")


class Station:
    """The station that sends the messages of one stream: which objects it includes, and when.

    Args:
        settings: of the process.
        stream: the stream, `site/node/sensor`.
        cpm: its settings.
        most: objects of a message.

    Attributes:
        perceived: confirmed tracks of the newest frame.
        predicted: whether its states come from `outputs`.
    """

    def __init__(self, settings: Settings, stream: str, cpm: CpmSettings, most: int) -> None:
        self._stream, self._cpm, self._most = stream, cpm, most
        site = settings.sites[stream.partition("/")[0]]
        lat, lon, alt = site.origin
        self._turn = math.radians(90.0 - site.x_heading)  # of the x axis, counter-clockwise from east
        self._position = {
            "latitude": round(lat * 1e7),
            "longitude": round(lon * 1e7),
            "position_confidence_ellipse": {"semi_major": 4095, "semi_minor": 4095, "semi_major_orientation": 3601},
            "altitude": {"value": max(-100_000, min(800_000, round(alt * 100))), "confidence": 15},
        }
        self._pace = Pace(cpm.rate_hz, predict=True)
        self._newest = "", 0  # session and time of the last message
        self._included: dict[int, tuple[float, ...]] = {}  # time, east, north, speed, heading, by id
        self._sensors_s = -math.inf
        self._regions: dict[str, dict[str, Any]] = {}
        self._noted: set[str] = set()
        self.perceived = 0
        self.predicted = settings.output_of(stream) is not None

    def json(self, message: dict[str, Any], now_ns: int) -> bytes:
        """Return a message as JSON that was generated at a time since 1970."""
        source = self._cpm.source_uuid or f"com_optipmb_{self._cpm.station_id}"
        about = {"message_type": "cpm", "source_uuid": source, "timestamp": now_ns // 10**6, "version": "2.1.1"}
        return json.dumps(about | message, separators=(",", ":")).encode()

    def see(self, detections: Detections) -> None:
        """Take the field of view of a frame as the region of its sensor."""
        shape = _radial(detections, self._turn)
        self._regions[detections.stream] = {} if shape is None else {"perception_region_shape": {"radial": shape}}

    def messages(self, tracks: Tracks, left_out: Counter[str]) -> Iterator[dict[str, Any]]:
        """Yield the messages that are due after a frame, if any; count confirmed tracks without a place in them.

        In a session their times ascend: the tracks of a late frame are in none.
        """
        stamp_ns = tracks.stamp_ns if tracks.predicted_to_ns is None else tracks.predicted_to_ns
        is_correction = tracks.revision > 0 and tracks.predicted_to_ns is None  # a prediction is of another time
        is_late = tracks.session == self._newest[0] and stamp_ns < self._newest[1]
        if is_correction or is_late or not self._pace.passes(self._stream, stamp_ns):
            return
        self._newest = tracks.session, stamp_ns
        rotations = int(tracks.id.max(initial=0)) // NUMBERS % 256
        if tracks.object is not None:  # one id over gaps, as in GeoJSON and ROS 2
            numbers = np.where(tracks.object >= 0, tracks.object, tracks.id)
            tracks = tracks.model_copy(update={"id": numbers})
        now = stamp_ns / 1e9
        turn = self._turn
        places = np.column_stack([tracks.center[:, :2] @ _axes(turn).T, tracks.center[:, 2]])
        objects = _objects(tracks, self._rows(tracks, now, places, turn, left_out), places, turn)
        parts = [objects[at : at + self._most] for at in range(0, len(objects), self._most)]
        sensors = self._cpm.sensors if abs(now - self._sensors_s) >= PERIOD_S - SOON and now >= EPOCH_S else ()
        if sensors:
            self._sensors_s = now
            parts = parts or [[]]
        leaps = int(np.searchsorted(LEAPS_S, now, side="right"))
        for number, part in enumerate(parts, 1):
            management: dict[str, Any] = {
                "reference_time": stamp_ns // 10**6 + 1000 * (leaps - EPOCH_S),
                "reference_position": self._position,
            }
            if len(parts) > 1:
                management["segmentation_info"] = {"total_msg_no": len(parts), "this_msg_no": number}
            message = {"protocol_version": 2, "station_id": self._cpm.station_id, "management_container": management}
            if sensors and number == 1:
                message["sensor_information_container"] = [
                    {"sensor_id": one.id, "sensor_type": one.number, "shadowing_applies": True}
                    | self._regions.get(one.stream, {})
                    for one in sensors
                ]
            if part:
                message["perceived_object_container"] = part
            yield {"object_id_rotation_count": rotations, "message": message}

    def _rows(
        self, tracks: Tracks, now: float, places: Values, turn: float, left_out: Counter[str]
    ) -> NDArray[np.int64]:
        """Return the rows of the objects that are included now, and remember their states."""
        confirmed = np.flatnonzero(json_form.shown(tracks))
        self.perceived = len(confirmed)
        near = (np.abs(places) <= FAR_M)[confirmed].all(axis=1)
        numbers = tracks.id[confirmed] % NUMBERS
        older = np.isin(np.arange(len(confirmed)), np.unique(numbers, return_index=True)[1])
        if now < EPOCH_S:
            self._leave_out(left_out, "clock", len(confirmed))
            return confirmed[:0]
        self._leave_out(left_out, "far", int((~near).sum()))
        self._leave_out(left_out, "id", int((near & ~older).sum()))
        rows = confirmed[near & older]
        speed = np.hypot(*tracks.velocity.T)
        states = np.column_stack([np.full(len(speed), now), places[:, :2], speed, tracks.yaw + turn])
        rows = rows[self._due(tracks, rows, states)]
        if (beyond := len(rows) - SEGMENTS * self._most) > 0:
            self._leave_out(left_out, "many", beyond)
            rows = np.sort(rows[np.argsort(-tracks.existence[rows], kind="stable")[:-beyond]])
        self._included = {one: self._included[one] for one in tracks.id.tolist() if one in self._included}
        self._included |= zip(tracks.id[rows].tolist(), map(tuple, states[rows].tolist()), strict=True)
        return rows

    def _due(self, tracks: Tracks, rows: NDArray[np.int64], states: Values) -> NDArray[np.bool_]:
        """Return which rows are included now, by TS 103 324, clause 6.1.2."""
        last = np.array([self._included.get(one, _NEVER) for one in tracks.id[rows].tolist()]).reshape(-1, len(_NEVER))
        change = np.abs(states[rows] - last)
        turned = np.abs(np.remainder(states[rows, 4] - last[:, 4] + np.pi, 2.0 * np.pi) - np.pi)
        age, moved = change[:, 0], np.hypot(change[:, 1], change[:, 2])
        due: NDArray[np.bool_] = (
            (age >= PERIOD_S - SOON) | (moved > MOVED_M) | (change[:, 3] > FASTER) | (turned > TURNED)
        )
        vru = np.isin(tracks.label[rows], [at for at, name in enumerate(tracks.labels) if name.lower() in VRUS])
        due[vru] = bool((age[vru] >= VRU_S - SOON).any())  # all of them together
        return due

    def _leave_out(self, left_out: Counter[str], reason: str, count: int) -> None:
        if count:
            left_out[reason] += count
            if reason not in self._noted:
                self._noted.add(reason)
                log.warning("cpm_left_out", stream=self._stream, reason=reason, objects=count)


def station_of(settings: Settings, stream: str, most: int) -> Station | None:
    """Return the station of a stream, by the first pattern that matches; None without one."""
    found = (one for pattern, one in settings.cpm.items() if fnmatchcase(stream, pattern))
    return next((Station(settings, stream, one, most) for one in found), None)


def _objects(tracks: Tracks, rows: NDArray[np.int64], places: Values, turn: float) -> list[dict[str, Any]]:
    """Return the objects of rows; a value `n` stands for values above n - 1 up to n units."""
    count, yaw, covariance = len(rows), tracks.yaw[rows] + turn, tracks.covariance[rows]
    axes = _axes(turn)
    place = axes @ covariance[:, :2, :2] @ axes.T  # (n, 2, 2)
    velocity = tracks.velocity[rows] @ axes.T
    cos, sin = np.cos(yaw), np.sin(yaw)
    speed = velocity[:, 0] * cos + velocity[:, 1] * sin
    slopes = np.stack([np.stack([cos, -speed * sin], 1), np.stack([sin, speed * cos], 1)], 1)
    spread = slopes @ covariance[:, 2:4, 2:4] @ slopes.transpose(0, 2, 1)
    x, y = (_pairs(places[rows, k], 0.01, LARGE, place[:, k, k], (4094, 4095)) for k in (0, 1))
    z = _pairs(places[rows, 2], 0.01, LARGE, None, 4096)
    vx, vy = (_pairs(velocity[:, k], 0.01, (-16_383, 16_382), spread[:, k, k], (125, 127)) for k in (0, 1))
    angle = _pairs(np.degrees(yaw) % 360.0, 0.1, (0, 3600), np.degrees(np.degrees(covariance[:, 3, 3])), (125, 126))
    rate = _pairs(np.degrees(tracks.yaw_rate[rows]), 1.0, (-255, 255), None, 7)
    length, width, height = (_pairs(tracks.size[rows, k], 0.1, (1, 255), None, 32) for k in range(3))
    measured = np.full(count, 7) if tracks.measured is None else tracks.measured[rows]
    age = np.minimum(1500, np.round(1e3 * tracks.age[rows])).astype(int).tolist()
    quality = np.round(15.0 * tracks.existence[rows]).astype(int).tolist()
    label, certain = tracks.label[rows], np.full(count, 101)
    if tracks.class_probability is not None:
        certain = np.clip(np.round(100.0 * tracks.class_probability[rows, label]), 1, 100).astype(int)
    names = [name.lower() for name in tracks.labels]
    kinds = [
        {"vru": VRUS[one]} if one in VRUS else {"vehicle": VEHICLES[one]} if one in VEHICLES else {"other": 1}
        for one in names
    ]
    numbers, labels, sure = (tracks.id[rows] % NUMBERS).tolist(), label.tolist(), certain.tolist()
    objects = []
    for row, known in enumerate(measured.tolist()):
        angle[row]["value"] %= 3600
        one: dict[str, Any] = {
            "measurement_delta_time": 0,
            "position": {"x_coordinate": x[row], "y_coordinate": y[row]},
            "object_id": numbers[row],
            "object_age": age[row],
            "object_perception_quality": quality[row],
            "classification": [{"object_class": kinds[labels[row]], "confidence": sure[row]}],
        }
        if known & 1:
            one["velocity"] = {"cartesian_velocity": {"x_velocity": vx[row], "y_velocity": vy[row]}}
            one |= {"angles": {"z_angle": angle[row]}, "z_angular_velocity": rate[row]}
        if known & 2:
            one |= {"object_dimension_x": length[row], "object_dimension_y": width[row]}
            one["object_dimension_z"] = height[row]
        if known & 4:
            one["position"]["z_coordinate"] = z[row]
        objects.append(one)
    return objects


def _radial(detections: Detections, turn: float) -> dict[str, Any] | None:
    """Return the horizontal sector of a field of view, clockwise from north; None without one, or too far away."""
    view, pose = detections.field_of_view, detections.pose
    if view is None:
        return None
    place, yaw = np.zeros(3), turn
    if pose is not None:
        place = np.append(_axes(turn) @ pose.translation[:2], pose.translation[2])
        w, x, y, z = pose.quaternion.tolist()
        yaw += math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    if (np.abs(place) > NEAR_M).any():
        return None
    begin, end = view.azimuth.tolist()
    angles = (
        np.array([0.0, 3599.0]) if abs(end - begin) > TURN else 900.0 - 10.0 * np.degrees(yaw + np.array([end, begin]))
    )
    start, stop = (np.ceil(np.round(angles, 6)).astype(int) % 3600).tolist()
    numbers = np.ceil(np.round(place / 0.01, 6)).astype(int).tolist()
    return {
        "range": min(4095, math.ceil(round(10.0 * view.range[1], 6))),
        "stationary_horizontal_opening_angle_start": start,
        "stationary_horizontal_opening_angle_end": stop,
        "shape_reference_point": {f"{axis}_coordinate": one for axis, one in zip("xyz", numbers, strict=True)},
    }


def _axes(turn: float) -> Values:
    """Return the matrix that turns vectors of the plane counter-clockwise."""
    cos, sin = math.cos(turn), math.sin(turn)
    return np.array([[cos, -sin], [sin, cos]])


def _pairs(
    values: Values, unit: float, limits: tuple[int, int], variance: Values | None, confidence: Any
) -> list[dict[str, int]]:
    """Return values (n,) in units, up to limits, with half of their 95 % intervals.

    Args:
        values: the values.
        unit: of the values and the intervals.
        limits: least and greatest number.
        variance: (n,) variances in the square of the unit of `values`; None: not known.
        confidence: greatest number of an interval and the ones for wider and for unknown ones.
    """
    numbers = np.clip(np.ceil(np.round(values / unit, 6)), *limits).astype(int).tolist()
    if variance is None:
        sure = [confidence] * len(numbers)
    else:
        most, beyond = confidence
        wide = np.maximum(1.0, np.ceil(np.round(SIGMAS * np.sqrt(np.maximum(variance, 0.0)) / unit, 6)))
        sure = np.where(wide > most, beyond, wide).astype(int).tolist()
    return [{"value": value, "confidence": one} for value, one in zip(numbers, sure, strict=True)]
