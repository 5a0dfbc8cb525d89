"""Comparison of the tracker's density and tracks with the oracle's, and of bytes with bytes."""

import hashlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from oracle import Oracle, OracleTracks

from optipmb import Density, Tracks

TOLERANCE = 1e-9
BERNOULLI = ["mean", "covariance", "existence", "label", "auxiliary", "id", "born_ns", "seen_ns", "score", "evidence"]
BERNOULLI += ["heading_odds", "extracted", "confirmed"]
POISSON = ["mean", "covariance", "weight", "label", "auxiliary", "born_ns"]
TRACKS = ["id", "label", "center", "size", "yaw", "velocity", "yaw_rate", "acceleration", "existence", "score"]
TRACKS += ["heading_confidence", "covariance", "age", "time_since_detection", "detection", "confirmed"]


def assert_close(found: np.ndarray[Any, Any], wanted: np.ndarray[Any, Any], what: str) -> None:
    """Integers and flags are equal, numbers are within 1e-9 of the largest of their row, headings modulo 2 pi."""
    assert found.shape == wanted.shape, f"{what}: {found.shape} instead of {wanted.shape}"
    if found.dtype.kind in "iub":
        np.testing.assert_array_equal(found, wanted, err_msg=what)
        return
    difference = found - wanted
    if what.endswith("yaw"):
        difference = (difference + np.pi) % (2 * np.pi) - np.pi
    elif what.endswith("mean") and found.size:
        difference[:, 3] = (difference[:, 3] + np.pi) % (2 * np.pi) - np.pi
    axes = tuple(range(1, wanted.ndim))
    scale = np.maximum(1.0, np.max(np.abs(wanted), axis=axes, keepdims=True)) if wanted.size and axes else 1.0
    if what.endswith(("existence", "weight")):  # these go over many magnitudes: relative too
        scale = np.minimum(1.0, 100 * np.abs(wanted)) + 1e-300
    error = np.abs(difference) / scale
    if error.size and not error.max() <= TOLERANCE:
        row = np.unravel_index(int(np.nanargmax(error)), error.shape)
        raise AssertionError(f"{what}{list(map(int, row))}: {found[row]!r} instead of {wanted[row]!r}")


def _stacked(objects: Sequence[Any], name: str, like: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    return np.array([getattr(one, name) for one in objects], dtype=like.dtype).reshape((-1, *like.shape[1:]))


def assert_matches(oracle: Oracle, wanted: OracleTracks, density: Density, tracks: Tracks, when: str) -> None:
    assert density.stamp_ns == oracle.stamp_ns, when
    np.testing.assert_array_equal(density.bernoulli.id, [b.id for b in oracle.bernoulli], err_msg=f"{when} ids")
    assert density.next_id == oracle.next_id, when
    for name in BERNOULLI:
        found = getattr(density.bernoulli, name)
        assert_close(found, _stacked(oracle.bernoulli, name, found), f"{when} bernoulli.{name}")
    if density.class_probability is not None:
        own = [row[row > 0] for row in density.class_probability]  # the classes of the group
        assert_close(np.concatenate([*own, []]), np.concatenate([*[b.pi for b in oracle.bernoulli], []]), f"{when} pi")
    for name in POISSON:
        found = getattr(density.poisson, name)
        assert_close(found, _stacked(oracle.poisson, name, found), f"{when} poisson.{name}")
    for name in TRACKS:
        found = getattr(tracks, name)
        rows = wanted.columns.get(name, np.zeros((0, *found.shape[1:])))
        assert_close(found, np.asarray(rows).astype(found.dtype), f"{when} tracks.{name}")


def density_bytes(density: Density) -> bytes:
    """All of a density as bytes: equal densities give equal bytes."""
    parts = [f"{density.stamp_ns} {density.next_id}".encode()]
    for rows, names in ((density.bernoulli, BERNOULLI), (density.poisson, POISSON)):
        for name in names:
            column = np.ascontiguousarray(getattr(rows, name))
            parts += [f"{name} {column.shape} {column.dtype.str}".encode(), column.tobytes()]
    return b"|".join(parts)


def tracks_bytes(tracks: Tracks, without: tuple[str, ...] = ()) -> bytes:
    columns = [np.ascontiguousarray(getattr(tracks, name)) for name in TRACKS if name not in without]
    return b"|".join(part for column in columns for part in (str(column.shape).encode(), column.tobytes()))


def digest(densities: Sequence[Density]) -> str:
    state = hashlib.sha256()
    for density in densities:
        state.update(density_bytes(density))
    return state.hexdigest()
