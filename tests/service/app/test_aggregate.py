"""What the parent of worker processes answers for them."""

import threading
from types import SimpleNamespace
from typing import Any

import pytest
from optipmb_schemas import DrainRequest, Keys, Message, MoveRequest, encode, encoding_of
from optipmb_service.app.configuration import load
from optipmb_service.app.workers import AggregateView, Worker
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


def parent(network: Any, metrics: Metrics) -> AggregateView:
    supervisor: Any = SimpleNamespace(workers=[Worker(0), Worker(1)], began=True)
    return AggregateView(load(None, {"instance": "yard", "store": "none"}).settings, supervisor, network, metrics)


def order(key: str, asked: Message, **calls: Any) -> Any:
    """Return a query with a request."""
    encoding = encoding_of(type(asked))
    return SimpleNamespace(key=key, payload=encode(asked), encoding=encoding, finish=lambda: None, **calls)


@pytest.mark.parametrize(
    ("key", "asked"),
    [(KEYS.move("yard"), MoveRequest(stream="a/b/c", worker=1)), (KEYS.drain("yard"), DrainRequest(drain=False))],
)
def test_an_order_that_workers_have_done_is_answered_with_itself(key: str, asked: Message) -> None:
    """At the key that was asked; the order is what the workers got."""
    ordered: list[bytes] = []
    answers: list[tuple[object, ...]] = []

    def ask(_key: str, _timeout: float, payload: bytes, _encoding: str) -> bytes:
        ordered.append(payload)
        return payload

    view = parent(SimpleNamespace(client=Network().client, ask=ask), Metrics())
    view.answer(order(key, asked, answer=lambda *one: answers.append(one)))
    view.ends()
    assert answers == [(key, asked)]
    assert set(ordered) == {encode(asked)}


def test_a_drain_keeps_no_status_waiting() -> None:
    """While the workers are asked to leave their streams, status and metrics are answered."""
    network, metrics = Network(), Metrics()
    view = parent(network, metrics)
    refused: list[object] = []
    request = order(KEYS.drain("yard"), DrainRequest(drain=False), refuse=refused.append)
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
