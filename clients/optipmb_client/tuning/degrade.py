"""Detections made worse on purpose, for parameters that stay good where the detector is not at its best.

A detector that was trained on the sequences at hand finds more there, places it better and is surer of it than it will
be anywhere else. A degraded copy of the detections loses some of them, moves and turns the others, and blurs their
scores. The same seed and the same detections give the same copy, whatever else is done in between.
"""

import zlib
from dataclasses import dataclass, replace

import numpy as np

from optipmb import Frame
from optipmb_client.geometry import wrap_angle
from optipmb_client.tuning.material import Clip

__all__ = ["Degradation", "degrade"]

_LEAST = 1e-12


@dataclass(frozen=True)
class Degradation:
    """How much worse the detections get."""

    drop: float = 0.1
    """Share of the detections that are lost."""
    position: float = 0.1
    """Standard deviation of what is added to x and to y, m."""
    heading: float = 0.05
    """Of what is added to the heading, rad."""
    velocity: float = 0.2
    """Of what is added to each component of a known velocity, m/s."""
    score: float = 0.5
    """Of what is added to the logit of the score."""


def degrade(clip: Clip, degradation: Degradation, seed: int, copy: int = 0) -> Clip:
    """Return a clip with worse detections; `copy` counts several copies of the same seed."""
    rng = np.random.Generator(np.random.PCG64([seed, copy, zlib.crc32("/".join((clip.name, *clip.labels)).encode())]))
    return replace(clip, frames=tuple(_worse(frame, degradation, rng) for frame in clip.frames))


def _worse(frame: Frame, degradation: Degradation, rng: np.random.Generator) -> Frame:
    # Every number is drawn for every detection, so that one more of them changes no other.
    count = len(frame.score)
    kept = np.flatnonzero(rng.random(count) >= degradation.drop)
    shift = degradation.position * rng.standard_normal((count, 2))
    turn = degradation.heading * rng.standard_normal(count)
    drift = degradation.velocity * rng.standard_normal((count, 2))
    blur = degradation.score * rng.standard_normal(count)
    center = frame.center.copy()
    center[:, :2] += shift
    with np.errstate(divide="ignore"):  # a score of one has the logit infinity and stays one
        logit = np.log(frame.score) - np.log1p(-frame.score) + blur
    score = np.clip(0.5 * (1.0 + np.tanh(0.5 * logit)), _LEAST, 1.0)
    return Frame(
        stamp_ns=frame.stamp_ns,
        center=center[kept],
        size=frame.size[kept],
        yaw=wrap_angle(frame.yaw + turn)[kept],
        velocity=(frame.velocity + drift)[kept],
        score=score[kept],
        label=frame.label[kept],
        source=frame.source[kept],
        labels=frame.labels,
        cloud=frame.cloud,
    )
