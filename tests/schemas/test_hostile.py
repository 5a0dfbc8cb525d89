"""For any bytes, decoding gives a message or a `MessageError`, in bounded memory."""

import json
import math
import struct
import tracemalloc
from typing import Any

import msgpack
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from optipmb_schemas import (
    MESSAGES,
    PATHS,
    Detections,
    Limits,
    Message,
    MessageError,
    Points,
    Tracks,
    decode,
    encode,
    encode_json,
)

MEGABYTE = 2**20
SHOWN = 600  # characters that an error may have, path included


def attempt(payload: bytes, kind: type[Message], **options: Any) -> MessageError | None:
    """Decode; check the error. Anything but a message or a MessageError fails the test by itself."""
    try:
        assert isinstance(decode(payload, kind, **options), kind)
    except MessageError as error:
        line = str(error)
        assert line.isascii()
        assert line.isprintable()
        assert len(line) < SHOWN
        return error
    return None


def measured(payload: bytes, kind: type[Message], **options: Any) -> tuple[MessageError | None, int]:
    """Attempt to decode; return the error and the bytes that it takes at most."""
    tracemalloc.start()
    try:
        error = attempt(payload, kind, **options)
        return error, tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def peak(payload: bytes, kind: type[Message], **options: Any) -> int:
    return measured(payload, kind, **options)[1]


kinds = st.sampled_from(MESSAGES)


@settings(max_examples=150, deadline=None)
@given(payload=st.binary(max_size=300), kind=kinds)
@example(payload=b"", kind=Detections)
@example(payload=b"\xc1", kind=Detections)
@example(payload=b"\x81\xc4\x01a\x01", kind=Detections)
@example(payload=b"\x81\xa4self\x01", kind=Detections)
@example(payload=b'{"self":1}', kind=Detections)
@example(payload=b'{"\\ud800":1}', kind=Detections)
@example(payload=b"\x80", kind=Detections)
def test_random_bytes(payload: bytes, kind: type[Message]) -> None:
    """Random bytes raise nothing but MessageError, read as msgpack, as JSON or as either."""
    for encoding in ("", "application/msgpack", "application/json"):
        attempt(payload, kind, encoding=encoding)


@settings(max_examples=100, deadline=None)
@given(data=st.data(), kind=kinds, in_json=st.booleans())
def test_damaged_messages(
    examples: dict[str, Message], data: st.DataObject, kind: type[Message], *, in_json: bool
) -> None:
    """Valid messages with flipped bits, cuts and splices raise nothing but MessageError, and take little memory."""
    write = encode_json if in_json else encode
    payload = bytearray(write(examples[kind.__name__]))
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, max(0, len(payload) - 1)))
        match data.draw(st.sampled_from(["flip", "cut", "splice", "drop", "byte"])):
            case "flip" if payload:
                payload[at] ^= 1 << data.draw(st.integers(0, 7))
            case "byte" if payload:
                payload[at] = data.draw(st.sampled_from(b'\x00\x90\xc1\xc6\xca\xcb\xd9\xdb\xdc\xdd\xde\xdf\xff[{"\\,'))
            case "cut":
                del payload[at:]
            case "drop":
                del payload[at : at + data.draw(st.integers(1, 9))]
            case _:
                other = write(examples[data.draw(kinds).__name__])
                start = data.draw(st.integers(0, len(other)))
                payload[at:at] = other[start : start + data.draw(st.integers(1, 60))]
    assert peak(bytes(payload), kind) < MEGABYTE


odd_values = st.one_of(
    st.none(),
    st.booleans(),
    st.sampled_from([0, -1, 1, 2**31, 2**63, 2**64 - 1, -(2**63), 0.0, -0.0, 1.5, math.nan, math.inf, -math.inf]),
    st.sampled_from(["", "a", "a/b/c", "\x00", "é", "x" * 600, b"", b"x", bytes(16), bytes(24), [], {}, [[]], [[[]]]]),
    st.sampled_from(
        [[1], [None], [[1, 2, 3]], [True], ["1"], {"dtype": "f8"}, {"data": b""}, {"shape": [2**40, 2**40]}]
    ),
    st.sampled_from(
        [
            {"dtype": d, "shape": s, "data": x}
            for d in ("f8", ">f8", 3)
            for s in ([3], [-1], [0, 3], 3)
            for x in (b"", bytes(24), 7)
        ]
    ),
)


def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path, *(place for key, item in items for place in places(item, (*path, key)))]


