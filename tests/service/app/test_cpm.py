"""Collective perception messages: their form, what their numbers mean, and which objects they include.

`SCHEMA` allows what the schema 2.1.1 of Orange's its-client allows of the fields that are written, and no other field.
"""

import collections
import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from optipmb_schemas import Detections
from optipmb_schemas.ros2.cpm import CPM, cpm_fields, definitions
from optipmb_schemas.ros2.types import own_types
from optipmb_service.app.configuration import SettingsInvalidError, load
from optipmb_service.edges.cpm import Station, station_of
from optipmb_service.settings import Settings
from tracks_message import tracks_message

SECOND = 10**9
AT = 1_167_609_600 * SECOND  # 2007-01-01, for which ETSI TS 102 894-2 gives the time 94,694,401,000
STREAM = "garage/gate/fused"
LABELS = ("Car", "Pedestrian", "Truck", "Bicycle", "Cone", "Motorcycle", "Bus", "Trailer")


def _whole(low: int, high: int) -> dict[str, Any]:
    return {"type": "integer", "minimum": low, "maximum": high}


def _map(optional: str = "", /, **fields: Any) -> dict[str, Any]:
    required = sorted(fields.keys() - set(optional.split()))
    return {"type": "object", "properties": fields, "required": required, "additionalProperties": False}


def _pair(low: int, high: int, least: int, most: int) -> dict[str, Any]:
    return _map(value=_whole(low, high), confidence=_whole(least, most))


COORDINATE, SPEED, SIZE = _pair(-131_072, 131_071, 1, 4096), _pair(-16_383, 16_383, 1, 127), _pair(1, 256, 1, 32)
SUBCLASS = {"type": "object", "maxProperties": 1, "minProperties": 1, "additionalProperties": False}
SUBCLASS["properties"] = {
    name: _whole(0, 15) for name in ("pedestrian", "bicyclist_and_light_vru_vehicle", "motorcylist", "animal")
}
KIND = {"type": "object", "maxProperties": 1, "minProperties": 1, "additionalProperties": False}
KIND["properties"] = {"vehicle": _whole(0, 255), "vru": SUBCLASS, "other": _whole(0, 255)}
OBJECT = _map(
    "velocity angles z_angular_velocity object_dimension_x object_dimension_y object_dimension_z",
    measurement_delta_time=_whole(-2048, 2047),
    position=_map("z_coordinate", x_coordinate=COORDINATE, y_coordinate=COORDINATE, z_coordinate=COORDINATE),
    object_id=_whole(0, 65_535),
    velocity=_map(cartesian_velocity=_map(x_velocity=SPEED, y_velocity=SPEED)),
    angles=_map(z_angle=_pair(0, 3601, 1, 127)),
    z_angular_velocity=_pair(-255, 256, 0, 7),
    **{f"object_dimension_{axis}": SIZE for axis in "xyz"},
    object_age=_whole(-2048, 2047),
    object_perception_quality=_whole(0, 15),
    classification={
        "type": "array",
        "minItems": 1,
        "maxItems": 8,
        "items": _map(object_class=KIND, confidence=_whole(1, 101)),
    },
)
PLACE = _map(
    latitude=_whole(-900_000_000, 900_000_001),
    longitude=_whole(-1_800_000_000, 1_800_000_001),
    position_confidence_ellipse=_map(
        semi_major=_whole(0, 4095), semi_minor=_whole(0, 4095), semi_major_orientation=_whole(0, 3601)
    ),
    altitude=_pair(-100_000, 800_001, 0, 15),
)
POINT = _map(**{f"{axis}_coordinate": _whole(-32_768, 32_767) for axis in "xyz"})
RADIAL = _map(
    range=_whole(0, 4095),
    stationary_horizontal_opening_angle_start=_whole(0, 3601),
    stationary_horizontal_opening_angle_end=_whole(0, 3601),
    shape_reference_point=POINT,
)
SENSOR = _map(
    "perception_region_shape",
    sensor_id=_whole(0, 255),
    sensor_type=_whole(0, 31),
    perception_region_shape=_map(radial=RADIAL),
    shadowing_applies={"type": "boolean"},
)
MANAGEMENT = _map(
    "segmentation_info",
    reference_time=_whole(0, 4_398_046_511_103),
    reference_position=PLACE,
    segmentation_info=_map(total_msg_no=_whole(1, 8), this_msg_no=_whole(1, 8)),
)
MESSAGE = _map(
    "sensor_information_container perceived_object_container",
    protocol_version=_whole(0, 255),
    station_id=_whole(0, 2**32 - 1),
    management_container=MANAGEMENT,
    sensor_information_container={"type": "array", "minItems": 1, "maxItems": 128, "items": SENSOR},
    perceived_object_container={"type": "array", "maxItems": 255, "items": OBJECT},
)
SCHEMA = _map(
    message_type={"const": "cpm"},
    source_uuid={"type": "string"},
    timestamp=_whole(1_514_764_800_000, 1_830_297_600_000),
    version={"const": "2.1.1"},
    object_id_rotation_count=_whole(0, 255),
    message=MESSAGE,
)


