"""Track over gRPC with the generated stubs alone: a car that drives along x at 10 m/s, seen ten times a second."""

import os
import struct
import time

from optipmb_schemas.protobuf import tracking_pb2 as pb
from optipmb_schemas.protobuf.tracking_pb2_grpc import TrackingServiceStub

import grpc

EPOCH = os.urandom(16)  # new at every start
START_NS = time.time_ns()


def array(dtype: int, code: str, shape: list[int], *values: float) -> pb.Array:
    """Pack numbers, row by row, little-endian."""
    return pb.Array(dtype=dtype, shape=shape, data=struct.pack(f"<{len(values)}{code}", *values))


def frame(seq: int) -> pb.TrackRequest:
    """Describe what the detector has seen at 0.1 s times `seq`: one car."""
    return pb.TrackRequest(
        detections=pb.Detections(
            stream="garage/robot-1/lidar",
            epoch=EPOCH,
            seq=seq,
            stamp_ns=START_NS + seq * 100_000_000,
            frame=pb.FRAME_WORLD,
            labels=["car"],
            label=array(pb.DATA_TYPE_I8, "q", [1], 0),
            center=array(pb.DATA_TYPE_F8, "d", [1, 3], seq * 1.0, 0.0, 0.8),
            size=array(pb.DATA_TYPE_F8, "d", [1, 3], 4.5, 1.9, 1.6),
            yaw=array(pb.DATA_TYPE_F8, "d", [1], 0.0),
            score=array(pb.DATA_TYPE_F8, "d", [1], 0.9),
        )
    )


with grpc.insecure_channel("127.0.0.1:50051") as channel:
    for response in TrackingServiceStub(channel).Track(map(frame, range(50))):
        if response.HasField("problem"):
            print("problem", response.problem.message)
            continue
        tracks = response.tracks
        numbers = struct.unpack(f"<{tracks.id.shape[0]}q", tracks.id.data)
        centers = list(struct.iter_unpack("<3d", tracks.center.data))
        for number, (x, y, _) in zip(numbers, centers, strict=True):
            print("frame", tracks.seq, "track", number, "at", round(x, 1), round(y, 1))
