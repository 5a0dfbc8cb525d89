"""Publishing detections and point clouds, for programs of your own.

Conventions: lengths in metres, angles in radians, stamps in integer nanoseconds of the sensor's clock. `frame="sensor"`
means that boxes and points are given in the sensor's own frame (x forward, y left, z up) and come with the pose of that
frame in the world; `frame="world"` that they are in the fixed world frame already. Velocities are over ground, along
the axes of the frame.

A stream is named `site/node/sensor`. The service keeps one tracking session per stream.
"""

import array
import operator
import secrets
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np
from optipmb_schemas import PREFIX, Detections, FieldOfView, Keys, MessageError, Points, Pose, Relocation
from optipmb_schemas.arrays import ArrayLike, numeric

from optipmb_client.links import Link, linked
from optipmb_client.trace_context import attachment_of, current_traceparent

if TYPE_CHECKING:
    from optipmb_client.grpc.streams import GrpcSender
    from optipmb_client.zenoh.handles import Sender

__all__ = ["Publisher"]

CACHE = 400  # detection messages kept for recovery: 20 s of a sensor at 20 Hz; a link that is dead is noticed in 11 s

PoseLike = Pose | tuple[ArrayLike, ArrayLike]


class Publisher:
    """Publishes the detections of one sensor, and its point clouds where somebody uses them.

    Messages are checked first: a wrong shape or value raises `MessageError`, with the path of the field, before
    anything is sent. Detections are kept for some 20 s, so that a service that restarts or loses its link gets them
    still. Publishing does not wait. One publisher may be used from several threads. Messages carry the trace context of
    the OpenTelemetry span that is active where they are published, if there is one.

    Args:
        stream: Name of the stream, `site/node/sensor`. One publisher per stream at a time.
        connect: Endpoint or endpoints of routers, such as `tcp/10.0.0.1:7447`, or of gRPC gateways, such as
            `grpc://10.0.0.1:50051`; default: this machine.
        config: A Zenoh configuration file, for TLS, passwords and the like; for gRPC the folder of the certificates.
        frame: Frame of all boxes and points given to `publish`.
        timeout: Seconds to wait for a router.
        connection: Share an open connection (it stays open) in the place of `connect` and `config`.
        cache: Number of detection messages kept for recovery.
        cache_clouds: Number of point clouds kept for recovery, in memory. Without, a frame that is recovered is tracked
            as one that never had a cloud: good enough for most uses, as clouds are a hundred times larger than
            detections. With it clouds are sent whether or not anybody subscribes.
        prefix: First part of all keys, as configured in the service.

    Raises:
        ConnectionFailed: No router, or gateway, within `timeout`, or `connection` is used up.
        MessageError: `stream` is no stream name.
    """

    def __init__(  # noqa: PLR0913  each option by its name, all but two seldom used
        self,
        stream: str,
        connect: str | Sequence[str] | None = None,
        *,
        frame: Literal["sensor", "world"] = "sensor",
        config: str | Path | None = None,
        timeout: float = 5.0,
        connection: "Link | None" = None,
        cache: int = CACHE,
        cache_clouds: int = 0,
        prefix: str = PREFIX,
    ) -> None:
        Keys(prefix).detections(stream)  # checks both
        self.stream = stream
        self.frame = frame
        self.epoch = secrets.token_bytes(16)  # identifies this start of the publisher
        self.last_put_ns = 0  # monotonic time just before the newest detections were handed to the network
        self._seq = 0
        self._points_seq = 0
        self._relocation: Relocation | None = None  # of the present world
        self._order = threading.Lock()  # sequence numbers go out in order
        self._own: Link | None = None
        if connection is None:
            connection = self._own = linked(connect, config=config, timeout=timeout)
        self._detections: Sender | GrpcSender
        self._points: Sender | GrpcSender
        self._detections, self._points = connection.senders(
            stream, prefix=prefix, cache=cache, cache_clouds=cache_clouds
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Withdraw the publisher; earlier messages are still sent. May be called twice."""
        self._detections.close()
        self._points.close()
        if self._own is not None:
            self._own.close()

    @property
    def points_wanted(self) -> bool:
        """Whether anybody subscribes to the point clouds of this stream at the moment."""
        return self._points.wanted

    def publish(  # noqa: PLR0913  the fields of the message, by name
        self,
        *,
        stamp_ns: int,
        label: Sequence[str] | ArrayLike,
        center: ArrayLike,
        score: ArrayLike,
        size: ArrayLike | None = None,
        yaw: ArrayLike | None = None,
        velocity: ArrayLike | None = None,
        labels: Sequence[str] | None = None,
        pose: PoseLike | None = None,
        points: ArrayLike | None = None,
        points_pose: PoseLike | None = None,
        has_points: bool | None = None,
        field_of_view: FieldOfView | None = None,
        position_covariance: ArrayLike | None = None,
        relocation: PoseLike | None = None,
        embedding: ArrayLike | None = None,
        embedding_model: str | None = None,
        attributes: Sequence[Mapping[str, str | tuple[str, float]]] | None = None,
    ) -> int:
        """Publish the detections of one sensor frame, and its point cloud where there is one.

        Args:
            stamp_ns: Sensor time of the frame.
            label: Class names of the M objects; or, with `labels`, indices (M,) into it.
            center: (M, 3), geometric centres of the boxes; NaN as z where it is unknown.
            score: (M,), in [0, 1]; an object of score 0 is left out and counted.
            size: (M, 3), length, width, height, all positive; NaN where unknown. None: unknown for all.
            yaw: (M,), counter-clockwise from x; NaN where unknown. None: unknown for all.
            velocity: (M, 2), over ground; a row of NaN where it is unknown. None: unknown for all.
            labels: The class names that `label` points into.
            pose: Pose of the sensor in the world, (translation (3,), unit quaternion w x y z (4,)); needed with
                `frame="sensor"`.
            points: (P, 3 or more), the cloud of this frame, sent where somebody subscribes to it. Rows that are not
                finite (no return) are left out, further columns too.
            points_pose: Pose of the frame the points are in, when it differs from the pose of the boxes.
            has_points: Whether the service shall wait for a cloud of this stamp. Default: True when `points` are sent,
                False when this publisher has sent clouds before, otherwise the service judges. True with `points` sends
                them in any case.
            field_of_view: Where the sensor detects objects, in the axes of `pose`; objects outside are neither detected
                nor missed. None: it sees everything.
            position_covariance: (M, 3, 3), of the errors of the centres; NaN for an object for which the noise of the
                profile holds. None: it holds for all.
            relocation: With the first frame after a loop closure or a change of map: the motion (translation (3,),
                quaternion of a turn about z) from the world frame before to the frame of this and all later messages.
                The service moves its tracks so, and they keep their ids.
            embedding: (M, E), appearance of the objects, E from 2 to 512; a row of NaN where it is unknown.
            embedding_model: Model and version that `embedding` is of, at most 64 characters; required with it.
            attributes: Of each object up to 8 texts by name, as `{"plate": "AB 12"}`, or each with a score in (0, 1].
                None: none are known.

        Returns:
            The sequence number of the frame.

        Raises:
            MessageError: Something in the arguments is no valid message. Nothing was sent.
        """
        names, index = _labelled(label, labels)
        with self._order:  # sequence numbers go out in their order
            cloud, world = None, self._relocation
            if relocation is not None:
                world = _relocation(relocation, 1 if world is None else world.world + 1)
            if points is not None and (has_points or self.points_wanted):
                cloud = self._encode_points(stamp_ns, points, pose if points_pose is None else points_pose)
                has_points = True
            elif has_points is None and self._points_seq > 0:
                has_points = False
            message = Detections(
                stream=self.stream,
                epoch=self.epoch,
                seq=self._seq,
                stamp_ns=_stamp(stamp_ns),
                frame=self.frame,
                pose=_pose(pose),
                relocation=world,
                labels=names,
                label=index,
                center=_array(center, 3),
                size=_array(size, 3),
                yaw=_array(yaw),
                velocity=_array(velocity, 2),
                score=_array(score),
                has_points=has_points,
                field_of_view=field_of_view,
                position_covariance=_array(position_covariance, 3, 3),
                embedding=_array(embedding, 2),
                embedding_model=embedding_model,
                attributes=_attributes(attributes, len(index)),
            )
            payload = self._detections.pack(message)
            attachment = attachment_of(current_traceparent())
            if cloud is not None:
                self._points.put(cloud, attachment)
                self._points_seq += 1
            self.last_put_ns = time.monotonic_ns()
            self._detections.put(payload, attachment)
            self._seq += 1
            self._relocation = world
            return message.seq

    def publish_points(self, *, stamp_ns: int, points: ArrayLike, pose: PoseLike | None = None) -> int | None:
        """Publish a point cloud by itself, for programs that have it earlier than the detections.

        Arguments as for `publish`, which is then called with `has_points=True`.

        Returns:
            Its sequence number, which counts clouds; None when there is no subscriber, and nothing was sent.

        Raises:
            MessageError: Something in the arguments is no valid message. Nothing was sent.
        """
        with self._order:
            if not self.points_wanted:
                return None
            cloud = self._encode_points(stamp_ns, points, pose)
            self._points.put(cloud, attachment_of(current_traceparent()))
            self._points_seq += 1
            return self._points_seq - 1

    def _encode_points(self, stamp_ns: int, points: ArrayLike, pose: PoseLike | None) -> bytes:
        return self._points.pack(
            Points(
                stream=self.stream,
                epoch=self.epoch,
                seq=self._points_seq,
                stamp_ns=_stamp(stamp_ns),
                frame=self.frame,
                pose=_pose(pose),
                xyz=numeric.finite(_array(points, 3)),
            )
        )


def _attributes(given: Sequence[Mapping[str, str | tuple[str, float]]] | None, count: int) -> Any:
    """Return the attributes as `Detections` takes them, which checks their values."""
    if given is None:
        return None
    if len(given) != count:
        raise MessageError("invalid_value", "attributes", f"{count} maps, one for each object", str(len(given)))
    found = []
    for row, one in enumerate(given):
        if not isinstance(one, Mapping):
            raise MessageError("invalid_value", f"attributes[{row}]", "a map of texts by name", type(one).__name__)
        for name, value in one.items():
            match value:
                case [text, score]:
                    pass
                case text:
                    score = 1.0
            found.append({"row": row, "name": name, "text": text, "score": score})
    return found


def _labelled(label: Any, labels: Sequence[str] | None) -> tuple[tuple[str, ...], Any]:
    """Return class names and indices (M,) into them, from either form that `publish` takes."""
    if labels is not None:
        return tuple(labels), _array(label)
    if isinstance(label, str) or not isinstance(label, Iterable):
        raise MessageError("invalid_value", "label", "a list of class names", repr(label)[:80])
    names = list(label)
    for row, name in enumerate(names):
        if not isinstance(name, str):
            raise MessageError("invalid_value", f"label[{row}]", "a class name, or labels given too", repr(name)[:80])
    index = {name: number for number, name in enumerate(dict.fromkeys(names))}
    return tuple(index), array.array("q", [index[name] for name in names])


def _array(values: Any, *columns: int) -> Any:
    """Return lists as they are (errors then name the element), all else as arrays; a table without rows as a list."""
    rows = values if values is None or isinstance(values, list | tuple) else np.asarray(values)
    return [] if columns and getattr(rows, "shape", None) == (0,) else rows


def _stamp(value: Any) -> Any:
    """Return integers of any library as Python's, and other values as they are, for the message to refuse."""
    try:
        return operator.index(value)
    except TypeError:
        return value


def _pose(pose: PoseLike | None) -> Pose | None:
    if pose is None or isinstance(pose, Pose):
        return pose
    try:
        translation, quaternion = pose
    except (TypeError, ValueError):
        raise MessageError("invalid_value", "pose", "a pair: translation, quaternion", type(pose).__name__) from None
    return Pose(translation=_array(translation), quaternion=_array(quaternion))


def _relocation(motion: PoseLike, world: int) -> Relocation:
    """Return the motion into a world of this number."""
    try:
        translation, quaternion = (motion.translation, motion.quaternion) if isinstance(motion, Pose) else motion
        return Relocation(world=world, translation=_array(translation), quaternion=_array(quaternion))
    except MessageError as error:
        raise error.under("relocation") from None
    except (TypeError, ValueError):
        expected = "a pair: translation, quaternion"
        raise MessageError("invalid_value", "relocation", expected, type(motion).__name__) from None
