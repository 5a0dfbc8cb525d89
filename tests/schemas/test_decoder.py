"""Messages decoded by msgspec equal those by the models; payloads that these refuse are left to them."""

import copy
import subprocess
import sys
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from optipmb_schemas import Detections, Limits, Message, MessageError, codec, decode, encode, encoded
from optipmb_schemas.codec import DECODERS, MOST_BYTES, MOST_NUMBERS, read_columns
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


NAMES = sorted(kind.__name__ for kind in DECODERS)


def by_models(payload: bytes, kind: type[Message], limits: Limits = DEFAULT) -> Message:
    """Return what the walk and the models make of a payload, however it is written."""
    fields = codec.read_map(payload, limits)
    return codec.build(fields, kind, limits)


def check(payload: bytes, kind: type[Message] = Detections, limits: Limits = DEFAULT) -> bool:
    """Compare both; returns whether the models were not needed."""
    found = read_columns(payload, kind, limits)
    if found is not None:
        made = by_models(payload, kind, limits)
        assert found == made
        assert repr(found) == repr(made)
        assert found.model_fields_set == made.model_fields_set
        for one, other in zip(arrays(found), arrays(made), strict=True):
            assert one.dtype == other.dtype
            for flag in ("C_CONTIGUOUS", "ALIGNED", "WRITEABLE"):
                assert one.flags[flag] == other.flags[flag]
        assert taken(found) in {None, payload}
        assert encoded(found) == encode(made)
    return found is not None


def taken(message: Message) -> bytes | None:
    """Return the bytes that a message keeps as its encoding."""
    return getattr(message, "encoded", None)


def arrays(message: Message) -> list[Any]:
    inner = [one for _, value in message.present() if isinstance(value, Message) for one in arrays(value)]
    return [value for _, value in message.present() if isinstance(value, np.ndarray)] + inner


