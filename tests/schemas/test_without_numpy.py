"""Messages where numpy cannot be imported are the same messages: same bytes, same errors."""

import array
import json
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import msgpack
import numpy as np
from message_rules import NAN, RULES, plain
from optipmb_schemas import Detections, Message, encode, encode_json, numeric
from optipmb_schemas import plain as plain_numbers
from optipmb_schemas.arrays import Array
from without_numpy import Case, command, outcome, outcomes_without


def random_detections(detections: Detections) -> Iterator[Case]:
    """Give detections with values near and beyond the limits of their fields, as lists and as buffers."""
    random = np.random.default_rng(3)
    for count in (0, 1, 2, 7, 40, 200):
        for _ in range(10):
            root = random.normal(0.0, 10.0 ** random.integers(-5, 5), (count, 3, 3))
            covariance = root @ root.transpose(0, 2, 1)
            covariance[random.random(count) < 0.3] = NAN
            velocity = random.normal(0.0, 400.0, (count, 2))
            velocity[random.random(count) < 0.3] = NAN
            fields = plain(detections) | {
                "label": random.integers(0, 2, count),
                "center": random.normal(0.0, 10.0 ** random.integers(0, 9), (count, 3)),
                "size": random.uniform(0.0, 5.0, (count, 3)),
                "yaw": random.normal(0.0, 3.0, count),
                "score": random.uniform(0.0, 1.0, count),
                "velocity": velocity,
                "position_covariance": covariance,
            }
            for written in (np.ndarray.tolist, buffer):
                given = {n: written(v) if isinstance(v, np.ndarray) else v for n, v in fields.items()}
                yield "make", "Detections", given


def buffer(column: "np.ndarray[Any, Any]") -> Any:
    """Return an array as `without_numpy` writes buffers, in which no table is without rows."""
    return ("buffer", column.dtype.char, column.shape, column.tobytes()) if column.size else column.tolist()


def clouds(points: dict[str, Any]) -> Iterator[Case]:
    """Give clouds of several number types and widths, some of them with points that are not finite, or too far."""
    random = np.random.default_rng(4)
    for action in ("make", "publish"):
        for dtype in ("f4", "f8", "i4", "u1", "u8"):
            for shape in ((1, 3), (5, 4), (700, 3), (700, 6), (3, 2), (2, 65), (6,)):
                cloud = np.abs(random.normal(0.0, 50.0, shape)).astype(dtype)
                yield action, "Points", points | {"xyz": buffer(cloud)}
                if dtype.startswith("f"):
                    cloud[random.random(shape) < 0.05] = NAN
                    yield action, "Points", points | {"xyz": buffer(cloud)}
                    cloud[0] = 1e38
                    yield action, "Points", points | {"xyz": buffer(cloud)}


def test_the_same_messages_and_errors(examples: dict[str, Message], detections: Detections) -> None:
    """Valid and invalid values and payloads give the same bytes, numbers and errors with numpy and without."""
    cases: list[Case] = [*random_detections(detections), *clouds(plain(examples["Points"]) | {"frame": "world"})]
    label = plain(detections) | {"label": ("buffer", "Q", (3,), np.array([0, 2**63, 1], "u8").tobytes())}
    cases += [
        ("make", "Detections", label),
        ("make", "Detections", label | {"label": ("buffer", "d", (3,), bytes(24))}),
    ]
    for kind, message in examples.items():
        cases += [("make", kind, plain(message))]
        payloads = [encode(message), encode_json(message), encode(message)[:-1], b"", b"\xc1"]
        cases += [("decode", kind, payload) for payload in payloads]
        blocks = msgpack.unpackb(encode(message))
        for name in message.arrays:
            for wrong in ({"dtype": "f2"}, {"shape": [2**40]}, {"data": b"1"}, {"dtype": "<u2"}):
                block = blocks.get(name) or {}
                cases += [("decode", kind, msgpack.packb(blocks | {name: block | wrong}))]
    for kind, field, value, _ in RULES:
        fields = plain(examples[kind]) | {field: value}
        cases += [("make", kind, fields), ("decode", kind, json.dumps(fields).encode())]
    without = outcomes_without(cases)
    assert len(without) == len(cases) > 500
    for case, found in zip(cases, without, strict=True):
        assert found == outcome(*case), case
    assert 100 < sum(isinstance(found, str) for found in without) < len(cases) - 100


def test_numbers_without_numpy_are_python_objects_like_others() -> None:
    """They can be pickled and copied; buffers of other libraries are read; what needs numpy says so."""
    code = """
import copy, ctypes, pickle
from optipmb_schemas import MessageError
from optipmb_schemas.arrays import numeric
center = numeric.given(memoryview(bytes(48)).cast("d", (2, 3)))
for again in (pickle.loads(pickle.dumps(center)), copy.deepcopy(center), copy.copy(center)):
    assert (again.tolist(), again.shape, again.dtype) == ([[0.0] * 3] * 2, (2, 3), "float64")
assert pickle.loads(pickle.dumps(numeric.of_leaves([], "f8", (0, 3)))).shape == (0, 3)
for wrong in (slice(1), (0, 1)):
    try:
        center[wrong]
    except TypeError as error:
        assert "pip install numpy" in str(error)
    else:
        raise AssertionError(wrong)
assert numeric.given(memoryview((ctypes.c_double * 2)(1, 2))).tolist() == [1, 2]
assert numeric.given(memoryview((ctypes.c_int64 * 2)(1, 2))).tolist() == [1, 2]
from optipmb_client.publisher import _array
try:
    _array("center", memoryview((ctypes.c_bool * 2)()), 3)
except MessageError as error:
    assert error.path == "center"
else:
    raise AssertionError
"""
    subprocess.run(command(code), check=True, timeout=60)


def test_a_limit_of_float32_is_the_same_without_numpy() -> None:
    """What rounds to a limit is within it."""
    description = Array("f4", ("P",), -0.1, 0.1)
    limits = array.array("f", (-0.1, 0.1))
    assert plain_numbers.first_outside(plain_numbers.Numbers(memoryview(limits), (2,)), description) is None
    assert numeric.first_outside(np.array(limits, "f4"), description) is None


def test_only_numpy_may_be_missing() -> None:
    """A module that is missing besides is an error where the messages are imported."""
    missing = "optipmb_schemas.numeric"
    code = f"import sys; sys.modules[{missing!r}] = None\nimport optipmb_schemas.codec"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=60)
    assert f"import of {missing} halted" in done.stderr
