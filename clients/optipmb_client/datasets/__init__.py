"""Datasets: detections, poses, clouds and truth, read or generated, behind one interface."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from optipmb_client.datasets.interface import Cloud, DataSequence, Dataset, DetectionFrame, Regions, Truth
from optipmb_client.files import DatasetError
from optipmb_client.geometry import Pose
from optipmb_client.table_files import tables_in

__all__ = [
    "DATASETS",
    "Cloud",
    "DataSequence",
    "Dataset",
    "DatasetArguments",
    "DatasetError",
    "DetectionFrame",
    "Pose",
    "Regions",
    "Truth",
    "dataset_at",
    "open_dataset",
]

_ROS2_MCAP = b"\x04\x00\x00\x00ros2"  # profile in the header of an MCAP file of ROS 2
_HEAD = 64

DATASETS = ("kitti", "nuscenes", "scene", "mcap", "rosbag", "table")


@dataclass(frozen=True)
class DatasetArguments:
    """What `open_dataset` is called with: enough to open the same dataset in another process."""

    name: str
    root: Path | None = None
    detections: str | None = None
    options: tuple[tuple[str, float | str], ...] = ()

    def open(self) -> Dataset:
        """Open the dataset; raises as `open_dataset` does."""
        return open_dataset(self.name, self.root, self.detections, **dict(self.options))


def open_dataset(
    name: str, root: Path | str | None = None, detections: str | Path | None = None, **options: float | str
) -> Dataset:
    """Return a dataset by name.

    Args:
        name: one of `DATASETS`.
        root: the folder of a dataset on disk, the file of a recording; a generated one takes none.
        detections: the detector whose results are used: its name, its folder or file. None when there is just one, or
            when only truth, poses and clouds are read.
        options: of the dataset. kitti: `clouds`, `poses`, `split`, `submission`; nuscenes: `clouds`, `z_bottom`,
            `submission`; scene: the fields of `SceneOptions`; mcap: none; rosbag: `points`, `odometry`, `fixed_frame`,
            `keep_input` and `class.NAME`; table: those of `optipmb_client.datasets.table.OPTIONS`. For table and mcap
            also `fuse`: the sensors of a recording share a density.

    Raises:
        DatasetError: the name, the root, the detector or an option is not known.
    """
    if name == "scene":
        if root is not None or detections is not None:
            raise DatasetError("--root and --detections", "nothing, for scenes are generated", str(root or detections))
        from optipmb_client.datasets.scene import SceneDataset, scene_options  # noqa: PLC0415 - of one format

        return SceneDataset(scene_options(_numbers(options)))
    if name not in DATASETS:
        raise DatasetError("--dataset", " or ".join(DATASETS), repr(name))
    if root is None:
        raise DatasetError("--root", "the file or folder of the dataset", "nothing")
    if name in {"table", "mcap", "rosbag"} and detections is not None:
        raise DatasetError("--detections", "nothing, for the file itself has them", repr(str(detections)))
    fuse = str(options.pop("fuse", "0")) not in {"0", "0.0", "False"}
    if fuse and name not in {"table", "mcap"}:
        raise DatasetError("--fuse", "a table with a column `sensor`, or a recording (.mcap)", name)
    opened = _OPEN[name](Path(root), detections, options)
    if not fuse:
        return opened
    from optipmb_client.datasets.fused import FusedDataset  # noqa: PLC0415 - of one format

    return FusedDataset(opened)


# Each function imports the modules of its format: a command reads one, and some need packages of extras.
_Options: TypeAlias = dict[str, float | str]


def _kitti(root: Path, detections: str | Path | None, options: _Options) -> Dataset:
    from optipmb_client.datasets.kitti import KittiDataset  # noqa: PLC0415 - of one format

    _known(options, {"clouds", "poses", "split", "submission"})
    text = {name: str(options[name]) for name in ("poses", "split", "submission") if name in options}
    return KittiDataset(root, detections, clouds=bool(options.get("clouds", True)), **text)


def _nuscenes(root: Path, detections: str | Path | None, options: _Options) -> Dataset:
    from optipmb_client.datasets.nuscenes import NuScenesDataset  # noqa: PLC0415 - of one format

    _known(options, {"clouds", "z_bottom", "submission"})
    z_bottom = bool(options["z_bottom"]) if "z_bottom" in options else None
    clouds, submission = bool(options.get("clouds", True)), "submission" in options
    if str(options.get("submission", "default")) != "default":
        raise DatasetError("--submission", "no score: AMOTA of nuScenes counts all tracks", str(options["submission"]))
    return NuScenesDataset(root, detections, clouds=clouds, z_bottom=z_bottom, submission=submission)


def _mcap(root: Path, _: str | Path | None, options: _Options) -> Dataset:
    from optipmb_client.datasets.mcap import RecordedDataset  # noqa: PLC0415 - of one format

    _known(options, set())
    return RecordedDataset(root)


def _table(root: Path, _: str | Path | None, options: _Options) -> Dataset:
    from optipmb_client.datasets.table import TableDataset  # noqa: PLC0415 - of one format

    return TableDataset(root, {key: str(value) for key, value in options.items()})


def _rosbag(root: Path, _: str | Path | None, options: _Options) -> Dataset:
    from optipmb_client.datasets.rosbag import RosbagDataset  # noqa: PLC0415 - of one format

    return RosbagDataset(root, dict(options))


_OPEN = {"kitti": _kitti, "nuscenes": _nuscenes, "mcap": _mcap, "rosbag": _rosbag, "table": _table}


def dataset_at(path: Path) -> str:
    """Return the name of the dataset that a file or folder is by its looks.

    Raises:
        DatasetError: it looks like none.
    """
    if not path.is_dir() and tables_in(path):
        return "table"
    if (path / "metadata.yaml").is_file() or path.suffix == ".db3":
        return "rosbag"
    if path.suffix == ".mcap" and path.is_file():
        return "rosbag" if _is_ros2(path) else "mcap"
    if path.is_dir():
        if any(path.glob("v1.0-*")):
            return "nuscenes"
        if (path / "training").is_dir() or (path / "testing").is_dir():
            return "kitti"
        tables, recordings = tables_in(path), list(path.glob("*.mcap"))
        if tables or (recordings and not any(map(_is_ros2, recordings))):
            return "table" if tables else "mcap"
    expected = (
        "a table (.csv, .parquet, .jsonl, .json, .feather), a bag of ROS 2 (with metadata.yaml, or .mcap or .db3), a "
        "recording (.mcap) or a folder of them, or a folder of KITTI or nuScenes"
    )
    raise DatasetError(path, expected, "another file or folder" if path.exists() else "nothing")


def _is_ros2(path: Path) -> bool:
    with path.open("rb") as file:
        return _ROS2_MCAP in file.read(_HEAD)


def _known(options: Mapping[str, object], known: set[str]) -> None:
    for option in options:
        if option not in known:
            raise DatasetError(f"option {option}", f"one of {', '.join(sorted(known))}", "an unknown option")


def _numbers(options: _Options) -> dict[str, float | bool]:
    for option, value in options.items():
        if isinstance(value, str):
            raise DatasetError(f"option {option}", "a number", repr(value))
    return {option: value for option, value in options.items() if not isinstance(value, str)}
