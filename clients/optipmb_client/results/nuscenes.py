"""Result files of the nuScenes tracking benchmark: `tracking_results.json`, all samples of all scenes of one run.

The layout is the one of `optipmb_client.results.nuscenes_layout`. `tracking_id` is the name of the scene with the id of
the track, so that no two scenes share one. Numbers have six decimals, samples are in order of time and boxes in the
order of the tracks, so the same tracks always give the same bytes. A sample holds at most 500 boxes, as the benchmark
demands: of more, those with the highest scores are written.

Each scene is first a file of its own, `scenes/NAME.json`, in the same layout; at the end of a run they are joined in
`tracking_results.json`. A run that is interrupted leaves the scenes that it finished.
"""

import itertools
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from optipmb_schemas import Tracks

from optipmb_client.files import DatasetError, read_text, write_whole
from optipmb_client.geometry import Ints, PoseLike
from optipmb_client.results.nuscenes_layout import NUSCENES_CLASSES, NUSCENES_META, Submission, read_submission
from optipmb_client.results.rows import ResultTable, ResultWriter, stacked

NUSCENES_FILE = "tracking_results.json"
NUSCENES_MAX_BOXES = 500  # boxes in one sample that the benchmark accepts

_DECIMALS = 6
_DIGITS = 18
_END = "\n}}\n"


def scene_file(out: Path, scene: str) -> Path:
    """Return the path of the file of one scene."""
    return out / "scenes" / f"{scene}.json"


def join_scenes(out: Path, scenes: Sequence[str], meta: Mapping[str, Any]) -> None:
    """Write `tracking_results.json` from the files of these scenes, in their order; `meta` is that of the writers.

    Raises:
        DatasetError: the file of a scene cannot be read.
    """
    head = _head(meta)
    texts = (read_text(scene_file(out, name), "the results of a scene") for name in scenes)
    parts = ((",\n" if i else "") + text[len(head) : -len(_END)] for i, text in enumerate(texts))
    write_whole(out / NUSCENES_FILE, itertools.chain([head], parts, [_END]))


def _head(meta: Mapping[str, Any]) -> str:
    used = {name: bool(meta.get(name, name == "use_lidar")) for name in NUSCENES_META}
    return f'{{"meta": {json.dumps(used)}, "results": {{\n'


class NuScenesResultWriter(ResultWriter):
    """Writes the tracks of one scene; use it as a context manager, or call `close` at the end.

    Args:
        out: the folder of all scenes.
        scene: its name.
        samples: the tokens of its samples, in order of time.
        meta: the meta of the detections.
    """

    def __init__(self, out: Path, scene: str, samples: Sequence[str], meta: Mapping[str, Any]) -> None:
        super().__init__(scene_file(out, scene))
        self._scene = scene
        self._samples = samples
        self._head = _head(meta)
        self._lines: dict[int, str] = {}

    def add(self, index: int, pose: PoseLike, tracks: Tracks) -> None:  # noqa: ARG002  boxes are global
        """Write the tracks (world frame) of frame `index`; the benchmark wants no sensor frame, so no pose.

        Raises:
            DatasetError: a track is of a class that the benchmark does not have.
        """
        unknown = [name for name in np.asarray(tracks.labels)[tracks.label].tolist() if name not in NUSCENES_CLASSES]
        if unknown:
            raise DatasetError("--profile", f"the classes {', '.join(NUSCENES_CLASSES)}", f"tracks of {unknown[0]!r}")
        rows = np.sort(np.argsort(-tracks.score, kind="stable")[:NUSCENES_MAX_BOXES])
        half = 0.5 * tracks.yaw[rows]
        # The official reader refuses unknown velocities, so they are written as standing still. Adding zero turns a
        # rounded -0 into 0, so that equal numbers are written alike.
        values = np.column_stack(
            [
                tracks.center[rows],
                tracks.size[rows][:, [1, 0, 2]],
                np.cos(half),
                np.sin(half),
                np.nan_to_num(tracks.velocity[rows]),
                tracks.score[rows],
            ]
        )
        token = self._samples[index]
        boxes = [
            {
                "sample_token": token,
                "translation": row[:3],
                "size": row[3:6],
                "rotation": [row[6], 0.0, 0.0, row[7]],
                "velocity": row[8:10],
                "tracking_id": f"{self._scene}-{identity}",
                "tracking_name": tracks.labels[label],
                "tracking_score": row[10],
            }
            for row, identity, label in zip(
                (np.round(values, _DECIMALS) + 0.0).tolist(), tracks.id[rows], tracks.label[rows], strict=True
            )
        ]
        self._lines[index] = json.dumps(boxes, allow_nan=False)

    def close(self) -> None:
        """Put the file in its place, with an empty list for every sample without tracks."""
        lines = (f"{json.dumps(token)}: {self._lines.get(i, '[]')}" for i, token in enumerate(self._samples))
        write_whole(self.path, [self._head, ",\n".join(lines), _END])


def read_nuscenes_results(path: Path) -> Submission:
    """Return a result file, or the one in a folder.

    Raises:
        DatasetError: it cannot be read, is not in the layout, or holds more boxes in a sample than the benchmark takes.
    """
    file = path / NUSCENES_FILE if path.is_dir() else path
    results = read_submission(file, "tracking")
    for token, rows in results.rows.items():
        if len(rows) > NUSCENES_MAX_BOXES:
            raise DatasetError(file, f"at most {NUSCENES_MAX_BOXES} boxes in results.{token}", f"{len(rows)}")
    return results


def result_table(results: Submission, scene: str, samples: Sequence[str]) -> ResultTable:
    """Return the tracks of one scene in the world frame; frames count along `samples`.

    Ids are the numbers behind the name of the scene, as the writer has them; other ids are numbered in order of
    appearance.

    Raises:
        DatasetError: a sample is missing, or an id stands twice in a sample.
    """
    frames = [results.boxes(token) for token in samples]
    names = [name for boxes in frames for name in boxes.id]
    for token, boxes in zip(samples, frames, strict=True):
        if len(set(boxes.id)) < len(boxes):
            twice = next(name for i, name in enumerate(boxes.id) if name in boxes.id[:i])
            raise DatasetError(results.path, f"a tracking_id once in results.{token}", f"{twice!r} again")
    label, center, size, yaw, score = (stacked(frames, name) for name in ("label", "center", "size", "yaw", "score"))
    frame, image = np.repeat(np.arange(len(frames)), [len(boxes) for boxes in frames]), np.full((len(names), 4), np.nan)
    return ResultTable(NUSCENES_CLASSES, frame, _numbers(scene, names), label, center, size, yaw, score, image)


def _numbers(scene: str, names: Sequence[str]) -> Ints:
    prefix = f"{scene}-"
    tails = [name.removeprefix(prefix) for name in names]
    ours = all(
        name.startswith(prefix) and len(tail) < _DIGITS and tail.isascii() and tail.isdigit() and str(int(tail)) == tail
        for name, tail in zip(names, tails, strict=True)
    )
    if ours:
        return np.array([int(tail) for tail in tails], dtype=np.int64)
    number = {name: i for i, name in enumerate(dict.fromkeys(names))}
    return np.array([number[name] for name in names], dtype=np.int64)
