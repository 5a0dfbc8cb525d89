"""One file for a browser, without a network: the confirmed tracks of a recording over time, from above."""

import html
import importlib.resources
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from optipmb_schemas import Tracks
from optipmb_schemas.json_form import shown

from optipmb_tools.files import write_whole
from optipmb_tools.geometry import Floats

MARGIN_M = 5.0


def write_page(path: Path, title: str, tracks: Mapping[int, Tracks]) -> None:
    """Write the tracks of a recording by frame index; places are rounded to centimetres, headings to 0.01 rad."""
    order = sorted(tracks)
    parts = [(place, tracks[index], np.flatnonzero(shown(tracks[index]))) for place, index in enumerate(order)]
    rows: dict[int, list[tuple[int, Tracks, int]]] = {}
    for place, one, confirmed in parts:
        for row in confirmed.tolist():
            rows.setdefault(int(one.id[row]), []).append((place, one, row))
    names: list[str] = next((list(one.labels) for one in tracks.values()), [])
    labels = sorted({names[int(one.label[row])] for track in rows.values() for _, one, row in track})
    places = np.vstack([np.zeros((0, 2)), *(one.center[confirmed, :2] for _, one, confirmed in parts)])
    corners = np.array([places.min(axis=0) - MARGIN_M, places.max(axis=0) + MARGIN_M]) if len(places) else np.eye(2)
    start = tracks[order[0]].stamp_ns if order else 0
    data = {
        "labels": labels,
        "times": [round((tracks[index].stamp_ns - start) / 1e9, 3) for index in order] or [0.0],
        "extent": corners.round(2).ravel().tolist(),
        "tracks": [
            _row(number, track, labels.index(names[int(track[-1][1].label[track[-1][2]])]))
            for number, track in sorted(rows.items())
        ],
    }
    text = (importlib.resources.files(__package__) / "page.html").read_text(encoding="utf-8")
    content = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")
    write_whole(path, text.replace("{{title}}", html.escape(title)).replace("{{data}}", content).encode())


def _row(number: int, track: list[tuple[int, Tracks, int]], label: int) -> list[Any]:
    """Return id, class, length and width of a track, and the steps of its frames, x, y and headings."""
    _, newest, row = track[-1]
    values = np.array([[*one.center[at, :2], one.yaw[at]] for _, one, at in track])
    length, width = newest.size[row, :2].round(2).tolist()
    columns = (_steps(column) for column in (100 * values).T)
    return [number, label, length, width, _steps(np.array([f for f, _, _ in track])), *columns]


def _steps(values: Floats) -> list[int]:
    return [int(one) for one in np.diff(np.round(values), prepend=0)]
