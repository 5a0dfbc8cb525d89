"""Boxes in lists of nested JSON, and columns in JSON."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from optipmb_tools.datasets.table import TableDataset
from optipmb_tools.files import DatasetError
from optipmb_tools.table_files import read_table


def players(frame: int) -> list[dict[str, Any]]:
    return [{"x": 10.0 * n + 0.1 * frame, "y": 5.0, "player_id": n} for n in range(4)]


def read(path: Path, content: object, **options: str) -> dict[str, Any]:
    path.write_text(json.dumps(content))
    return read_table(path, options)


BALL = {"x": 0.0, "y": 1.0, "z": 0.2}
NAMES = ["car", "car", "person", "person"]


@pytest.mark.parametrize("outer", ["{}", '{"data": {}}', '{"frame": {"objects3": {}}}'])
def test_the_list_of_boxes_is_found_at_any_depth(tmp_path: Path, outer: str) -> None:
    """Not a single object beside it, and not a list of numbers of its own, is read in its place."""
    frames = [
        {"t": 0.1 * n, "ball": BALL, "agents": players(n), "map": {"bounds": [0, 1, 2]}, **json.loads(outer)}
        for n in range(5)
    ]
    found = read(tmp_path / "a.json", {"meta": {"fps": 10}, "frames": frames})
    assert len(found["x"]) == 20
    assert found["x"][:4].tolist() == [0.0, 10.0, 20.0, 30.0]
    boxes = [[*(10.0 * n, 5.0, 0.8), *(4.0, 2.0, 1.5), 0.0] for n in range(4)]
    frames = [{"t": 0.1 * n, "annos": {"names": NAMES, "boxes_3d": boxes}} for n in range(5)]
    (tmp_path / "b.jsonl").write_text("\n".join(map(json.dumps, frames)))
    found = read_table(tmp_path / "b.jsonl")
    assert found["names"][:4].tolist() == NAMES
    assert found["boxes_3d.0"][3] == 30.0


def test_of_two_lists_of_boxes_the_user_chooses(tmp_path: Path) -> None:
    """Both are named, and both can be read: then their names are the kinds of the boxes."""
    frames = [{"t": 0.1 * n, "home": players(n), "away": players(n)[:1]} for n in range(5)]
    with pytest.raises(DatasetError, match=r"boxes=home,away.*the lists home, away"):
        read(tmp_path / "a.json", frames)
    assert len(read(tmp_path / "a.json", frames, boxes="away")["x"]) == 5
    assert np.unique(read(tmp_path / "a.json", frames, boxes="home,away")["kind"]).tolist() == ["away", "home"]
    TableDataset(tmp_path / "a.json", {"boxes": "home"})


@pytest.mark.parametrize("shape", ["columns", "lists", "split"])
def test_tables_of_data_frames_as_json_are_columns(tmp_path: Path, shape: str) -> None:
    """By the numbers of rows, as lists, and with the names of the columns apart."""
    t, x = [0.0, 0.1, 0.2], [1.0, 2.0, 3.0]
    content: dict[str, Any] = {
        "columns": {name: dict(zip("012", one, strict=True)) for name, one in (("t", t), ("x", x))},
        "lists": {"t": t, "x": x},
        "split": {"columns": ["t", "x"], "index": [0, 1, 2], "data": list(zip(t, x, strict=True))},
    }
    found = read(tmp_path / "a.json", content[shape])
    assert found["t"].tolist() == t
    assert found["x"].tolist() == x


def test_corners_and_paths_of_a_box_are_no_boxes(tmp_path: Path) -> None:
    """A row that has a place itself is one box, whatever lists of points it has."""
    rows = [{"t": 0.1 * n, "x": 1.0, "y": 2.0, "path": [{"x": 3.0, "y": 4.0}, {"x": 5.0, "y": 6.0}]} for n in range(5)]
    assert len(read(tmp_path / "a.json", rows)["x"]) == 5
