"""Array blocks: accepted, viewed and refused ones."""

from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from optipmb_schemas import Detections, Message, MessageError, Points, Tracks, decode, encode

HEADER: dict[str, Any] = {"stream": "a/b/c", "epoch": bytes(16), "seq": 0, "stamp_ns": 0, "frame": "world"}


def block(array: np.ndarray[Any, Any], dtype: str | None = None) -> dict[str, Any]:
    return {"dtype": dtype or array.dtype.str, "shape": list(array.shape), "data": array.tobytes()}


def cloud(xyz: dict[str, Any]) -> bytes:
    packed: bytes = msgpack.packb({**HEADER, "xyz": xyz})
    return packed


@pytest.mark.parametrize("dtype", ["f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8"])
@pytest.mark.parametrize("spelling", ["{}", "<{}"])
def test_all_number_types_are_understood(dtype: str, spelling: str) -> None:
    """A block of any listed number type, in either spelling, becomes what the field holds."""
    values = np.array([[1, 2, 3], [4, 5, 6]], dtype="<" + dtype)
    name = spelling.format(dtype)
    name = name.replace("<", "|") if dtype.endswith("1") else name
    received = decode(cloud(block(values, name)), Points).xyz
    assert received.dtype == np.float32
    assert received.tolist() == [[1, 2, 3], [4, 5, 6]]


@pytest.mark.parametrize("dtype", ["u1", "u4", "u8", "i2", "i8"])
def test_integer_columns_take_any_integer_type(detections: Detections, dtype: str) -> None:
    """Labels may come as any integer type; floating-point labels are refused, also whole ones."""
    plain = msgpack.unpackb(encode(detections))
    plain["label"] = block(detections.label.astype("<" + dtype))
    assert decode(msgpack.packb(plain), Detections) == detections
    plain["label"] = block(detections.label.astype("<f4"))
    with pytest.raises(MessageError, match=r"^label: expected an array of integers"):
        decode(msgpack.packb(plain), Detections)


def test_large_unsigned_integers_do_not_wrap(examples: dict[str, Message]) -> None:
    """An identity above 2^63 is refused, not made negative."""
    plain = msgpack.unpackb(encode(examples["Tracks"]))
    plain["id"] = block(np.array([1, 2**63], dtype="<u8"))
    with pytest.raises(MessageError, match=r"^id\[1\]: expected an integer from 0 to 9223372036854775807"):
        decode(msgpack.packb(plain), Tracks)
    plain = msgpack.unpackb(encode(examples["Tracks"]))
    plain["detection"] = block(np.array([0, 2**64 - 1], dtype="<u8"))  # as a signed integer this were -1: none
    with pytest.raises(MessageError, match=r"^detection\[1\]: expected an integer from -1 to 9223372036854775807"):
        decode(msgpack.packb(plain), Tracks)


def test_single_precision_overflow_is_refused() -> None:
    """A coordinate that float32 cannot hold is refused by name."""
    with pytest.raises(MessageError, match=r"^xyz\[0\]\[1\]: expected a number"):
        decode(cloud(block(np.array([[0, 1e300, 0]]))), Points)


BAD: list[tuple[dict[str, Any], str]] = [
    ({"dtype": ">f4", "shape": [1, 3], "data": bytes(12)}, "xyz.dtype"),
    ({"dtype": "f2", "shape": [1, 3], "data": bytes(6)}, "xyz.dtype"),
    ({"dtype": "O", "shape": [1, 3], "data": bytes(24)}, "xyz.dtype"),
    ({"dtype": 4, "shape": [1, 3], "data": bytes(12)}, "xyz.dtype"),
    ({"dtype": None, "shape": [1, 3], "data": bytes(12)}, "xyz.dtype"),
    ({"shape": [1, 3], "data": bytes(12)}, "xyz.dtype"),
    ({"dtype": "f4", "data": bytes(12)}, "xyz.shape"),
    ({"dtype": "f4", "shape": [1, 3]}, "xyz.data"),
    ({"dtype": "f4", "shape": 3, "data": bytes(12)}, "xyz.shape"),
    ({"dtype": "f4", "shape": [3], "data": bytes(12)}, "xyz.shape"),
    ({"dtype": "f4", "shape": [1, 1, 3], "data": bytes(12)}, "xyz.shape"),
    ({"dtype": "f4", "shape": [1, 3.0], "data": bytes(12)}, "xyz.shape[1]"),
    ({"dtype": "f4", "shape": [True, 3], "data": bytes(12)}, "xyz.shape[0]"),
    ({"dtype": "f4", "shape": [-1, 3], "data": bytes(12)}, "xyz.shape[0]"),
    ({"dtype": "f4", "shape": [1, 2], "data": bytes(8)}, "xyz"),
    ({"dtype": "f4", "shape": [1, 65], "data": bytes(260)}, "xyz"),
    ({"dtype": "f4", "shape": [1, 3], "data": bytes(11)}, "xyz.data"),
    ({"dtype": "f4", "shape": [1, 3], "data": bytes(13)}, "xyz.data"),
    ({"dtype": "f4", "shape": [2**40, 3], "data": b""}, "xyz.data"),
    ({"dtype": "f4", "shape": [0, 2**40], "data": b""}, "xyz"),
    ({"dtype": "f4", "shape": [1, 3], "data": "0" * 12}, "xyz.data"),
    ({"dtype": "f4", "shape": [1, 3], "data": [0] * 12}, "xyz.data"),
]


