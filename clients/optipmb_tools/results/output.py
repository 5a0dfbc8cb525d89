"""Output of a run, the same for offline tracking and replay: result files in a folder, or one table.

A table has one row per track and frame, in the world frame, in order of frames and, in a frame, of ids. Columns: those
that name the recording and the time in the table of detections (for other data sets `sequence` and `stamp_ns`), then
frame (its number in the table of detections, or else counted from 0), id, class, x, y, z, l, w, h, yaw, vx, vy,
yaw_rate, acceleration, score, existence, confirmed (1 or 0), age, time_since_detection and detection_row: the row of
the table (from 0; for other data sets the place in the frame) of the detection that the track was given, no value while
it is missed. A velocity has no value until it is known: from the second detection on, where the detector gives none.
Where tracks are joined over gaps, object (id of the first track of the object, -1: none) and object_probability follow,
and where columns of the detections are attributes, the text of each with most evidence, as `attributes.plate`.
With a georeference lat, lon, alt and heading follow (degrees, m above the ellipsoid, degrees from true north). On
request the upper triangle of the covariance of (x, y, v, phi, omega, a) follows, `cov_x_x` to `cov_a_a`. Metres,
seconds, radians; in text with the decimals of `DECIMALS`. The same tracks always give the same bytes.
"""

import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from optipmb_schemas import Tracks, attributes_of_rows
from optipmb_schemas.json_form import shown

from optipmb_tools.files import remove_unfinished
from optipmb_tools.geometry import Floats, Ints
from optipmb_tools.results import full_path, stacked, write_full
from optipmb_tools.results.exports import is_features, is_openlabel, write_features
from optipmb_tools.spool import Spool
from optipmb_tools.table_files import Columns, is_table, is_text, joined, write_blocks

if TYPE_CHECKING:
    from optipmb_tools.datasets.interface import DataSequence, Dataset, Georeference

_STATE: Final = ("x", "y", "v", "phi", "omega", "a")
COVARIANCE: Final = {f"cov_{_STATE[i]}_{_STATE[j]}": (i, j) for i in range(6) for j in range(i, 6)}
"""Column -> place in the covariance (6, 6)."""
DECIMALS: Final = {
    **dict.fromkeys((*"xyzlwh", "yaw", "yaw_rate", "score", "existence", "age", "time_since_detection"), 4),
    **dict.fromkeys(("vx", "vy", "acceleration"), 3),
    **dict.fromkeys(("lat", "lon"), 9),
    **dict.fromkeys(("alt", "heading"), 4),
    "object_probability": 4,
    **dict.fromkeys(COVARIANCE, 8),
}
"""Decimals of columns in text: 0.1 mm, 1e-4 rad, 1 mm/s, probabilities to 1e-4."""
FULL: Final = "full"  # digits of text that give every bit of a number
_BLOCK: Final = 1024  # frames whose columns are made at once
_RANKED: Final = {".txt", ".json"}
SHOWN: Final = "shown"
"""Folder beside the result files of a benchmark, which rank all tracks: the same files of the tracks that are shown."""


def track_columns(
    name: str,
    tracks: Mapping[int, Tracks],
    sequence: "DataSequence | None" = None,
    *,
    full: bool = False,
    georeference: "Georeference | None" = None,
    objects: "ObjectIds | None" = None,
) -> Iterator[Columns]:
    """Yield tracks (world frame) by frame index as columns, in blocks of rows; with `full` also the covariance.

    Args:
        name: Value of the column `sequence`.
        tracks: The tracks of each frame.
        sequence: The tracked sequence; knows the columns and rows of its table of detections, if it came from one.
        full: Whether to add the covariance.
        georeference: Place of the world frame; adds latitude, longitude, height and true heading.
        objects: Which object each track is of; adds `object` and `object_probability`.
    """
    order = sorted(tracks)
    joined = bool(order) and all(tracks[index].object is not None for index in order)  # of a service that joins tracks
    more: dict[str, Any] = {"full": full, "georeference": georeference, "objects": objects, "joined": joined}
    for start in range(0, max(len(order), 1), _BLOCK):  # of a long recording not all messages are in memory
        block = {index: tracks[index] for index in order[start : start + _BLOCK]}
        yield _columns_of(name, block, sequence, **more)


