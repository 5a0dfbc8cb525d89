"""State of the process, for those who ask from outside: from before the service exists until after its end.

The age of the control loop's last beat is reported. States: `starting`, then the state of the service
(`ready`, `degraded` when it works with a part missing, `paused` when it may not publish, `unlinked` without a router,
or `draining` when others track its streams), then `stopping`.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final

from optipmb_service.telemetry.metrics import PROCESS_METRICS

if TYPE_CHECKING:
    import optipmb_schemas as schemas
    from optipmb_client.zenoh.session import ZenohSession

    from optipmb_service.telemetry.certificates import Certificates
    from optipmb_service.telemetry.metrics import Metrics


BEAT_S: Final = 0.5
STUCK_S: Final = 10.0  # a loop that has not turned for so long is stuck
USABLE: Final = frozenset({"ready", "degraded"})


class Component:
    """Part of a process that does its work, and reports its state; by default one without streams.

    Args:
        session: on the network, if it has one.
    """

    _session: ZenohSession | None = None

    def __init__(self, session: ZenohSession | None = None) -> None:
        self._session = session

    @property
    def state(self) -> str:
        """State of the process while this works: `unlinked` without a router, `degraded` after another failure."""
        return "unlinked" if self.unlinked else "degraded" if self.failure else "ready"

    @property
    def unlinked(self) -> str:
        """Why it has no network; empty while it has."""
        return "" if self._session is None or self._session.linked() else "network: no router"

    @property
    def failure(self) -> str:
        """Why it cannot be used, or works with a part missing; empty while it works."""
        return self.unlinked

    @property
    def stuck(self) -> bool:
        """Whether the thread that works has stopped working."""
        return False

    @property
    def usable(self) -> bool:
        """Whether it can be used in a state that can."""
        return True

    def status(self) -> schemas.ServiceStatus | None:
        """Return its report; None when it makes none."""
        return None

    def session(self) -> ZenohSession | None:
        """Return the session by which readers of this process subscribe; None: there is none now."""
        return self._session

    def detections_of(self, stream: str) -> str:
        """Return the pattern of the streams whose detections belong to the tracks of a stream."""
        return stream


class ProcessHealth:
    """Health of one process; every method may be called by any thread and answers at once."""

    def __init__(self, instance: str, metrics: Metrics) -> None:
        self.instance = instance
        self.metrics = metrics
        self.tls: Certificates | None = None
        """The certificates of the process; None while they are not read."""
        self._service = Component()
        self._began = False
        self._ending = False
        self._beat_ns = time.monotonic_ns()
        metrics.add(PROCESS_METRICS, lambda: self)

    def beat(self) -> None:
        """Note that the control loop turns."""
        self._beat_ns = time.monotonic_ns()

    def report(self, service: Component) -> None:
        """Report the state of this part from now on."""
        self._service, self._began = service, True

    def ends(self) -> None:
        """Report the end from now on."""
        self._ending = True

    def beat_age_s(self) -> float:
        """Return the seconds since the control loop last turned."""
        return (time.monotonic_ns() - self._beat_ns) / 1e9

    def alive(self) -> bool:
        """Return whether the control loop turns and the working thread is not stuck."""
        return self.beat_age_s() < STUCK_S and not self._service.stuck

    def failure(self) -> str:
        """Return why the service cannot be used, or works with a part missing; empty while it works."""
        return "; ".join(one.failure for one in (self.tls, self._service) if one is not None and one.failure)

    def state(self) -> str:
        if self._ending:
            return "stopping"
        state = self._service.state if self._began else "starting"
        return "degraded" if state == "ready" and self.tls is not None and self.tls.failure else state

    def ready(self) -> bool:
        """Return whether the service can be used."""
        usable = self._service.usable and self.alive()
        return usable and self.state() in USABLE and not (self.tls is not None and self.tls.cut_off)

    def status(self) -> schemas.ServiceStatus | None:
        """Return the service's own report; None while it starts."""
        return self._service.status()

    def session(self) -> ZenohSession | None:
        """Return the session for readers (`Component.session`); None while the service starts."""
        return self._service.session()

    def detections_of(self, stream: str) -> str:
        """Return the pattern of the streams whose detections belong to a stream (`Component.detections_of`)."""
        return self._service.detections_of(stream)