def put(value: Any, path: tuple[Any, ...], new: Any) -> Any:
    if not path:
        return new
    copy = dict(value) if isinstance(value, dict) else list(value)
    copy[path[0]] = put(copy[path[0]], path[1:], new)
    return copy


@settings(max_examples=100, deadline=None)
@given(data=st.data(), kind=kinds, form=st.sampled_from(["blocks", "lists", "json"]))
def test_values_of_other_types(
    examples: dict[str, Message], data: st.DataObject, kind: type[Message], form: str
) -> None:
    """Any value of a valid message replaced by anything else raises nothing but MessageError."""
    message = examples[kind.__name__]
    plain = msgpack.unpackb(encode(message)) if form == "blocks" else json.loads(encode_json(message))
    for _ in range(data.draw(st.integers(1, 2))):
        plain = put(plain, data.draw(st.sampled_from(places(plain))), data.draw(odd_values))
    in_json = form == "json"
    attempt(json.dumps(plain, default=bytes.hex).encode() if in_json else msgpack.packb(plain), kind)


@settings(max_examples=100, deadline=None)
@given(data=st.data(), kind=kinds)
def test_fields_left_out(examples: dict[str, Message], data: st.DataObject, kind: type[Message]) -> None:
    """A message without some of its fields is complete still, or the error names a field that is left out."""
    plain = msgpack.unpackb(encode(examples[kind.__name__]))
    gone = data.draw(st.sets(st.sampled_from(sorted(plain)), min_size=1))
    error = attempt(msgpack.packb({name: value for name, value in plain.items() if name not in gone}), kind)
    required = {name for name in gone if kind.model_fields[name].is_required() or name == "pose"}
    if kind is Tracks and not gone.issuperset(PATHS):  # predicted paths are there together
        required |= gone.intersection(PATHS)
    assert (error is not None) == bool(required)
    if error:
        assert error.code == "missing_field"
        assert error.path in required


def block(shape: list[Any], data: bytes = b"", dtype: Any = "f8") -> bytes:
    return msgpack.packb({"center": {"dtype": dtype, "shape": shape, "data": data}})


BOMBS = {
    "array32 of 2^32-1": b"\xdd\xff\xff\xff\xff",
    "map32 of 2^32-1": b"\xdf\xff\xff\xff\xff",
    "str32 of 2^32-1": b"\x81\xa1a\xdb\xff\xff\xff\xff",
    "bin32 of 2^32-1": b"\x81\xa1a\xc6\xff\xff\xff\xff",
    "ext32 of 2^32-1": b"\x81\xa1a\xc9\xff\xff\xff\xff\x01",
    "fixext": b"\x81\xa1a\xd4\x01\x00",
    "timestamp": b"\x81\xa1a\xd6\xff\x00\x00\x00\x00",
    "nested arrays": b"\x81\xa1a" + b"\x91" * 100_000 + b"\xc0",
    "nested arrays, not closed": b"\x91" * 1_000_000,
    "nested arrays of many claims": b"\x81\xa1a" + b"\xdd\x00\x01\x00\x00" * 10_000,
    "nested maps": b"\x81\xa1a" * 50_000 + b"\xc0",
    "array16s inside each other": b"\xdc\xff\xff" * 1000,
    "many empty lists": b"\x81\xa1a\xdd\x00\x7f\xff\xff" + b"\x90" * 0x7FFFFF,
    "long text": b"\x81\xa1a\xda\xff\xff" + b"x" * 0xFFFF,
    "long list of labels": b"\x81\xa6labels\xdd\x00\x7f\xff\xff" + b"\xa0" * 0x7FFFFF,
    "long list as a shape": b"\x81\xa5label\x83\xa5dtype\xa2i8\xa5shape\xdd\x00\x7f\xff\xff" + bytes(0x7FFFFF),
    "labels of 2^32-1": b"\x81\xa6labels\xdd\xff\xff\xff\xff",
    "nested labels": b"\x81\xa6labels" + b"\x91" * 1_000_000 + b"\xc0",
    "shape overflow": block([2**40, 2**40]),
    "shape overflow to zero": block([2**62, 4, 2**62]),
    "shape overflow with a zero": block([2**63 - 1, 0]),
    "negative shape": block([-1, -3], bytes(24)),
    "negative rows": block([-1, 3], bytes(24)),
    "data too short": block([1000, 3], bytes(24)),
    "data without shape": block([], bytes(8)),
    "blown-up type": block([1_000_000, 3], bytes(3_000_000), "u1"),
    "object type": block([1, 3], bytes(24), "O8"),
    "big-endian type": block([1, 3], bytes(24), ">f8"),
    "structured type": block([1, 3], bytes(24), "f8,f8"),
    "json nested lists": b'{"a":' + b"[" * 1_000_000,
    "json nested lists, closed": b'{"a":' + b"[" * 100_000 + b"]" * 100_000 + b"}",
    "json nested maps": b'{"a":' * 100_000 + b"1" + b"}" * 100_000,
    "json open text of escapes": b'{"' + b'\\"' * 1_000_000,
    "json many texts": b"{" + b'"",' * 2_000_000,
    "json long integer": b'{"seq":' + b"9" * 1_000_000 + b"}",
    "json long number": b'{"seq":' + b"9" * 1_000_000 + b".5}",
    "json many empty lists": b'{"a":[' + b"[]," * 2_000_000 + b"[]]}",
}


