"""Generated traffic scenes as a dataset: detections, clouds and truth for people without data.

Conventions: the sensor is a LiDAR on the roof of a car that drives along; its frame is x forward, y left, z up, level,
1.75 m above the ground. The world has its origin in the middle of the block and the ground at z = 0. The same options
give the same bytes, independent of the order of calls.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path

import numpy as np
from optipmb_schemas import Tracks

from optipmb_tools.camera import synthetic_camera
from optipmb_tools.datasets.interface import Cloud, DataSequence, Dataset, DetectionFrame, Truth
from optipmb_tools.datasets.scene.detector import CLASSES, Found, InRange, detect
from optipmb_tools.datasets.scene.lidar import Scan, scan
from optipmb_tools.datasets.scene.traffic import World, build_world, fixed_boxes, street
from optipmb_tools.files import DatasetError
from optipmb_tools.geometry import Bools, Floats, Ints, Pose, planar_pose, rotation_of, to_sensor, wrap_angle
from optipmb_tools.results.kitti import write_kitti_results

HEIGHT = 1.75  # of the sensor above the ground
RADIUS = 60.0  # objects farther away are neither detected nor part of the truth
MIN_POINTS = 5  # an object with fewer points cannot be expected to be found: its truth is ignored

HIDDEN_S = 2.0
"""An object that no ray has met for longer is a new one when it is seen again, as is one that was out of range: without
its looks it cannot be recognised."""

_NAME_DIGITS = 4


@dataclass(frozen=True)
class SceneOptions:
    """Options of generated scenes."""

    seed: int = 0
    frames: int = 200
    rate: float = 10.0  # frames per second
    vehicles: int = 20  # Cars, a good third of them parked
    pedestrians: int = 12
    cyclists: int = 5
    clouds: bool = True  # frames carry their point cloud
    velocity: bool = False  # detections carry a velocity
    lasting: bool = False  # objects keep their ids when they were hidden long, and more buildings hide them

    def __post_init__(self) -> None:
        for name, low, high in _BOUNDS:
            value = getattr(self, name)
            if not low <= value <= high or (name != "rate" and value != int(value)):
                raise DatasetError(f"option {name}", f"a number from {low:g} to {high:g}", f"{value:g}")


_BOUNDS = (
    ("seed", 0, 2**63 - 1),
    ("frames", 1, 100_000),
    ("rate", 0.5, 50.0),
    ("vehicles", 0, 50),
    ("pedestrians", 0, 100),
    ("cyclists", 0, 30),
)


class SceneSequence(DataSequence):
    """One generated scene; it is driven through at the first use, each frame is scanned when it is asked for."""

    labels = CLASSES

    def __init__(self, name: str, options: SceneOptions) -> None:
        self.name = name
        self.areas = street()
        self._options = options
        self._scanned: dict[int, tuple[Ints, Floats]] = {}

    def __len__(self) -> int:
        return self._options.frames

    @cached_property
    def has_clouds(self) -> bool:
        """Whether frames have point clouds."""
        return self._options.clouds

    def _chance(self, *purpose: int) -> np.random.Generator:
        """Return a source of chance of its own for each purpose, so that no order of use changes anything."""
        return np.random.Generator(np.random.PCG64([self._options.seed, int(self.name), *purpose]))

    @cached_property
    def _world(self) -> World:
        counts = self._options.vehicles, self._options.pedestrians, self._options.cyclists
        return build_world(counts, np.arange(self._options.frames) / self._options.rate, self._chance(0))

    @cached_property
    def poses(self) -> tuple[Pose, ...]:
        """World from sensor, one per frame."""
        return tuple(planar_pose(x, y, HEIGHT, yaw) for x, y, yaw in self._world.carrier.tolist())

    def _local(self, frame: int, center: Floats, yaw: Floats) -> tuple[Floats, Floats]:
        """Carry boxes from the world to the sensor frame."""
        pose = self.poses[frame]
        return to_sensor(rotation_of(pose.quaternion), pose.translation, center, yaw)

    def _scan(self, frame: int) -> Scan:
        """Return the scan of a frame; its first boxes are the objects, the others only hide them."""
        world = self._world
        place, extent = fixed_boxes(lasting=self._options.lasting)
        center, yaw = self._local(
            frame,
            np.vstack([world.center[frame], place]),
            np.concatenate([world.yaw[frame], np.zeros(len(place))]),
        )
        seen = scan(center, np.vstack([world.size, extent]), yaw, HEIGHT, self._chance(1, frame))
        count = len(world.label)
        self._scanned[frame] = (seen.points[:count], seen.covered[:count])
        return seen

    def _in_range(self, frame: int) -> Ints:
        offset = self._world.center[frame, :, :2] - self._world.carrier[frame, :2]
        return np.flatnonzero(np.linalg.norm(offset, axis=1) <= RADIUS)

    def observe(self, frame: int) -> tuple[Scan, Found]:
        """Return the scan of a frame and its detections, with the source of each."""
        world = self._world
        view = self._scan(frame)
        rows = self._in_range(frame)
        center, yaw = self._local(frame, world.center[frame, rows], world.yaw[frame, rows])
        ahead = rotation_of(self.poses[frame].quaternion)[:2, :2]
        seen = InRange(
            index=rows,
            label=world.label[rows],
            center=center,
            size=world.size[rows],
            yaw=yaw,
            velocity=world.velocity[frame, rows] @ ahead,
            points=view.points[rows],
            ease=world.ease[frame, rows],
        )
        place, _ = fixed_boxes(lasting=self._options.lasting)
        sites, _ = self._local(frame, place, np.zeros(len(place)))
        return view, detect(seen, sites[:, :2], RADIUS, HEIGHT, self._chance(2, frame))

    def frames(self) -> Iterator[DetectionFrame]:
        """Yield every frame in order."""
        for index, pose in enumerate(self.poses):
            view, found = self.observe(index)
            yield DetectionFrame(
                index=index,
                stamp_ns=round(index * 1e9 / self._options.rate),
                pose=pose,
                labels=CLASSES,
                label=found.label,
                center=found.center,
                size=found.size,
                yaw=found.yaw,
                score=found.score,
                velocity=found.velocity if self._options.velocity else None,
                cloud=Cloud(view.xyz, pose.translation, pose.quaternion) if self._options.clouds else None,
            )

    def truth(self) -> Truth:
        """Return the objects in range, from when they are first seen.

        One that was away or hidden long is a new one, or the same with the option `lasting`.
        """
        world = self._world
        inside = np.zeros(world.yaw.shape, dtype=np.bool_)
        for frame in range(len(self)):
            inside[frame, self._in_range(frame)] = True
            if frame not in self._scanned:
                self._scan(frame)
        returns = np.stack([self._scanned[i][0] for i in range(len(self))])
        absence = len(self) if self._options.lasting else round(HIDDEN_S * self._options.rate)
        identity = visits(inside & (returns > 0), absence)
        when, which = np.nonzero(inside & (identity >= 0))
        points = returns[when, which]
        covered = np.stack([self._scanned[i][1] for i in range(len(self))])[when, which]
        level = np.digitize(np.nan_to_num(covered, nan=0.0), [0.1, 0.5])
        return Truth.of(
            CLASSES,
            when.astype(np.int64),
            id=identity[when, which],
            label=world.label[which],
            center=world.center[when, which],
            size=world.size[which],
            yaw=wrap_angle(world.yaw[when, which]),
            velocity=world.velocity[when, which],
            occlusion=level.astype(np.int64),
            covered=covered,
            points=points,
            ignored=points < MIN_POINTS,
        )


def visits(inside: Bools, absence: int) -> Ints:
    """Return the id (F, O) of the stay that each object is on, -1 outside; stays are numbered in order of time.

    A stay goes on over a break of at most `absence` frames, which belong to it.
    """
    identity = np.full(inside.shape, -1, dtype=np.int64)
    last = np.full(inside.shape[1], -absence - 2, dtype=np.int64)
    current = np.full(inside.shape[1], -1, dtype=np.int64)
    following = 0
    for frame, present in enumerate(inside):
        new = np.flatnonzero(present & (frame - last > absence + 1))
        current[new] = following + np.arange(len(new))
        following += len(new)
        for row in np.flatnonzero(present & (frame - last <= absence + 1)):
            identity[last[row] + 1 : frame, row] = current[row]
        identity[frame, present] = current[present]
        last[present] = frame
    return identity


class SceneDataset(Dataset):
    """Generated scenes; sequences are named by four digits, and each is another scene."""

    name = "scene"
    profile = "scene"

    def __init__(self, options: SceneOptions) -> None:
        self._options = options

    def sequences(self, names: Sequence[str]) -> list[SceneSequence]:
        """Return the scenes of these names; `all` is the one scene 0000.

        Raises:
            DatasetError: a name is not of four digits, or there is none.
        """
        wanted = dict.fromkeys("0000" if name == "all" else name for name in names)
        for name in wanted:
            if len(name) != _NAME_DIGITS or not (name.isascii() and name.isdigit()):
                raise DatasetError(
                    "--sequences", "the names of generated scenes (four digits, such as 0000)", repr(name)
                )
        if not wanted:
            raise DatasetError("--sequences", "at least one sequence", "none")
        return [SceneSequence(name, self._options) for name in wanted]

    def write(self, out: Path, sequence: DataSequence, tracks: Mapping[int, Tracks]) -> Path:
        """Write `out/SSSS.txt` in the format of KITTI, for a camera in the sensor's place."""
        return write_kitti_results(out / f"{sequence.name}.txt", synthetic_camera(), sequence.poses, tracks)


def scene_options(options: dict[str, float | bool]) -> SceneOptions:
    """Return the options by name.

    Raises:
        DatasetError: an option is not known or out of its bounds.
    """
    known = {field.name: field.type for field in fields(SceneOptions)}
    for name in options:
        if name not in known:
            raise DatasetError(f"option {name}", f"one of {', '.join(known)}", "an unknown option")
    return SceneOptions(**options)  # type: ignore[arg-type]  # the bounds are checked by SceneOptions itself
