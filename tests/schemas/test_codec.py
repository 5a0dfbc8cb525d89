"""Encoding strings, versions, forms and malformed payloads."""

import json

import msgpack
import numpy as np
import pytest
from optipmb_schemas import (
    MESSAGES,
    Detections,
    Message,
    MessageError,
    ResetRequest,
    SessionState,
    decode,
    encode,
    encode_json,
    encoding_of,
)


def code_of(payload: bytes, encoding: str = "", kind: type[Message] = Detections) -> str:
    with pytest.raises(MessageError) as caught:
        decode(payload, kind, encoding=encoding)
    return caught.value.code


def test_encoding_strings(detections: Detections) -> None:
    """The encoding names the form, the type and the version, for a type and for a message."""
    assert encoding_of(Detections) == "application/msgpack;optipmb.Detections.v1"
    assert encoding_of(detections, form="json") == "application/json;optipmb.Detections.v1"


@pytest.mark.parametrize(
    ("encoding", "code"),
    [
        *((fits, "") for fits in ("", "zenoh/bytes", "zenoh/string", "application/msgpack")),
        ("application/msgpack; optipmb.Detections.v1", ""),
        ("application/msgpack;optipmb.Tracks.v1", "wrong_type"),
        ("application/msgpack;optipmb.detections.v1", "wrong_type"),
        ("application/msgpack;other.Detections.v1", "wrong_type"),
        ("application/msgpack;optipmb.Detections", "wrong_type"),
        ("application/cbor", "wrong_type"),
        ("text/plain", "wrong_type"),
        ("application/msgpack;optipmb.Detections.v2", "unsupported_version"),
        ("application/msgpack;optipmb.Detections.v0", "unsupported_version"),
        ("application/msgpack;optipmb.Detections.v10", "unsupported_version"),
        ("application/json;optipmb.Detections.v2", "unsupported_version"),
        ("application/msgpack;optipmb.Detections.v" + "9" * 10_000, "wrong_type"),
        ("application/msgpack;optipmb.Detections.v१", "wrong_type"),
        ("\x00\ud800", "wrong_type"),
    ],
)
def test_encodings_fit_or_are_refused(detections: Detections, encoding: str, code: str) -> None:
    """Another type, form or major version is refused; no encoding, Zenoh's defaults and the form alone are not."""
    if code:
        assert code_of(encode(detections), encoding) == code
    else:
        assert decode(encode(detections), Detections, encoding=encoding) == detections


def test_the_encoding_decides_on_the_form(detections: Detections) -> None:
    """JSON that is called msgpack is malformed, and the other way round."""
    assert code_of(encode_json(detections), "application/msgpack") == "malformed"
    assert code_of(encode(detections), "application/json") == "malformed"


def test_json_may_begin_with_white_space(detections: Detections) -> None:
    """Without an encoding, indented JSON is recognised."""
    text = json.dumps(json.loads(encode_json(detections)), indent=1)
    assert decode(("\n " + text).encode(), Detections) == detections


@pytest.mark.parametrize("in_json", [False, True])
def test_unknown_fields_are_ignored(examples: dict[str, Message], *, in_json: bool) -> None:
    """Fields that a newer minor version has added do no harm, under any name and with any content."""
    for message in examples.values():
        extra = {"new": {"deep": [1, [2, {"x": None}]]}, "self": 1, "cls": 2, "é": 3, "model_config": 4, "": 5}
        if in_json:
            payload = json.dumps({**json.loads(encode_json(message)), **extra}).encode()
        else:
            payload = msgpack.packb({**msgpack.unpackb(encode(message)), **extra})
        assert decode(payload, type(message)) == message


MALFORMED = {
    "empty": b"",
    "nil": b"\xc0",
    "list": b"\x90",
    "number": b"\x07",
    "cut": b"\x81\xa1",
    "large bytes cut": b"\x81\xa1a\xc6\x00\x00\x20\x00" + bytes(100),
    "trailing bytes": b"\x80\x80",
    "duplicate key": b"\x82\xa1a\x01\xa1a\x02",
    "duplicate key inside": b"\x81\xa1a\x82\xa1b\x01\xa1b\x01",
    "integer key": b"\x81\x01\x01",
    "bytes key": b"\x81\xc4\x01a\x01",
    "list key": b"\x81\x90\x01",
    "nil key": b"\x81\xc0\x01",
    "bad UTF-8": b"\x81\xa1\xff\x01",
    "bad UTF-8 value": b"\x81\xa1a\xa1\xff",
    "surrogate": b"\x81\xa1a\xa3\xed\xa0\x80",
    "extension": b"\x81\xa1a\xc7\x00\x01",
    "extension whose bytes look like values": b"\x81\xa1a\x93\xd4\x92\x01\x02\x03",
    "never used": b"\x81\xa1a\xc1",
    "json list": b"  [1]",
    "json nothing": b"  ",
    "json cut": b'{"a":1',
    "json open text": b'{"a',
    "json trailing": b'{"a":1} x',
    "json two": b"{}{}",
    "json duplicate key": b'{"a":1,"a":1}',
    "json NaN": b'{"a":NaN}',
    "json Infinity": b'{"a":-Infinity}',
    "json bad UTF-8": b'{"a":"\xff"}',
    "json long integer": b'{"a":123456789012345678901}',
    "json control character": b'{"a":"\n"}',
    "json single quotes": b"{'a':1}",
    "json comment": b"{} // nothing",
}


@pytest.mark.parametrize("payload", MALFORMED.values(), ids=MALFORMED.keys())
def test_malformed_payloads(payload: bytes) -> None:
    """Anything but exactly one map of texts to values is malformed, also where all fields are optional."""
    assert code_of(payload, kind=ResetRequest) == "malformed"


def test_what_follows_is_counted() -> None:
    """The error for bytes after the map says how many there are."""
    with pytest.raises(MessageError, match=r"expected one msgpack value, received 2 bytes after its end"):
        decode(b"\x80\x80\x80", ResetRequest)


def test_absent_fields_are_not_written() -> None:
    """Fields that are None take no bytes."""
    state = SessionState(stream="a/b/c", session="0" * 32, state="new", profile="kitti")
    assert {"epoch", "seq", "stamp_ns"}.isdisjoint(msgpack.unpackb(encode(state)))
    assert {"epoch", "seq", "stamp_ns"}.isdisjoint(json.loads(encode_json(state)))


def test_fields_are_written_in_the_order_of_the_description(examples: dict[str, Message]) -> None:
    """Header first, arrays later, always the same."""
    for kind in MESSAGES:
        names = list(msgpack.unpackb(encode(examples[kind.__name__])))
        assert names == [name for name in kind.model_fields if name in names]


def test_msgpack_lists_are_understood(detections: Detections) -> None:
    """A publisher without array blocks may send nested lists, with nil or NaN for an unknown velocity."""
    plain = json.loads(encode_json(detections))
    assert decode(msgpack.packb(plain), Detections) == detections
    plain["velocity"] = np.where(np.isnan(detections.velocity), np.nan, detections.velocity).tolist()
    plain["epoch"] = detections.epoch
    assert decode(msgpack.packb(plain), Detections) == detections
