"""Datasets: detections, poses, clouds and truth, read or generated, behind one interface."""

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
    "open_dataset",
]

DATASETS = ("kitti", "nuscenes", "scene", "mcap")


def open_dataset(
    name: str, root: Path | str | None = None, detections: str | Path | None = None, **options: float | bool
) -> Dataset:
    """Return a dataset by name.

    Args:
        name: one of `DATASETS`.
        root: the folder of a dataset on disk, the file of a recording; a generated one takes none.
        detections: the detector whose results are used: its name, its folder or file. None when there is just one, or
            when only truth, poses and clouds are read.
        options: of the dataset. kitti: `clouds`; nuscenes: `clouds`, `z_bottom`; scene: the fields of `SceneOptions`;
            mcap: none.

    Raises:
        DatasetError: the name, the root, the detector or an option is not known.

    """
    if name == "kitti":
        if root is None:
            raise DatasetError("--root", "the folder of the dataset", "nothing")
        _known(options, {"clouds"})
        return KittiDataset(Path(root), detections, clouds=bool(options.get("clouds", True)))
    if name == "nuscenes":
        if root is None:
            raise DatasetError("--root", "the folder of the dataset", "nothing")
        _known(options, {"clouds", "z_bottom"})
        z_bottom = bool(options["z_bottom"]) if "z_bottom" in options else None
        return NuScenesDataset(Path(root), detections, clouds=bool(options.get("clouds", True)), z_bottom=z_bottom)
    if name == "mcap":
        from optipmb_client.datasets.mcap import RecordedDataset  # noqa: PLC0415 - needs packages of an extra

        if root is None or detections is not None:
            raise DatasetError("--root", "the file of the recording, and no --detections", str(detections or "nothing"))
        _known(options, set())
        return RecordedDataset(Path(root))
    if name == "scene":
        if root is not None or detections is not None:
            raise DatasetError("--root and --detections", "nothing, for scenes are generated", str(root or detections))
        return SceneDataset(scene_options(options))
    raise DatasetError("--dataset", " or ".join(DATASETS), repr(name))


def _known(options: dict[str, float | bool], known: set[str]) -> None:
    for option in options:
        if option not in known:
            raise DatasetError(f"option {option}", f"one of {', '.join(sorted(known))}", "an unknown option")
