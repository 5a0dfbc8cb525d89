"""Datasets: detections, poses, clouds and truth, read or generated, behind one interface."""

from collections.abc import Mapping
from pathlib import Path

from optipmb_client.datasets.interface import (
    Cloud,
    DataSequence,
    Dataset,
    DetectionFrame,
    Regions,
    Truth,
)
from optipmb_client.datasets.kitti import KittiDataset
from optipmb_client.datasets.nuscenes import NuScenesDataset
from optipmb_client.datasets.scene import SceneDataset, scene_options
from optipmb_client.files import DatasetError
from optipmb_client.geometry import Pose

__all__ = [
    "DATASETS",
    "Cloud",
    "DataSequence",
    "Dataset",
    "DatasetError",
    "DetectionFrame",
    "Pose",
    "Regions",
    "Truth",
    "dataset_at",
    "open_dataset",
]

_ROS2_MCAP = b"\x04\x00\x00\x00ros2"
"""Profile in the header of an MCAP file of ROS 2."""
_HEAD = 64

DATASETS = ("kitti", "nuscenes", "scene", "mcap", "rosbag")


def open_dataset(
    name: str, root: Path | str | None = None, detections: str | Path | None = None, **options: float | bool | str
) -> Dataset:
    """Return a dataset by name.

    Args:
        name: one of `DATASETS`.
        root: the folder of a dataset on disk, the file of a recording; a generated one takes none.
        detections: the detector whose results are used: its name, its folder or file. None when there is just one, or
            when only truth, poses and clouds are read.
        options: of the dataset. kitti: `clouds`; nuscenes: `clouds`, `z_bottom`; scene: the fields of `SceneOptions`;
            mcap: none; rosbag: `points`, `odometry`, `fixed_frame`, `keep_input` and `class.NAME`.

    Raises:
        DatasetError: the name, the root, the detector or an option is not known.

    """
    if name not in DATASETS:
        raise DatasetError("--dataset", " or ".join(DATASETS), repr(name))
    if name == "scene":
        if root is not None or detections is not None:
            raise DatasetError("--root and --detections", "nothing, for scenes are generated", str(root or detections))
        return SceneDataset(scene_options({name: _number(name, value) for name, value in options.items()}))
    if root is None:
        raise DatasetError("--root", "the folder or file of the dataset", "nothing")
    if name in {"mcap", "rosbag"}:
        if detections is not None:
            raise DatasetError("--detections", f"nothing, for the file of {name} holds them", str(detections))
        return _recorded(name, Path(root), options)
    _known(options, {"clouds"} if name == "kitti" else {"clouds", "z_bottom"})
    clouds = bool(options.get("clouds", True))
    if name == "kitti":
        return KittiDataset(Path(root), detections, clouds=clouds)
    z_bottom = bool(options["z_bottom"]) if "z_bottom" in options else None
    return NuScenesDataset(Path(root), detections, clouds=clouds, z_bottom=z_bottom)


def _recorded(name: str, path: Path, options: dict[str, float | bool | str]) -> Dataset:
    if name == "rosbag":
        from optipmb_client.datasets.rosbag import RosbagDataset  # noqa: PLC0415 - needs packages of an extra

        return RosbagDataset(path, options)
    from optipmb_client.datasets.mcap import RecordedDataset  # noqa: PLC0415 - as above

    _known(options, set())
    return RecordedDataset(path)


def dataset_at(path: Path) -> str:
    """Return the name of the dataset that a path is: a bag of ROS 2, or a recording of streams.

    Raises:
        DatasetError: it is neither.
    """
    if (path / "metadata.yaml").is_file() or path.suffix == ".db3":
        return "rosbag"
    if path.suffix == ".mcap" and path.is_file():
        with path.open("rb") as file:
            return "rosbag" if _ROS2_MCAP in file.read(_HEAD) else "mcap"
    received = "a folder without it" if path.is_dir() else "another file" if path.exists() else "nothing"
    raise DatasetError(path, "a bag of ROS 2 (with metadata.yaml, or .mcap or .db3) or a recording (.mcap)", received)


def _number(name: str, value: float | bool | str) -> float:  # noqa: FBT001  an option's value
    if isinstance(value, str):
        raise DatasetError(f"option {name}", "a number", repr(value))
    return value


def _known(options: Mapping[str, object], known: set[str]) -> None:
    for option in options:
        if option not in known:
            raise DatasetError(f"option {option}", f"one of {', '.join(sorted(known))}", "an unknown option")