@pytest.mark.parametrize("payload", BOMBS.values(), ids=BOMBS.keys())
def test_declared_lengths_take_no_memory(payload: bytes) -> None:
    """Crafted payloads are refused, and take a few times their own size in memory at most."""
    assert attempt(payload, Detections) is not None
    assert peak(payload, Detections) < MEGABYTE + 6 * len(payload)


SHARE = 8
EIGHTH = Limits(max_values=Limits().max_values // SHARE, max_json_bytes=Limits().max_json_bytes // SHARE)
MOST = EIGHTH.max_values - 8

WASTEFUL = {
    "empty maps": b"\x81\xa1a\xdd" + struct.pack(">I", MOST) + b"\x80" * MOST,
    "short texts": b"\x81\xa1a\xdd" + struct.pack(">I", MOST) + b"".join(b"\xa5%05x" % i for i in range(MOST)),
    "a large map": b"\x81\xa1a\xdf"
    + struct.pack(">I", MOST // 2)
    + b"".join(b"\xa5%05x\x01" % i for i in range(MOST // 2)),
    "json empty maps": b'{"a":[' + b",".join([b"{}"] * (MOST // 2)) + b"]}",
    "json large map": b'{"a":{' + b",".join(b'"%05x":1' % i for i in range(MOST // 2)) + b"}}",
    "json wide text": b'{"a":"' + b"a" * (EIGHTH.max_json_bytes - 20) + "😀".encode() + b'"}',
}


@pytest.mark.parametrize("payload", WASTEFUL.values(), ids=WASTEFUL.keys())
def test_the_worst_within_the_limits(payload: bytes) -> None:
    """As much as is allowed, in its most wasteful form, is read to the end and takes less than 70 MB.

    Memory grows with the limits, so an eighth of the limits is allowed and an eighth of that memory.
    """
    # The least of three: keys are interned, and whose key makes the interpreter enlarge its table of them is chance.
    results = [measured(payload, Detections, limits=EIGHTH) for _ in range(3)]
    assert all(error is not None and error.code == "missing_field" for error, _ in results)
    assert min(memory for _, memory in results) * SHARE < 70 * MEGABYTE


def test_size_is_checked_first() -> None:
    """A payload above the limit is refused without being looked at, in no time and memory."""
    limits = Limits(max_bytes=1000, max_json_bytes=500)
    for payload, form in ((b"\x81" + bytes(1000), "msgpack"), (b"{" + b" " * 500, "json")):
        error = attempt(payload, Detections, limits=limits)
        assert error is not None
        assert error.code == "too_large"
        assert form in error.expected
        assert peak(payload, Detections, limits=limits) < 20_000


@pytest.mark.parametrize("limit", ["max_values", "max_depth", "max_text", "max_labels", "max_detections"])
def test_every_limit_is_kept(detections: Detections, limit: str) -> None:
    """A message is refused as too large when it exceeds any limit, in both forms."""
    tight = {"max_values": 20, "max_depth": 1, "max_text": 5, "max_labels": 1, "max_detections": 2}
    limits = Limits(**{limit: tight[limit]})
    error = attempt(encode(detections), Detections, limits=limits)
    assert error is not None
    assert error.code == "too_large"
    if limit != "max_text":  # JSON texts are bounded by the payload and by the fields themselves
        assert attempt(encode_json(detections), Detections, limits=limits) is not None


def test_points_have_a_limit_of_their_own(examples: dict[str, Message]) -> None:
    """A cloud above `max_points` is refused, one at the limit is not."""
    payload = encode(examples["Points"])
    assert attempt(payload, Points, limits=Limits(max_points=10)) is None
    error = attempt(payload, Points, limits=Limits(max_points=9))
    assert error is not None
    assert (error.code, error.path, error.expected) == ("too_large", "xyz", "at most 9 rows")
