"""The recipes of docs/own-data.md run as they stand, on files as the detectors write them."""

import json
import pickle
import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import run_here
from nuscenes_tables import Scene, box, write_detections, write_root
from optipmb_tools.table_files import read_table, write_table
from own_tables import FRAMES, boxes
from real_data import REPOSITORY

PAGE = REPOSITORY / "docs" / "own-data.md"


def section() -> str:
    return PAGE.read_text().partition("\n## Recipes\n")[2].partition("\n## ")[0]


def recipes() -> dict[str, list[tuple[str, str]]]:
    parts = re.split(r"^### (.+)$", section(), flags=re.MULTILINE)[1:]
    found = zip(parts[::2], parts[1::2], strict=True)
    return {name: re.findall(r"^```(\w+)\n(.*?)^```", text, flags=re.DOTALL | re.MULTILINE) for name, text in found}


def lidar() -> np.ndarray:
    """Give the boxes (F, 3, 7) of two cars and a pedestrian."""
    columns = boxes()
    return np.column_stack([columns[name] for name in ("x", "y", "z", "l", "w", "h", "yaw")]).reshape(FRAMES, 3, 7)


def open_pcdet(folder: Path) -> None:
    names, scores = np.array(["Car", "Car", "Pedestrian"]), np.array([0.9, 0.8, 0.7], dtype=np.float32)
    frames: list[dict[str, Any]] = [
        {
            "name": names,
            "score": scores,
            "boxes_lidar": rows,
            "pred_labels": np.array([1, 1, 2]),
            "frame_id": f"{i:06d}",
        }
        for i, rows in enumerate(lidar())
    ]
    frames[4] |= {"name": np.zeros(0), "score": np.zeros(0), "boxes_lidar": np.zeros((0, 7))}
    (folder / "result.pkl").write_bytes(pickle.dumps(frames))


def mmdetection3d(folder: Path) -> None:
    (folder / "preds").mkdir()
    for i, rows in enumerate(lidar()):
        rows[:, 2] -= 0.5 * rows[:, 5]
        lists = {"labels_3d": [2, 1, 0], "scores_3d": [0.9, 0.8, 0.7], "bboxes_3d": rows.tolist()}
        (folder / "preds" / f"{i:06d}.json").write_text(json.dumps({**lists, "box_type_3d": "LiDAR"}))


def kitti_object(folder: Path) -> None:
    (folder / "results").mkdir()
    for i, rows in enumerate(lidar()):
        lines = [
            f"{name} -1 -1 0 0 0 9 9 {h} {w} {length} {-y} {-(z - h / 2)} {x} {-yaw - np.pi / 2} 0.9"
            for name, (x, y, z, length, w, h, yaw) in zip(("Car", "Car", "Pedestrian"), rows.tolist(), strict=True)
        ]
        (folder / "results" / f"{i:06d}.txt").write_text("\n".join(lines))


def nuscenes(folder: Path) -> None:
    scene = Scene("scene-0103", [(100.0, 200.0)] * 5, [])
    write_root(folder / "nuscenes", [scene])
    found = {scene.token(i): [box(scene.token(i), translation=[110.0, 200.0, 1.0])] for i in range(5)}
    write_detections(folder / "nuscenes", "made", [scene], found)
    (made,) = (folder / "nuscenes").rglob("made*.json")
    made.rename(folder / "results_nusc.json")


def argoverse_2(folder: Path) -> None:
    """Write `detections.feather` with the columns of the dataset, and its poses, 100 m to the left."""
    plain = boxes()
    columns = {"tx_m": plain["x"], "ty_m": plain["y"], "tz_m": plain["z"]}
    columns |= {"length_m": plain["l"], "width_m": plain["w"], "height_m": plain["h"]}
    columns |= {"qw": np.cos(plain["yaw"] / 2), "qx": 0 * plain["x"], "qy": 0 * plain["x"]}
    columns |= {"qz": np.sin(plain["yaw"] / 2), "score": plain["score"], "category": plain["class"]}
    columns["timestamp_ns"] = np.round(plain["t"] * 1e9).astype(np.int64) + 315_966_265_259_836_000
    write_table(folder / "detections.feather", columns)
    poses = {"timestamp_ns": columns["timestamp_ns"][::3], "qw": np.ones(FRAMES)}
    poses |= {name: np.zeros(FRAMES) for name in ("qx", "qy", "qz", "tx_m", "ty_m", "tz_m")}
    write_table(folder / "city_SE3_egovehicle.feather", poses | {"ty_m": np.full(FRAMES, 100.0)})


FILES = {
    "OpenPCDet": open_pcdet,
    "MMDetection3D": mmdetection3d,
    "KITTI object": kitti_object,
    "nuScenes": nuscenes,
    "Argoverse 2": argoverse_2,
}


@pytest.mark.parametrize("name", recipes())
def test_every_recipe_gives_tracks(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The blocks of a recipe, run one after the other where the files of the detector are, give their tracks."""
    FILES[name](tmp_path)
    monkeypatch.chdir(tmp_path)
    for _, text in recipes()[name]:
        program, *arguments = shlex.split(text)
        assert program == "optipmb"
        done = run_here(capsys, *arguments)
        assert done.returncode == 0, done.stderr
    if name == "nuScenes":
        assert json.loads((tmp_path / "tracks" / "tracking_results.json").read_text())["results"]
        return
    tracks = read_table(tmp_path / "tracks.csv")
    assert len(set(tracks["id"].tolist())) == 3
    assert {one.lower() for one in tracks["class"].tolist()} >= {"car", "pedestrian"}
    assert np.median(tracks["y"]) == pytest.approx(104.0 if name == "Argoverse 2" else 4.0, abs=1.0)
    last = tracks["frame"] == tracks["frame"].max()
    assert np.sort(tracks["x"][last]) == pytest.approx(np.sort(lidar()[-1, :, 0]), abs=0.3)
    assert tracks["z"][last] == pytest.approx(0.8, abs=0.11)
