"""Data sets: detections, poses, clouds and truth, read or generated, behind one interface."""

from pathlib import Path
from typing import Any, TypeAlias

from optipmb_tools.datasets.interface import (
    Cloud,
    DataSequence,
    Dataset,
    DatasetArguments,
    DetectionFrame,
    Preloaded,
    Regions,
    Truth,
    digits_of,
    georeference_of,
    selected_frames,
    time_origin_of,
)
from optipmb_tools.extras import needed
from optipmb_tools.files import DatasetError, reading
from optipmb_tools.geometry import Pose
from optipmb_tools.table_files import tables_in

__all__ = [
    "DATASETS",
    "Cloud",
    "DataSequence",
    "Dataset",
    "DatasetArguments",
    "DatasetError",
    "DetectionFrame",
    "Pose",
    "Preloaded",
    "Regions",
    "Truth",
    "dataset_at",
    "open_dataset",
    "selected_frames",
]

_ROS2_MCAP = b"\x04\x00\x00\x00ros2"  # profile in the header of an MCAP file of ROS 2
_HEAD = 64


def open_dataset(
    name: str, root: Path | str | None = None, detections: str | Path | None = None, **options: float | str
) -> Dataset:
    """Return a data set by name.

    Args:
        name: One of `DATASETS`.
        root: Folder of a data set on disk, or file of a recording; a generated one takes none.
        detections: Detector whose results are used: its name, its folder or file. None when there is just one, or when
            only truth, poses and clouds are read.
        options: Of the data set. kitti: `clouds`, `poses`, `split`, `submission`; nuscenes: `clouds`, `z_bottom`,
            `submission`; scene: the fields of `SceneOptions`; mcap: none; rosbag: `points`, `odometry`, `fixed_frame`,
            `keep_input`, `invalid` and `class.NAME`; table: `optipmb_tools.datasets.table.OPTIONS`. For table and mcap
            also `fuse`: the sensors of a recording share a density. For all `origin`: as of `Georeference.parse`;
            `digits`: `unit` or `full`, of numbers in tables of tracks as text; and `time_origin`: the time in UTC of
            the stamp 0, for GeoJSON, MF-JSON and OpenLABEL.

    Raises:
        DatasetError: The name, the root, the detector or an option is not known.
    """
    place = None if root is None else Path(root)
    arguments = DatasetArguments(name, place, None if detections is None else str(detections), tuple(options.items()))
    if name not in DATASETS:
        raise DatasetError("--dataset", " or ".join(DATASETS), repr(name))
    if name == "scene" and (root is not None or detections is not None):
        raise DatasetError("--root and --detections", "nothing, for scenes are generated", str(root or detections))
    if name != "scene" and root is None:
        raise DatasetError("--root", "the file or folder of the dataset", "nothing")
    if name in {"table", "mcap", "rosbag"} and detections is not None:
        raise DatasetError("--detections", "nothing, for the file itself has them", repr(str(detections)))
    fuse = name != "scene" and str(options.pop("fuse", "0")) not in {"0", "0.0", "False"}
    if fuse and name not in {"table", "mcap"}:
        raise DatasetError("--fuse", "a table with a column `sensor`, or a recording (.mcap)", name)
    digits = digits_of(options.pop("digits", "unit"))
    time_origin_ns = time_origin_of(options.pop("time_origin")) if "time_origin" in options else 0
    georeference = None
    if "origin" in options:
        georeference = georeference_of(options["origin"])
    if name != "table":  # whose latitudes and longitudes need it
        options.pop("origin", None)
    with reading(place or name):
        opened = [_OPEN[name](place or Path(), detections, options)]
    if fuse:
        from optipmb_tools.datasets.fused import FusedDataset  # noqa: PLC0415  of one format

        opened.append(FusedDataset(opened[0]))
    for one in opened:
        one.arguments, one.georeference, one.digits = arguments, georeference, digits
        one.time_origin_ns = time_origin_ns
    return opened[-1]


# Each function imports the modules of its format: a command reads one, and some need packages of extras.
_Options: TypeAlias = dict[str, float | str]


def _kitti(root: Path, detections: str | Path | None, options: _Options) -> Dataset:
    from optipmb_tools.datasets.kitti import KittiDataset  # noqa: PLC0415  of one format

    _check(options, "clouds", "poses", "split", "submission")
    texts: dict[str, Any] = {name: str(value) for name, value in options.items() if name != "clouds"}
    return KittiDataset(root, detections, clouds=bool(options.get("clouds", True)), **texts)


def _nuscenes(root: Path, detections: str | Path | None, options: _Options) -> Dataset:
    from optipmb_tools.datasets.nuscenes import NuScenesDataset  # noqa: PLC0415  of one format

    _check(options, "clouds", "submission", "z_bottom")
    if (score := str(options.get("submission", "default"))) != "default":
        raise DatasetError("--submission", "no score: AMOTA of nuScenes counts all tracks", score)
    flags: dict[str, Any] = {name: bool(options[name]) for name in ("clouds", "z_bottom") if name in options}
    return NuScenesDataset(root, detections, submission="submission" in options, **flags)


def _mcap(root: Path, _: str | Path | None, options: _Options) -> Dataset:
    needed("recordings", "record", "mcap", need="need")
    from optipmb_tools.datasets.mcap import RecordedDataset  # noqa: PLC0415  of one format

    _check(options)
    return RecordedDataset(root)


def _table(root: Path, _: str | Path | None, options: _Options) -> Dataset:
    from optipmb_tools.datasets.table import TableDataset  # noqa: PLC0415  of one format

    return TableDataset(root, {option: str(value) for option, value in options.items()})


def _rosbag(root: Path, _: str | Path | None, options: _Options) -> Dataset:
    needed("bags", "ros2", "rosbags", need="need")
    from optipmb_tools.datasets.rosbag import RosbagDataset  # noqa: PLC0415  of one format

    return RosbagDataset(root, options)


def _scene(_root: Path, _: str | Path | None, options: _Options) -> Dataset:
    from optipmb_tools.datasets.scene.dataset import SceneDataset, scene_options  # noqa: PLC0415  of one format

    numbers = {}
    for option, value in options.items():
        if isinstance(value, str):
            raise DatasetError(f"option {option}", "a number", repr(value))
        numbers[option] = value
    return SceneDataset(scene_options(numbers))


_OPEN = {"kitti": _kitti, "nuscenes": _nuscenes, "scene": _scene, "mcap": _mcap, "rosbag": _rosbag, "table": _table}
DATASETS = tuple(_OPEN)


def _check(options: _Options, *known: str) -> None:
    for option in options:
        if option not in known:
            raise DatasetError(f"option {option}", f"one of {', '.join(known)}", "an unknown option")


def dataset_at(path: Path) -> str:
    """Return the name of the data set that a file or folder is by its looks.

    Raises:
        DatasetError: It looks like none.
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
