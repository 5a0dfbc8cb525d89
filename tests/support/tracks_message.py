"""Tracks of one frame as a service publishes them, for tests in which most of their numbers do not matter."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from optipmb_schemas import Tracks

SESSION = "0123456789abcdef0123456789abcdef"


def tracks_message(stream: str, seq: int, ids: Sequence[int] = (), **changes: Any) -> Tracks:
    """Return tracks of these ids: cars of 1 m at the origin that exist for certain, every other number 0.

    Args:
        stream: its name.
        seq: number of the frame, and its stamp unless changed.
        ids: of the tracks.
        changes: other fields; a number of a column holds for every track.
    """
    count = len(ids)
    fields: dict[str, Any] = {
        "stream": stream,
        "epoch": bytes(16),
        "seq": seq,
        "stamp_ns": seq,
        "session": SESSION,
        "profile": "kitti",
        "cloud_used": False,
        "labels": ("Car",),
    }
    fields |= {name: 0 for name in Tracks.arrays if Tracks.model_fields[name].is_required()}
    fields |= {"id": ids, "size": 1, "existence": 1, "covariance": np.eye(6)} | changes
    for name, array in Tracks.arrays.items():
        rows, *inner = array.shape
        if name in fields and rows == "N" and all(isinstance(one, int) for one in inner):
            fields[name] = np.broadcast_to(np.asarray(fields[name], array.dtype), (count, *inner)).copy()
    return Tracks(**fields)
