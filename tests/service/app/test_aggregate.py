"""What the parent of worker processes answers for them."""

import threading
from types import SimpleNamespace
from typing import Any

from optipmb_schemas import DrainRequest, Keys, encode, encoding_of
from optipmb_service.app.workers import AggregateView, Worker
from optipmb_service.settings import load
from optipmb_service.telemetry.metrics import Metrics

KEYS = Keys()
HANGS_S = 60.0


class Network:
    """Workers that answer nothing: a question about their status at once, one to leave streams after a while."""

    def __init__(self) -> None:
        self.asked, self.gate = threading.Event(), threading.Event()

    def client(self) -> SimpleNamespace:
        return SimpleNamespace(failure="", linked=lambda: True)

    def ask(self, key: str, timeout: float, payload: bytes = b"", encoding: str = "") -> None:
        del timeout, payload, encoding
        if key.endswith("/drain"):
            self.asked.set()
            assert self.gate.wait(HANGS_S)


def test_a_drain_keeps_no_status_waiting() -> None:
    """While the workers are asked to leave their streams, status and metrics are answered."""
    network: Any = Network()
    supervisor: Any = SimpleNamespace(workers=[Worker(0), Worker(1)], began=True)
    settings, metrics = load(None, {"instance": "yard", "store": "none"}).settings, Metrics()
    view = AggregateView(settings, supervisor, network, metrics)
    refused: list[object] = []
    asked = DrainRequest(drain=False)
    request: Any = SimpleNamespace(
        key=KEYS.drain("yard"),
        payload=encode(asked),
        encoding=encoding_of(asked),
        refuse=refused.append,
        finish=lambda: None,
    )
    draining = threading.Thread(target=view.answer, args=(request,), daemon=True)
    draining.start()
    assert network.asked.wait(HANGS_S)
    found: list[object] = []
    asking = threading.Thread(target=lambda: found.extend((view.status().instance, metrics.text())), daemon=True)
    asking.start()
    asking.join(HANGS_S / 2)
    assert found[:1] == ["yard"]
    assert len(found) == 2
    network.gate.set()
    draining.join(HANGS_S)
    assert len(refused) == 1
    view.ends()
