"""A table of detections as a new user has it, for the tests of own data."""

from typing import Any

import numpy as np

FRAMES, PERIOD = 30, 0.1


def boxes(**changed: Any) -> dict[str, np.ndarray]:
    t = np.repeat(np.arange(FRAMES) * PERIOD, 3)
    columns: dict[str, Any] = {
        "t": t.round(6),
        "x": np.tile([0.0, 40.0, 5.0], FRAMES) + t * np.tile([8.0, -6.0, 1.2], FRAMES),
        "y": np.tile([0.0, 4.0, 9.0], FRAMES),
        "z": np.tile([0.8, 0.8, 0.9], FRAMES),
        "l": np.tile([4.5, 4.2, 0.6], FRAMES),
        "w": np.tile([1.9, 1.8, 0.6], FRAMES),
        "h": np.tile([1.6, 1.5, 1.7], FRAMES),
        "yaw": np.tile([0.0, 3.1, 0.1], FRAMES),
        "score": np.tile([0.9, 0.8, 0.7], FRAMES),
        "class": np.array(["Car", "Car", "Pedestrian"] * FRAMES),
    }
    columns |= changed
    return {name: np.asarray(values) for name, values in columns.items() if values is not None}
