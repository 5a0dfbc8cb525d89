"""Damaged files: each reader gives the readable part, or one clear error, and no library's error or warning."""

import json
import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import nuscenes_tables as nuscenes
import pytest
from bags import messages, write_mcap, write_sqlite
from optipmb_client.errors import ClientError, UsageError
from optipmb_schemas import MessageError
from optipmb_tools.datasets import open_dataset
from optipmb_tools.files import DatasetError
from optipmb_tools.results.kitti import read_kitti_results
from optipmb_tools.results.nuscenes import read_submission
from optipmb_tools.table_files import write_table
from own_tables import boxes

DAMAGES = 200
ROWS = 12
WRONG = (b"", b"null", b'"x"', b"[]", b"{}", b"nan", b"-1", b"1e308", b"-1e308", b"99999999999999999999", b"true", b",")
BOX = "Car 0.00 0 0.0 1 2 3 4 1.5 1.9 4.5 {k} 1.6 20 0.1 0.9\n"
LABEL = "{k} 1 Car 0 0 0.0 1 2 3 4 1.5 1.9 4.5 1 1.6 20 0.1"
CALIBRATION = (
    "P2: 700 0 600 45 0 700 180 0 0 0 1 0\nR0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0\n"
)
POSE = "1 0 0 0 0 1 0 0 0 0 1 {k}\n"
DETECTION = "{k},2,1,2,3,4,0.9,1.5,1.9,4.5,1,1.6,20,0.1,0\n"


def damaged(data: bytes, seed: int) -> bytes:
    """Return a file that was cut, whose bytes were shuffled or replaced, or in which a number is something else."""
    chance = random.Random(seed)
    if seed % 4 == 0:
        return data[: chance.randrange(len(data))]
    at = chance.randrange(len(data))
    if seed % 4 == 1:
        part = bytearray(data[at : at + 40])
        chance.shuffle(part)
        return data[:at] + bytes(part) + data[at + len(part) :]
    if seed % 4 == 2:
        return data[:at] + chance.randbytes(chance.choice((1, 2, 8))) + data[at + 1 :]
    begin = next((i for i in range(at, len(data)) if data[i : i + 1].isdigit()), at)
    end = next((i for i in range(begin, len(data)) if not data[i : i + 1].isdigit()), len(data))
    return data[:begin] + chance.choice(WRONG) + data[end:]


def table(name: str) -> Callable[[Path], tuple[Path, Callable[[], None]]]:
    """Return a function that writes a table, and gives it with the function that reads it."""

    def made(folder: Path) -> tuple[Path, Callable[[], None]]:
        path = folder / name
        columns = {column: values[:ROWS] for column, values in boxes(id=np.arange(90) % 3).items()}
        if path.suffix == ".json":
            rows = [
                dict(zip(columns, row, strict=True))
                for row in zip(*(c.tolist() for c in columns.values()), strict=True)
            ]
            path.write_text(json.dumps(rows))
        else:
            write_table(path, columns)
        return path, lambda: whole("table", path)

    return made


def whole(name: str, root: Path, **options: str) -> None:
    for sequence in open_dataset(name, root, **options).sequences(["all"]):
        list(sequence.frames())
        _ = sequence.truth(), sequence.notes


def kitti(damage: str) -> Callable[[Path], tuple[Path, Callable[[], None]]]:
    def made(folder: Path) -> tuple[Path, Callable[[], None]]:
        for place, text in {
            "training/calib/0000.txt": CALIBRATION,
            "training/poses/0000.txt": "".join(POSE.format(k=k) for k in range(3)),
            "training/label_02/0000.txt": "".join(LABEL.format(k=k) + "\n" for k in range(3)),
            "detections/own/Car/0000.txt": "".join(DETECTION.format(k=k) for k in range(3)),
        }.items():
            (folder / place).parent.mkdir(parents=True, exist_ok=True)
            (folder / place).write_text(text)
        return folder / damage, lambda: whole("kitti", folder)

    return made


def frames_of_kitti(folder: Path) -> tuple[Path, Callable[[], None]]:
    (folder / "boxes").mkdir()
    for k in range(3):
        (folder / "boxes" / f"{k:06d}.txt").write_text(BOX.format(k=k))
    return folder / "boxes" / "000001.txt", lambda: whole("table", folder / "boxes", rate="10")


def of_nuscenes(damage: str) -> Callable[[Path], tuple[Path, Callable[[], None]]]:
    def made(folder: Path) -> tuple[Path, Callable[[], None]]:
        scene = nuscenes.Scene("scene-0103", [(100.0, 200.0)] * 2, [])
        nuscenes.write_root(folder, [scene])
        boxes_ = {scene.token(k): [nuscenes.box(scene.token(k))] for k in range(2)}
        nuscenes.write_detections(folder, "made", [scene], boxes_)
        return folder / damage, lambda: whole("nuscenes", folder)

    return made


def bag(name: str) -> Callable[[Path], tuple[Path, Callable[[], None]]]:
    def made(folder: Path) -> tuple[Path, Callable[[], None]]:
        scene = open_dataset("scene", frames=3, vehicles=2, pedestrians=0, cyclists=0, clouds=0).sequences(["all"])[0]
        sent = list(messages(scene))
        root = folder / name
        file = write_mcap(root, sent) if root.suffix == ".mcap" else next(write_sqlite(root, sent).glob("*.db3"))
        return file, lambda: whole("rosbag", root)

    return made


def results(name: str) -> Callable[[Path], tuple[Path, Callable[[], None]]]:
    def made(folder: Path) -> tuple[Path, Callable[[], None]]:
        path = folder / name
        if path.suffix == ".txt":
            path.write_text("".join(LABEL.format(k=k) + " 0.9\n" for k in range(3)))
            return path, lambda: _done(read_kitti_results(path))
        one = nuscenes.box("s", tracking_id="1", tracking_name="car", tracking_score=0.9)
        path.write_text(json.dumps({"meta": {}, "results": {"s": [one]}}))
        return path, lambda: _done(read_submission(path, "tracking").boxes("s"))

    return made


def _done(_: Any) -> None:
    """Drop a result."""


READERS = {
    **{name: table(f"d.{name}") for name in ("csv", "tsv", "jsonl", "json", "parquet", "feather")},
    "frames": frames_of_kitti,
    "calib": kitti("training/calib/0000.txt"),
    "poses": kitti("training/poses/0000.txt"),
    "labels": kitti("training/label_02/0000.txt"),
    "detections": kitti("detections/own/Car/0000.txt"),
    "nuscenes": of_nuscenes("detections/made.json"),
    "samples": of_nuscenes("v1.0-mini/sample.json"),
    "poses of nuscenes": of_nuscenes("v1.0-mini/ego_pose.json"),
    "mcap": bag("d.mcap"),
    "db3": bag("d"),
    "results of KITTI": results("0000.txt"),
    "results of nuScenes": results("tracking_results.json"),
}


@pytest.mark.parametrize("reader", READERS)
def test_a_damaged_file_is_read_or_refused(reader: str, tmp_path: Path) -> None:
    """Each of 200 damages gives the readable part, or one error that names the place; warnings are errors here."""
    path, read = READERS[reader](tmp_path)
    data = path.read_bytes()
    read()
    wrong = []
    for seed in range(DAMAGES):
        path.write_bytes(damaged(data, seed))
        try:
            read()
        except (DatasetError, UsageError, MessageError, ClientError):
            continue
        except Exception as error:  # noqa: BLE001  all of them are listed
            wrong.append(f"{seed}: {type(error).__name__}: {error}")
    assert not wrong, "\n".join(wrong)
    shutil.rmtree(tmp_path)
