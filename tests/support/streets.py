"""A street with crossing and parked cars, as columns of a table."""

import numpy as np

Table = dict[str, np.ndarray]
CARS, PERIOD = 8, 0.1


def street(seconds: float = 12.0, *, ray: float = 0.0, copies: int = 1, parked: int = 4, seed: int = 5) -> Table:
    """Return cars on a grid of streets at 10 Hz around a sensor, some of them parked.

    Args:
        seconds: Length of the recording.
        ray: Scatter of the range, as a part of it.
        copies: Boxes of each car, with scores from high to low, as before suppression.
        parked: Cars that stand.
        seed: Of the noise.
    """
    rng = np.random.default_rng(seed)
    frames = round(seconds / PERIOD)
    course = np.resize([0.0, 0.5 * np.pi, np.pi, -0.5 * np.pi], CARS) + rng.normal(0.0, 0.05, CARS)
    speed = np.where(np.arange(CARS) < parked, 0.0, 8.0)
    begin = np.column_stack([np.arange(CARS) * 9.0 - 30.0, np.tile([-25.0, 25.0], CARS // 2)])
    t, car = np.repeat(np.arange(frames) * PERIOD, CARS * copies), np.tile(np.repeat(np.arange(CARS), copies), frames)
    place = begin[car] + (speed[car] * t)[:, None] * np.column_stack([np.cos(course), np.sin(course)])[car]
    place = place * (1.0 + ray * rng.normal(size=(len(t), 1))) + rng.normal(0.0, 0.03 * copies, (len(t), 2))
    count = len(t)
    return {
        "t": t.round(6),
        "x": place[:, 0],
        "y": place[:, 1],
        "z": np.full(count, 0.8),
        "l": np.full(count, 4.5),
        "w": np.full(count, 1.9),
        "h": np.full(count, 1.6),
        "yaw": course[car] + rng.normal(0.0, 0.02, count),
        "score": 0.9 * np.resize([1.0, 0.6, 0.2, 0.05, 0.01][:copies], count),
        "class": np.full(count, "car"),
    }