def _columns_of(
    name: str,
    tracks: Mapping[int, Tracks],
    sequence: "DataSequence | None",
    *,
    full: bool,
    georeference: "Georeference | None",
    objects: "ObjectIds | None",
    joined: bool,
) -> Columns:
    """Return the columns of some frames; arguments as for `track_columns`, and whether all frames have `object`."""
    order, parts = list(tracks), list(tracks.values())
    frame = np.repeat(np.array(order, dtype=np.int64), [len(one.id) for one in parts])
    stamps = np.repeat(np.array([one.stamp_ns for one in parts], dtype=np.int64), [len(one.id) for one in parts])
    names = [np.asarray(one.labels, np.str_)[one.label] for one in parts]
    numbers = None if sequence is None else sequence.numbers
    columns: Columns = {} if sequence is None else {one: each[frame] for one, each in sequence.frame_columns.items()}
    if sequence is not None and sequence.time_column and sequence.times is not None:
        keys = {column: np.full(len(frame), value) for column, value in sequence.key_columns.items()}
        columns = keys | columns | {sequence.time_column: sequence.times[frame]}
    else:
        columns = {"sequence": np.full(len(frame), name)} | columns | {"stamp_ns": stamps}
    columns |= {"frame": frame if numbers is None else numbers[frame]}
    columns |= {"id": stacked(parts, "id"), "class": np.concatenate([np.empty(0, np.str_), *names])}
    age, unseen, velocity = (stacked(parts, name) for name in ("age", "time_since_detection", "velocity"))
    unknown = (age == unseen) & (velocity == 0.0).all(axis=1)  # detected once, by a detector that gives none
    columns |= dict(zip("xyz", stacked(parts, "center").T, strict=True))
    columns |= dict(zip("lwh", stacked(parts, "size").T, strict=True))
    columns["yaw"] = stacked(parts, "yaw")
    columns |= dict(zip(("vx", "vy"), np.where(unknown[:, None], np.nan, velocity).T, strict=True))
    columns |= {name: stacked(parts, name) for name in ("yaw_rate", "acceleration", "score", "existence")}
    columns["confirmed"] = np.concatenate([np.empty(0, np.int64), *(shown(one).astype(np.int64) for one in parts)])
    columns |= {"age": age, "time_since_detection": unseen}
    detections = []
    for index, part in zip(order, parts, strict=True):
        known = part.detection >= 0
        place = np.where(known, part.detection, np.nan)
        if sequence is not None and (rows := sequence.rows(index)) is not None:
            place[known] = rows[part.detection[known]]
        detections.append(place)
    columns["detection_row"] = np.concatenate([np.empty(0), *detections])
    if objects is not None:
        columns |= objects.columns(columns["id"], stamps)
    elif joined:
        columns |= {name: stacked(parts, name) for name in ("object", "object_probability")}
    if sequence is not None and sequence.attributes:
        starts = itertools.accumulate((len(one.id) for one in parts), initial=0)
        texts = {
            (start + known.row, known.name): known.text
            for start, one in zip(starts, parts, strict=False)
            for known in one.attributes or ()
        }
        for known_as in sequence.attributes:
            values = [texts.get((row, known_as), "") for row in range(len(frame))]
            columns[f"attributes.{known_as}"] = np.array(values, np.str_)
    if georeference is not None:
        columns |= georeference.to_geographic(stacked(parts, "center"), columns["yaw"])._asdict()
    if full:
        covariance = stacked(parts, "covariance")
        columns |= {name: covariance[:, i, j] for name, (i, j) in COVARIANCE.items()}
    return columns


def write_tracks(path: Path, blocks: Callable[[], Iterable[Columns]], digits: str) -> None:
    """Write blocks of rows of tracks as a table; numbers in text have the decimals of `DECIMALS`, with `FULL` all."""
    write_blocks(path, blocks if digits == FULL or not is_text(path) else lambda: map(_rounded, blocks()))


