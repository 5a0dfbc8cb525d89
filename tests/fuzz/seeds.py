"""Writes the first files of the corpora: `python tests/fuzz/seeds.py`, with tests/support on the path."""

import json
from pathlib import Path

import numpy as np
import optipmb_schemas as schemas
from optipmb_schemas.protobuf import convert
from optipmb_schemas.protobuf import tracking_pb2 as pb
from optipmb_service.session.checkpoint import HEAD, encode_checkpoint
from optipmb_service.session.session import Session
from router import Sensor
from sessions import chained, feed

import optipmb

CORPUS = Path(__file__).parent / "corpus"


def main() -> None:
    """One small message of each common type, as msgpack and as JSON, and a checkpoint with and without a window."""
    sensor = Sensor()
    messages: list[schemas.Message] = [
        sensor.detections(1, objects=2),
        sensor.points(1, count=3),
        schemas.ResetRequest(close=True),
        schemas.SessionParameters(profile="kitti"),
        schemas.SessionState(stream=sensor.stream, session="0" * 32, state="new", profile="kitti"),
    ]
    for message in messages:
        kind = bytes([schemas.MESSAGES.index(type(message))])
        name = type(message).__name__
        _write("messages", f"{name}.msgpack", kind + schemas.encode(message))
        _write("messages", f"{name}.json", kind + schemas.encode_json(message))
    one = {"class": "car", "lat": 48.0, "lon": 11.0, "alt": None, "heading": 90, "score": 0.5, "size": [4, 2, None]}
    two = {"class": "bus", "position": [1, 2, None], "velocity": [0, 1], "yaw": 1.5, "confidence": 1}
    numbers = {"epoch": "0" * 32, "seq": "1", "stamp_ns": 5, "key": "a", "stream": "a/b/c"}
    _write("frames", "objects", json.dumps({"objects": [one, two], **numbers}).encode())
    _write("frames", "columns", schemas.encode_json(messages[0]))
    groups = {"car": [{"class": "car", "x": 1, "y": 2.5}]}
    _write("frames", "mapped", json.dumps({"objects": groups, "time": "2026-11-27T08:00:00.100+01:00"}).encode())
    asked = pb.TrackFilter(classes=["car"], area=pb.Polygon(x=[0, 1, 1], y=[0, 0, 1]), fields=["center"])
    requests = [
        pb.TrackRequest(detections=convert.to_proto(messages[0])),
        pb.PublishRequest(points=convert.to_proto(messages[1])),
        pb.SubscribeRequest(pattern="*/*/*", filter=asked, max_rate_hz=2.0),
        pb.SetParametersRequest(stream=sensor.stream, parameters=convert.to_proto(messages[3])),
    ]
    for number, request in enumerate(requests):
        _write("protobuf", type(request).__name__, bytes([number]) + request.SerializeToString())
    scalars = ("yaw", "yaw_rate", "acceleration", "existence", "score", "age", "time_since_detection")
    columns = {name: np.zeros(1) for name in scalars} | {
        name: np.zeros(1, int) for name in ("id", "label", "detection")
    }
    columns |= {"center": np.zeros((1, 3)), "size": np.ones((1, 3)), "velocity": np.zeros((1, 2))}
    header = {"stream": sensor.stream, "epoch": bytes(16), "seq": 0, "stamp_ns": 0, "session": "0" * 32}
    rest = {"profile": "kitti", "cloud_used": False, "labels": ("car",), "covariance": np.zeros((1, 6, 6))}
    tracks = schemas.Tracks(**header, **rest, **columns)
    _write("protobuf", "Tracks", bytes([len(requests)]) + schemas.encode(tracks))
    parameters = optipmb.load_profile("kitti")
    small = parameters.model_copy(update={"classes": dict(list(parameters.classes.items())[:1]), "provenance": ""})
    one = Session(sensor.stream, small, tracker=chained)
    _write("checkpoints", "empty", _body(one))
    feed(one, [0, 2, 1], sensor, objects=1)
    _write("checkpoints", "window", _body(one))


def _body(session: Session) -> bytes:
    """Return what follows the head of a checkpoint and its numbers."""
    data = encode_checkpoint(session.snapshot())[HEAD:]
    return data[4 + int.from_bytes(data[:4]) :]


def _write(corpus: str, name: str, data: bytes) -> None:
    (CORPUS / corpus).mkdir(parents=True, exist_ok=True)
    (CORPUS / corpus / name).write_bytes(data)


if __name__ == "__main__":
    main()
