"""Content of a recording by stream, and the order of playing it: pure functions of its messages.

A frame is played with the cloud that took part in its tracks when it was recorded, however late that cloud came then,
and without one where its recorded tracks were made without. So the result does not depend on time.
"""

import collections
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Final, TypeAlias, TypeVar

from optipmb_schemas import Detections, Message, MessageError, SessionParameters, Tracks, decode, encode, encoding_of

from optipmb_tools.recordings.recording_file import KINDS, Recorded

FrameId: TypeAlias = tuple[bytes, int]  # epoch and sequence number

MARGIN_S: Final = 1e-3  # of ages, which are of floating point

_T = TypeVar("_T", bound=Message)

_ANYWHERE = {"stream": "any/any/any", "session": "0" * 32, "delivery": None, "revision": 0}


@dataclass
class StreamPlan:
    """Content of a recording for one stream."""

    stream: str
    frames: dict[FrameId, int] = field(default_factory=dict)  # stamps in order of arrival, each frame once
    clouds: collections.Counter[int] = field(default_factory=collections.Counter)  # by stamp
    with_cloud: set[FrameId] = field(default_factory=set)  # frames that are played with their cloud
    tracks: dict[FrameId, Tracks] = field(default_factory=dict)  # newest
    has_embeddings: bool = False
    parameters: SessionParameters | None = None  # when the session began; None when they were not recorded

    @property
    def clouds_lost(self) -> int:
        """Frames whose recorded tracks were made with a cloud that the recording lacks."""
        used = (frame for frame, tracks in self.tracks.items() if tracks.cloud_used)
        return sum(frame in self.frames and frame not in self.with_cloud for frame in used)

    @property
    def begins_late(self) -> bool:
        """Whether the recording begins in the middle of a session: tracks are older than its first frame."""
        first = min(self.frames.values(), default=0)
        return any((tracks.age > (tracks.stamp_ns - first) * 1e-9 + MARGIN_S).any() for tracks in self.tracks.values())

    @property
    def never_tracked(self) -> int:
        """Frames without recorded tracks between others that have some."""
        tracked = [place for place, frame in enumerate(self.frames) if frame in self.tracks]
        return tracked[-1] - tracked[0] + 1 - len(tracked) if tracked else 0

    def settle(self) -> None:
        """Give each frame its cloud; to be called when all is known."""
        left = self.clouds.copy()
        for frame, stamp in self.frames.items():
            if left[stamp] and (frame not in self.tracks or self.tracks[frame].cloud_used):
                left[stamp] -= 1
                self.with_cloud.add(frame)


@dataclass(frozen=True)
class Step:
    """Detections, and their cloud, which is published first.

    `frame` is None for an invalid message: it is played too, for its problem.
    """

    detections: Recorded
    cloud: Recorded | None
    frame: FrameId | None


def plan(messages: Iterable[Recorded]) -> dict[str, StreamPlan]:
    """Return the plans of all streams that have detections."""
    plans: dict[str, StreamPlan] = {}
    for recorded in messages:
        one = plans.setdefault(recorded.stream, StreamPlan(recorded.stream))
        if recorded.topic == "points":
            one.clouds[recorded.stamp_ns] += 1
        elif recorded.topic == "detections" and (detections := _read(recorded, Detections)) is not None:
            one.frames.setdefault(_id(detections), detections.stamp_ns)
            one.has_embeddings |= detections.embedding is not None
        elif recorded.topic == "tracks" and (tracks := _read(recorded, Tracks)) is not None:
            known = one.tracks.get(_id(tracks))
            if known is None or tracks.revision > known.revision:
                one.tracks[_id(tracks)] = tracks
        elif recorded.topic == "parameters" and one.parameters is None:
            one.parameters = _read(recorded, SessionParameters)
    for one in plans.values():
        one.settle()
    return {name: plans[name] for name in sorted(plans) if plans[name].frames}


def steps(messages: Iterable[Recorded], plans: Mapping[str, StreamPlan]) -> Iterator[Step]:
    """Yield the steps of the streams of `plans`, in the order in which they were received.

    A frame that was received again is left out, and so is a cloud that is not needed. Frames wait for their cloud, so
    messages between the two are kept in memory.
    """
    done: set[tuple[str, FrameId]] = set()
    shelf: dict[tuple[str, int], list[Recorded]] = collections.defaultdict(list)
    waiting: collections.deque[tuple[Recorded, Detections | None, bool]] = collections.deque()
    stamps = {(name, one.frames[frame]) for name, one in plans.items() for frame in one.with_cloud}
    for recorded in messages:
        if recorded.stream not in plans:
            continue
        where = (recorded.stream, recorded.stamp_ns)
        if recorded.topic == "points" and where in stamps:
            shelf[where].append(recorded)
        elif recorded.topic == "detections":
            detections = _read(recorded, Detections)
            if detections is None:
                waiting.append((recorded, None, False))
            elif (recorded.stream, _id(detections)) not in done:
                done.add((recorded.stream, _id(detections)))
                waiting.append((recorded, detections, _id(detections) in plans[recorded.stream].with_cloud))
        while waiting and (not waiting[0][2] or shelf.get((waiting[0][0].stream, waiting[0][0].stamp_ns))):
            frame, detections, needs = waiting.popleft()
            cloud = shelf[frame.stream, frame.stamp_ns].pop(0) if needs else None
            yield _step(frame, detections, cloud)


def renamed(recorded: Recorded, stream: str) -> Recorded:
    """Return a message under another stream's name; one that is not valid stays as it is inside."""
    kind = KINDS[recorded.topic]
    message = _read(recorded, kind)
    if stream == recorded.stream or message is None:
        return replace(recorded, stream=stream)
    message = message.model_copy(update={"stream": stream})
    return replace(recorded, stream=stream, payload=encode(message), encoding=encoding_of(message))


def content(tracks: Tracks) -> bytes:
    """Return the bytes of tracks without the fields that differ between runs: stream, session, delivery, revision."""
    return encode(tracks.model_copy(update=_ANYWHERE))


def _step(recorded: Recorded, detections: Detections | None, cloud: Recorded | None) -> Step:
    if detections is None:
        return Step(recorded, None, None)
    if cloud is None and detections.has_points is not False:  # nothing is to be waited for
        without = detections.model_copy(update={"has_points": False})
        recorded = replace(recorded, payload=encode(without), encoding=encoding_of(without))
    return Step(recorded, cloud, _id(detections))


def _id(message: Detections | Tracks) -> FrameId:
    return message.epoch, message.seq


def _read(recorded: Recorded, kind: type[_T]) -> _T | None:
    try:
        return decode(recorded.payload, kind, encoding=recorded.encoding)
    except MessageError:
        return None
