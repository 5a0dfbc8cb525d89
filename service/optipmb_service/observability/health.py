"""How the process is, for those who ask from outside: from before the service exists until after its end.

The control loop beats; whoever asks sees for how long it has not. States: `starting`, then what the service says
(`ready`, `degraded` when it works with a part missing, `paused` when it may not publish, `unlinked` without a router,
or `draining` when others track its streams), then `stopping`.
"""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING, Final, Protocol, runtime_checkable

from optipmb_service.observability import collectors
from optipmb_service.observability.metrics import Metrics

if TYPE_CHECKING:
    from collections.abc import Callable

    import optipmb_schemas as schemas


BEAT_S: Final = 0.5
STUCK_S: Final = 10.0
"""A loop that has not turned for so long is taken for stuck."""

USABLE: Final = frozenset({"ready", "degraded"})


class StatusSource(Protocol):
    """What works, seen from here."""

    @property
    def state(self) -> str:
        """How it is, as in the status."""

    @property
    def stuck(self) -> bool:
        """Whether the thread that works has stopped working."""

    @property
    def failure(self) -> str:
        """Why it cannot be used, or works with a part missing; empty while it works."""

    def status(self) -> schemas.ServiceStatus | None:
        """Return its report; None when it makes none."""


class TlsSource(Protocol):
    """What knows the certificates."""

    @property
    def failure(self) -> str:
        """Which certificates have ended; empty while all hold."""

    @property
    def cut_off(self) -> bool:
        """Whether there is no link to the network for it."""


@runtime_checkable
class LiveSource(Protocol):
    """What has streams that can be looked at."""

    def tap(self, stream: str, receive: Callable[[str, bytes, str], None]) -> Callable[[], None]:
        """Hand over what comes on a stream to a viewer, until the result is called."""


class ProcessHealth:
    """Implements `http.Source`.

    Args:
        instance: name of the instance.
    """

    def __init__(self, instance: str) -> None:
        self.metrics = Metrics()
        self.tls: TlsSource | None = None
        """The certificates of the process; None while they are not read."""
        self._service: StatusSource | None = None
        self._state = "starting"
        self._lock = threading.Lock()
        self._beat_ns = time.monotonic_ns()
        self.metrics.add(lambda: collectors.of_process(instance, self.state()))

    def beat(self) -> None:
        """Say that the control loop turns."""
        self._beat_ns = time.monotonic_ns()

    def report(self, service: StatusSource) -> None:
        """Say what this one says, from now on."""
        with self._lock:
            self._service = service

    def ends(self) -> None:
        """Report the end."""
        self._state = "stopping"

    def beat_age_s(self) -> float:
        """Return the seconds since the control loop last turned."""
        return (time.monotonic_ns() - self._beat_ns) / 1e9

    def alive(self) -> bool:
        """Tell whether the control loop turns and the tracking thread works."""
        service = self._service
        return self.beat_age_s() < STUCK_S and not (service is not None and service.stuck)

    def failure(self) -> str:
        """Return why the service cannot be used, or works with a part missing; empty while it works."""
        return "; ".join(
            source.failure for source in (self.tls, self._service) if source is not None and source.failure
        )

    def state(self) -> str:
        """Return the state of the process."""
        service = self._service
        if service is None or self._state == "stopping":
            return self._state
        return "degraded" if service.state == "ready" and self.tls is not None and self.tls.failure else service.state

    def ready(self) -> bool:
        """Tell whether the service can be used."""
        return self.state() in USABLE and self.alive() and not (self.tls is not None and self.tls.cut_off)

    def status(self) -> schemas.ServiceStatus | None:
        """Return the service's own report; None while it starts."""
        service = self._service
        return None if service is None else service.status()

    def tap(self, stream: str, receive: Callable[[str, bytes, str], None]) -> Callable[[], None] | None:
        """Hand over what comes on a stream to a viewer, until the result is called; None while the service starts."""
        service = self._service
        return service.tap(stream, receive) if isinstance(service, LiveSource) else None

    def text(self) -> bytes:
        """Return the metrics in Prometheus' text format."""
        return self.metrics.text()
