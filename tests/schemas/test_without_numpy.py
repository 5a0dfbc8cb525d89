"""Messages where numpy cannot be imported are the same messages: same bytes, same errors."""

import json
from collections.abc import Iterator
from typing import Any

import msgpack
import numpy as np
from message_rules import NAN, RULES, plain
from optipmb_schemas import Detections, Message, encode, encode_json
from without_numpy import Case, outcome, outcomes_without


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
