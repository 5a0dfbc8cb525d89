"""Every rule of the messages, with the path that its error names. Each rule holds on construction and on both wires."""

import json
from typing import Any

import msgpack
import numpy as np
import pytest
from message_rules import INF, NAN, RULES, SPREAD, plain
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
    messages,
)
from optipmb_schemas.protobuf.convert import from_proto, to_proto


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


VECTORS = [[3, 4], [0, 1e-5], [NAN, NAN]]


def test_vectors_of_some_objects_survive(detections: Detections) -> None:
    """A row of NaN is an object without one, null in JSON; vectors of no objects have the least length."""
    fields = dict(detections.present()) | {"embedding": VECTORS, "embedding_model": "reid-7"}
    message = Detections(**fields)
    columns = {name: value[:0] for name, value in message.present() if name in message.arrays}
    none = Detections(**(fields | columns | {"embedding": np.empty((0, 600))}))
    for one in (message, none, from_proto(to_proto(message), Detections)):
        for payload in (encode(one), encode_json(one)):
            assert decode(payload, Detections) == one
    assert json.loads(encode_json(message))["embedding"] == [[3.0, 4.0], [0.0, float(np.float32(1e-5))], [None] * 2]
    assert none.embedding is not None
    assert none.embedding.shape == (0, 2)


@pytest.mark.parametrize(
    ("change", "path"),
    [
        ({"embedding": VECTORS[:2]}, "embedding"),
        ({"embedding": [1, 2, 3]}, "embedding[0]"),
        ({"embedding": np.ones((3, 1))}, "embedding"),
        ({"embedding": np.ones((3, 513))}, "embedding"),
        ({"embedding": [[1, 2], [1, INF], [1, 2]]}, "embedding[1][1]"),
        ({"embedding": [[1, 2], [1, NAN], [1, 2]]}, "embedding[1][1]"),
        ({"embedding": [[1, 2], [1, 2], [0, 9e-7]]}, "embedding[2]"),
        ({"embedding_model": None}, "embedding_model"),
        ({"embedding_model": ""}, "embedding_model"),
        ({"embedding_model": "x" * 65}, "embedding_model"),
    ],
)
def test_vectors_that_are_none_are_refused(change: dict[str, Any], path: str, detections: Detections) -> None:
    """Of a message and of its msgpack, with the path."""
    fields = dict(detections.present()) | {"embedding": VECTORS, "embedding_model": "reid-7"} | change
    with pytest.raises(MessageError) as made:
        Detections(**fields)
    assert (made.value.code, made.value.path) == ("invalid_value", path)
    sent = encode(Detections(**(fields | {"embedding": VECTORS, "embedding_model": "reid-7"})))
    lists = {name: np.asarray(one).tolist() if name == "embedding" else one for name, one in change.items()}
    with pytest.raises(MessageError) as read:
        decode(msgpack.packb(msgpack.unpackb(sent) | lists), Detections)
    assert read.value.path == path


@pytest.mark.parametrize("spread", [(0.99e8, 0.1, 0.1), (1.0, 1.01e-8, 1.01e-8), (1e8, 1e8, 1e8), (1e-8, 1e-8, 1e-8)])
def test_long_ellipsoids_are_covariances(spread: tuple[float, ...]) -> None:
    """However a matrix with eigenvalues within the limits is turned, it is one; with a negative one it is none."""
    turns, _ = np.linalg.qr(np.random.default_rng(2).normal(0, 1, (2000, 3, 3)))

    def accepted(*values: float) -> list[bool]:
        matrices = turns * np.array(values) @ turns.transpose(0, 2, 1)
        found: list[bool] = messages._are_covariances(matrices).tolist()
        return found

    assert all(accepted(*spread))
    assert not any(accepted(spread[0], spread[1], -1e-3 * spread[1] - 1e-14 * spread[0]))
    assert not any(accepted(spread[0], spread[1], 1.0001e8))


def test_paths_of_no_tracks_are_a_message(examples: dict[str, Message]) -> None:
    """A frame without tracks keeps its horizons in both forms, although lists of no rows cannot say how long they are.

    Paths without horizons, and more horizons than the limit, are refused.
    """
    tracks = examples["Tracks"]
    none = type(tracks)(**{name: value[:0] if tracks.arrays.get(name) and name != "horizons" else value
                           for name, value in tracks.present()})  # fmt: skip
    assert isinstance(none, Tracks)
    assert none.path_covariance is not None
    assert none.path_covariance.shape == (0, 3, 2, 2)
    assert none.class_probability is not None
    assert none.class_probability.shape == (0, 2)
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
    """The text of an error has the place, the expected and the received value, and never more than a line."""
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
    """For any received value, the error quotes at most 80 printable ASCII characters of it."""
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
