"""Disturbed messages and sessions end like undisturbed ones: by search, and by simulation."""

import os
from dataclasses import replace

import pytest
from disturbed import World, give
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, precondition, rule
from optipmb_schemas import Detections, MessageError, Points, decode, encode
from optipmb_service.session.checkpoint import decode_checkpoint, encode_checkpoint, state_bytes
from optipmb_service.session.policy import Policy
from optipmb_service.session.session import Session
from router import SECOND, Sensor
from sessions import Merged, chained

import optipmb

NUSCENES = optipmb.load_profile("nuscenes")
POLICY = Policy(rewind_ns=3600 * SECOND, rewind_frames=10_000, late_clouds=True)
SEEDS = int(os.environ.get("OPTIPMB_TEST_SEEDS", "4"))


class Disturbed(RuleBasedStateMachine):
    """A stream whose messages hypothesis delivers as it likes, to a session that it crashes as it likes.

    The model is the session that gets everything once, in order, and never crashes. All that was sent is delivered in
    the end: messages under way, and messages forgotten in a crash, from the publisher's cache.
    """

    @initialize(first=st.integers(0, 3))
    def begin(self, first: int) -> None:
        self.sensor = Sensor()
        self.stamp_ns, self.seq = 10**6 * SECOND, first
        self.now_ns = 0
        self.session, self.model = self.fresh(), self.fresh()
        self.merged, self.expected = Merged(), Merged()
        self.sent: list[bytes] = []
        self.under_way: list[bytes] = []
        self.saved = encode_checkpoint(self.session.snapshot())

    def fresh(self) -> Session:
        return Session(self.sensor.stream, NUSCENES, POLICY, tracker=chained)

    @rule(objects=st.integers(0, 3), step=st.sampled_from([0, 1, 1, 1, 2, 40, 70]), cloud=st.booleans())
    def send(self, objects: int, step: int, cloud: bool) -> None:  # noqa: FBT001 - drawn
        """The publisher sends a frame, perhaps after a silence, perhaps with a cloud."""
        self.stamp_ns += step * SECOND // 10
        cloud = cloud and step > 0
        frame = self.sensor.detections(self.seq, objects=objects, stamp_ns=self.stamp_ns, has_points=cloud)
        messages = [encode(frame)]
        if cloud:
            points = self.sensor.points(self.seq, count=3, stamp_ns=self.stamp_ns)
            messages.append(encode(points))
            self.expected.take(self.model.on_points(points, 0))
        self.expected.take([*self.model.on_detections(frame, 0), *self.model.flush()])
        self.seq += 1
        self.sent += messages
        self.under_way += messages

    @rule(hours=st.sampled_from([-1, 1]))
    def jump(self, hours: int) -> None:
        self.stamp_ns += hours * 3600 * SECOND

    @rule(lost=st.integers(1, 3))
    def drop(self, lost: int) -> None:
        self.seq += lost

    @precondition(lambda self: self.under_way)
    @rule(data=st.data())
    def deliver(self, data: st.DataObject) -> None:
        self.receive(self.under_way.pop(data.draw(st.integers(0, len(self.under_way) - 1))))

    @precondition(lambda self: self.under_way)
    @rule()
    def deliver_next(self) -> None:
        self.receive(self.under_way.pop(0))

    @precondition(lambda self: self.sent)
    @rule(data=st.data())
    def repeat(self, data: st.DataObject) -> None:
        self.receive(data.draw(st.sampled_from(self.sent)))

    @precondition(lambda self: self.sent)
    @rule(data=st.data())
    def malform(self, data: st.DataObject) -> None:
        """A truncated message arrives."""
        payload = data.draw(st.sampled_from(self.sent))
        self.receive(payload[: data.draw(st.integers(0, len(payload) - 1))])

    @rule(periods=st.integers(1, 30))
    def wait(self, periods: int) -> None:
        self.now_ns += periods * SECOND // 10
        self.merged.take(self.session.on_tick(self.now_ns), self.session.run)

    @rule()
    def checkpoint(self) -> None:
        """The session is saved; the restored one equals it."""
        self.saved = encode_checkpoint(self.session.snapshot())
        again = Session.restore(decode_checkpoint(self.saved), 0, POLICY, tracker=chained).snapshot()
        assert encode_checkpoint(replace(again, run=again.run - 1)) == self.saved

    @rule()
    def crash(self) -> None:
        """The session crashes and is restored; its messages arrive again at some time."""
        self.session = Session.restore(decode_checkpoint(self.saved), self.now_ns, POLICY, tracker=chained)
        self.saved = encode_checkpoint(self.session.snapshot())
        self.under_way = list(self.sent)

    def receive(self, payload: bytes) -> None:
        """Hand over what arrives, as a service does."""
        for kind in (Detections, Points):
            try:
                message = decode(payload, kind)
            except MessageError:
                continue
            self.merged.take(give(self.session, message, self.now_ns), self.session.run)
            return

    def teardown(self) -> None:
        """Deliver all messages; then the session equals the model."""
        if not hasattr(self, "sent"):
            return
        for payload in self.under_way:
            self.receive(payload)
        self.merged.take([*self.session.recovered(self.now_ns), *self.session.flush()], self.session.run)
        assert self.session.counters.late == 0
        assert state_bytes(self.session.snapshot()) == state_bytes(self.model.snapshot())
        found, expected = self.merged.plain(), self.expected.plain()
        assert found.items() >= expected.items()
        # A frame that came first was published, also where those before it then showed that it is to be refused.
        assert len(found) - len(expected) <= self.model.counters.refused


TestDisturbed = Disturbed.TestCase
TestDisturbed.settings = settings(
    max_examples=int(os.environ.get("OPTIPMB_TEST_EXAMPLES", "25")), stateful_step_count=40, deadline=None
)


@pytest.mark.parametrize("seed", range(SEEDS))
def test_a_disturbed_world_ends_like_a_quiet_one(seed: int) -> None:
    """Streams with delays, repeats, garbage, jumps, crashes and torn checkpoints end like those without."""
    world = World(seed, seconds=20)
    world.run()  # what fails names the seed
    assert world.messages > 200


def test_a_world_with_the_real_tracker() -> None:
    """The same with the filter itself."""
    World(1, streams=1, seconds=10, tracker=optipmb.Tracker).run()
