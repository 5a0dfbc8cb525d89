"""Tracks in the forms of other tools: GeoJSON, Moving Features JSON, and OpenLABEL (`optipmb_tools.results.openlabel`).

GeoJSON (RFC 7946) and MF-JSON (OGC 19-045r3, Prism encoding) have a feature for each confirmed track, in degrees
(WGS84, longitude first) and metres above the ellipsoid. MF-JSON holds tracks of at least two frames; their height is a
temporal property, because readers take a position as two numbers.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray
from optipmb_client.errors import UsageError
from optipmb_schemas.json_form import YEARS_NS

from optipmb_tools.files import write_whole
from optipmb_tools.geometry import Ints
from optipmb_tools.table_files import Columns

if TYPE_CHECKING:
    from optipmb_tools.datasets.interface import Dataset

_GEOJSON: Final = ".geojson"
FEATURES: Final = (_GEOJSON, ".mfjson")
"""Suffixes of files with a feature for each track."""
OPENLABEL: Final = ".openlabel.json"
"""Ending of the name of a file of tracks in OpenLABEL."""
_DECIMALS: Final = {"lon": 9, "lat": 9, "alt": 3, "speed": 3, "heading": 4, "existence": 4, "l": 3, "w": 3, "h": 3}
_CRS: Final = {"type": "Name", "properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}}
_TRS: Final = {"type": "Name", "properties": {"name": "urn:ogc:data:time:iso8601"}}
_UNITS: Final = {"speed": ("MTS", "Linear"), "alt": ("MTR", "Linear"), "heading": ("DEG", "Step"),
                 "existence": ("C62", "Linear")}  # fmt: skip
"""Code of UN/CEFACT and interpolation of the properties of MF-JSON; between 359 and 1 degree nothing is linear."""
_LEAST: Final = 2  # positions of a moving point


def is_features(path: Path) -> bool:
    """Tell by its name whether a file is GeoJSON or MF-JSON."""
    return path.suffix.lower() in FEATURES


def is_openlabel(path: Path) -> bool:
    """Tell by its name whether a file of tracks is written as OpenLABEL."""
    return path.name.lower().endswith(OPENLABEL)


def check_export(out: Path, dataset: "Dataset", recordings: int) -> None:
    """Refuse what a form of another tool cannot hold.

    Raises:
        UsageError: A place of the world is missing, or there are several recordings for one file.
    """
    if is_features(out) and dataset.georeference is None:
        raise UsageError(f"--out {out}: expected --origin LAT,LON,HEIGHT, the place of the world frame")
    if is_openlabel(out) and recordings != 1:
        raise UsageError(f"--out {out}: expected one recording by --sequences, received {recordings}")


def is_utc(stamps: Ints) -> bool:
    """Tell whether stamps (F,) are times in UTC, of this century, and not of another clock."""
    return bool(((stamps >= YEARS_NS[0]) & (stamps < YEARS_NS[1])).all())


def iso_times(stamps: Ints) -> NDArray[np.str_]:
    """Return times (F,) in UTC of stamps (F,), nanoseconds since 1970, with all digits."""
    texts = np.datetime_as_string(stamps.astype("datetime64[ns]"), unit="ns")
    return np.char.add(texts, "Z")


def write_features(path: Path, columns: Columns) -> list[str]:
    """Write columns of tracks (`track_columns`, with latitudes) as GeoJSON or MF-JSON; return notes on omitted tracks.

    The file appears complete, or not at all.

    Raises:
        UsageError: The stamps are no times in UTC.
    """
    if not is_utc(columns["stamp_ns"]):
        received = f"{columns['stamp_ns'].min()} ns"
        raise UsageError(f"--out {path}: expected times in UTC, or --option time_origin=TIME, received {received}")
    values = {**columns, "speed": np.hypot(columns["vx"], columns["vy"])}
    values |= {name: np.round(values[name], digits) + 0.0 for name, digits in _DECIMALS.items()}
    values["time"] = iso_times(columns["stamp_ns"])
    confirmed = columns["confirmed"] == 1
    placed = np.isfinite(columns["lat"])
    plain = path.suffix.lower() == _GEOJSON
    features, short = [], 0
    for rows in _tracks(columns, np.flatnonzero(confirmed & placed)):
        track = {name: column[rows] for name, column in values.items()}
        if plain:
            features.append(_trajectory(track))
        elif len(rows) >= _LEAST:
            features.append(_moving_point(track))
        else:
            short += 1
    content = {"type": "FeatureCollection", **({} if plain else {"crs": _CRS, "trs": _TRS}), "features": features}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, json.dumps(content, allow_nan=False).encode())
    far = int((confirmed & ~placed).sum())
    notes = {
        f"{path}: {short} tracks of one frame are left out: a moving point has two positions": short,
        f"{path}: {far} rows farther than 100 km from --origin are left out": far,
        f"{path}: no tracks, which MF-JSON does not provide for": not (features or plain),
    }
    return [text for text, holds in notes.items() if holds]


def _tracks(columns: Columns, rows: Ints) -> Iterator[Ints]:
    """Yield the rows of each track in the order of time, by recordings and ids."""
    recording = np.unique(columns["sequence"], return_inverse=True)[1][rows]
    identity = columns["id"][rows]
    order = np.lexsort((columns["stamp_ns"][rows], identity, recording))
    new = (np.diff(identity[order]) != 0) | (np.diff(recording[order]) != 0)
    return iter(np.split(rows[order], np.flatnonzero(new) + 1)) if len(rows) else iter(())


def _known(values: NDArray[Any]) -> list[Any]:
    return [None if value != value else value for value in values.tolist()]  # noqa: PLR0124  NaN


def _trajectory(track: Columns) -> dict[str, Any]:
    """Return a feature of GeoJSON."""
    places = np.column_stack([track[name] for name in ("lon", "lat", "alt")]).tolist()
    one = len(places) == 1
    times = track["time"].tolist()
    return {
        "type": "Feature",
        "geometry": {"type": "Point" if one else "LineString", "coordinates": places[0] if one else places},
        "properties": {
            "id": int(track["id"][0]),
            "class": str(track["class"][-1]),
            "recording": str(track["sequence"][0]),
            "start": times[0],
            "end": times[-1],
            "times": times,
            "speed": _known(track["speed"]),
            "heading": track["heading"].tolist(),
            "size": [float(track[name][-1]) for name in "lwh"],
            "existence": round(float(track["existence"].mean()), _DECIMALS["existence"]),
        },
    }


def _moving_point(track: Columns) -> dict[str, Any]:
    """Return a feature of MF-JSON; values that are unknown in a frame are null."""
    times = track["time"].tolist()
    recording, number = str(track["sequence"][0]), int(track["id"][0])
    measures = {
        name: {"type": "Measure", "form": form, "values": _known(track[name]), "interpolation": between}
        for name, (form, between) in _UNITS.items()
    }
    return {
        "type": "Feature",
        "temporalGeometry": {
            "type": "MovingPoint",
            "datetimes": times,
            "coordinates": np.column_stack((track["lon"], track["lat"])).tolist(),
            "interpolation": "Linear",
        },
        "temporalProperties": [{"datetimes": times, **measures}],
        "properties": {
            "id": f"{recording}-{number}",  # unique in the file, as readers need it
            "track": number,
            "recording": recording,
            "class": str(track["class"][-1]),
        },
    }
