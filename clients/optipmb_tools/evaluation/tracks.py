"""The tracks of a run, read for evaluation: a table of anybody's, or the result files of a dataset in a folder."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from optipmb_tools.datasets import DataSequence, DatasetError, Truth
from optipmb_tools.datasets.interface import ANNOTATIONS, class_like
from optipmb_tools.datasets.kitti import KittiSequence
from optipmb_tools.datasets.nuscenes import NuScenesSequence
from optipmb_tools.datasets.table import ObjectTable, TableOptions, TableSequence, read_objects, span
from optipmb_tools.evaluation.calibration import rows_of
from optipmb_tools.results import FullTable, ResultTable, full_path, full_table, read_full
from optipmb_tools.results.kitti import LEAST_SHOWN, read_kitti_results
from optipmb_tools.results.nuscenes import NUSCENES_FILE, Submission, read_nuscenes_results, result_table
from optipmb_tools.results.output import SHOWN
from optipmb_tools.table_files import SUFFIXES, is_table

_OTHERS = ("Van", "Truck", "Person_sitting", "Person", "Tram")
"""Classes of KITTI that are no synonyms of evaluated ones."""


By = Literal["id", "object"]
"""Column that tells which rows are of one track."""

_BETTER = 0.5  # share of the distance from which another frame fits much better
_FAR = 20.0  # m from the truth, from which tracks are of other coordinates
_ENOUGH = 20  # boxes from which distances are compared


def read_compared(
    sequences: Sequence[DataSequence],
    results: Path,
    names: Sequence[str],
    warn: Callable[[str], None] | None = None,
    *,
    by: By = "id",
) -> list[tuple[Truth, ResultTable]]:
    """Return truth and tracks (as `read_tracks`) of each sequence, with one name for classes that mean the same.

    Args:
        sequences: what to compare with.
        results: as for `read_tracks`.
        names: classes to be evaluated, by whose names others are called.
        warn: is called with each assumption.
        by: as for `read_tracks`.

    Raises:
        DatasetError: a sequence has no truth, or as for `read_tracks`.
    """
    pairs = []
    for sequence in sequences:
        truth = sequence.truth()
        if truth is None:
            raise DatasetError(f"sequence {sequence.name}", ANNOTATIONS, "none")
        pairs.append((truth, read_tracks(results, sequence, by)))
    detected = _alike((label for one in sequences for label in one.labels), names)
    known = (*names, *detected.values())
    true = tuple(label for truth, _ in pairs for label in truth.labels)
    if not any(isinstance(one, TableSequence) for one in sequences):
        known += (*true, *_OTHERS)
    renamed = _alike(true, known), _alike((label for _, tracks in pairs for label in tracks.labels), known)
    notes = [note for pair in pairs for one in pair for note in one.notes]
    notes += _shifted(sequences, pairs)
    for owner, found in zip(("truth", "tracks"), renamed, strict=True):
        if other := [f"{label} as {name}" for label, name in found.items() if label != name]:
            notes.append(f"classes of the {owner}: {', '.join(other)}")
        if known and (other := [label for label, name in found.items() if name not in known]):
            notes.append(f"classes of the {owner} not compared: {', '.join(other)} (--option class.NAME=NAME)")
    if all(renamed) and set(renamed[0].values()).isdisjoint(renamed[1].values()):
        notes.append(f"no class is in both: truth has {', '.join(renamed[0])}, tracks have {', '.join(renamed[1])}")
    if warn is not None:
        for note in notes:
            warn(note)
    true_names, track_names = renamed
    return [
        (
            replace(truth, labels=tuple(true_names[label] for label in truth.labels)),
            replace(tracks, labels=tuple(track_names[label] for label in tracks.labels)),
        )
        for truth, tracks in pairs
    ]


def _shifted(sequences: Sequence[DataSequence], pairs: Sequence[tuple[Truth, ResultTable]]) -> list[str]:
    """Return a note for each sequence whose tracks fit the truth of a neighbouring frame much better."""
    notes = []
    for sequence, (truth, tracks) in zip(sequences, pairs, strict=True):
        placed = tracks.to_world(sequence.poses)
        here, before, after = (_apart(truth, placed, shift) for shift in (0, -1, 1))
        if _FAR < here < np.inf:
            text = f"tracks lie {here:.3g} m from the truth of their frame"
            notes.append(f"{sequence.name}: {text}: another origin, other axes or another unit?")
            continue
        if min(before, after) < _BETTER * here < np.inf:
            other = "before" if before < after else "after"
            text = (
                f"{here:.2g} m from the truth of their frame, {min(before, after):.2g} m from that of the frame {other}"
            )
            notes.append(f"{sequence.name}: tracks lie {text}: does one of the two count frames from 1?")
    return notes


def _apart(truth: Truth, tracks: ResultTable, shift: int) -> float:
    """Return the median distance of tracks from the nearest truth of the frame `shift` frames on, infinite if few."""
    apart = [np.empty(0)]
    for frame in np.unique(tracks.frame).tolist():
        true, found = (one.center[one.frame == at, :2] for one, at in ((truth, frame + shift), (tracks, frame)))
        if len(true) and len(found):
            apart.append(np.linalg.norm(found[:, None] - true, axis=2).min(axis=1))
    every = np.concatenate(apart)
    return float(np.median(every)) if len(every) >= _ENOUGH else np.inf


def _alike(labels: Iterable[str], known: Sequence[str]) -> dict[str, str]:
    """Return each label with the name by which it is known, or its own.

    Where a label has that name but for its case, others that mean the same keep theirs: `car` is, `van` is not.
    """
    known = tuple(dict.fromkeys(known))
    found = {label: class_like(label, known) or label for label in labels}
    same = {name for label, name in found.items() if label.lower() == name.lower()}
    return {label: label if name in same and label.lower() != name.lower() else name for label, name in found.items()}


def read_tracks(results: Path, sequence: DataSequence, by: By = "id") -> ResultTable:
    """Return the tracks of a sequence in the sensor frame of each frame, where KITTI's result files have them.

    Args:
        results: a table of tracks of one or more sequences, or a folder with `NAME.txt` (KITTI) or a table `NAME.*`;
            for nuScenes also a result file of its benchmark, or its folder.
        sequence: the tracked sequence.
        by: `object`: ids are the column `object` of `optipmb track --rejoin`, or the track's id where it has none.

    Raises:
        DatasetError: there is no such file, or it is wrong, or has frames that the sequence lacks, or no objects.
    """
    if isinstance(sequence, NuScenesSequence) and (results.suffix == ".json" or (results / NUSCENES_FILE).is_file()):
        _refuse_objects(results, by)
        files = read_nuscenes_results(results), shown_submission(results)
        return scene_table(*files, sequence).to_sensor(sequence.poses)
    path = result_file(results, sequence.name)
    if is_table(path) or (path == results and (path.suffix != ".txt" or hasattr(sequence, "tables"))):
        return _with_image(path, _from_table(path, sequence, by).to_sensor(sequence.poses), sequence)
    _refuse_objects(path, by)
    table, shown = read_kitti_results(path), path.parent / SHOWN / path.name
    if shown.is_file():
        table = _with_shown(table, read_kitti_results(shown))
    if len(table) and table.frame[-1] >= len(sequence):
        raise DatasetError(path, f"frames from 0 to {len(sequence) - 1}", f"frame {table.frame[-1]}")
    return _with_image(path, table, sequence)


def shown_submission(results: Path) -> Submission | None:
    """Return the nuScenes tracks that are shown, of a folder of `optipmb track`; None where no file tells."""
    path = results / SHOWN / NUSCENES_FILE
    return read_nuscenes_results(path) if path.is_file() else None


def scene_table(every: Submission, shown: Submission | None, sequence: NuScenesSequence) -> ResultTable:
    """Return the tracks of a scene in the world frame, confirmed where they are among the shown ones."""
    table = result_table(every, sequence.name, sequence.samples)
    return table if shown is None else _with_shown(table, result_table(shown, sequence.name, sequence.samples))


def _with_shown(table: ResultTable, shown: ResultTable) -> ResultTable:
    return replace(table, confirmed=rows_of(shown.frame, shown.id, table.frame, table.id) >= 0)


def _refuse_objects(path: Path, by: By) -> None:
    if by == "object":
        raise DatasetError(path, "a table with the column object (optipmb track --rejoin --out tracks.csv)", "none")


def read_full_tracks(result: Path) -> FullTable | None:
    """Return all columns of the tracks of a result file; None where they were not written."""
    path = full_path(result)
    return read_full(path) if path.is_file() else None


def result_file(results: Path, name: str) -> Path:
    """Return the file of a sequence in a folder of results, or the table of tracks that they are."""
    if results.is_file():
        return results
    tables = (results / f"{name}{suffix}" for suffix in SUFFIXES)
    return next((path for path in tables if path.is_file()), results / f"{name}.txt")


def _from_table(path: Path, sequence: DataSequence, by: By) -> ResultTable:
    """Return the tracks of a table in the world frame."""
    tables: TableOptions = getattr(sequence, "tables", TableOptions())
    (table,) = read_objects(path, [path], tables)
    key = _key(table, sequence, tables) if len(table.boxes.frame_stamp) else None
    if key is None:
        return replace(full_table((), {}), notes=(f"{path}: no tracks of {sequence.name}",))
    rows, frame, _, notes = table.at(key, sequence.stamps, sequence.numbers)
    boxes = table.boxes
    if (frame < 0).any() and getattr(sequence, "is_truth", False) and (frame >= 0).any():
        left_out = int((frame < 0).sum())
        notes.append(f"{path}: {left_out} rows are at no frame of the truth, and no detections say more: left out")
        rows, frame = rows[left_out:], frame[left_out:]
    if (frame < 0).all() and len(frame):
        own = table.boxes.frame_stamp[table.boxes.row[rows]]
        expected = f"stamps of the frames of {sequence.name}, {span(sequence.stamps)}"
        raise DatasetError(path, expected, f"{span(own)}: another clock, or another unit?")
    if (frame < 0).any():
        line = table.line(int(rows[np.flatnonzero(frame < 0)[0]]))
        raise DatasetError(path, f"stamps of the frames of {sequence.name}", "another stamp", line=line)
    labels = tuple(dict.fromkeys(boxes.name[rows].tolist()))
    identity = boxes.id[rows] if boxes.id is not None else rows
    if by == "object":
        if table.object is None:
            _refuse_objects(path, by)
        else:
            joined = table.object[boxes.row[rows]]
            identity = np.where(joined < 0, identity, joined)
    center, yaw, velocity = table.in_world(rows)
    return ResultTable(
        labels=labels,
        frame=frame,
        id=identity,
        label=np.array([labels.index(name) for name in boxes.name[rows].tolist()], dtype=np.int64),
        center=center,
        size=boxes.size[rows],
        yaw=yaw,
        score=boxes.score[rows],
        box2d=np.full((len(rows), 4), np.nan),
        notes=(*table.notes, *notes),
        velocity=None if boxes.velocity is None else velocity,
        confirmed=None if table.confirmed is None else table.confirmed[boxes.row[rows]],
    )


def _key(table: ObjectTable, sequence: DataSequence, tables: TableOptions) -> str | None:
    """Return the key of a sequence in a table of tracks; None where it has other recordings of the dataset only."""
    keys = table.boxes.keys
    counted = sequence.name.lstrip("0") or "0"  # a text table has no way to say that 0004 is not the number 4
    for one in (".".join(sequence.key_columns.values()), sequence.name, counted):
        if one in keys:
            return one
    if tables.recordings & keys.keys():
        return None
    if len(keys) == 1:
        return next(iter(keys))
    raise DatasetError(table.path, f"rows of {sequence.name}", f"those of {', '.join(keys)}")


def _with_image(path: Path, table: ResultTable, sequence: DataSequence) -> ResultTable:
    """Return tracks of KITTI with image boxes: projected ones for lines without (-1), and for files without any.

    Lines of OptiPMB that the image does not show (0 0 0 0) stay so, for they were projected in the same way.
    """
    box = table.box2d
    lacking = np.isnan(box).any(axis=1) | (box == -1.0).all(axis=1) | ~(box[:, 3] > box[:, 1]).any()
    if not isinstance(sequence, KittiSequence) or not lacking.any():
        return table
    image, shown = sequence.camera.boxes(table.center, table.size, table.yaw, least_shown=LEAST_SHOWN)
    note = f"{path}: {int(lacking.sum())} boxes without an image box: their 3D boxes are projected into the image"
    notes = (*table.notes, note) if shown[lacking].any() else table.notes
    return replace(table, box2d=np.where(lacking[:, None], image, box), notes=notes)
