"""Compile every kernel ahead of the first frame."""

from __future__ import annotations

import gc
import os
import pickle
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numba.core.dispatcher import Dispatcher

from optipmb import compiled
from optipmb.filter.geometry import bev_iou
from optipmb.filter.paths import predict_tracks
from optipmb.joining.decision import Kinds, Rejoin
from optipmb.joining.evidence import pair_scores
from optipmb.joining.matching import match
from optipmb.joining.places import with_declared
from optipmb.learning.hindsight import later_velocities
from optipmb.learning.self_calibration import learned_noise
from optipmb.model.errors import EffortError
from optipmb.model.frame import FieldOfView, PointCloud, Pose, make_frame
from optipmb.model.parameters import Parameters, load_profile, parse_parameters
from optipmb.model.tracks import sound
from optipmb.tracker import Modules, Tracker, update
from optipmb.world.zones import Shapes, Zone, crossings, locate


def kernels() -> dict[str, Any]:
    """Return the kernels by name, as numba's dispatchers."""
    loaded = sys.modules.copy()  # not the dictionary itself: other threads may import meanwhile
    return {
        f"{module}.{name}": value
        for module in sorted(loaded)
        if module.startswith("optipmb.")
        for name, value in vars(loaded[module]).items()
        if isinstance(value, Dispatcher) and value.py_func.__module__ == module
    }


def compilations() -> int:
    """Count the kernels that were missing in the cache and compiled so far, by this process or for it."""
    here = sum(sum(kernel.stats.cache_misses.values()) for kernel in kernels().values())
    return here + len(compiled.progress.built or ())


def warm_up(*, rejoin: bool = False) -> int:
    """Compile all kernels, or load them from the cache, by running a few frames through a tracker.

    The first call after an installation compiles, in several processes, for up to a minute; later processes load the
    machine code (under a second). Call it before the first frame that is waited for.

    Args:
        rejoin: Also the kernels that join tracks over gaps (`Rejoin`), which takes another half minute.

    Returns:
        How many kernels had to be compiled; none in a prepared installation.
    """
    before = compilations()
    parameters = _run()
    if rejoin:
        _run_rejoining(parameters)
    return compilations() - before


def plan() -> None:
    """Write the kernels that Python calls, with the types of their arguments, to the file that is the argument.

    Their numbers go to the output. Nothing is compiled.
    """
    _run()
    largest = f"{update.__module__}.{update.__name__}"
    calls = sorted(compiled.calls.signatures, key=lambda call: call[0] != largest)
    Path(sys.argv[1]).write_bytes(pickle.dumps(calls))
    os.write(sys.stdout.fileno(), bytes(range(len(calls))))


def build() -> None:
    """Compile kernels of the plan in the file that is the argument: those whose numbers are read from the input."""
    compiled.progress.is_helper = True
    # A compiler fills the memory with small objects that live long; the default walks through them again and again.
    gc.set_threshold(100_000, *gc.get_threshold()[1:])
    known = kernels()
    while number := os.read(sys.stdin.fileno(), 1):
        name, signature = pickle.loads(Path(sys.argv[1]).read_bytes())[number[0]]  # noqa: S301 - of a process of ours
        known[name].compile(signature)


def _run() -> Parameters:
    """Call all kernels that every tracker needs; return the parameters of one."""
    curve = dict.fromkeys(("evidence", "existence", "along", "across"), (0.1, 0.9))
    document = load_profile("nuscenes").model_dump() | {"self_calibration": True, "sensor_motion": True}
    document["classes"]["pedestrian"] |= {
        "score_filter": 0.1,
        "birth_score": 0.5,
        "calibration": curve | {"memory": 0.5, "missed": 1.0},
    }
    parameters = parse_parameters(document)
    tracker = Tracker(parameters)
    posterior = tracker.initial()
    pose = Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
    cloud = PointCloud(np.zeros((8, 3), np.float32), pose)
    # A low score announces, a second detection then starts a track from the announcement; two close objects make a
    # cluster.
    for k, score in enumerate((0.21, 0.21, 0.9, 0.9, 0.9)):
        given, _ = make_frame(
            parameters,
            stamp_ns=k * 500_000_000,
            labels=("pedestrian",),
            label=[0, 0, 0],
            center=[[0.0, 0.0, 0.0], [1.5, 0.0, 0.0], [9.0, 9.0, 0.0]],
            size=[[0.6, 0.6, 1.7]] * 3,
            yaw=[0.0, 1.0, 2.0],
            score=[score] * 3,
            velocity=[[1.0, 0.0], [0.0, 0.0], [np.nan, np.nan]],
            cloud=cloud if k else None,
            field_of_view=FieldOfView() if k else None,
        )
        result = tracker.step(posterior, given)
        posterior = result.density
        sound(result.tracks)
    predict_tracks(result.tracks, [0.5], parameters)
    learned_noise(posterior)
    points: dict[str, Any] = {"label": [0], "center": [[0.2, 0.0, np.nan]], "score": [0.9]}
    point, _ = make_frame(parameters, stamp_ns=5 * 500_000_000, labels=("pedestrian",), **points)
    tracker.step(posterior, point)
    with suppress(EffortError):
        Tracker(parameters, max_pairs=8).step(posterior, given)
    Tracker(parameters, Modules(habm=False)).step(posterior, given)
    bev_iou(np.zeros((1, 5)), np.zeros((1, 5)))
    later_velocities(np.zeros(1, np.int64), np.ones((1, 7)), 0.0)
    line = Zone("line", line=((0.0, 0.0), (1.0, 0.0)))
    locate(np.zeros((1, 3)), np.zeros((1, 2)), *Shapes.of([line]))
    crossings(np.array(line.line), 0.0, 0.0, 0.0, 0.0)
    return parameters


def _run_rejoining(parameters: Parameters) -> None:
    empty, kinds = np.zeros(0, np.int64), Kinds.of(parameters)
    pair_scores(np.zeros(0), empty, empty, kinds.kind, kinds.motion, 60.0)
    with_declared(np.zeros(0), np.zeros(0), empty, empty, kinds.declared)
    match(empty, empty, np.zeros(0), np.zeros(0, np.bool_), 0)
    tracker = Tracker(parameters, rejoin=Rejoin(embedding_model="any"))
    posterior = tracker.initial()
    boxes: dict[str, Any] = {"label": [0], "center": [[0.0, 0.0, 0.0]], "score": [0.9]}
    boxes |= {"embedding": [[1.0, 0.0]], "embedding_model": "any"}
    for k in range(8):  # until it is decided which object the track is
        frame, _ = make_frame(parameters, stamp_ns=k * 500_000_000, labels=("pedestrian",), **boxes)
        posterior = tracker.step(posterior, frame).density