def _rounded(columns: Columns) -> Columns:
    return {
        name: np.round(values, DECIMALS[name]) + 0.0  # -0 becomes 0
        if name in DECIMALS and values.dtype.kind == "f"
        else values
        for name, values in columns.items()
    }


@dataclass(frozen=True)
class ObjectIds:
    """The objects of the confirmed tracks of a recording."""

    id: Ints  # (N,) of the tracks, ascending
    object: Ints  # (N,) id of the first track of the object
    probability: Floats  # (N,) that all joins up to this track are right
    until_ns: Ints  # (N,) stamp from which a later track is the object

    def columns(self, identity: Ints, stamp_ns: Ints) -> Columns:
        """Return the columns of rows of tracks: `object` is -1 in rows that are of no object, or not any more."""
        place = np.minimum(np.searchsorted(self.id, identity), max(len(self.id) - 1, 0))
        known = np.isin(identity, self.id)
        known[known] = stamp_ns[known] < self.until_ns[place[known]]
        number, probability = np.full(len(identity), -1, dtype=np.int64), np.full(len(identity), np.nan)
        number[known], probability[known] = self.object[place[known]], self.probability[place[known]]
        return {"object": number, "object_probability": probability}

    def as_ids(self, tracks: Tracks) -> Tracks:
        """Return the tracks of a frame with their objects as ids, without tracks that a later one has replaced."""
        number = self.columns(tracks.id, np.full(len(tracks.id), tracks.stamp_ns))["object"]
        replaced = (number < 0) & np.isin(tracks.id, self.id)
        identity = np.where(number < 0, tracks.id, number)
        order = np.argsort(identity, kind="stable")
        found = taken(tracks, order[~replaced[order]])
        return found.model_copy(update={"id": identity[order[~replaced[order]]]})


def taken(tracks: Tracks, rows: NDArray[Any]) -> Tracks:
    """Return rows of the tracks of a message."""
    of_tracks = Tracks.arrays["id"].rows
    columns = {name: getattr(tracks, name) for name, array in Tracks.arrays.items() if array.rows == of_tracks}
    kept = {name: one[rows] for name, one in columns.items() if one is not None}
    places = np.arange(len(tracks.id))[rows].tolist()
    return tracks.model_copy(update=kept | {"attributes": attributes_of_rows(tracks.attributes, places)})


class TrackCounts(NamedTuple):
    """Counts of the tracks of a sequence."""

    tracks: int  # that are shown in some frame
    rows: int  # a track in a frame
    unconfirmed_rows: int

    @classmethod
    def of(cls, frames: Iterable[Tracks]) -> Self:
        ids: set[int] = set()
        rows = confirmed = 0
        for one in frames:
            numbers = one.id[shown(one)]
            ids.update(numbers.tolist())
            rows, confirmed = rows + len(one.id), confirmed + len(numbers)
        return cls(len(ids), rows, rows - confirmed)


@dataclass(frozen=True)
class Latency:
    """Quantiles of durations, in milliseconds."""

    p50_ms: float
    p99_ms: float
    max_ms: float


def latency(durations_ns: Sequence[int]) -> Latency | None:
    """Return the quantiles of durations in nanoseconds; None when there are none."""
    if not durations_ns:
        return None
    p50, p99, most = np.quantile(np.asarray(durations_ns, dtype=np.float64) / 1e6, [0.5, 0.99, 1.0])
    return Latency(float(p50), float(p99), float(most))


def horizons_for(out: Path) -> tuple[float, ...] | None:
    """Return the horizons of the predicted paths that a result needs: a bag of ROS 2; None: the profile's."""
    if out.suffix != ".mcap":
        return None
    from optipmb_schemas.ros2.tracks import HORIZONS  # noqa: PLC0415  packages of an extra

    return HORIZONS


