"""All decisions about time, as pure functions of the frames seen so far; no clock is read here.

Conventions. A frame is known by its `Mark`: the epoch of its publisher (new at every start of it), the sequence number
in that epoch, and the sensor's stamp in nanoseconds. Frames are ordered by stamp, equal stamps by sequence number. Two
clocks occur and are never mixed: sensor stamps, and the local monotonic clock (`now_ns`), which serves only for
waiting.

A stream is cut into *eras*: a new one begins with every publisher epoch and with every jump of the stamps. A
*generation* is what one density lives through: eras that only continue another share it, a restart begins the next one.

`Timeline.judge` decides on a frame's arrival, `Timeline.release` is told when the frame is processed (it may be held
for its point cloud in between, and frames that overtook each other are put in order while they are held). Going back
behind a processed frame is not done: such frames are `Verdict.LATE`, and this verdict is the only place where a rewind
would begin.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum, unique
from typing import Final

WINDOW: Final = 1024
"""How many sequence numbers back a frame is remembered; older unseen ones count as late."""

RETIRED: Final = 32
"""How many succeeded publisher epochs are remembered."""

_AFTER_ALL: Final = 2**63
"""A sequence number behind all others, for a floor that excludes its whole stamp."""


@unique
class Verdict(StrEnum):
    """What becomes of a frame."""

    FIRST = "first"
    """The first frame of the stream: a session begins."""
    NEXT = "next"
    """In order: it continues the density."""
    NEW_EPOCH = "new_epoch"
    """The publisher was restarted and its stamps go on: the density is kept, sequence numbers begin anew."""
    RESTART = "restart"
    """The stamps jumped, ahead or back: this session begins anew with this frame."""
    DUPLICATE = "duplicate"
    """The same epoch and sequence number came before: dropped."""
    LATE = "late"
    """A later frame has been processed already: refused."""
    RETIRED = "retired"
    """From a publisher epoch that another one has succeeded: refused."""

    @property
    def admitted(self) -> bool:
        """Whether the frame is to be processed."""
        return self in _ADMITTED


_ADMITTED: Final = frozenset({Verdict.FIRST, Verdict.NEXT, Verdict.NEW_EPOCH, Verdict.RESTART})


@dataclass(frozen=True, slots=True)
class Mark:
    """What identifies and orders a frame.

    Attributes:
        epoch: 16 bytes, new at every start of the publisher.
        seq: counts the publisher's frames in the epoch.
        stamp_ns: sensor time, nanoseconds.
    """

    epoch: bytes
    seq: int
    stamp_ns: int


@dataclass(frozen=True, slots=True)
class Decision:
    """The verdict on one frame, and the place of the frame among all others.

    Attributes:
        verdict: what becomes of the frame.
        era: the era that it belongs to; frames are processed in order of (era, stamp, seq).
        generation: counts restarts; a frame of a higher generation than the last one processed starts the session anew.
        jump_ns: how far the stamp lies from the newest stamp before it; 0 for the first frame.
    """

    verdict: Verdict
    era: int
    generation: int
    jump_ns: int = 0


@dataclass(frozen=True, slots=True)
class Timeline:
    """What is remembered of the frames of a stream.

    Attributes:
        gap_limit_ns: a step of the stamps beyond this, ahead or back, is a jump.
        epoch: the publisher epoch in force, None before the first frame.
        retired: epochs that were succeeded, newest last.
        era: number of the era in force.
        generation: number of restarts.
        first_seq: lowest sequence number that belongs to the era.
        highest: highest sequence number admitted in the epoch.
        seen: bit i says whether `highest - i` was admitted, for i below `WINDOW`.
        newest_ns: highest stamp admitted in the era.
        floor: (stamp, seq) of the last frame processed in the era, or what else frames of the era must lie behind.
        processed: epoch and highest sequence number of the frames processed, for counting gaps.
    """

    gap_limit_ns: int
    epoch: bytes | None = None
    retired: tuple[bytes, ...] = ()
    era: int = 0
    generation: int = 0
    first_seq: int = 0
    highest: int = 0
    seen: int = 0
    newest_ns: int = 0
    floor: tuple[int, int] | None = None
    processed: tuple[bytes, int] | None = None

    def judge(self, mark: Mark) -> tuple[Decision, Timeline]:
        """Decide on a frame that arrived; the second result replaces this timeline."""
        if self.epoch is None:
            return self._open(mark, Verdict.FIRST)
        if mark.epoch in self.retired:
            return self._refuse(mark, Verdict.RETIRED)
        if mark.epoch != self.epoch:
            continues = 0 < mark.stamp_ns - self.newest_ns <= self.gap_limit_ns
            return self._open(mark, Verdict.NEW_EPOCH if continues else Verdict.RESTART)
        return self._judge_in_epoch(mark)

    def _judge_in_epoch(self, mark: Mark) -> tuple[Decision, Timeline]:
        behind = self.highest - mark.seq
        if 0 <= behind < WINDOW and self.seen >> behind & 1:
            return self._refuse(mark, Verdict.DUPLICATE)
        if behind >= WINDOW or mark.seq < self.first_seq:
            return self._refuse(mark, Verdict.LATE)
        if abs(mark.stamp_ns - self.newest_ns) > self.gap_limit_ns:
            # Only a frame that is new by its sequence number proves a jump; an old one merely took long.
            return self._open(mark, Verdict.RESTART) if behind < 0 else self._refuse(mark, Verdict.LATE)
        if self.floor is not None and (mark.stamp_ns, mark.seq) <= self.floor:
            return self._refuse(mark, Verdict.LATE)
        highest, seen = self._remember(mark.seq)
        timeline = replace(self, highest=highest, seen=seen, newest_ns=max(self.newest_ns, mark.stamp_ns))
        return self._decide(mark, Verdict.NEXT, timeline), timeline

    def release(self, mark: Mark, era: int) -> tuple[int, Timeline]:
        """Note that a frame is processed now; the first result is how many frames are missing directly before it."""
        floor = (mark.stamp_ns, mark.seq) if era == self.era else self.floor
        if self.processed is None or self.processed[0] != mark.epoch:
            return 0, replace(self, floor=floor, processed=(mark.epoch, mark.seq))
        highest = self.processed[1]
        gap = max(0, mark.seq - highest - 1)
        return gap, replace(self, floor=floor, processed=(mark.epoch, max(highest, mark.seq)))

    def _open(self, mark: Mark, verdict: Verdict) -> tuple[Decision, Timeline]:
        same = mark.epoch == self.epoch
        highest, seen = self._remember(mark.seq) if same else (mark.seq, 1)
        retired = self.retired if same or self.epoch is None else (*self.retired, self.epoch)[-RETIRED:]
        timeline = replace(
            self,
            epoch=mark.epoch,
            retired=retired,
            era=self.era + 1,
            generation=self.generation + (verdict is Verdict.RESTART),
            first_seq=mark.seq if same else 0,
            highest=highest,
            seen=seen,
            newest_ns=mark.stamp_ns,
            floor=(self.newest_ns, _AFTER_ALL) if verdict is Verdict.NEW_EPOCH else None,
        )
        return self._decide(mark, verdict, timeline), timeline

    def _refuse(self, mark: Mark, verdict: Verdict) -> tuple[Decision, Timeline]:
        return self._decide(mark, verdict, self), self

    def _decide(self, mark: Mark, verdict: Verdict, timeline: Timeline) -> Decision:
        jump_ns = 0 if self.epoch is None else mark.stamp_ns - self.newest_ns
        return Decision(verdict, timeline.era, timeline.generation, jump_ns)

    def _remember(self, seq: int) -> tuple[int, int]:
        ahead = seq - self.highest
        if ahead <= 0:
            return self.highest, self.seen | 1 << -ahead
        # A sequence number may leap by 2^60: never shift further than the window is wide.
        shifted = self.seen << ahead if ahead < WINDOW else 0
        return seq, (shifted | 1) & ((1 << WINDOW) - 1)


def hold_until(
    *,
    has_points: bool | None,
    stamp_ns: int,
    arrived_ns: int,
    newest_cloud_ns: int | None,
    cloud_wait_ns: int,
    cloud_memory_ns: int,
) -> int | None:
    """Until when (monotonic, ns) a frame without its point cloud waits for it; None: not at all.

    Args:
        has_points: what the frame says: a cloud comes, none comes, or nothing (None).
        stamp_ns: the frame's sensor stamp.
        arrived_ns: monotonic time of the frame's arrival.
        newest_cloud_ns: highest stamp of the clouds that the stream has sent so far.
        cloud_wait_ns: the longest wait.
        cloud_memory_ns: when the frame says nothing, it waits only if its stamp is this close to a cloud's.
    """
    if has_points is None:
        has_points = newest_cloud_ns is not None and abs(stamp_ns - newest_cloud_ns) <= cloud_memory_ns
    return arrived_ns + cloud_wait_ns if has_points and cloud_wait_ns > 0 else None
