"""Where recorded data are, for the tests that need them: they may not be part of this repository."""

import os
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]


def kitti_root() -> Path:
    """Give the folder with KITTI tracking data and detections; skip the test where there is none."""
    return _find("kitti", "KITTI_ROOT")


def nuscenes_root() -> Path:
    """Give the folder with nuScenes tables and detections; skip the test where there is none."""
    return _find("nuscenes", "NUSCENES_ROOT")


def _find(name: str, variable: str) -> Path:
    given = os.environ.get(variable)
    places = [Path(given)] if given else sorted(REPOSITORY.parent.glob(f"*/data/{name}"))
    for place in places:
        if (place / "detections").is_dir():
            return place
    pytest.skip(f"no {name} data: neither {variable} nor data/{name} in a folder beside this repository")