class Results:
    """Result files of a run: one for each sequence in a folder, or one table of all of them.

    `write` may be called in another process than `take` and `close`, on an object with the same arguments.

    Args:
        dataset: The tracked data set; it knows the format of its result files.
        out: The folder, or a file with the suffix of a table or of another form (`optipmb_tools.results.exports`).
        full: Whether all columns of the tracks are written: into a file for each result file, or into further
            columns of the table. Otherwise such files of an earlier run are removed.
    """

    def __init__(self, dataset: "Dataset", out: Path, *, full: bool = False) -> None:
        self._dataset = dataset
        self._out = out
        self._full = full
        self._submission = "submission" in dict(dataset.arguments.options)
        self._features = is_features(out)
        self._table = self._features or (is_table(out) and not out.is_dir())
        self._blocks = Spool()  # of the rows of a table
        self._taken: dict[str, Path | list[int]] = {}  # file, or places of its blocks

    def write(
        self, sequence: "DataSequence", tracks: Mapping[int, Tracks], objects: ObjectIds | None = None
    ) -> Path | Iterable[Columns]:
        """Write the tracks of a sequence by frame index; return the file, or blocks of rows of the table of all.

        The blocks are made when they are taken, once. Only a table has columns for `objects`.
        """
        place = self._dataset.georeference
        if self._features:
            blocks = track_columns(sequence.name, tracks, georeference=place)
            return ({**one, "stamp_ns": one["stamp_ns"] + self._dataset.time_origin_ns} for one in blocks)
        if is_openlabel(self._out):
            from optipmb_tools.results.openlabel import write_openlabel  # noqa: PLC0415  of one format

            write_openlabel(self._out, sequence, tracks, self._dataset.time_origin_ns, full=self._full)
            return self._out
        if self._table:
            return track_columns(sequence.name, tracks, sequence, full=self._full, georeference=place, objects=objects)
        path = self._dataset.write(self._out, sequence, tracks)
        if path.suffix in _RANKED and not self._submission:
            self._dataset.write(
                self._out / SHOWN, sequence, {index: taken(one, shown(one)) for index, one in tracks.items()}
            )
        if self._full:
            write_full(full_path(path), tracks)
        else:
            full_path(path).unlink(missing_ok=True)
        return path

    def take(self, sequence: "DataSequence", written: Path | Iterable[Columns]) -> bool:
        """Keep what `write` returned; return whether it is here: another machine may have written it elsewhere."""
        if isinstance(written, Path) and not written.is_file():
            return False
        kept = written if isinstance(written, Path) else [self._blocks.append(block) for block in written]
        self._taken[sequence.name] = kept
        return True

    def state(self, sequences: "Sequence[DataSequence]") -> str:
        """Remove unfinished files of a run that ends early, and say what is complete."""
        remove_unfinished(self._out, [one.name for one in sequences])
        done = sum(isinstance(one, Path) for one in self._taken.values())
        return f"{done} of {len(sequences)} recordings are in {self._out}"

    def close(self, sequences: "Sequence[DataSequence]") -> list[str]:
        """Write the table in the order of the names, or the file of a benchmark that holds all sequences.

        Sequences that were not taken are missing in the table; a file of a benchmark is written of all or not at all.
        Return notes on omissions.
        """
        parts = [places for _, places in sorted(self._taken.items()) if not isinstance(places, Path)]
        if parts:
            if self._features:
                return write_features(self._out, joined(self._rows(parts)))
            write_tracks(self._out, lambda: self._rows(parts), self._dataset.digits)
        elif not is_openlabel(self._out) and all(one.name in self._taken for one in sequences):
            self._dataset.join(self._out, sequences)
            if (self._out / SHOWN).is_dir():
                self._dataset.join(self._out / SHOWN, sequences)
        return []

    def _rows(self, parts: Sequence[list[int]]) -> Iterator[Columns]:
        """Yield the blocks of several sequences, each column with one type that holds the values of all."""
        types = [{name: values.dtype for name, values in self._blocks[places[0]].items()} for places in parts]
        wanted = {name: np.result_type(*(one[name] for one in types)) for name in types[0]}
        wanted |= {name: np.dtype(np.str_) for name, one in wanted.items() if one.kind == "U"}  # of any length
        for place in itertools.chain(*parts):
            block = self._blocks[place]
            yield {name: block[name].astype(one, copy=False) for name, one in wanted.items()}
