"""Bags of ROS 2 as a dataset: each topic of detections is a sequence, `/lidar/boxes` is called `lidar.boxes`.

Stamps are those of the headers. Tracks are in the fixed frame of tf. There is no truth. What a bag leaves open is
chosen by options: `points`, `odometry`, `fixed_frame`, and `class.NAME=OTHER` for names of classes.
"""

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING

from optipmb_schemas import Tracks
from optipmb_schemas.installation import install_command

from optipmb_client.camera import synthetic_camera
from optipmb_client.datasets.interface import (
    DETECTION_COLUMNS,
    Cloud,
    DataSequence,
    Dataset,
    DetectionFrame,
    Points,
    relabelled,
)
from optipmb_client.errors import ClientError
from optipmb_client.files import DatasetError
from optipmb_client.results.kitti import write_kitti_results

if TYPE_CHECKING:
    from optipmb_client.geometry import Pose

try:
    from optipmb_schemas import MessageError
    from optipmb_schemas.ros2.arrays import Boxes, boxes_of, points_of

    from optipmb_client.datasets.bag import Bag, Choice, Plan, Raw, detection_topics, plan, read_transforms
    from optipmb_client.results.bag import write_bag
except ImportError as error:
    raise ClientError(f"bags need rosbags, which is not installed: {install_command('ros2')}") from error

_CLASS = "class."


class RosbagSequence(DataSequence):
    """One topic of detections."""

    poses: "list[Pose]"

    def __init__(self, bag: Bag, plan_: Plan, classes: Mapping[str, str], *, covariance: bool) -> None:
        self.name = plan_.topic.strip("/").replace("/", ".")
        self.plan = plan_
        self.bag = bag
        self.has_clouds: bool = bool(plan_.clouds)
        self.notes = plan_.notes
        self.poses = [frame.pose for frame in plan_.frames]
        self._classes = classes
        self._covariance = covariance

    def __len__(self) -> int:
        return len(self.plan.frames)

    @cached_property
    def labels(self) -> tuple[str, ...]:
        """Class names of all frames."""
        messages = self.bag.messages((self.plan.topic,))
        return tuple(dict.fromkeys(name for raw in messages for name in self._boxes(raw).labels))

    def frames(self) -> Iterator[DetectionFrame]:
        """Yield every frame in the order of the stamps. What is received between a frame and its cloud is kept."""
        topics = {self.plan.topic, *([self.plan.cloud_topic] if self.plan.cloud_topic else [])}
        due = [(frame.stamp_ns, frame.received_ns) for frame in self.plan.frames]
        known = set(due)
        boxes: dict[tuple[int, int], Boxes] = {}
        clouds: dict[int, Raw] = {}
        index = 0
        for raw in self.bag.messages(topics):
            stamp_ns = self.bag.header(raw).stamp_ns
            if raw.topic == self.plan.topic:
                if (stamp_ns, raw.received_ns) in known:
                    boxes[stamp_ns, raw.received_ns] = self._boxes(raw)
            elif stamp_ns in self.plan.clouds:
                clouds[stamp_ns] = raw
            while index < len(due) and due[index] in boxes and self._complete(due[index][0], clouds):
                yield self._frame(index, boxes.pop(due[index]), clouds.get(due[index][0]))
                index += 1
                if index == len(due) or due[index][0] != due[index - 1][0]:
                    clouds.pop(due[index - 1][0], None)

    def _complete(self, stamp_ns: int, clouds: Mapping[int, Raw]) -> bool:
        return stamp_ns not in self.plan.clouds or stamp_ns in clouds

    def _frame(self, index: int, boxes: Boxes, cloud: Raw | None) -> DetectionFrame:
        planned = self.plan.frames[index]
        pose = self.plan.clouds.get(planned.stamp_ns)
        columns = {name: getattr(boxes, name) for name in DETECTION_COLUMNS}
        columns["label"] = relabelled(boxes.label, boxes.labels, self.labels)
        return DetectionFrame(
            index=index,
            stamp_ns=planned.stamp_ns,
            pose=planned.pose,
            labels=self.labels,
            **columns,
            cloud=None if cloud is None or pose is None else Cloud(partial(self._points, cloud), *pose),
        )

    def _boxes(self, raw: Raw) -> Boxes:
        try:
            return boxes_of(self.bag.read(raw), self._classes, covariance=self._covariance)
        except MessageError as error:
            raise self.bag.wrong(raw, error) from error

    def _points(self, raw: Raw) -> Points:
        try:
            return points_of(self.bag.read(raw))
        except MessageError as error:
            raise self.bag.wrong(raw, error) from error


class RosbagDataset(Dataset):
    """The topics of detections of one bag.

    Args:
        path: The folder or file.
        options: `points`, `odometry`, `fixed_frame`, `class.NAME`, `keep_input`, and `covariance`: whether the
            covariances of positions in the detections are taken for their accuracy.

    Raises:
        DatasetError: It cannot be read, has no detections, or an option is not known.
    """

    name = "rosbag"
    profile = "auto"

    def __init__(self, path: Path, options: Mapping[str, float | str]) -> None:
        texts = {name: str(value) for name, value in options.items()}
        self._classes = {name.removeprefix(_CLASS): texts.pop(name) for name in list(texts) if name.startswith(_CLASS)}
        self._keep_input = texts.pop("keep_input", "0") not in {"0", "False"}
        self._covariance = texts.pop("covariance", "0") not in {"0", "False"}
        known = set(Choice.__dataclass_fields__)
        for name in texts:
            if name not in known:
                allowed = f"one of {', '.join(sorted(known))}, keep_input, covariance, class.NAME"
                raise DatasetError(f"option {name}", allowed, "an unknown option")
        self._bag = Bag(path)
        self._sequences: dict[str, RosbagSequence] = {}
        self._choice = Choice(**texts)
        self._topics = {topic.strip("/").replace("/", "."): topic for topic in detection_topics(self._bag)}

    def sequences(self, names: Sequence[str]) -> Sequence[RosbagSequence]:
        """Return the topics of these names, with dots or slashes, or `all`."""
        wanted: dict[str, None] = {}
        for name in names:
            for dotted in self._topics if name == "all" else (name.strip("/").replace("/", "."),):
                if dotted not in self._topics:
                    raise DatasetError("--sequences", f"topics of detections: {', '.join(self._topics.values())}", name)
                wanted[dotted] = None
        new = [name for name in wanted if name not in self._sequences]
        if new:
            transforms = read_transforms(self._bag, self._choice)
            for name in new:
                made = plan(self._bag, self._topics[name], transforms, self._choice)
                self._sequences[name] = RosbagSequence(self._bag, made, self._classes, covariance=self._covariance)
        return [self._sequences[name] for name in wanted]

    def write(self, out: Path, sequence: DataSequence, tracks: Mapping[int, Tracks]) -> Path:
        """Write the bag `out` if that is an .mcap file, else `out/NAME.txt` in the format of KITTI."""
        if out.suffix == ".mcap":
            (one,) = self.sequences([sequence.name])
            return write_bag(out, one.bag, one.plan, tracks, keep_input=self._keep_input)
        return write_kitti_results(out / f"{sequence.name}.txt", synthetic_camera(), sequence.poses, tracks)
