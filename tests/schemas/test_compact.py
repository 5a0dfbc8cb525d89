"""Detections that are read without the models are what the models make of them; whatever these refuse is theirs."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from optipmb_schemas import Detections, Limits, Message, MessageError, codec, compact, decode, encode, encoded
from optipmb_schemas.compact import MOST, read_detections
from optipmb_schemas.layout import stream_end
from optipmb_schemas.limits import DEFAULT

CORPUS = Path(__file__).parents[1] / "fuzz" / "corpus" / "messages"
NAN, INF = float("nan"), float("inf")
SCALARS = (
    *(None, True, False, 0, 1, -1, 255, 256, 2**63 - 1, 2**63, 2**64 - 1, -(2**63)),
    *(0.0, -0.0, 1.0, NAN, INF, 1e8, 5e-324, "", "a", "owner/b/c", "a/b/c", "a/./c", "world", "sensor", "car", "\x00"),
    *("i8", "<i8", "f8", "<f8", ">f8", "f4", "i4", "0" * 32, "x" * 5000, b"", b"\x00", bytes(16), bytes(24)),
    *([], [3], [3.0], [True], [1], [3, 3], ["car", "car"], ["car"], {}, {"dtype": "f8"}),
    *(msgpack.Timestamp(0, 0), msgpack.ExtType(1, b"")),
)
NUMBERS = (0.0, -0.0, NAN, INF, -INF, 5e-324, -5e-324, 1.0, 1.0 + 2**-52, 1e3, 1001.0, -1e4, 1e4, 1.00001e4, 1e8, 1.1e8)
SMALL = (Limits(max_detections=2), Limits(max_labels=1), Limits(max_values=60), Limits(max_depth=3), Limits(max_text=4))


def by_models(payload: bytes, limits: Limits = DEFAULT) -> Detections:
    """Return what the walk and the models make of a payload, however it is written."""
    fields = codec._parse_msgpack(payload, limits)
    if not isinstance(fields, dict):
        raise MessageError("malformed", "", "", "")
    return codec.build(fields, Detections, limits)


def check(payload: bytes, limits: Limits = DEFAULT, made: Detections | None = None) -> bool:
    """Compare both, `made` being what the models make of it; returns whether the models were not needed."""
    read = read_detections(payload, limits)
    if read is not None:
        made = made or by_models(payload, limits)
        assert read == made
        assert repr(read) == repr(made)
        assert read.model_fields_set == made.model_fields_set
        for one, other in zip(arrays(read), arrays(made), strict=True):
            assert one.dtype == other.dtype
            for flag in ("C_CONTIGUOUS", "ALIGNED", "WRITEABLE"):
                assert one.flags[flag] == other.flags[flag]
        assert taken(read) in {None, payload}
        assert encoded(read) == encode(made)
    return read is not None


def taken(message: Detections) -> bytes | None:
    """Return the bytes that a message keeps as its encoding."""
    return getattr(message, "encoded", None)


def arrays(message: Message) -> list[Any]:
    """Return the arrays of a message and of those in it."""
    inner = [one for _, value in message.present() if isinstance(value, Message) for one in arrays(value)]
    return [value for _, value in message.present() if isinstance(value, np.ndarray)] + inner


def places(tree: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Return the paths of all values in a tree."""
    below = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    return [path, *(one for key, value in below for one in places(value, (*path, key)))]


def written(pairs: Any) -> bytes:
    """Return a tree as msgpack."""
    packed: bytes = msgpack.packb(pairs)
    return packed


@pytest.fixture
def tree(examples: dict[str, Message]) -> Any:
    """The example as maps, lists and scalars."""
    return msgpack.unpackb(encode(examples["Detections"]))


def test_what_our_encoder_writes_needs_no_models(examples: dict[str, Message]) -> None:
    """Messages with and without a pose, velocities and clouds, small ones and those whose arrays are padded."""
    example = examples["Detections"]
    many = {"label": np.zeros(700, int), "center": np.ones((700, 3)), "size": np.ones((700, 3)), "velocity": None}
    larger = dict(example.present()) | many | {"yaw": np.ones(700), "score": np.ones(700)}
    spread = np.broadcast_to(np.eye(3), (3, 3, 3))
    assert not check(encode(Detections(**(dict(example.present()) | {"position_covariance": spread}))))
    for changes in ({}, {"velocity": None}, {"has_points": None}, {"frame": "world", "pose": None}, {"frame": "world"}):
        message = example.model_copy(update=changes)
        assert check(encode(message))
        assert decode(encode(message), Detections) == message
    payload = encode(Detections(**larger))
    assert len(payload) < MOST
    assert check(payload)


def known(payload: bytes) -> bool:
    """Whether a payload has the layout of one that was read."""
    stream = stream_end(payload)
    assert stream is not None
    layouts = compact._known.get(len(payload) - stream[1], ())
    return any(one.layout.values(payload, stream[1]) is not None for one in layouts)


