"""`SubscribeEvents`: events of zones by request; events that can still change are held back by default."""

from typing import Any

import grpc
import pytest
from gateway import GatewayProcess, detections, frame
from optipmb_client import Connection, EventSubscriber
from optipmb_schemas import Events, Keys, decode
from optipmb_schemas.protobuf import tracking_pb2 as pb
from service_process import ServiceProcess

EVENTS = [("yard", "entered"), ("gate", "crossed"), ("yard", "left")]
FRAMES = 60


def events(stub: Any, stream: str, number: int, **asked: Any) -> list[tuple[str, str]]:
    call = stub.SubscribeEvents(pb.SubscribeEventsRequest(pattern=stream, **asked))
    call.initial_metadata()
    list(stub.Track(detections(frame(seq, stream)) for seq in range(FRAMES)))
    found: list[tuple[str, str]] = []
    while len(found) < number:
        found += [(one.zone, one.kind) for one in next(call).events.events]
    call.cancel()
    return found


@pytest.mark.parametrize(
    ("asked", "found"),
    [
        ({}, EVENTS),
        ({"final": False}, EVENTS),
        ({"zones": ["yard"]}, [EVENTS[0], EVENTS[2]]),
        ({"kinds": ["crossed"], "classes": ["car"]}, [EVENTS[1]]),
        ({"final": False, "classes": ["car"], "kinds": ["left", "entered"]}, [EVENTS[0], EVENTS[2]]),
    ],
)
def test_events_are_chosen(stub: Any, stream: str, asked: dict[str, Any], found: list[tuple[str, str]]) -> None:
    """By zone, kind and class; final or at once."""
    assert events(stub, stream.replace("yard", "zoned"), len(found), **asked) == found


def test_history_comes_first_and_once(stub: Any, stream: str) -> None:
    """A late subscriber gets the kept events, and so does a client of the library, over either network."""
    name = stream.replace("yard", "zoned")
    events(stub, name, 3)
    call = stub.SubscribeEvents(pb.SubscribeEventsRequest(pattern=name, final=False, history=True))
    assert [(one.zone, one.kind) for _ in range(8) for one in next(call).events.events] == EVENTS
    call.cancel()


def test_the_client_library_counts_over_both_networks(
    service: ServiceProcess, gateway: GatewayProcess, stub: Any, stream: str
) -> None:
    """Final events are the same over gRPC and Zenoh; `q/zones` has their sums."""
    name = stream.replace("yard", "zoned")
    events(stub, name, 3)
    for endpoint in (service.endpoint, f"grpc://{gateway.address}"):
        with EventSubscriber(name, endpoint, timeout=10.0) as subscriber:
            found: list[tuple[str, str]] = []
            for message in subscriber:
                found += [(one.zone, one.kind) for one in message.events]
                if len(found) >= len(EVENTS):
                    break
        assert found == EVENTS
    with Connection(service.endpoint) as connection:
        (answer,) = connection.query(Keys().query(name, "zones"))
    counts = {
        one.zone: (sum(one.entered), sum(one.left), sum(one.to_right))
        for one in decode(answer.payload, Events).zones or ()
    }
    assert counts == {"gate": (0, 0, 1), "yard": (1, 1, 0)}


@pytest.mark.parametrize(("asked", "path"), [({"kinds": ["came"]}, "kinds"), ({"pattern": "a/**"}, "pattern")])
def test_what_cannot_be_asked_for_is_refused(stub: Any, asked: dict[str, Any], path: str) -> None:
    """The status is INVALID_ARGUMENT, and names the field."""
    with pytest.raises(grpc.RpcError) as raised:
        list(stub.SubscribeEvents(pb.SubscribeEventsRequest(**{"pattern": "a/b/c", **asked})))
    assert raised.value.code() == grpc.StatusCode.INVALID_ARGUMENT
    assert path in raised.value.details()
