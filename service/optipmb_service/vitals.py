"""How the process is, for those who ask from outside: from before the service exists until after its end.

The control loop beats; whoever asks sees for how long it has not. States: `starting`, then what the service says
(`ready`, or `degraded` when it works with a part missing), then `stopping`.
"""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING, Final

from optipmb_service import figures
from optipmb_service.metrics import Metrics

if TYPE_CHECKING:
    from collections.abc import Callable

    import optipmb_schemas as schemas

    from optipmb_service.service import Service

BEAT_S: Final = 0.5
STUCK_S: Final = 10.0
"""A loop that has not turned for so long is taken for stuck."""

USABLE: Final = frozenset({"ready", "degraded"})


class Vitals:
    """Implements `http.Source`.

    Args:
        instance: name of the instance.
    """

    def __init__(self, instance: str) -> None:
        self.metrics = Metrics()
        self._service: Service | None = None
        self._state = "starting"
        self._lock = threading.Lock()
        self._beat_ns = time.monotonic_ns()
        self.metrics.add(lambda: figures.of_process(instance, self.state()))

    def beat(self) -> None:
        """Say that the control loop turns."""
        self._beat_ns = time.monotonic_ns()

    def serve(self, service: Service) -> None:
        """Report what this service says from now on."""
        with self._lock:
            self._service = service

    def ends(self) -> None:
        """Report the end."""
        self._state = "stopping"

    def beat_age_s(self) -> float:
        """Return the seconds since the control loop last turned."""
        return (time.monotonic_ns() - self._beat_ns) / 1e9

    def alive(self) -> bool:
        """Tell whether the control loop turns."""
        return self.beat_age_s() < STUCK_S

    def state(self) -> str:
        """Return the state of the process."""
        service = self._service
        return self._state if service is None or self._state == "stopping" else service.state

    def ready(self) -> bool:
        """Tell whether the service can be used."""
        return self.state() in USABLE

    def status(self) -> schemas.ServiceStatus | None:
        """Return the service's own report; None while it starts."""
        service = self._service
        return None if service is None else service.status()

    def tap(self, stream: str, receive: Callable[[str, bytes, str], None]) -> Callable[[], None] | None:
        """Hand over what comes on a stream to a viewer, until the result is called; None while the service starts."""
        service = self._service
        return None if service is None else service.tap(stream, receive)

    def text(self) -> bytes:
        """Return the metrics in Prometheus' text format."""
        return self.metrics.text()