def test_every_byte_of_a_known_layout_replaced_by_others(examples: dict[str, Message]) -> None:
    """Whatever byte is another one, in the values or between them: what is read is what the models make of it."""
    for changes in ({}, {"velocity": None, "has_points": None}, {"frame": "world", "pose": None}):
        payload = encode(examples["Detections"].model_copy(update={"seq": 2**40, **changes}))
        assert check(payload)
        assert check(payload)
        assert known(payload)
        same, read = 0, 0
        for at, byte in enumerate(payload):
            for other in {0, 0x7F, 0xC0, 0xFF, byte ^ 1, byte ^ 0x80} - {byte}:
                changed = payload[:at] + bytes([other]) + payload[at + 1 :]
                try:
                    made = by_models(changed)
                except MessageError:
                    assert read_detections(changed, DEFAULT) is None
                else:
                    same += known(changed)
                    read += check(changed, made=made)
        assert same
        assert read


def test_streams_share_a_layout_and_other_labels_have_another(examples: dict[str, Message]) -> None:
    """A layout holds for every stream, and of several messages of one length each has its own values."""
    example = examples["Detections"].model_copy(update={"seq": 300})
    others = {"has_points": not example.has_points}, {"labels": tuple(label.upper() for label in example.labels)}
    for _ in range(3):
        for changes in ({}, *others):
            for stream in ("a/b/c", "a/b/d", "some/longer/name", f"{'long' * 8}/b/c"):
                assert check(encode(example.model_copy(update={"stream": stream, **changes})))
    payload = encode(example)
    assert known(payload)
    assert not check(payload.replace(example.stream.encode(), b"owner" + b"/" * (len(example.stream) - 5)))
    assert not check(payload, Limits(max_detections=len(example.label) - 1))


def test_the_bytes_of_a_known_layout_are_kept_where_encoding_gives_them_again(examples: dict[str, Message]) -> None:
    """So for every name of a stream, unless it moves the padding; a copy that is changed has none."""
    example = examples["Detections"].model_copy(update={"seq": 300})
    count = 200
    rows = {"label": np.zeros(count, int), "center": np.ones((count, 3)), "size": np.ones((count, 3))}
    rows |= {"yaw": np.ones(count), "score": np.ones(count), "velocity": None}
    padded = Detections(**dict(example.present()) | rows)
    streams = ["a/b/c", "a/b/d", "a/b/c12345678", f"a/b/{'c' * 27}", f"a/b/{'c' * 28}", f"a/b/{'c' * 60}"]
    for message, kept in (example, [True] * 6), (padded, [True, True, True, False, False, False]):
        compact._known.clear()
        for _ in range(2):
            decode(encode(message.model_copy(update={"stream": "a/b/c"})), Detections)
        read = [decode(encode(message.model_copy(update={"stream": stream})), Detections) for stream in streams]
        assert [taken(one) is not None for one in read] == kept
        assert all(encoded(one) == encode(one) for one in read)
        changed = read[0].model_copy(update={"seq": 301})
        assert taken(changed) is None
        assert encoded(changed) == encode(changed)
    moved = encode(padded.model_copy(update={"stream": "a/b/c"})).replace(b"\xa5a/b/c", b"\xa6a/b/cd")
    assert known(moved)
    assert taken(decode(moved, Detections)) is None


def test_bytes_that_encoding_does_not_give_again_are_not_kept(examples: dict[str, Message]) -> None:
    """Integers and names in more bytes than they need, another order of fields, other names of the number types."""
    example = examples["Detections"].model_copy(update={"seq": 300, "stream": "a/b/c"})
    payload = encode(example)
    wide = payload.replace(b"\xa3seq\xcd\x01\x2c", b"\xa3seq\xce\x00\x00\x01\x2c")
    long = payload.replace(b"\xa5a/b/c", b"\xd9\x05a/b/c")
    other = payload.replace(b"\xa5dtype\xa2f8", b"\xa5dtype\xa3<f8")
    fields = list(msgpack.unpackb(payload).items())
    turned = msgpack.packb(dict([fields[0], *reversed(fields[1:])]))
    small = payload.replace(b"\xa3seq\xcd\x01\x2c", b"\xa3seq\xcd\x00\x2c")
    compact._known.clear()
    stamp = b"\xa8stamp_ns\xcf"
    early = payload.replace(stamp + example.stamp_ns.to_bytes(8, "big"), stamp + (2**32 - 1).to_bytes(8, "big"))
    for one in (payload, wide, long, other, turned, small, early):
        for _ in range(3):
            read = decode(one, Detections)
        assert known(one)
        assert taken(read) == (payload if one is payload else None)
        assert encoded(read) == encode(read)


