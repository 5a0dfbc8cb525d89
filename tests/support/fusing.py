"""Sensors of one node that share a session, and a drive past them."""

import math

import numpy as np
from optipmb_schemas import Detections, FieldOfView
from router import Sensor

FUSED = "site/node/fused"
FRONT = Sensor("site/node/front", b"f" * 16)
REAR = Sensor("site/node/rear", b"r" * 16, start_s=10_000.03)
SIDE = Sensor("site/node/side", b"s" * 16)
"""With the stamps of the front sensor."""

FORWARD = FieldOfView(azimuth=[-1.2, 1.2], elevation=[-1, 1], range=[0, 100])
BACKWARD = FieldOfView(azimuth=[math.pi - 1.2, -math.pi + 1.2], elevation=[-1, 1], range=[0, 100])


def drive(frames: int = 60) -> list[Detections]:
    """A car that falls behind, seen by a front sensor, then by none, then by a rear one."""
    found = []
    for seq in range(frames):
        for sensor, view in ((FRONT, FORWARD), (REAR, BACKWARD)):
            time = seq * 0.1 + (0.03 if sensor is REAR else 0.0)
            x = 20.0 - 8.0 * time
            turn = math.atan2(3.0, x)
            seen = abs(turn) <= 1.2 if sensor is FRONT else abs(turn) >= math.pi - 1.2
            found.append(
                sensor.detections(
                    seq,
                    objects=int(seen),
                    center=np.array([[x, 3.0, 1.0]])[: int(seen)],
                    velocity=np.array([[-8.0, 0.0]])[: int(seen)],
                    yaw=np.full(int(seen), math.pi),
                    field_of_view=view,
                )
            )
    return found