@pytest.mark.parametrize(("xyz", "path"), BAD)
def test_the_error_names_the_part_of_the_block(xyz: dict[str, Any], path: str) -> None:
    """A block that is not well formed is refused by the name of its part."""
    with pytest.raises(MessageError) as caught:
        decode(cloud(xyz), Points)
    assert caught.value.path == path


def test_a_pose_may_have_blocks(detections: Detections) -> None:
    """Blocks are understood in nested messages as well, and their errors have the whole path."""
    plain = msgpack.unpackb(encode(detections))
    assert isinstance(plain["pose"]["translation"], dict)
    plain["pose"]["translation"]["shape"] = [4]
    with pytest.raises(MessageError) as caught:
        decode(msgpack.packb(plain), Detections)
    assert caught.value.path == "pose.translation"


def test_json_has_no_blocks() -> None:
    """A block in JSON is refused with a hint, since JSON has no bytes."""
    with pytest.raises(MessageError, match=r"^xyz\.data: expected bytes \(in JSON, arrays are nested lists\)"):
        decode(b'{"xyz":{"dtype":"f4","shape":[1,3],"data":"AAAA"}}', Points)


def test_other_fields_of_a_block_are_ignored() -> None:
    """A block may have fields that this version does not know."""
    extended = {**block(np.ones((2, 3), "f4")), "compression": None, "x": [1]}
    assert decode(cloud(extended), Points).xyz.sum() == 6


@settings(max_examples=30, deadline=None)
@given(name=st.text("abc", min_size=1, max_size=40), rows=st.integers(2000, 4000))
def test_large_arrays_are_views_of_the_payload(name: str, rows: int) -> None:
    """An array in the form of `encode` is decoded without a copy, aligned and read-only, at any place in it."""
    xyz = np.arange(3 * rows, dtype="f4").reshape(rows, 3)
    payload = encode(Points(**{**HEADER, "stream": f"{name}/b/c"}, xyz=xyz))
    received = decode(payload, Points).xyz
    assert np.array_equal(received, xyz)
    assert np.shares_memory(received, np.frombuffer(payload, "u1"))
    assert received.flags.aligned
    assert received.flags.c_contiguous
    assert not received.flags.writeable


@pytest.mark.parametrize("shift", range(8))
def test_arrays_are_aligned_whatever_the_payload(shift: int) -> None:
    """A large block that another encoder did not align is copied, so that compiled code sees one kind of array."""
    xyz = np.arange(3000, dtype="f4").reshape(1000, 3)
    received = decode(cloud({"x": "y" * shift, **block(xyz)}), Points).xyz
    assert np.array_equal(received, xyz)
    assert received.flags.aligned
    assert not received.flags.writeable


def test_the_constructor_views_arrays_that_fit() -> None:
    """An array of the described kind is held without a copy, its owner's rights untouched; others are converted."""
    xyz = np.ones((5, 3), "f4")
    message = Points(**HEADER, xyz=xyz)
    assert np.shares_memory(message.xyz, xyz)
    assert not message.xyz.flags.writeable
    assert xyz.flags.writeable
    for other in (xyz.astype("f8"), xyz.astype(">f4"), np.asfortranarray(xyz), xyz[::-1], xyz.astype("i2")):
        converted = Points(**HEADER, xyz=other)
        assert converted == message
        assert converted.xyz.flags.c_contiguous


@pytest.mark.parametrize("dtype", ["?", "c16", "O", "U3", "M8[s]"])
def test_arrays_of_no_numbers_are_refused(dtype: str) -> None:
    """Arrays of truth values, complex numbers, objects, texts or dates are no arrays of numbers."""
    with pytest.raises(MessageError, match=r"^xyz: expected an array of numbers"):
        Points(**HEADER, xyz=np.zeros((2, 3), dtype))