def test_layouts_that_are_remembered_are_few(examples: dict[str, Message]) -> None:
    """Lengths, and layouts of one length, beyond a number push out the oldest."""
    example = dict(examples["Detections"].present())
    for count in range(1, 2 * compact.MOST_LENGTHS // 3):
        rows = {"label": np.zeros(count, int), "center": np.ones((count, 3)), "size": np.ones((count, 3))}
        rows |= {"yaw": np.ones(count), "score": np.ones(count), "velocity": None}
        for seq in (2**10, 2**20, 2**40):
            assert check(encode(Detections(**example | rows | {"seq": seq})))
    for number in range(3 * compact.MOST_LAYOUTS):
        payload = encode(Detections(**example | {"seq": 2**40, "labels": [f"{number:09}{one}" for one in range(20)]}))
        assert check(payload)
        assert check(payload)
        assert known(payload)
    assert len(compact._known) <= compact.MOST_LENGTHS
    assert max(map(len, compact._known.values())) <= compact.MOST_LAYOUTS


@pytest.mark.parametrize("limits", SMALL, ids=str)
def test_limits_are_those_of_the_models(examples: dict[str, Message], limits: Limits) -> None:
    """A message above a limit is not read here."""
    payload = encode(examples["Detections"])
    assert not check(payload, limits)
    with pytest.raises(MessageError):
        decode(payload, Detections, limits=limits)


def test_every_value_replaced_by_every_other(tree: Any) -> None:
    """Any value of the message replaced, left out, or written twice: what is read is what the models make of it."""
    read = 0
    for path in places(tree)[1:]:
        for value in (*SCALARS, ...):
            changed = copy.deepcopy(tree)
            parent = changed
            for key in path[:-1]:
                parent = parent[key]
            if value is ...:
                del parent[path[-1]]
            else:
                parent[path[-1]] = copy.deepcopy(value)
            read += check(written(changed))
    assert read > 0


def test_fields_that_are_there_twice_or_unknown(tree: Any) -> None:
    """A map with a field twice, or one that nobody knows, is left to the models, in the message and inside it."""
    for path in places(tree):
        inner = tree
        for key in path:
            inner = inner[key]
        if not isinstance(inner, dict):
            continue
        packed, key = written(inner), next(iter(inner))
        for name in (key, "unknown"):
            more = bytes([packed[0] + 1]) + packed[1:] + written(name) + written(inner[key])
            assert not check(written(tree).replace(packed, more))


@settings(max_examples=200)
@given(data=st.data())
def test_every_number(examples: dict[str, Message], data: st.DataObject) -> None:
    """Numbers at and beyond the ends of every range, in any place."""
    payload = written_with(examples["Detections"], data)
    error: MessageError | None = None
    try:
        by_models(payload)
    except MessageError as refused:
        error = refused
    assert check(payload) == (error is None)
    if error is not None:
        with pytest.raises(MessageError) as raised:
            decode(payload, Detections)
        assert raised.value.args == error.args


def written_with(example: Message, data: st.DataObject) -> bytes:
    """Return the example with a few other numbers in its arrays."""
    tree = msgpack.unpackb(encode(example))
    blocks = [tree[name] for name in ("center", "size", "yaw", "score", "velocity")]
    blocks += [tree["pose"]["translation"], tree["pose"]["quaternion"]]
    blocks += [tree["field_of_view"][name] for name in ("azimuth", "elevation", "range")]
    for _ in range(data.draw(st.integers(1, 3))):
        block = data.draw(st.sampled_from(blocks))
        numbers = np.frombuffer(block["data"]).copy()
        numbers[data.draw(st.integers(0, len(numbers) - 1))] = data.draw(st.sampled_from(NUMBERS))
        block["data"] = numbers.tobytes()
    return written(tree)


@settings(max_examples=200)
@given(data=st.data())
def test_damaged_bytes(examples: dict[str, Message], data: st.DataObject) -> None:
    """Bytes flipped, cut and put in: what is read is what the models make of it."""
    payload = bytearray(encode(examples["Detections"]))
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(payload) - 1))
        match data.draw(st.sampled_from(["flip", "byte", "cut", "drop", "insert"])):
            case "flip":
                payload[at] ^= 1 << data.draw(st.integers(0, 7))
            case "byte":
                payload[at] = data.draw(st.sampled_from(b"\x00\x80\x90\xc0\xc1\xc3\xc4\xca\xd6\xd9\xdc\xde\xff"))
            case "cut" if at:
                del payload[at:]
            case "drop" if len(payload) > 1:
                del payload[at]
            case _:
                payload.insert(at, data.draw(st.sampled_from(b"\x00\x80\x90\xc0\xa1\xff")))
    check(bytes(payload))


@pytest.mark.parametrize("file", sorted(CORPUS.iterdir()), ids=lambda one: one.name)
def test_files_that_a_search_found(file: Path) -> None:
    """Every file kept for the search, whatever message it was meant to be."""
    check(file.read_bytes()[1:])