def places(tree: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    below = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    return [path, *(one for key, value in below for one in places(value, (*path, key)))]


def written(pairs: Any) -> bytes:
    packed: bytes = msgpack.packb(pairs)
    return packed


@pytest.mark.parametrize("name", NAMES)
def test_what_our_encoder_writes_needs_no_models(examples: dict[str, Message], name: str) -> None:
    """Every message with columns is read, with each of its optional fields and without."""
    example = examples[name]
    payload = encode(example)
    assert check(payload, type(example))
    assert decode(payload, type(example)) == example
    for field in type(example).optional:
        changed = example.model_copy(update={field: None})
        try:
            by_models(encode(changed), type(example))
        except MessageError:
            assert not check(encode(changed), type(example))
        else:
            assert check(encode(changed), type(example))


@pytest.mark.parametrize("count", [1, 170, 180, MOST_NUMBERS // 11, 1000, MOST_BYTES // 80])
@pytest.mark.parametrize("stream", ["a/b/c", "a/b/cd", "a/b/cde", f"a/b/{'c' * 60}"])
def test_detections_of_any_number_keep_their_bytes(examples: dict[str, Message], count: int, stream: str) -> None:
    """Small blocks, padded ones, and messages too large to be encoded again; a changed copy keeps none."""
    found = decode(encode(many(examples["Detections"], count, stream=stream)), Detections)
    payload = encode(found)
    assert check(payload)
    assert taken(decode(payload, Detections)) == payload
    assert taken(found.model_copy(update={"seq": 301})) is None


def many(example: Message, count: int, **changes: Any) -> Detections:
    rows = {"label": np.zeros(count, int), "center": np.ones((count, 3)), "size": np.ones((count, 3))}
    rows |= {"yaw": np.ones(count), "score": np.ones(count), "velocity": np.full((count, 2), NAN)}
    covariance = {"position_covariance": np.broadcast_to(np.eye(3), (count, 3, 3))}
    return Detections(**dict(example.present()) | rows | covariance | changes)


@pytest.mark.parametrize("name", NAMES)
def test_every_byte_replaced_by_others(examples: dict[str, Message], name: str) -> None:
    """With any byte replaced, in the values or between them, a message that is read equals the one by the models."""
    example, found = examples[name], 0
    payload = encode(example)
    for at, byte in enumerate(payload):
        others = (0, 0x7F, 0xC0, 0xFF, byte ^ 1, byte ^ 0x80)
        for other in set(others[at % 3 :: 3]) - {byte}:
            found += check(payload[:at] + bytes([other]) + payload[at + 1 :], type(example))
    assert found


def test_bytes_that_encoding_does_not_give_again_are_not_kept(examples: dict[str, Message]) -> None:
    """Another order of fields is read without the models; longer integers and names, and other number types with."""
    example = examples["Detections"].model_copy(update={"seq": 300, "stream": "a/b/c"})
    payload = encode(example)
    wide = payload.replace(b"\xa3seq\xcd\x01\x2c", b"\xa3seq\xce\x00\x00\x01\x2c")
    long = payload.replace(b"\xa5a/b/c", b"\xd9\x05a/b/c")
    other = payload.replace(b"\xa5dtype\xa2f8", b"\xa5dtype\xa3<f8")
    tree = msgpack.unpackb(payload)
    turned = written(dict(reversed(tree.items())))
    inner = written(tree | {"pose": dict(reversed(tree["pose"].items()))})
    large = written(msgpack.unpackb(encode(many(example, 200, position_covariance=None))))
    unpadded = large.replace(b"\xa3pad", b"\xa3pat")
    for one, read_here in ((wide, 0), (long, 0), (other, 0), (turned, 1), (inner, 1), (large, 0), (unpadded, 0)):
        assert check(one) == bool(read_here)
        assert taken(decode(one, Detections)) is None
    without = {
        name: {k: v for k, v in value.items() if k != "pad"} if isinstance(value, dict) else value
        for name, value in msgpack.unpackb(large).items()
    }
    assert check(written(without))
    assert taken(decode(written(without), Detections)) is None


def test_limits_of_a_service_need_no_models(examples: dict[str, Message]) -> None:
    """Fewer values than by default, as a service allows, are still more than a message with columns has."""
    limits = Limits(max_values=2**17, max_json_bytes=2**21)
    assert all(check(encode(examples[name]), type(examples[name]), limits) for name in NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_every_value_replaced_by_every_other(examples: dict[str, Message], name: str) -> None:
    """With any value of the message replaced, left out, or written twice, the result equals the models' result."""
    kind, tree, found = type(examples[name]), msgpack.unpackb(encode(examples[name])), 0
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
            found += check(written(changed), kind)
    assert found > 0


@pytest.mark.parametrize("name", NAMES)
def test_fields_that_are_there_twice_or_unknown(examples: dict[str, Message], name: str) -> None:
    """A map with a field twice, or an unknown one, is left to the models, in the message and inside it."""
    tree = msgpack.unpackb(encode(examples[name]))
    for path in places(tree):
        inner = tree
        for key in path:
            inner = inner[key]
        if not isinstance(inner, dict):
            continue
        packed, key = written(inner), next(iter(inner))
        head = packed[:1] if packed[0] < 0xA0 else packed[:3]
        more = written(dict.fromkeys(range(len(inner) + 1), 0))[: 1 if len(inner) < 15 else 3]
        for twice in (key, "unknown"):
            changed = more + packed[len(head) :] + written(twice) + written(inner[key])
            assert not check(written(tree).replace(packed, changed), type(examples[name]))


@settings(max_examples=100)
@given(data=st.data())
def test_every_number(examples: dict[str, Message], data: st.DataObject) -> None:
    """Numbers at and beyond the ends of every range, in any place."""
    payload = written_with(examples["Detections"], data)
    error: MessageError | None = None
    try:
        by_models(payload, Detections)
    except MessageError as refused:
        error = refused
    assert check(payload) == (error is None)
    if error is not None:
        with pytest.raises(MessageError) as raised:
            decode(payload, Detections)
        assert raised.value.args == error.args


def written_with(example: Message, data: st.DataObject) -> bytes:
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


@pytest.mark.parametrize("file", sorted(CORPUS.iterdir()), ids=lambda one: one.name)
def test_files_that_a_search_found(file: Path) -> None:
    """Every file kept for the search, as any message."""
    for kind in DECODERS:
        check(file.read_bytes()[1:], kind)


FIRST = """
import sys, threading
from router import Sensor
import optipmb_schemas as schemas
sys.setswitchinterval(1e-6)
payload, start = schemas.encode(Sensor().detections(0)), threading.Barrier(8)
def decode():
    start.wait(60)
    schemas.decode(payload, schemas.Detections)
threads = [threading.Thread(target=decode) for _ in range(8)]
for one in threads: one.start()
for one in threads: one.join(60)
"""


def test_threads_may_decode_their_first_messages_at_once() -> None:
    """No process ends by a signal whose threads all decode as soon as the modules are imported."""
    folder = str(Path(__file__).parents[1] / "support")
    for _ in range(3):
        code = f"import sys; sys.path.insert(0, {folder!r}){FIRST}"
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)
        assert (done.returncode, done.stderr) == (0, "")
