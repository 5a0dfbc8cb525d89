"""Values between two known ones, in each place that interpolates, against the exact motion."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from optipmb_schemas.ros2.transforms import Transforms
from optipmb_tools.datasets import open_dataset
from optipmb_tools.table_files import write_table

TURN = 2.0
"""Heading at the end, rad; it is 0 at the beginning, and the way leads from (0, 0) to (10, -4)."""
END_NS = 1_000_000_000

Place = tuple[float, float, float]


def of_transforms(at_ns: int, _folder: Path) -> Place:
    """Look a transform up."""
    transforms = Transforms()
    for stamp_ns, x, y, yaw in ((0, 0.0, 0.0, 0.0), (END_NS, 10.0, -4.0, TURN)):
        quaternion = np.array([math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)])
        transforms.add("map", "base", stamp_ns, np.array([x, y, 0.0]), quaternion)
    found = transforms.lookup("map", "base", at_ns)
    w, _, _, z = found.quaternion.tolist()
    return float(found.translation[0]), float(found.translation[1]), 2.0 * math.atan2(z, w)


def of_tables(at_ns: int, folder: Path) -> Place:
    """Read a detection with the poses of another table."""
    columns = {name: np.array([0.5]) for name in ("x", "y", "z", "l", "w", "h", "yaw", "score")}
    write_table(folder / "boxes.csv", {"t": np.array([at_ns / 1e9]), "class": np.array(["car"]), **columns})
    ends = {"t": [0.0, 1.0], "x": [0.0, 10.0], "y": [0.0, -4.0], "yaw": [0.0, TURN]}
    write_table(folder / "poses.csv", {name: np.array(values) for name, values in ends.items()})
    options = {"poses": str(folder / "poses.csv"), "time": "s", "yaw": "radians"}
    (sequence,) = open_dataset("table", folder / "boxes.csv", **options).sequences(["all"])
    (frame,) = sequence.frames()
    assert frame.pose is not None
    w, _, _, z = frame.pose.quaternion.tolist()
    return float(frame.pose.translation[0]), float(frame.pose.translation[1]), 2.0 * math.atan2(z, w)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.25, 0.9, 1.0])
@pytest.mark.parametrize("place", [of_transforms, of_tables])
def test_a_share_of_the_time_is_that_share_of_the_way(
    place: Callable[[int, Path], Place], share: float, tmp_path: Path
) -> None:
    """Positions lie on the line and headings on the arc, as far from the first as the time is."""
    assert place(round(share * END_NS), tmp_path) == pytest.approx((10.0 * share, -4.0 * share, TURN * share))
