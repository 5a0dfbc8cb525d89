"""A ROS 2 node by zenoh-ros2-sdk, a client of rmw_zenoh that is not ours; definitions and hashes are given to it.

The SDK would fetch definitions of types from the network: it gets the product's, and computes the hashes of
types from them by its own rules.
"""

import os
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any, Self

import numpy as np
from optipmb_schemas.ros2.types import own_types

os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")  # its imports look for git, which nothing here needs

import zenoh_ros2_sdk as sdk
from zenoh_ros2_sdk import discovery
from zenoh_ros2_sdk.session import ZenohSession
from zenoh_ros2_sdk.utils import get_type_hash

# As patient as the product: by default messages that wait for a millisecond are dropped, reliable or not.
DROP = "transport/link/tx/queue/congestion_control/drop"
os.environ["ZENOH_CONFIG_OVERRIDE"] = f"{DROP}/wait_before_drop=1000000;{DROP}/max_wait_before_drop_fragments=5000000"
SEPARATOR = "=" * 80 + "\nMSG: "
DEADLINE_S = 60.0


def hash_by_sdk(kind: str) -> str:
    """Give the hash of a type as the SDK computes it."""
    main, *rest = own_types().definition(kind).split(SEPARATOR)
    dependencies = {}
    for part in rest:
        name, _, text = part.partition("\n")
        package, _, message = name.strip().rpartition("/")
        dependencies[f"{package.removesuffix('/msg')}/msg/{message}"] = text
    found: str = get_type_hash(kind, main, dependencies)
    return found


class Ros2Client:
    """Publishers and subscriptions of one session; close it, as one does a context manager.

    Args:
        endpoint: of the router.
        domain: of ROS.
    """

    def __init__(self, endpoint: str, domain: int) -> None:
        host, _, port = endpoint.removeprefix("tcp/").rpartition(":")
        self._where = {"router_ip": host, "router_port": int(port), "domain_id": domain}
        self._publishers: dict[str, Any] = {}
        self._subscribers: list[Any] = []
        self._changed = threading.Condition()
        self.received: dict[str, list[Any]] = {}

    def publish(self, topic: str, kind: str, fields: Mapping[str, Any], **options: Any) -> None:
        to = f"{topic} {options.get('type_hash')}"
        if to not in self._publishers:
            about = {"msg_definition": own_types().definition(kind), "type_hash": hash_by_sdk(kind)}
            self._publishers[to] = sdk.ROS2Publisher(topic, kind, **(self._where | about | options))
            ends = time.monotonic() + DEADLINE_S
            while not self._publishers[to].pub.matching_status.matching:  # earlier messages are lost
                assert time.monotonic() < ends, f"nobody subscribes to {topic}"
                time.sleep(0.01)
        publisher = self._publishers[to]
        message = _built(publisher.session_mgr.store, kind, fields)
        publisher.publish(**{name: getattr(message, name) for name in message.__dataclass_fields__})

    def subscribe(self, topic: str, kind: str, *, name: str = "", **options: Any) -> None:
        received = self.received[name or topic] = []

        def take(message: Any) -> None:
            with self._changed:
                received.append(message)
                self._changed.notify_all()

        about = {"msg_definition": own_types().definition(kind), "type_hash": hash_by_sdk(kind)}
        self._subscribers.append(sdk.ROS2Subscriber(topic, kind, take, **(self._where | about | options)))

    def wait(self, topic: str, true: Callable[[list[Any]], bool]) -> list[Any]:
        with self._changed:
            met = self._changed.wait_for(lambda: true(self.received[topic]), DEADLINE_S)
            assert met, f"{topic}: {len(self.received[topic])} messages; {self._diagnosis()}"
            return list(self.received[topic])

    def endpoints(self, topic: str) -> list[tuple[str, str, str, str]]:
        """Give what another program says of the endpoints of a topic: kind, node, type, hash of the type."""
        about = discovery.get_topic_info(topic, **self._where, timeout=DEADLINE_S, verbose=True)
        return [
            (kind, f"{one.node_namespace.rstrip('/')}/{one.node_name}", one.topic_type, one.type_hash)
            for kind, found in (("publisher", about.publishers), ("subscription", about.subscribers))
            for one in found
        ]

    def _diagnosis(self) -> str:
        newest = self.received.get("/diagnostics", [])[-1:]
        said = [(status.message, [(v.key, v.value) for v in status.values]) for one in newest for status in one.status]
        return f"diagnostics: {said}"

    def close(self) -> None:
        """Close everything: the session is shared by all of the process."""
        for one in (*self._publishers.values(), *self._subscribers):
            one.close()
        if ZenohSession._instance is not None:
            ZenohSession._instance.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _built(store: Any, kind: str, fields: Mapping[str, Any]) -> Any:
    """Give a message from maps and lists: the library wants objects, and arrays for lists of numbers."""
    values = {}
    for name, (node, about) in store.fielddefs[kind][1]:
        value = fields[name]
        if int(node) == 2:  # another type
            value = _built(store, about, value)
        elif int(node) in {3, 4}:  # an array or a list
            inner, of = about[0]
            if int(inner) == 2:
                value = [_built(store, of, one) for one in value]
            elif isinstance(value, bytes):
                value = np.frombuffer(value, dtype=np.uint8)
            elif of[0] != "string":
                value = np.array(value, dtype=of[0])
        values[name] = value
    return store.types[kind](**values)