VALIDATOR = jsonschema.Draft202012Validator(SCHEMA)


def station(most: int = 128, x_heading: float = 90.0, **cpm: Any) -> Station:
    site = {"origin": (48.265, 11.671, 489.0), "x_heading": x_heading}
    settings = Settings(sites={"garage": site}, cpm={"garage/*/fused": {"station_id": 4711} | cpm})
    found = station_of(settings, STREAM, most)
    assert found is not None
    return found


def frame(seq: int, ids: Any, **changes: Any) -> Any:
    about = {"stamp_ns": AT + seq * SECOND // 10, "labels": LABELS, "confirmed": 1} | changes
    return tracks_message(STREAM, seq, ids, **about)


def texts(sender: Station, tracks: Any, counted: Any = None) -> list[dict[str, Any]]:
    left_out = collections.Counter() if counted is None else counted
    found = [json.loads(sender.json(one, 1_764_316_800 * SECOND)) for one in sender.messages(tracks, left_out)]
    for one in found:
        VALIDATOR.validate(one)
    return found


def objects(found: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [each for one in found for each in one["message"].get("perceived_object_container", ())]


def ids(found: list[dict[str, Any]]) -> list[int]:
    return [one["object_id"] for one in objects(found)]


@pytest.mark.parametrize("x_heading", [90.0, 0.0, 217.0])
def test_numbers_read_back_are_the_tracks_within_their_units(x_heading: float) -> None:
    """In axes east and north, whatever the site's world axes, at all magnitudes and in each quadrant."""
    count = 400
    turn = np.linspace(-7.0, 7.0, count)
    reach, speed = np.geomspace(0.01, 1300.0, count), np.geomspace(0.01, 160.0, count)
    spread = np.zeros((count, 6, 6))
    spread[:, range(4), range(4)] = np.geomspace(1e-6, 1e3, count)[:, None] * [1.0, 0.3, 0.5, 1e-3]
    spread[:, 0, 1] = spread[:, 1, 0] = 0.2 * spread[:, 0, 0]
    center = np.column_stack([reach * np.cos(3 * turn), reach * np.sin(3 * turn), 0.01 * reach])
    about: dict[str, Any] = {
        "center": center,
        "yaw": turn,
        "velocity": np.column_stack([speed * np.cos(turn), speed * np.sin(turn)]),
        "yaw_rate": 0.3 * turn,
        "size": np.geomspace(0.05, 30.0, count)[:, None] * [1.0, 0.5, 0.4],
        "existence": np.linspace(0.0, 1.0, count),
        "age": np.geomspace(0.01, 100.0, count),
        "label": np.arange(count) % len(LABELS),
        "covariance": spread,
    }
    found = texts(station(x_heading=x_heading), frame(0, range(count), **about))
    assert [one["message"]["management_container"]["segmentation_info"]["this_msg_no"] for one in found] == [1, 2, 3, 4]
    management = found[0]["message"]["management_container"]
    assert management["reference_time"] == 94_694_401_000
    assert management["reference_position"]["latitude"] == 482_650_000
    assert management["reference_position"]["altitude"]["value"] == 48_900

    east = math.radians(90.0 - x_heading)  # of the world's x axis, counter-clockwise
    axes = np.array([[math.cos(east), -math.sin(east)], [math.sin(east), math.cos(east)]])
    for row, one in enumerate(objects(found)):
        place = [one["position"][f"{axis}_coordinate"] for axis in "xyz"]
        true = [*(axes @ center[row, :2]), center[row, 2]]
        for given, value in zip(place, true, strict=True):
            assert -1e-6 <= given["value"] / 100 - value < 0.01 + 1e-6
        sigma = 1.96 * np.sqrt(np.diag(axes @ spread[row, :2, :2] @ axes.T))
        for given, value in zip(place, sigma, strict=False):
            expected = 4095 if value > 40.94 else math.ceil(round(100 * value, 6))
            assert given["confidence"] == max(1, expected)
        velocity = one["velocity"]["cartesian_velocity"]
        for given, value in zip(velocity.values(), axes @ about["velocity"][row], strict=True):
            assert -1e-6 <= given["value"] / 100 - value < 0.01 + 1e-6
        angle = one["angles"]["z_angle"]["value"] / 10 - math.degrees(turn[row] + east)
        assert -1e-6 <= (angle + 1e-6) % 360.0 < 0.1 + 1e-5
        wide = math.degrees(1.96 * math.sqrt(spread[row, 3, 3])) * 10
        assert one["angles"]["z_angle"]["confidence"] == (126 if wide > 125 else max(1, math.ceil(wide)))
        rate = np.clip(math.ceil(math.degrees(0.3 * turn[row])), -255, 255)
        assert one["z_angular_velocity"] == {"value": rate, "confidence": 7}
        for axis, value in zip("xyz", about["size"][row], strict=True):
            assert one[f"object_dimension_{axis}"]["value"] == min(255, math.ceil(round(10 * value, 6)))
        assert one["object_perception_quality"] == round(15 * about["existence"][row])
        assert one["object_age"] == min(1500, round(1e3 * about["age"][row]))
    kinds = [one["classification"][0]["object_class"] for one in objects(found)[: len(LABELS)]]
    assert kinds[:3] == [{"vehicle": 5}, {"vru": {"pedestrian": 1}}, {"vehicle": 8}]
    assert kinds[3:6] == [{"vru": {"bicyclist_and_light_vru_vehicle": 1}}, {"other": 1}, {"vru": {"motorcylist": 2}}]
    assert kinds[6:] == [{"vehicle": 6}, {"vehicle": 9}]


def test_the_confidence_of_a_velocity_turns_with_it() -> None:
    """Along the heading it is that of the speed, across that of the heading times the speed."""
    spread = np.diag([1.0, 1.0, 0.2**2, 0.01**2, 1.0, 1.0])
    (one,) = objects(texts(station(), frame(0, [1], velocity=[0.0, 10.0], yaw=math.pi / 2, covariance=spread)))
    velocity = one["velocity"]["cartesian_velocity"]
    assert velocity["x_velocity"]["confidence"] == math.ceil(196 * 0.01 * 10)
    assert velocity["y_velocity"]["confidence"] == math.ceil(196 * 0.2)
    wide = spread * 100.0
    (one,) = objects(texts(station(), frame(0, [1], velocity=[0.0, 10.0], yaw=math.pi / 2, covariance=wide)))
    assert one["velocity"]["cartesian_velocity"]["y_velocity"]["confidence"] == 127


def test_what_is_not_known_is_absent() -> None:
    """Bits of `measured`: heading, size, height; without the heading there is no velocity either."""
    found = objects(texts(station(), frame(0, range(4), measured=[0, 1, 2, 4])))
    moving = {"velocity", "angles", "z_angular_velocity"}
    sized = {f"object_dimension_{axis}" for axis in "xyz"}
    for bit, names in ((1, moving), (2, sized)):
        for row, one in enumerate(found):
            assert names & one.keys() == (names if [0, 1, 2, 4][row] & bit else set())
    assert ["z_coordinate" in one["position"] for one in found] == [False, False, False, True]


def run(label: str, **path: Any) -> list[int]:
    """Return in which of 16 frames at 10 Hz an object is included whose columns follow a path of (N,) steps."""
    sender, kept = station(), []
    for seq in range(16):
        columns = {name: np.array([value[seq]]) for name, value in path.items()}
        if ids(texts(sender, frame(seq, [1], label=LABELS.index(label), **columns))):
            kept.append(seq)
    return kept


STEPS = np.arange(16.0)[:, None]


@pytest.mark.parametrize(
    ("path", "expected"),
    [
        ({}, [0, 10]),
        ({"center": STEPS * [1.01, 0.0, 0.0]}, [0, 4, 8, 12]),
        ({"center": STEPS * [0.39, 0.0, 5.0]}, [0, 10]),
        ({"velocity": STEPS * [0.11, 0.0]}, [0, 5, 10, 15]),
        ({"velocity": STEPS * [0.049, 0.0]}, [0, 10]),
        ({"yaw": 3.1 + np.radians(2.1) * STEPS[:, 0]}, [0, 2, 4, 6, 8, 10, 12, 14]),
        ({"yaw": np.radians(0.39) * STEPS[:, 0]}, [0, 10]),
    ],
)
def test_a_vehicle_is_included_when_it_is_new_changes_or_a_second_has_passed(
    path: dict[str, Any], expected: list[int]
) -> None:
    """By more than 4 m in the plane, 0.5 m/s or 4 degrees since it was last included."""
    assert run("Car", **path) == expected
    assert run("Pedestrian", **path) == [0, 5, 10, 15]


def test_vulnerable_road_users_are_included_together() -> None:
    """As soon as one of them is new, or was not included for half a second."""
    sender = station()
    kinds = [LABELS.index(one) for one in ("Pedestrian", "Bicycle", "Motorcycle", "Car")]
    assert ids(texts(sender, frame(0, [1], label=kinds[:1]))) == [1]
    assert ids(texts(sender, frame(2, [1, 2, 3], label=kinds[:3]))) == [1, 2, 3]
    assert ids(texts(sender, frame(6, [1, 2, 3, 4], label=kinds))) == [4]
    assert ids(texts(sender, frame(7, [1, 2, 3, 4], label=kinds))) == [1, 2, 3]


def test_the_rate_is_bounded_and_corrections_are_not_sent() -> None:
    """Between two messages lies a period in sensor time; without objects none is sent. Predictions correct nothing."""
    sender = station(rate_hz=2)
    kept = [bool(texts(sender, frame(seq, [1], label=1))) for seq in range(11)]
    assert [seq for seq, one in enumerate(kept) if one] == [0, 5, 10]
    assert not texts(sender, frame(15, [1], label=1, revision=1))
    assert not texts(sender, frame(20, []))
    assert not texts(sender, frame(25, [1], confirmed=0))
    assert ids(texts(sender, frame(29, [1], label=1, revision=1, predicted_to_ns=AT + 3 * SECOND))) == [1]


def test_times_ascend_in_a_session() -> None:
    """Tracks of a late frame of another sensor are not sent; tracks of a new session are, with any clock."""
    sender = station()
    assert ids(texts(sender, frame(10, [1]))) == [1]
    assert not texts(sender, frame(8, [2]))
    assert ids(texts(sender, frame(11, [2]))) == [2]
    assert ids(texts(sender, frame(5, [3], session="f" * 32))) == [3]


def test_sensors_are_named_once_a_second() -> None:
    """Also without objects."""
    sender = station(sensors=[{"id": 3, "type": "lidar"}, {"id": 4, "type": "monovideo"}])
    found = [texts(sender, frame(seq, [])) for seq in range(11)]
    assert [seq for seq, one in enumerate(found) if one] == [0, 10]
    assert [one["sensor_type"] for one in found[10][0]["message"]["sensor_information_container"]] == [2, 3]


@pytest.mark.parametrize(
    ("azimuth", "expected"),
    [((-math.pi / 4, math.pi / 2), (3600 - 900, 450)), ((-math.pi, math.pi), (0, 3599))],
)
def test_the_region_of_a_sensor_is_its_newest_field_of_view(
    azimuth: tuple[float, float], expected: tuple[int, int]
) -> None:
    """A sector clockwise from north, at the place of the sensor; none without a field of view, or too far away."""
    sender = station(x_heading=0.0, sensors=[{"id": 3, "type": "lidar", "stream": "garage/gate/lidar"}])
    view = {"azimuth": azimuth, "elevation": [-1, 1], "range": [0, 80.05]}
    about: dict[str, Any] = {
        "stream": "garage/gate/lidar",
        "epoch": bytes(16),
        "seq": 0,
        "stamp_ns": 1,
        "frame": "sensor",
    }
    about |= {
        "center": np.empty((0, 3)),
        "size": np.empty((0, 3)),
        "yaw": [],
        "score": [],
        "label": [],
        "labels": ["Car"],
    }
    found = []
    for place, given in (((10.0, 20.0, 3.0), view), ((10.0, 400.0, 3.0), view), ((10.0, 20.0, 3.0), None)):
        pose = {"translation": place, "quaternion": [1.0, 0.0, 0.0, 0.0]}
        sender.see(Detections(**about, pose=pose, field_of_view=given))
        found += texts(sender, frame(10 * len(found), []))
    first, *others = (one["message"]["sensor_information_container"][0] for one in found)
    radial = first["perception_region_shape"]["radial"]
    angles = radial["stationary_horizontal_opening_angle_start"], radial["stationary_horizontal_opening_angle_end"]
    assert (angles, radial["range"]) == (expected, 801)
    assert radial["shape_reference_point"] == {"x_coordinate": -2000, "y_coordinate": 1000, "z_coordinate": 300}
    assert all("perception_region_shape" not in one for one in others)
    types = own_types(perception=True)
    message = cpm_fields(found[0]["message"], 0)
    sensor = plain(types.read(CPM, types.write(types.new(CPM, **message))))["payload"]["cpm_containers"][0]
    (sensor,) = sensor["container_data_sensor_information_container"]
    assert sensor["perception_region_shape"] == {"radial": radial}


def test_the_id_is_that_of_the_object() -> None:
    """A track that was joined over a gap has the id of its object, and one that is not decided its own."""
    known = {"object": [3, 2, -1], "object_probability": np.array([1.0, 0.98, 1.0], np.float32)}
    assert ids(texts(station(), frame(0, [3, 9, 11], **known))) == [3, 2, 11]


def test_objects_without_a_place_are_left_out_and_counted() -> None:
    """Too far, with the number of an older one, beyond eight messages; all of them where stamps are not in UTC."""
    counted: collections.Counter[str] = collections.Counter()
    numbers = [7, 9, 65_536 + 7, 2 * 65_536 + 8]
    place = np.array([[0.0, 0.0, 0.0], [0.0, 1310.8, 0.0], [1.0, 0.0, 0.0], [0.0, -1310.7, 0.0]])
    found = texts(station(), frame(0, numbers, center=place), counted)
    assert (ids(found), found[0]["object_id_rotation_count"]) == ([7, 8], 2)
    assert counted == {"far": 1, "id": 1}

    existence = np.linspace(0.0, 1.0, 200)[::-1]
    found = texts(station(most=20), frame(0, range(200), existence=existence), counted)
    assert ids(found) == list(range(160))
    assert [one["message"]["management_container"]["segmentation_info"]["total_msg_no"] for one in found] == [8] * 8
    assert not texts(station(), frame(0, [1, 2], stamp_ns=SECOND), counted)
    assert counted == {"far": 1, "id": 1, "many": 40, "clock": 2}


def plain(message: Any) -> Any:
    """Return a message of ROS 2 without what it needs for numbers, lists, choices and fields that are absent."""
    if isinstance(message, list):
        return [plain(one) for one in message]
    if not dataclasses.is_dataclass(message):
        return message
    found = {one.name: getattr(message, one.name) for one in dataclasses.fields(message) if one.name[0] != "_"}
    present = {name.removesuffix("_is_present"): one for name, one in found.items() if name.endswith("_is_present")}
    kept = [name for name in found if not name.endswith("_is_present") and present.get(name, True)]
    if "choice" in found:
        kept = [kept[1 + found["choice"]]]
    if kept in (["value"], ["array"]):
        return plain(found[kept[0]])
    return {name: plain(found[name]) for name in kept}


def test_the_message_of_ros_has_what_json_has() -> None:
    """Through its bytes: the same numbers under the names of the ASN.1, and no field that JSON lacks."""
    sender = station(most=20, sensors=[{"id": 3, "type": "radar"}])
    known = {"measured": np.arange(40) % 8, "label": np.arange(40) % len(LABELS), "velocity": [3.0, -4.0], "yaw": -0.9}
    first, second = texts(sender, frame(0, range(40), **known))
    types = own_types(perception=True)
    read = plain(types.read(CPM, types.write(types.new(CPM, **cpm_fields(first["message"], 300)))))
    assert read["header"] == {"protocol_version": 2, "message_id": 14, "station_id": 4711}
    management = first["message"]["management_container"]
    given = read["payload"]["management_container"]
    ellipse = {"semi_major_confidence": 4095, "semi_minor_confidence": 4095, "semi_major_orientation": 3601}
    altitude = {"altitude_value": 48_900, "altitude_confidence": 15}
    place = management["reference_position"] | {"position_confidence_ellipse": ellipse, "altitude": altitude}
    assert given == management | {"reference_position": place}
    sensors, perceived = read["payload"]["cpm_containers"]
    assert (sensors["container_id"], perceived["container_id"]) == (3, 5)
    named = sensors["container_data_sensor_information_container"]
    assert named == first["message"]["sensor_information_container"]
    perceived = perceived["container_data_perceived_object_container"]
    assert perceived["number_of_perceived_objects"] == 255
    renamed = json.dumps(first["message"]["perceived_object_container"])
    for theirs, name in (("vehicle", "vehicle_sub_class"), ("vru", "vru_sub_class"), ("other", "other_sub_class")):
        renamed = renamed.replace(f'"{theirs}"', f'"{name}"')
    assert perceived["perceived_objects"] == json.loads(renamed.replace("motorcylist", "motorcyclist"))
    assert "sensor_information_container" not in second["message"]
    assert len(dict(definitions())) == 120


@pytest.mark.parametrize(
    ("text", "error"),
    [
        (
            '[cpm."yard/*/*"]\nstation_id = 1',
            "setting cpm (from the file): yard/*/*: a site that is in sites, received yard",
        ),
        ('[cpm."*/*/*"]\nstation_id = 1', "a site that is in sites, received *"),
        ('[sites.a]\norigin = [1, 2, 3]\n[cpm."a/*/*"]\nsource_uuid = "x"', "station_id"),
        ('[mqtt]\ntopics = ["cpm"]', 'setting mqtt (from the file): topics: "cpm" needs a station'),
        ('[ros2.streams."a/b/c"]\ndetections = "/d"\ncpm = true', "streams.a/b/c.cpm: needs a station"),
        ('[sites.a]\norigin = [1, 2, 3]\n[cpm."a/*/*"]\nstation_id = 1\nsensors = [{id = 1, type = "sonar"}]', "sonar"),
    ],
)
def test_settings_without_a_place_or_a_number_are_refused(tmp_path: Path, text: str, error: str) -> None:
    """By the path of the setting."""
    path = tmp_path / "settings.toml"
    path.write_text(text)
    with pytest.raises(SettingsInvalidError) as caught:
        load(path)
    assert error in str(caught.value)
