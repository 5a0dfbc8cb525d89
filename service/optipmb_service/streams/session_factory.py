"""Making of sessions, as the settings and profiles of a process say."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, Any, Final

from optipmb.world.zones import MOST, Zone
from optipmb_service.session.fixed_rate import FixedRate
from optipmb_service.session.policy import Policy
from optipmb_service.session.session import Session
from optipmb_service.units import MEGABYTE, SECOND

if TYPE_CHECKING:
    from collections.abc import Callable

    from optipmb_service.session.checkpoint import Checkpoint
    from optipmb_service.session.identity import Incarnation
    from optipmb_service.settings import Settings
    from optipmb_service.streams.profiles import Fusion, Profiles

PARTS: Final = 4
"""Parts of a stream's memory: queue, clouds, pending frames, window."""


class SessionFactory:
    """Makes and restores the sessions of a process.

    Args:
        settings: in force.
        profiles: the parameters that can be had.
        fusion: streams that share sessions.
        tracker: makes the trackers of sessions.
        report: takes code, stream, expected and received of a problem, and its path.
    """

    def __init__(
        self,
        settings: Settings,
        profiles: Profiles,
        fusion: Fusion,
        tracker: Callable[..., Any],
        report: Callable[..., None],
    ) -> None:
        self.profiles = profiles
        self._settings = settings
        self._fusion = fusion
        self._tracker = tracker
        self._report = report
        self._policy = policy_of(settings)
        self._zone = cache(settings.zone)

    def policy(self, name: str) -> Policy:
        """Return the policy of a session, with its zones and sensors."""
        names = self._settings.zones_of(name)
        if len(names) > MOST:
            expected, received = f"at most {MOST} zones and lines for a session", f"{len(names)}; the last are left out"
            self._report("refused", name, expected, received, path="zones")
        site, known = name.partition("/")[0], self._settings.zones
        sensors = self._fusion.sensors_of(name, self.profiles.sensors)
        rejoin = self._settings.rejoin_of(name)
        zones = [self._zone(one, site if known[one].geo else "") for one in names[:MOST]]
        if rejoin is not None:  # an object that may still return has not left
            lasts_s = rejoin.gap_s + rejoin.decide_s + Zone.lost_s
            zones = [replace(one, lost_s=lasts_s) if known[one.name].lost_s is None else one for one in zones]
        return replace(
            self._policy,
            zones=tuple(zones),
            sensors=sensors,
            needs_view=bool(sensors.uses) or name in self._fusion.sites,
            has_place=site in self._settings.sites,
            rejoin=None if rejoin is None else rejoin.joining(),
        )

    def fixed_rate(self, name: str) -> FixedRate | None:
        """Return the output of a session at a fixed rate; None: it has none."""
        output = self._settings.output_of(name)
        return None if output is None else FixedRate(output)

    def new(self, name: str, policy: Policy, incarnation: Incarnation) -> Session:
        """Return a session that begins."""
        return Session(
            name,
            self.profiles.of(name),
            policy,
            fused=self._fusion.is_session(name),
            instance=self._settings.instance,
            incarnation=incarnation,
            tracker=self._tracker,
        )

    def restored(self, checkpoint: Checkpoint, policy: Policy, now_ns: int, fence: int) -> Session:
        """Return the session of a checkpoint, as `Session.restore`."""
        return Session.restore(
            checkpoint, now_ns, policy, fence=fence, instance=self._settings.instance, tracker=self._tracker
        )

    def differing_profile(self, session: Session) -> str | None:
        """Return the name of the configured profile if a session tracks with other parameters, else None."""
        wanted, in_force = self.profiles.of(session.stream), session.parameters
        same = in_force is wanted or in_force.model_copy(update={"horizons": wanted.horizons}) == wanted
        return None if same else wanted.name


def policy_of(settings: Settings) -> Policy:
    """Return the policy of sessions by the settings."""
    part = settings.stream_mb * MEGABYTE // PARTS
    return Policy(
        gap_limit_ns=round(settings.gap_limit_s * SECOND),
        cloud_wait_ns=round(settings.cloud_wait_s * SECOND),
        cloud_memory_ns=round(settings.cloud_memory_s * SECOND),
        clouds=settings.queue_clouds,
        cloud_bytes=part,
        held_bytes=part,
        rewind_bytes=part,
        rewind_ns=round(settings.rewind_s * SECOND),
        late_clouds=settings.late_clouds,
        recovery_wait_ns=round(settings.recovery_wait_s * SECOND),
        max_speed=settings.max_speed,
        jumps=settings.jumps,
        at_once=1,  # other streams have their turn between two frames
    )
