"""Where recorded data are, for the tests that need them: they may not be part of this repository."""

import json
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


def all_nuscenes(root: Path) -> Path:
    """Write one root with the tables and detections of all nuScenes scenes that there are; skip without the second."""
    parts = [nuscenes_root(), _find("nuscenes-more", "NUSCENES_MORE_ROOT")]
    for path in sorted((parts[0] / "v1.0-mini").glob("*.json")):
        files = [json.loads((part / "v1.0-mini" / path.name).read_bytes()) for part in parts]
        rows = {row["token"]: row for file in files for row in file}
        target = root / "v1.0-mini" / path.name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(json.dumps(list(rows.values())), encoding="utf-8")
    for name in ("centerpoint", "megvii"):
        one, other = (json.loads((part / "detections" / f"{name}.json").read_bytes()) for part in parts)
        target = root / "detections" / f"{name}.json"
        target.parent.mkdir(exist_ok=True)
        target.write_text(json.dumps(one | {"results": one["results"] | other["results"]}), encoding="utf-8")
    return root


def _find(name: str, variable: str) -> Path:
    given = os.environ.get(variable)
    places = [Path(given)] if given else sorted(REPOSITORY.parent.glob(f"*/data/{name}"))
    for place in places:
        if (place / "detections").is_dir():
            return place
    pytest.skip(f"no {name} data: neither {variable} nor data/{name} in a folder beside this repository")
