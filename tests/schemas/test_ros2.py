"""What ROS 2 messages mean: transforms over time, clouds, shapes, types."""

import base64
import dataclasses
import json
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from optipmb_schemas import MessageError, Tracks
from optipmb_schemas.ros2.arrays import CLOUD, DETECTIONS, boxes_of, points_of
from optipmb_schemas.ros2.tracks import HORIZONS, TOPICS, messages
from optipmb_schemas.ros2.transforms import TransformError, Transforms
from optipmb_schemas.ros2.types import Types, own_types
from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat

REFERENCE = json.loads(Path(__file__).with_name("ros2_reference.json").read_text())
UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])


def turned(yaw: float) -> np.ndarray:
    return np.array([math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)])


def as_fields(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        names = (one.name for one in dataclasses.fields(value) if one.name.islower() and one.name != "__msgtype__")
        return {name: as_fields(getattr(value, name)) for name in names}  # names of constants are in capitals
    if isinstance(value, list | np.ndarray):
        return [as_fields(one) for one in value]
    return value.item() if isinstance(value, np.generic) else value


@pytest.mark.parametrize("name", REFERENCE)
def test_types_are_those_of_ros(name: str) -> None:
    """Hashes, fields and bytes of every type in use equal those by ROS 2's own code (`ros2_reference.py`)."""
    reference, types = REFERENCE[name], own_types()
    assert types.hash_of(name) == reference["hash"]
    theirs = base64.b64decode(reference["cdr"])
    message = types.read(name, theirs)
    assert as_fields(message) == reference["fields"]
    ours = types.write(message)
    assert len(ours) == len(theirs)
    assert {one for one, other in zip(ours, theirs, strict=True) if one != other} <= {0}  # ROS 2 does not clear padding


def test_all_types_that_are_used_live_have_a_reference() -> None:
    """Nothing is read or published live whose definition ROS 2 has not confirmed, but for the older Autoware's."""
    older = "autoware_auto_perception_msgs/msg/DetectedObjects"
    live = {*TOPICS.values(), CLOUD, *DETECTIONS, "tf2_msgs/msg/TFMessage", "nav_msgs/msg/Odometry"}
    assert live - {older} < set(REFERENCE)


def test_bytes_that_are_no_message_are_refused() -> None:
    """Cut, too long, empty, of another encapsulation: one error for all."""
    types = own_types()
    whole = types.write(types.new("std_msgs/msg/String", data="here"))
    assert types.read("std_msgs/msg/String", whole).data == "here"
    for data in (
        b"",
        whole[:3],
        whole[:-3],
        whole + bytes(9),
        b"\x00\x03" + whole[2:],
        b"\x00\x01\x00\x00\xff\xff\xff\xff",
    ):
        with pytest.raises(MessageError, match="CDR of std_msgs/msg/String"):
            types.read("std_msgs/msg/String", data)
    with pytest.raises(MessageError, match="wrong_type"):
        types.read("nobody_msgs/msg/Thing", whole)


def test_a_stamp_that_was_given_is_answered_as_it_was() -> None:
    """At a given stamp there is no rounding, between two stamps both parts are interpolated."""
    transforms = Transforms()
    for second in range(3):
        transforms.add("map", "base", second * 10**9, np.array([0.1 * second, 1.0, 0.0]), turned(0.3 * second))
    exact = transforms.lookup("map", "base", 10**9)
    assert exact.translation.tolist() == [0.1, 1.0, 0.0]
    half = transforms.lookup("map", "base", 15 * 10**8)
    np.testing.assert_allclose(half.translation, [0.15, 1.0, 0.0])
    np.testing.assert_allclose(half.quaternion, turned(0.45))


def test_the_shorter_way_round_is_taken() -> None:
    """A quaternion and its negative are one rotation: interpolation does not go the long way."""
    transforms = Transforms()
    transforms.add("map", "base", 0, np.zeros(3), turned(0.2))
    transforms.add("map", "base", 2, np.zeros(3), -turned(0.4))
    np.testing.assert_allclose(np.abs(transforms.lookup("map", "base", 1).quaternion), np.abs(turned(0.3)))


def test_a_chain_goes_up_and_down_the_tree() -> None:
    """A point of one sensor is found in the frame of another one, over the common frame and over static frames."""
    transforms = Transforms()
    transforms.add("map", "base", 0, np.array([10.0, 0.0, 0.0]), turned(math.pi / 2))
    transforms.add("/base", "front", 0, np.array([1.0, 0.0, 0.0]), UPRIGHT, static=True)
    transforms.add("base", "rear", 0, np.array([-1.0, 0.0, 0.0]), turned(math.pi), static=True)
    np.testing.assert_allclose(transforms.lookup("map", "front", 0).translation, [10.0, 1.0, 0.0], atol=1e-12)
    across = transforms.lookup("rear", "front", 0)
    np.testing.assert_allclose(across.translation, [-2.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(np.abs(across.quaternion), [0, 0, 0, 1], atol=1e-12)
    assert transforms.root("front") == "map"


def test_what_is_not_known_is_told_and_whether_it_can_come() -> None:
    """Unknown frames and later stamps may still come; earlier stamps and circles cannot be mended."""
    transforms = Transforms()
    transforms.add("map", "base", 5, np.zeros(3), UPRIGHT)
    transforms.add("other", "lidar", 5, np.zeros(3), UPRIGHT)
    for target, source, stamp, text, later in (
        ("map", "radar", 5, "frame 'radar'", True),
        ("map", "lidar", 5, "roots are map and other", True),
        ("map", "base", 9, "after the last", True),
        ("map", "base", 1, "before the first", False),
    ):
        with pytest.raises(TransformError, match=text) as caught:
            transforms.lookup(target, source, stamp)
        assert caught.value.later is later
    transforms.add("base", "map", 5, np.zeros(3), UPRIGHT)
    with pytest.raises(TransformError, match="circle"):
        transforms.root("base")


def test_transforms_are_bounded() -> None:
    """The oldest stamps go first, frames beyond the limit are refused, and invalid poses."""
    transforms = Transforms(kept=3, frames=2)
    for stamp in range(10):
        transforms.add("map", "base", stamp, np.zeros(3), UPRIGHT)
    with pytest.raises(TransformError, match="before the first"):
        transforms.lookup("map", "base", 6)
    assert transforms.lookup("map", "base", 7)
    transforms.add("map", "b", 0, np.zeros(3), UPRIGHT)
    with pytest.raises(MessageError, match="at most 2 frames"):
        transforms.add("map", "c", 0, np.zeros(3), UPRIGHT)
    for wrong in ((np.array([np.nan, 0, 0]), UPRIGHT), (np.zeros(3), np.zeros(4)), (np.zeros(3), UPRIGHT * np.nan)):
        with pytest.raises(MessageError, match="unit quaternion"):
            transforms.add("map", "base", 11, *wrong)
    with pytest.raises(MessageError, match="two different frames"):
        transforms.add("map", "/map", 0, np.zeros(3), UPRIGHT)


def cloud(**changes: Any) -> Any:
    """Give a cloud of 2 rows with 3 points, big endian, 64-bit z ahead of x and y, rows padded by 5 bytes."""
    point = np.dtype(
        {"names": ["z", "x", "y"], "formats": [">f8", ">f4", ">f4"], "offsets": [0, 10, 14], "itemsize": 20}
    )
    values = np.zeros((2, 3), point)
    values["x"], values["y"], values["z"] = np.arange(6).reshape(2, 3), 1, -2
    values["x"][1, 1] = np.nan
    data = np.zeros((2, 65), np.uint8)
    data[:, :60] = values.view(np.uint8).reshape(2, 60)
    fields = [
        SimpleNamespace(name=name, offset=offset, datatype=kind, count=1)
        for name, offset, kind in (("z", 0, 8), ("x", 10, 7), ("y", 14, 7))
    ]
    given = {"height": 2, "width": 3, "fields": fields, "is_bigendian": True, "point_step": 20, "row_step": 65}
    return SimpleNamespace(**(given | {"data": data.ravel()} | changes))


def test_clouds_of_any_layout_are_read() -> None:
    """Order of fields and bytes, 64 bits, padding and rows do not matter; points without a return are left out."""
    assert points_of(cloud()).tolist() == [[x, 1.0, -2.0] for x in (0.0, 1.0, 2.0, 3.0, 5.0)]
    assert points_of(cloud(height=0, width=0, data=np.empty(0, np.uint8))).shape == (0, 3)


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("floats", [("f4", "f4", "f4"), ("f8", "f8", "f8"), ("f4", "f8", "f4")])
@pytest.mark.parametrize(("height", "gap", "rest"), [(1, 0, 0), (1, 4, 0), (3, 1, 7)])
def test_every_layout_of_floats_gives_the_same_points(
    order: str, floats: tuple[str, ...], height: int, gap: int, rest: int
) -> None:
    """Byte order, 32 and 64 bits, gaps between fields, padded and organised rows."""
    xyz = np.random.default_rng(1).normal(scale=50, size=(12, 3)).astype(np.float32)
    sizes = [int(kind[1]) + gap for kind in floats]
    offsets = [gap + sum(sizes[:column]) for column in range(3)]
    point = np.dtype(
        {
            "names": list("xyz"),
            "formats": [order + kind for kind in floats],
            "offsets": offsets,
            "itemsize": gap + sum(sizes),
        }
    )
    values = np.zeros((height, 12 // height), point)
    for column, name in enumerate("xyz"):
        values[name] = xyz[:, column].reshape(values.shape)
    row = values.shape[1] * point.itemsize + rest
    data = np.full((height, row), 0x7F, np.uint8)
    data[:, : row - rest] = values.view(np.uint8).reshape(height, -1)
    fields = [
        SimpleNamespace(name=name, offset=offset, datatype={"f4": 7, "f8": 8}[kind], count=1)
        for name, offset, kind in zip("xyz", offsets, floats, strict=True)
    ]
    about = {"fields": fields, "is_bigendian": order == ">", "point_step": point.itemsize, "row_step": row}
    message = cloud(height=height, width=12 // height, data=data.ravel(), **about)
    assert np.array_equal(points_of(message), xyz)


def test_clouds_that_contradict_themselves_are_refused() -> None:
    """No read goes beyond the data, for any sizes."""
    fields = cloud().fields
    for changes, path in (
        ({"height": 3}, "data"),
        ({"row_step": 50}, "data"),
        ({"width": 2**31, "height": 2**31}, "data"),
        ({"point_step": 15}, "point_step"),
        ({"fields": fields[:2]}, "fields"),
        ({"fields": [SimpleNamespace(name="x", offset=0, datatype=2, count=1)]}, "fields"),
    ):
        with pytest.raises(MessageError) as caught:
            points_of(cloud(**changes))
        assert caught.value.path == path


def autoware(**changes: Any) -> Any:
    """Give one object of Autoware at (1, 2, 3) that looks along y."""
    types = own_types()
    package = "autoware_perception_msgs/msg"
    zero = np.zeros(36)

    def vector(x: float, y: float, z: float, kind: str = "Vector3") -> Any:
        return types.new(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)

    turn = types.new("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=math.sqrt(0.5), w=math.sqrt(0.5))
    pose = types.new("geometry_msgs/msg/Pose", position=vector(1.0, 2.0, 3.0, "Point"), orientation=turn)
    twist = types.new("geometry_msgs/msg/Twist", linear=vector(4.0, 0.0, 0.0), angular=vector(0.0, 0.0, 0.0))
    shape = {
        "type": 0,
        "footprint": types.new("geometry_msgs/msg/Polygon", points=[]),
        "dimensions": vector(4.0, 2.0, 1.5),
    }
    given: dict[str, Any] = {
        "existence_probability": 0.75,
        "classification": [
            types.new(f"{package}/ObjectClassification", label=label, probability=probability)
            for label, probability in ((1, 0.25), (2, 0.5))
        ],
        "kinematics": types.new(
            f"{package}/DetectedObjectKinematics",
            pose_with_covariance=types.new("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=zero),
            has_position_covariance=False,
            orientation_availability=2,
            twist_with_covariance=types.new("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=zero),
            has_twist=True,
            has_twist_covariance=False,
        ),
    }
    shape |= {name: changes.pop(name) for name in list(changes) if name in shape}
    given["shape"] = types.new(f"{package}/Shape", **shape)
    one = types.new(f"{package}/DetectedObject", **(given | changes))
    stamp = types.new("builtin_interfaces/msg/Time", sec=1, nanosec=2)
    header = types.new("std_msgs/msg/Header", stamp=stamp, frame_id="/lidar")
    return types.new(f"{package}/DetectedObjects", header=header, objects=[one])


def test_what_a_detector_does_not_measure_is_unknown() -> None:
    """A length of zero, an orientation that is not available, a quaternion of zeros; the twist counts all the same."""
    types = own_types()
    flat = types.new("geometry_msgs/msg/Vector3", x=4.0, y=0.0, z=0.0)
    message = autoware(dimensions=flat)
    message.objects[0].kinematics.orientation_availability = 0
    boxes = boxes_of(message)
    np.testing.assert_array_equal(boxes.size, [[4.0, np.nan, np.nan]])
    assert np.isnan(boxes.yaw).all()
    np.testing.assert_allclose(boxes.velocity, [[0.0, 4.0]], atol=1e-12)
    zeros = types.new("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=0.0)
    message = autoware()
    message.objects[0].kinematics.pose_with_covariance.pose.orientation = zeros
    boxes = boxes_of(message)
    assert np.isnan(boxes.yaw).all()
    assert boxes.size.tolist() == [[4.0, 2.0, 1.5]]
    np.testing.assert_allclose(boxes.velocity, [[4.0, 0.0]], atol=1e-12)
    with pytest.raises(MessageError, match=r"objects\[0\].shape.dimensions.y: expected a positive length"):
        boxes_of(autoware(dimensions=types.new("geometry_msgs/msg/Vector3", x=4.0, y=-1.0, z=0.0)))


def test_an_object_of_autoware_is_read_whole() -> None:
    """The likeliest class, the existence probability, and the twist turned out of the frame of the object."""
    boxes = boxes_of(autoware())
    assert (boxes.labels, boxes.score.tolist(), boxes.size.tolist()) == (("truck",), [0.75], [[4.0, 2.0, 1.5]])
    assert boxes.yaw[0] == pytest.approx(math.pi / 2)
    assert boxes.velocity is not None
    np.testing.assert_allclose(boxes.velocity, [[0.0, 4.0]], atol=1e-12)
    assert boxes_of(autoware(existence_probability=0.0)).score.tolist() == [0.5]
    assert boxes_of(autoware(), {"truck": "Lorry"}).labels == ("Lorry",)


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1), (1, 2, 0)])
@pytest.mark.parametrize("kind", ["vision_msgs", "vision_msgs before 4", "autoware"])
def test_the_likeliest_of_several_classes_is_taken(kind: str, order: tuple[int, ...]) -> None:
    """Label, score and covariance are those of the likeliest hypothesis, wherever it stands."""
    labels, scores = ("bus", "truck", "car"), (0.2, 0.7, 0.1)
    if kind == "autoware":
        message = autoware(existence_probability=0.0)
        message.objects[0].classification = [SimpleNamespace(label=(3, 2, 1)[k], probability=scores[k]) for k in order]
        assert (boxes_of(message).labels, boxes_of(message).score.tolist()) == (("truck",), [0.7])
        return
    pose = autoware().objects[0].kinematics.pose_with_covariance.pose
    results = []
    for k in order:
        one: dict[str, Any] = {"class_id" if kind == "vision_msgs" else "id": labels[k], "score": scores[k]}
        place = SimpleNamespace(covariance=np.arange(36.0) + k + 1.0)
        own = {"hypothesis": SimpleNamespace(**one)} if kind == "vision_msgs" else one
        results.append(SimpleNamespace(pose=place, **own))
    box = SimpleNamespace(center=pose, size=SimpleNamespace(x=4.0, y=2.0, z=1.5))
    array: Any = SimpleNamespace(
        __msgtype__=DETECTIONS[0],
        header=autoware().header,
        detections=[SimpleNamespace(results=results, bbox=box, id="")],
    )
    boxes = boxes_of(array, covariance=True)
    assert (boxes.labels, boxes.score.tolist()) == (("truck",), [0.7])
    assert boxes.position_covariance is not None
    assert boxes.position_covariance[0, 0, 0] == 2.0


def test_covariances_of_positions_are_read_where_asked_for() -> None:
    """Covariances of a pose's x, y and z, if the message says that it has them; zeros are unknown."""
    types, spread = own_types(), np.arange(36.0)
    message = autoware()
    kinematics = message.objects[0].kinematics
    kinematics.pose_with_covariance.covariance[:] = spread
    assert boxes_of(message, covariance=True).position_covariance is None
    kinematics.has_position_covariance = True
    assert boxes_of(message).position_covariance is None
    found = boxes_of(message, covariance=True).position_covariance
    assert found is not None
    assert found.tolist() == [[[0, 1, 2], [6, 7, 8], [12, 13, 14]]]
    pose = kinematics.pose_with_covariance
    package = "vision_msgs/msg"
    results = [
        [types.new(f"{package}/ObjectHypothesisWithPose", pose=of,
                   hypothesis=types.new(f"{package}/ObjectHypothesis", class_id="car", score=0.5))]
        for of in (pose, types.new("geometry_msgs/msg/PoseWithCovariance", pose=pose.pose, covariance=np.zeros(36)))
    ]  # fmt: skip
    size = types.new("geometry_msgs/msg/Vector3", x=1.0, y=1.0, z=1.0)
    box = types.new(f"{package}/BoundingBox3D", center=pose.pose, size=size)
    detections = [
        types.new(f"{package}/Detection3D", header=message.header, results=one, bbox=box, id="") for one in results
    ]
    array = types.new(f"{package}/Detection3DArray", header=message.header, detections=detections)
    both = boxes_of(types.read(DETECTIONS[0], types.write(array)), covariance=True).position_covariance
    assert both is not None
    assert both[0].tolist() == found[0].tolist()
    assert np.isnan(both[1]).all()


def test_a_score_of_zero_refuses_no_message() -> None:
    """An object of score 0 is read, to be left out and counted as in every other message; one below 0 is refused."""
    types = own_types()
    message = autoware(existence_probability=0.0)
    for score in (0.0, -0.5):
        message.objects[0].classification = [
            types.new("autoware_perception_msgs/msg/ObjectClassification", label=2, probability=score)
        ]
        if score < 0:
            with pytest.raises(MessageError, match=r"objects\[0\].existence_probability: expected a score in \[0, 1\]"):
                boxes_of(message)
        else:
            assert boxes_of(message).score.tolist() == [0.0]


def test_other_shapes_become_boxes() -> None:
    """A cylinder is as long as wide; the box around a polygon is where the polygon is."""
    types = own_types()
    assert boxes_of(autoware(type=1)).size.tolist() == [[4.0, 4.0, 1.5]]
    corners = [types.new("geometry_msgs/msg/Point32", x=x, y=y, z=0.0) for x, y in ((0, 0), (4, 0), (4, 1), (0, 1))]
    boxes = boxes_of(autoware(type=2, footprint=types.new("geometry_msgs/msg/Polygon", points=corners)))
    assert boxes.size.tolist() == [[4.0, 1.0, 1.5]]
    np.testing.assert_allclose(boxes.center, [[0.5, 4.0, 3.0]])
    for changes in ({"type": 2}, {"type": 7}):
        with pytest.raises(MessageError, match=r"objects\[0\].shape"):
            boxes_of(autoware(**changes))


@pytest.mark.parametrize("more", [(), (0.75, 10.0)])
def test_predicted_objects_have_the_paths_of_tracks(more: tuple[float, ...]) -> None:
    """A path is the box now and at each of the horizons of ROS; tracks without these, or without heading, say so."""
    horizons = sorted((*HORIZONS, *more))
    at = np.array(horizons)
    tracks = SimpleNamespace(
        id=np.array([4, 9]),
        labels=("car",),
        label=np.array([0, 0]),
        center=np.array([[1.0, 2.0, 3.0], [5.0, 0.0, 0.5]]),
        size=np.ones((2, 3)),
        yaw=np.array([0.25, 0.0]),
        velocity=np.zeros((2, 2)),
        yaw_rate=np.zeros(2),
        acceleration=np.zeros(2),
        existence=np.ones(2),
        score=np.ones(2),
        covariance=np.zeros((2, 6, 6)),
        horizons=at,
        path_position=np.stack([np.c_[1 + at, 2 * np.ones(len(at))], np.c_[5 - at, at]]),
        path_yaw=np.stack([0.25 + at / 8, at / 4]).astype("f4"),
    )
    tracks.measured = np.array([7, 2])
    made = dict(messages(own_types(), cast("Tracks", tracks), 5, "map", "a/b/c"))
    assert [one.kinematics.orientation_availability for one in made[""].objects] == [2, 0]
    paths = [one.kinematics.predicted_paths for one in made["/predicted"].objects]
    for row, (path,) in enumerate(paths):
        assert (path.time_step.sec, path.time_step.nanosec, path.confidence) == (0, 500_000_000, 1.0)
        assert len(path.path) == 7
        for step, pose in enumerate(path.path):
            ahead = 0.5 * step
            x, y, yaw = (1 + ahead, 2.0, 0.25 + ahead / 8) if row == 0 else (5 - ahead, ahead, ahead / 4)
            assert (pose.position.x, pose.position.y, pose.position.z) == (x, y, tracks.center[row, 2])
            assert 2 * math.atan2(pose.orientation.z, pose.orientation.w) == pytest.approx(yaw)
    for lacking in (None, at[1:]):
        tracks.horizons = lacking
        made = dict(messages(own_types(), cast("Tracks", tracks), 5, "map", "a/b/c"))
        assert [one.kinematics.predicted_paths for one in made["/predicted"].objects] == [[], []]


def test_objects_have_the_probabilities_of_their_classes() -> None:
    """One class with probability 1, or each that is possible, the most probable first; equal numbers are added up."""
    columns = {name: np.zeros(2) for name in ("yaw", "yaw_rate", "acceleration", "existence", "score")}
    tracks = SimpleNamespace(
        id=np.array([4, 9]),
        labels=("car", "truck", "van"),
        label=np.array([0, 1]),
        center=np.zeros((2, 3)),
        size=np.ones((2, 3)),
        velocity=np.zeros((2, 2)),
        covariance=np.zeros((2, 6, 6)),
        horizons=None,
        **columns,
    )

    def classes() -> list[list[tuple[int, float]]]:
        made = dict(messages(own_types(), cast("Tracks", tracks), 5, "map", "a/b/c"))
        return [[(one.label, one.probability) for one in row.classification] for row in made[""].objects]

    assert classes() == [[(1, 1.0)], [(2, 1.0)]]
    tracks.class_probability = np.array([[0.25, 0.375, 0.375], [0.0, 1.0, 0.0]])
    assert classes() == [[(1, 0.625), (2, 0.375)], [(2, 1.0)]]


def test_damaged_bytes_raise_nothing_else() -> None:
    """A message cut anywhere, or with any byte changed, is read or refused by the one error of the package."""
    types = own_types()
    whole = types.write(autoware())
    kind = "autoware_perception_msgs/msg/DetectedObjects"
    damaged = [whole[:end] for end in range(len(whole))]
    damaged += [whole[:at] + bytes([whole[at] ^ 0xFF]) + whole[at + 1 :] for at in range(len(whole))]
    refused = 0
    for data in damaged:
        try:
            boxes_of(types.read(kind, data))
        except MessageError:
            refused += 1
    assert refused > len(whole) // 2


def test_definitions_of_the_data_take_the_place_of_ours() -> None:
    """Data of a type whose fields have changed since are read as they were written."""
    name = "geometry_msgs/msg/Point"
    turned = MessageDefinition(MessageDefinitionFormat.MSG, "float64 z\nfloat64 y\nfloat64 x\n")
    data = own_types().write(own_types().new(name, x=1.0, y=2.0, z=3.0))
    there, ours = Types({name: turned}).read(name, data), Types({}).read(name, data)
    assert (there.x, there.y, there.z) == (3.0, 2.0, 1.0)
    assert (ours.x, ours.y, ours.z) == (1.0, 2.0, 3.0)
