"""Every rule of the messages, with the path that its error names. Each rule holds on construction and on both wires."""

import json
from typing import Any

import msgpack
import numpy as np
import pytest
from optipmb_schemas import (
    Detections,
    Limits,
    Message,
    MessageError,
    Points,
    Pose,
    Problem,
    SessionParameters,
    Tracks,
    decode,
    encode,
    encode_json,
)

NAN = float("nan")
INF = float("inf")
HUGE = 10**30
SPREAD = [[0.5, 0.1, 0], [0.1, 0.25, 0], [0, 0, 1]]

# type, field, value, path of the error
RULES: list[tuple[str, str, Any, str]] = [
    # header
    ("Detections", "stream", "site/node", "stream"),
    ("Detections", "stream", "a/b/c/d", "stream"),
    ("Detections", "stream", "a/b c/d", "stream"),
    ("Detections", "stream", "a/b/c\n", "stream"),
    ("Detections", "stream", "a/b/@c", "stream"),
    ("Detections", "stream", "a/../c", "stream"),
    ("Detections", "stream", "owner/b/c", "stream"),
    ("Detections", "stream", "service/b/c", "stream"),
    ("Detections", "stream", "a/b/" + "c" * 300, "stream"),
    ("Detections", "stream", 5, "stream"),
    ("Detections", "epoch", "00" * 15, "epoch"),
    ("Detections", "epoch", "0g" * 16, "epoch"),
    ("Detections", "epoch", 5, "epoch"),
    ("Detections", "seq", -1, "seq"),
    ("Detections", "seq", 2**63, "seq"),
    ("Detections", "seq", 1.0, "seq"),
    ("Detections", "seq", True, "seq"),
    ("Detections", "seq", "1", "seq"),
    ("Detections", "stamp_ns", -1, "stamp_ns"),
    ("Detections", "stamp_ns", 1.5e18, "stamp_ns"),
    ("Detections", "frame", "lidar", "frame"),
    ("Detections", "frame", None, "frame"),
    ("Detections", "pose", [0, 0, 0], "pose"),
    ("Detections", "pose", {"translation": [0, 0, 0]}, "pose.quaternion"),
    ("Detections", "pose", {"translation": [0, 0], "quaternion": [1, 0, 0, 0]}, "pose.translation"),
    ("Detections", "pose", {"translation": [0, 2e8, 0], "quaternion": [1, 0, 0, 0]}, "pose.translation[1]"),
    ("Detections", "pose", {"translation": [0, 0, 0], "quaternion": [1, 0, 0, 0.1]}, "pose.quaternion"),
    ("Detections", "pose", {"translation": [0, 0, 0], "quaternion": [0, 0, 0, 0]}, "pose.quaternion"),
    ("Detections", "pose", {"translation": [0, 0, 0], "quaternion": [1, 0, 0]}, "pose.quaternion"),
    ("Detections", "field_of_view", [-1, 1], "field_of_view"),
    ("Detections", "field_of_view", {"azimuth": [-1, 1]}, "field_of_view.elevation"),
    *(
        ("Detections", "field_of_view", {"azimuth": [-1, 1], "elevation": [-1, 1], "range": [0, 9]} | wrong, path)
        for wrong, path in (
            ({"azimuth": [1, 1]}, "field_of_view.azimuth"),
            ({"azimuth": [-4, 4]}, "field_of_view.azimuth"),
            ({"azimuth": [-4, 7]}, "field_of_view.azimuth[1]"),
            ({"azimuth": [0, 1, 2]}, "field_of_view.azimuth"),
            ({"elevation": [0.1, 0]}, "field_of_view.elevation"),
            ({"elevation": [-2, 0]}, "field_of_view.elevation[0]"),
            ({"range": [5, 5]}, "field_of_view.range"),
            ({"range": [-1, 5]}, "field_of_view.range[0]"),
        )
    ),
    *(
        ("Detections", "position_covariance", [SPREAD, SPREAD, wrong], path)
        for wrong, path in (
            ([[1, 0, 0], [0, 1, 0]], "position_covariance[2]"),
            ([[1, 0.5, 0], [0.4, 1, 0], [0, 0, 1]], "position_covariance[2]"),
            ([[1, 1, 0], [1, 1, 0], [0, 0, 1]], "position_covariance[2]"),
            ([[1, 0, 0], [0, -1, 0], [0, 0, 1]], "position_covariance[2]"),
            ([[1, 0, 0], [0, 1e-9, 0], [0, 0, 1]], "position_covariance[2]"),
            ([[1, 0, 0], [0, 1.1e8, 0], [0, 0, 1]], "position_covariance[2][1][1]"),
            ([[1, 0, 0], [None] * 3, [0, 0, 1]], "position_covariance[2]"),
            ([[1, 0, 0], [0, 1, None], [0, 0, 1]], "position_covariance[2][1][2]"),
        )
    ),
    ("Detections", "position_covariance", [SPREAD] * 2, "position_covariance"),
    ("Points", "pose", {"translation": [0, "x", 0], "quaternion": [1, 0, 0, 0]}, "pose.translation[1]"),
    # labels
    ("Detections", "labels", "car", "labels"),
    ("Detections", "labels", ["car", 3], "labels[1]"),
    ("Detections", "labels", ["car", ""], "labels[1]"),
    ("Detections", "labels", ["car", "car"], "labels[1]"),
    ("Detections", "labels", ["car", "a\nb"], "labels[1]"),
    ("Detections", "labels", ["car", "x" * 65], "labels[1]"),
    ("Detections", "labels", [f"l{i}" for i in range(257)], "labels"),
    ("Detections", "labels", [], "label[1]"),
    ("Detections", "labels", ["car"], "label[1]"),
    ("Detections", "label", [0, -1, 0], "label[1]"),
    ("Detections", "label", [0, 1, 2], "label[2]"),
    ("Detections", "label", [0, 1, 0.5], "label[2]"),
    ("Detections", "label", [0, 1.0, 0], "label[1]"),
    ("Detections", "label", [0, 1, HUGE // 10**15], "label[2]"),
    # what the numbers of arrays are
    ("Detections", "center", [[0, 0, 0], [0, INF, 0], [0, 0, 0]], "center[1][1]"),
    ("Detections", "center", [[0, 0, 0], [0, 0, 0], [0, 0, -2e8]], "center[2][2]"),
    ("Detections", "center", [[0, 0, 0], [0, 0, NAN], [0, 0, 0]], "center[1][2]"),
    ("Detections", "center", [[0, 0, 0], [0, 0, None], [0, 0, 0]], "center[1][2]"),
    ("Detections", "center", [[0, 0, 0], [0, 0, "1"], [0, 0, 0]], "center[1][2]"),
    ("Detections", "center", [[0, 0, 0], [0, 0, True], [0, 0, 0]], "center[1][2]"),
    ("Detections", "center", [[0, 0, 0], [0, 0, [1]], [0, 0, 0]], "center[1][2]"),
    ("Detections", "size", [[1, 1, 1], [1, 1, 1], [1, 0, 1]], "size[2][1]"),
    ("Detections", "size", [[1, 1, 1], [1, 1, 1], [1, -0.0, 1]], "size[2][1]"),
    ("Detections", "size", [[1, 1, 1], [-1, 1, 1], [1, 1, 1]], "size[1][0]"),
    ("Detections", "size", [[1, 1, 1], [1, 1, 1], [1, 1, 2e4]], "size[2][2]"),
    ("Detections", "yaw", [0, NAN, 0], "yaw[1]"),
    ("Detections", "yaw", [0, 0, INF], "yaw[2]"),
    ("Detections", "yaw", [0, 0, 1e5], "yaw[2]"),
    ("Detections", "score", [0.5, 0.5, -1e-9], "score[2]"),
    ("Detections", "score", [0.5, 1.0000001, 0.5], "score[1]"),
    ("Detections", "score", [-0.5, 0.5, 0.5], "score[0]"),
    ("Detections", "score", [0.5, NAN, 0.5], "score[1]"),
    ("Detections", "velocity", [[0, 0], [NAN, 0], [0, 0]], "velocity[1][0]"),
    ("Detections", "velocity", [[0, 0], [0, NAN], [0, 0]], "velocity[1][1]"),
    ("Detections", "velocity", [[0, 0], [None, 0], [0, 0]], "velocity[1][0]"),
    ("Detections", "velocity", [[0, 0], [NAN, NAN], [INF, 0]], "velocity[2][0]"),
    ("Detections", "velocity", [[0, 0], [NAN, NAN], [0, 2e4]], "velocity[2][1]"),
    # what the shapes of arrays are
    ("Detections", "center", [[0, 0, 0], [0, 0, 0]], "center"),
    ("Detections", "size", [[1, 1, 1]] * 4, "size"),
    ("Detections", "yaw", [], "yaw"),
    ("Detections", "score", [0.5], "score"),
    ("Detections", "velocity", [[0, 0]] * 2, "velocity"),
    ("Detections", "center", [[0, 0, 0], [0, 0], [0, 0, 0]], "center[1]"),
    ("Detections", "center", [[0, 0]] * 3, "center[0]"),
    ("Detections", "center", [0, 0, 0], "center[0]"),
    ("Detections", "center", [[0, 0, 0], 7, [0, 0, 0]], "center[1]"),
    ("Detections", "yaw", [[0], [0], [0]], "yaw[0]"),
    ("Detections", "yaw", 1.5, "yaw"),
    ("Detections", "yaw", "abc", "yaw"),
    ("Detections", "has_points", 1, "has_points"),
    ("Detections", "has_points", "yes", "has_points"),
    ("Points", "xyz", [[0, 0, 0], [0, INF, 0]], "xyz[1][1]"),
    ("Points", "xyz", [[0, 0, 0], [0, 1e39, 0]], "xyz[1][1]"),
    ("Points", "xyz", [[0, 0, 0], [0, NAN, 0]], "xyz[1][1]"),
    ("Points", "xyz", [[0, 0], [0, 0]], "xyz[0]"),
    ("Points", "xyz", [[0] * 65], "xyz[0]"),
    # tracks
    ("Tracks", "session", "xyz", "session"),
    ("Tracks", "session", "F" * 32, "session"),
    ("Tracks", "session", "f" * 33, "session"),
    ("Tracks", "profile", "../secret", "profile"),
    ("Tracks", "profile", "", "profile"),
    ("Tracks", "revision", -1, "revision"),
    ("Tracks", "gap", -1, "gap"),
    ("Tracks", "cloud_used", None, "cloud_used"),
    ("Tracks", "id", [8, 3], "id[1]"),
    ("Tracks", "id", [3, 3], "id[1]"),
    ("Tracks", "id", [-1, 3], "id[0]"),
    ("Tracks", "label", [1, 2], "label[1]"),
    ("Tracks", "existence", [0.5, 1.5], "existence[1]"),
    ("Tracks", "existence", [0.5, NAN], "existence[1]"),
    ("Tracks", "score", [-0.1, 0.5], "score[0]"),
    ("Tracks", "velocity", [[0, 0], [NAN, NAN]], "velocity[1][0]"),
    ("Tracks", "covariance", [[[0] * 6] * 6, [[0] * 6] * 5 + [[0, 0, 0, 0, 0, INF]]], "covariance[1][5][5]"),
    ("Tracks", "covariance", [[[0] * 6] * 6, [[0] * 6] * 5 + [[0] * 5]], "covariance[1][5]"),
    ("Tracks", "age", [0, -1], "age[1]"),
    ("Tracks", "time_since_detection", [0, -1], "time_since_detection[1]"),
    ("Tracks", "detection", [-2, 0], "detection[0]"),
    ("Tracks", "horizons", [0, 1, 2], "horizons[0]"),
    ("Tracks", "horizons", [1, 2, 30.1], "horizons[2]"),
    ("Tracks", "horizons", [1, 2, 2], "horizons[2]"),
    ("Tracks", "horizons", [1, 2], "path_position"),
    ("Tracks", "horizons", None, "horizons"),
    ("Tracks", "path_position", [[[1, 2]], [[1, 2]]], "path_position"),
    ("Tracks", "path_position", [[[1, 2]] * 3, [[1, 2], [1, NAN], [1, 2]]], "path_position[1][1][1]"),
    ("Tracks", "path_position", [[[1, 2]] * 3, [[1, 2]] * 2], "path_position[1]"),
    ("Tracks", "path_position", [[[1, 2, 3]] * 3] * 2, "path_position[0][0]"),
    ("Tracks", "path_yaw", [[0] * 3], "path_yaw"),
    ("Tracks", "path_yaw", None, "path_yaw"),
    ("Tracks", "path_covariance", [[[[1, 0], [0, 1e31]]] * 3] * 2, "path_covariance[0][0][1][1]"),
    ("Tracks", "delivery", {"instance": "a"}, "delivery.received_ns"),
    # control
    ("SessionParameters", "cloud_wait_s", -1, "cloud_wait_s"),
    ("SessionParameters", "cloud_wait_s", "0.1", "cloud_wait_s"),
    ("SessionParameters", "profile", "/etc/passwd", "profile"),
    ("SessionParameters", "horizons", [2.0, 1.0], "horizons[1]"),
    ("SessionParameters", "horizons", [-1.0], "horizons[0]"),
    ("SessionParameters", "horizons", 1.0, "horizons"),
    ("SessionParameters", "restart", None, "restart"),
    ("SessionParameters", "values", [1], "values"),
    ("ResetRequest", "close", 1, "close"),
    ("SessionState", "state", "old", "state"),
    ("SessionState", "epoch", "", "epoch"),
    ("Density", "weight", [0.5, -1.0], "weight[1]"),
    ("Density", "label", [0, 2], "label[1]"),
    ("Problem", "message", "x" * 501, "message"),
    ("Problem", "instance", "a/b", "instance"),
    ("Problem", "instance", "", "instance"),
    ("ServiceStatus", "sessions", [{"stream": "a/b/c", "profile": "p", "state": "s"}, {}], "sessions[1].stream"),
    ("ServiceStatus", "uptime_s", -0.5, "uptime_s"),
]


def plain(message: Message) -> dict[str, Any]:
    """Return the message as JSON has it."""
    fields: dict[str, Any] = json.loads(encode_json(message))
    return fields


@pytest.mark.parametrize(("kind", "field", "value", "path"), RULES)
def test_the_error_names_the_element(
    examples: dict[str, Message], kind: str, field: str, value: Any, path: str
) -> None:
    """A value that breaks a rule is refused with the path of the element, made here, from msgpack and from JSON."""
    message = examples[kind]
    fields = {**plain(message), field: value}
    with pytest.raises(MessageError) as made:
        type(message)(**fields)
    with pytest.raises(MessageError) as packed:
        decode(msgpack.packb(fields), type(message))
    assert made.value.path == packed.value.path == path
    text = json.dumps(fields).encode()
    with pytest.raises(MessageError) as written:
        decode(text, type(message))
    if b"NaN" not in text and b"Infinity" not in text:
        assert written.value.path == path


def test_integers_where_numbers_are_wanted(examples: dict[str, Message]) -> None:
    """Integers are numbers, in scalars and in arrays."""
    fields = {**plain(examples["Detections"]), "yaw": [1, 2, 3]}
    assert decode(json.dumps(fields).encode(), Detections).yaw.dtype == np.float64
    status = {**plain(examples["ServiceStatus"]), "uptime_s": 5}
    assert decode(json.dumps(status).encode(), type(examples["ServiceStatus"])).uptime_s == 5.0


def test_covariances_of_some_objects_survive(detections: Detections) -> None:
    """A matrix of NaN is an object without one, null in JSON; single precision is symmetric enough."""
    spread = np.array([SPREAD, np.full((3, 3), NAN), np.eye(3)])
    message = Detections(**(dict(detections.present()) | {"position_covariance": spread}))
    for payload in (encode(message), encode_json(message)):
        assert decode(payload, Detections) == message
        assert decode(payload, Detections).position_covariance is not None
    assert json.loads(encode_json(message))["position_covariance"][1] == [[None] * 3] * 3
    columns = {name: value[:0] for name, value in message.present() if name in message.arrays}
    none = Detections(**(dict(message.present()) | columns))
    for payload in (encode(none), encode_json(none)):
        assert decode(payload, Detections) == none
    root = np.random.default_rng(0).normal(0, 1, (3, 3, 3))
    single = (root @ root.transpose(0, 2, 1) + 0.01 * np.eye(3)).astype("f4")
    Detections(**(dict(detections.present()) | {"position_covariance": single}))


def test_paths_of_no_tracks_are_a_message(examples: dict[str, Message]) -> None:
    """A frame without tracks keeps its horizons in both forms, although lists of no rows cannot say how long they are.

    Paths without horizons, and more horizons than the limit, are refused.
    """
    tracks = examples["Tracks"]
    none = type(tracks)(**{name: value[:0] if tracks.arrays.get(name) and name != "horizons" else value
                           for name, value in tracks.present()})  # fmt: skip
    assert none.path_covariance.shape == (0, 3, 2, 2)  # type: ignore[attr-defined]
    for payload in (encode(none), encode_json(none)):
        assert decode(payload, Tracks) == none
    fields = plain(tracks)
    with pytest.raises(MessageError, match="horizons"):
        decode(json.dumps(fields | {"horizons": None}).encode(), Tracks)
    for payload in (encode(tracks), encode_json(tracks)):
        with pytest.raises(MessageError, match="horizons: expected at most 2 rows, received 3 rows"):
            decode(payload, Tracks, limits=Limits(max_horizons=2))
    endless = msgpack.unpackb(encode(tracks))
    endless["path_yaw"] |= {"shape": [0, 2**62], "data": b""}
    with pytest.raises(MessageError, match="path_yaw: expected at most 100 of dimension H"):
        decode(msgpack.packb(endless), Tracks)


def test_a_score_of_zero_is_valid(detections: Detections) -> None:
    """A detector may give an object the score 0: the message is valid, from msgpack and from JSON, and keeps it."""
    fields = {**plain(detections), "score": [0.5, 0, 0.5]}
    for payload in (json.dumps(fields).encode(), msgpack.packb(fields)):
        assert decode(payload, Detections).score.tolist() == [0.5, 0.0, 0.5]


def test_no_detections_are_a_message(detections: Detections) -> None:
    """A frame without objects is valid, with empty lists or with empty blocks, and keeps its shapes."""
    empty = {"label": [], "center": [], "size": [], "yaw": [], "score": [], "velocity": []}
    message = decode(json.dumps({**plain(detections), **empty}).encode(), Detections)
    assert message.center.shape == (0, 3)
    assert message.velocity is not None
    assert message.velocity.shape == (0, 2)
    made = Detections(
        **{name: getattr(detections, name) for name in ("stream", "epoch", "seq", "stamp_ns", "frame", "pose")},
        labels=(),
        label=np.empty(0, int),
        center=np.empty((0, 3)),
        size=np.empty((0, 3)),
        yaw=np.empty(0),
        score=np.empty(0),
    )
    assert made.center.shape == (0, 3)


def test_a_sensor_frame_needs_a_pose(detections: Detections) -> None:
    """Without a pose, a message in the sensor frame is incomplete; in the world frame it is not."""
    fields = {name: value for name, value in plain(detections).items() if name != "pose"}
    with pytest.raises(MessageError) as caught:
        Detections(**fields)
    assert (caught.value.code, caught.value.path) == ("missing_field", "pose")
    assert Detections(**{**fields, "frame": "world"}).pose is None


def test_null_is_absent(detections: Detections) -> None:
    """An optional field that is null is absent."""
    fields = {**plain(detections), "velocity": None, "has_points": None}
    message = decode(json.dumps(fields).encode(), Detections)
    assert message.velocity is None
    assert message.has_points is None


def test_quaternions_of_single_precision_pass() -> None:
    """The tolerance of the norm lets float32 sources through."""
    quaternion = np.array([0.1, -0.7, 0.3, 0.64031242], dtype="f4")
    assert Pose(translation=np.zeros(3), quaternion=quaternion).quaternion.dtype == np.float64


def test_errors_are_one_clear_line() -> None:
    """The text of an error says where, what was expected and what came, and never more than a line."""
    with pytest.raises(MessageError) as caught:
        Pose(translation=[0, float("nan"), 0], quaternion=[1, 0, 0, 0])
    expected = "translation[1]: expected a number in [-1e8, 1e8], received nan [invalid_value]"
    assert str(caught.value) == expected


RECEIVED = {
    "long text": "x" * 10**6,
    "odd text": "é\n\x1b[31m\ud800" * 99,
    "long integer": 10**5000,
    "bytes": b"x" * 999,
    "lists": [[1] * 99] * 99,
    "map": {"a": "b" * 999},
    "object": object(),
}


@pytest.mark.parametrize("name", RECEIVED)
def test_received_values_are_cut(name: str) -> None:
    """Whatever was received, the error quotes at most 80 printable ASCII characters of it."""
    with pytest.raises(MessageError) as caught:
        Tracks(stream=RECEIVED[name])
    assert len(caught.value.received) <= 80
    assert caught.value.received.isascii()
    assert caught.value.received.isprintable()


def test_every_error_becomes_a_problem() -> None:
    """A problem tells all that an error says, cut to the limits of its texts."""
    with pytest.raises(MessageError) as caught:
        Pose(translation=[0, float("nan"), 0], quaternion=[1, 0, 0, 0])
    problem = Problem.of(caught.value, stream="a/b/c", instance="host-1")
    assert (problem.code, problem.path, problem.received) == ("invalid_value", "translation[1]", "nan")
    assert problem.message == str(caught.value)
    long = MessageError("malformed", "p" * 999, "e" * 999, "r" * 999)
    assert len(Problem.of(long, stream="s" * 999, instance="host-1").message) == 500


def test_messages_cannot_be_changed(detections: Detections) -> None:
    """Neither fields nor array elements can be set."""
    with pytest.raises(ValueError, match="frozen"):
        detections.seq = 5
    with pytest.raises(ValueError, match="read-only"):
        detections.center[0, 0] = 5


def test_values_of_parameters_are_plain() -> None:
    """Parameter values are what JSON can say; the error names the place inside."""
    for bad, path in (
        ({"a": {"b": [0, NAN]}}, "values.a.b[1]"),
        ({"a": {"b": 2**63}}, "values.a.b"),
        ({"a": b""}, "values.a"),
        ({"a": "\ud800"}, "values.a"),
        ({"a": [[[[[[[[[[[[1]]]]]]]]]]]]}, "values.a" + "[0]" * 9),
    ):
        with pytest.raises(MessageError) as caught:
            SessionParameters(values=bad)
        assert caught.value.path == path


def test_points_of_more_columns_are_cut() -> None:
    """Further columns of a cloud, such as intensity, are dropped."""
    header = {"stream": "a/b/c", "epoch": bytes(16), "seq": 0, "stamp_ns": 0, "frame": "world"}
    rows = [[1.0, 2.0, 3.0, 0.5], [4.0, 5.0, 6.0, 0.7]]
    cloud = Points(**header, xyz=rows)
    assert cloud.xyz.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert cloud.xyz.flags.c_contiguous
    packed = msgpack.packb({**header, "xyz": rows})
    assert decode(packed, Points) == cloud
