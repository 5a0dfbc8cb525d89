"""What a session tells: of the frames it took and of those it did not, its counters, and the answer to a query."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING, Any, Literal

import optipmb_schemas as schemas

from optipmb_service.session.refusals import Refusals
from optipmb_service.session.timeline import Verdict
from optipmb_service.session.values import Begun, Counters, Deliveries, Tracked

if TYPE_CHECKING:
    from collections.abc import Sequence

    import optipmb
    from optipmb_service.session.state import FilterState
    from optipmb_service.session.timeline import Decision, FrameId
    from optipmb_service.session.transition import Outcome
    from optipmb_service.session.values import Output, Policy

    Condition = Literal["new", "running", "recovering", "quarantined", "closed"]


class SessionReporting:
    """Says what became of messages, and counts it.

    Args:
        stream: `site/node/sensor`.
        instance: name of the service, for problems.
        policy: where a sensor can be.
    """

    def __init__(self, stream: str, instance: str, policy: Policy) -> None:
        self._stream = stream
        self._policy = policy
        self.complain = Refusals(stream, instance)
        self.deliveries = Deliveries()

    def refused(self, frame_id: FrameId, decision: Decision) -> list[Output]:
        """Tell of a frame that is not admitted; of a duplicate there is nothing to tell."""
        if decision.verdict is Verdict.DUPLICATE:
            self.deliveries.duplicates += 1
            return []
        if decision.verdict is Verdict.RETIRED:
            self.deliveries.refused += 1
            return [self.complain.retired(frame_id, self._policy.gap_limit_ns)]
        if decision.verdict is Verdict.JUMPED:
            self.deliveries.refused += 1
            return [self.complain.other_clock(frame_id, decision.place.jump_ns)]
        self.deliveries.late += 1
        return [self.complain.late(frame_id, decision.place.jump_ns)]

    def begun(self, outcomes: Sequence[Outcome], session: str) -> list[Output]:
        """Tell of the life with a new id that frames began, the last one if there were several."""
        for one in reversed(outcomes):
            if (begins := one.begins) is not None:
                begun = Begun(session, begins.reason, begins.jump_ns)
                return [begun] if begun.reason == "first" else [begun, self.complain.restarted(one.entry, begun)]
        return []

    def tracked(
        self, outcomes: Sequence[Outcome], parameters: optipmb.Parameters, ticket: Any, took_ns: int, run: int
    ) -> list[Output]:
        """Tell the tracks of frames that were gone through, and what of these was left out.

        Args:
            outcomes: what became of each frame.
            parameters: the profile.
            ticket: what came with the frame that is new.
            took_ns: how long they took together.
            run: see `Session.run`.
        """
        outputs: list[Output] = []
        step_ns = took_ns // max(1, len(outcomes))
        for one in outcomes:
            if one.unknown or one.tracks is None:
                outputs += self._left_out(one, parameters)
            if one.tracks is not None:
                self.deliveries.corrected += one.entry.revision > 0
                outputs.append(Tracked(one.tracks, ticket, step_ns, run))
        return outputs

    def _left_out(self, outcome: Outcome, parameters: optipmb.Parameters) -> list[Output]:
        """Tell what of a frame was not tracked: objects of unknown classes, or all of it; once, not at corrections."""
        if outcome.entry.revision > 0:
            return []
        unknown = self.complain.unknown(outcome.entry.frame_id, outcome.unknown, parameters)
        if outcome.tracks is not None:
            return list(unknown)
        if outcome.entry.place.opens is Verdict.UNCONFIRMED:
            return [*unknown, self.complain.unconfirmed(outcome.entry)]
        if outcome.effort is not None:
            return [*unknown, self.complain.effort(outcome.entry.frame_id, outcome.effort)]
        return [*unknown, self.complain.astray(outcome.entry, self._policy)]

    def counters(self, head: FilterState) -> Counters:
        """Return what happened to the messages: what depends on delivery, and what follows from the frames alone."""
        deliveries, counts = self.deliveries, head.counts
        return Counters(
            frames=counts.frames,
            duplicates=deliveries.duplicates,
            late=deliveries.late,
            inserted=deliveries.inserted,
            corrected=deliveries.corrected,
            refused=deliveries.refused + counts.astray + counts.effort + counts.unconfirmed,
            gaps=counts.gaps,
            new_epochs=counts.new_epochs,
            clouds_used=counts.clouds_used,
            clouds_missed=counts.clouds_missed,
            repaired=counts.repaired,
        )

    def state(
        self, profile: str, head: FilterState, *, condition: Condition, shed: int, queue: int
    ) -> schemas.SessionState:
        """Return the state as the message that answers a query.

        Args:
            profile: name of the parameters.
            head: the present state.
            condition: what the session does at present.
            shed: frames dropped before they came to the session.
            queue: frames that wait.
        """
        density, last, counters = head.density, head.last, self.counters(head)
        return schemas.SessionState(
            stream=self._stream,
            session=head.session,
            state=condition,
            profile=profile,
            epoch=last.epoch if last else None,
            seq=last.seq if last else None,
            stamp_ns=last.stamp_ns if last else None,
            shed=shed,
            **{field.name: getattr(counters, field.name) for field in fields(Counters)},
            tracks=head.tracks,
            bernoullis=len(density.bernoulli),
            poissons=len(density.poisson),
            next_id=density.next_id,
            queue=queue,
        )
