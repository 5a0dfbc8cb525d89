"""Recordings as a dataset: each stream is a sequence, named by its stream with dots, `garage.robot-1.lidar`.

Of a folder of recordings the name of the file comes first: `monday.garage.robot-1.lidar` is in `monday.mcap`.

The frames are the ones that the service would track from the recording: each once, with the clouds that took part.
Frames must be in the order of their stamps here; a recording in which they are not needs a service that is there
when they come late (`optipmb play`). There is no truth.
"""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path

from optipmb_schemas import Detections, Points, Tracks, decode

from optipmb_tools.camera import synthetic_camera
from optipmb_tools.datasets.interface import IDENTITY, Cloud, DataSequence, Dataset, DetectionFrame
from optipmb_tools.files import DatasetError
from optipmb_tools.geometry import Floats, Pose, box_columns, rotation_of, to_sensor
from optipmb_tools.recordings.plan import StreamPlan, plan, steps
from optipmb_tools.recordings.recording_file import Recorded, RecordingFile
from optipmb_tools.results.kitti import write_kitti_results


class RecordedSequence(DataSequence):
    """One stream of a recording."""

    def __init__(self, name: str, recording: RecordingFile, plan_: StreamPlan) -> None:
        self.name = name
        self.sensor = plan_.stream
        self.recording = f"{name.removesuffix(plan_.stream.rpartition('/')[2])}fused"
        self.has_clouds: bool = bool(plan_.with_cloud)
        self._recording = recording
        if plan_.has_embeddings:
            self.notes = (f"{name}: embeddings are not used: objects are followed by motion alone",)
        self._plan = replace(plan_, tracks={})  # they are large, and not needed for tracking
        stamps = list(plan_.frames.values())
        for number, (before, after) in enumerate(itertools.pairwise(stamps), start=1):
            if after < before:
                raise DatasetError(
                    recording.path,
                    f"frames of {plan_.stream} in the order of their stamps (optipmb play takes any order)",
                    f"frame {number} that is {(before - after) / 1e9:.3f} s before the one ahead of it",
                )

    def __len__(self) -> int:
        return len(self._plan.frames)

    @cached_property
    def poses(self) -> Sequence[Pose]:
        """World from sensor of each frame; the identity where boxes are in the world frame."""
        return [_placed(message)[0] for message, _ in self._messages(clouds=False)]

    @cached_property
    def labels(self) -> tuple[str, ...]:
        """Class names of all frames."""
        return tuple(dict.fromkeys(name for message, _ in self._messages(clouds=False) for name in message.labels))

    def frames(self) -> Iterator[DetectionFrame]:
        """Yield every frame in order."""
        for index, (message, cloud) in enumerate(self._messages(clouds=True)):
            pose, center, yaw, velocity, covariance = _placed(message)
            yield DetectionFrame(
                index=index,
                stamp_ns=message.stamp_ns,
                pose=pose,
                labels=message.labels,
                label=message.label,
                center=center,
                size=box_columns(message)[0],
                yaw=yaw,
                score=message.score,
                velocity=velocity,
                cloud=None if cloud is None else _cloud(cloud),
                field_of_view=message.field_of_view,
                position_covariance=covariance,
            )

    def _messages(self, *, clouds: bool) -> Iterator[tuple[Detections, Recorded | None]]:
        messages = self._recording if clouds else (one for one in self._recording if one.topic != "points")
        plans = {self._plan.stream: self._plan if clouds else StreamPlan(self._plan.stream)}
        for step in steps(messages, plans):
            if step.frame is not None:
                yield decode(step.detections.payload, Detections, encoding=step.detections.encoding), step.cloud


class RecordedDataset(Dataset):
    """The streams of one recording, or of all recordings of a folder.

    Args:
        path: The MCAP file, or the folder: then the names of streams begin with the name of their file and a dot.

    Raises:
        DatasetError: There is none, or it cannot be read.
    """

    name = "mcap"

    def __init__(self, path: Path) -> None:
        files = sorted(path.glob("[!.]*.mcap"), key=lambda one: one.stem) if path.is_dir() else [path]
        if not files:
            raise DatasetError(path, "a folder with recordings (.mcap)", "none in it")
        self._files = {f"{file.stem}." if path.is_dir() else "": RecordingFile(file) for file in files}
        self._planned: tuple[str, dict[str, StreamPlan]] | None = None

    @cached_property
    def profile(self) -> str:
        """The profile that was in force when it was recorded, of the first stream that tells."""
        for one in (one for prefix in self._files for one in self._plans(prefix).values()):
            names = [one.parameters.profile] if one.parameters else []
            names += [tracks.profile for tracks in one.tracks.values()]
            if names and names[0] is not None:
                return names[0]
        raise DatasetError("--profile", "a profile, for the recording does not say which was in force", "none")

    def sequences(self, names: Sequence[str]) -> Sequence[DataSequence]:
        """Return the streams of these names, with dots or slashes, or `all`."""
        chosen: dict[str, DataSequence] = {}
        for name in names:
            wanted = name.replace("/", ".")
            found = {
                full: (recording, one)
                for prefix, recording in self._files.items()
                if name == "all" or wanted.startswith(prefix)
                for full, one in self._plans(prefix).items()
                if name == "all" or full == wanted
            }
            if not found:
                known = ", ".join(full for prefix in self._files for full in self._plans(prefix))
                raise DatasetError("--sequences", f"streams of the recording: {known}", name)
            for full, (recording, one) in found.items():
                chosen[full] = RecordedSequence(full, recording, one)
        return list(chosen.values())

    def _plans(self, prefix: str) -> dict[str, StreamPlan]:
        """Return the plans of one file by the full names of its streams; the last ones are cached."""
        if self._planned is None or self._planned[0] != prefix:
            recording = self._files[prefix]
            plans = {prefix + stream.replace("/", "."): one for stream, one in plan(recording).items()}
            if not plans:
                raise DatasetError(recording.path, "a recording with detections", "one without")
            self._planned = prefix, plans
        return self._planned[1]

    def write(self, out: Path, sequence: DataSequence, tracks: Mapping[int, Tracks]) -> Path:
        """Write `out/NAME.txt` in the format of KITTI, for a camera in the sensor's place."""
        return write_kitti_results(out / f"{sequence.name}.txt", synthetic_camera(), sequence.poses, tracks)


def _pose(message: Detections | Points) -> Pose:
    if message.frame == "world" or message.pose is None:
        return IDENTITY
    return Pose(message.pose.translation, message.pose.quaternion)


def _placed(message: Detections) -> tuple[Pose, Floats, Floats, Floats | None, Floats | None]:
    """Return pose, centres, yaws, velocities and covariances of the centres.

    Boxes in the world frame are carried to a sensor with a field of view.
    """
    center, (_, yaw) = message.center, box_columns(message)
    velocity, covariance = message.velocity, message.position_covariance
    if message.frame == "sensor" or message.pose is None or message.field_of_view is None:
        return _pose(message), center, yaw, velocity, covariance
    pose = Pose(message.pose.translation, message.pose.quaternion)
    rotation = rotation_of(pose.quaternion)
    center, yaw = to_sensor(rotation, pose.translation, center, yaw)
    velocity = None if velocity is None else velocity @ rotation[:2, :2]
    return pose, center, yaw, velocity, None if covariance is None else rotation.T @ covariance @ rotation


def _cloud(recorded: Recorded) -> Cloud:
    message = decode(recorded.payload, Points, encoding=recorded.encoding)
    return Cloud(message.xyz, *_pose(message))
