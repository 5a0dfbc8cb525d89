"""Which numbers of tracks are sound."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import optipmb
from optipmb.model.tracks import MAX_AGE, MAX_COVARIANCE, MAX_PLACE, MAX_VALUE, unsound

ANYTHING = st.sampled_from([np.nan, np.inf, -np.inf, -1.0, -1e-300])
SHAPES = {
    "center": ((3,), -MAX_PLACE, MAX_PLACE),
    "size": ((3,), 5e-324, MAX_VALUE),
    "yaw": ((), -MAX_VALUE, MAX_VALUE),
    "velocity": ((2,), -MAX_VALUE, MAX_VALUE),
    "yaw_rate": ((), -MAX_VALUE, MAX_VALUE),
    "acceleration": ((), -MAX_VALUE, MAX_VALUE),
    "existence": ((), 0.0, 1.0),
    "heading_confidence": ((), 0.0, 1.0),
    "score": ((), 0.0, 1.0),
    "covariance": ((6, 6), -MAX_COVARIANCE, MAX_COVARIANCE),
    "age": ((), 0.0, MAX_AGE),
    "time_since_detection": ((), 0.0, MAX_AGE),
}


def plain(tracks: optipmb.Tracks) -> bool:
    """The twin: whole-array comparisons."""
    columns = {name: (getattr(tracks, name), low, high) for name, (_, low, high) in SHAPES.items()}
    within = all(bool(((array >= low) & (array <= high)).all()) for array, low, high in columns.values())
    return within and bool((np.diff(tracks.id, prepend=-1) > 0).all())


@settings(deadline=None)  # the first call compiles
@given(data=st.data(), count=st.integers(0, 3), odd=st.sampled_from([*SHAPES, "id", ""]))
def test_bounds_are_kept_in_every_column(data: st.DataObject, count: int, odd: str) -> None:
    """A number at its bound is sound, one beyond is not, nor is NaN, whichever column it stands in."""
    columns = {}
    for name, (shape, low, high) in SHAPES.items():
        values = st.sampled_from([low, high, high / 2])
        if name == odd:
            values = values | ANYTHING | st.sampled_from([np.nextafter(high, np.inf), np.nextafter(low, -np.inf)])
        columns[name] = data.draw(arrays(np.float64, (count, *shape), elements=values))
    identity = st.integers(-1, 3) if odd == "id" else st.just(0)
    columns["id"] = data.draw(arrays(np.int64, count, elements=identity)) + (0 if odd == "id" else np.arange(count))
    whole = np.zeros(count, np.int64)
    tracks = optipmb.Tracks(label=whole, detection=whole, confirmed=whole > 0, **columns)
    assert optipmb.sound(tracks) == plain(tracks)
    if not odd:
        assert optipmb.sound(tracks)
    if not optipmb.sound(tracks):
        assert unsound(tracks)[0].startswith(f"tracks.{odd}[")
