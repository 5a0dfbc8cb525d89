"""How rmw_zenoh names things: keys of topics, liveliness tokens, quality of service, attachments.

A message of a topic goes to `<domain>/<topic>/<type>/<hash>`. Nodes and endpoints are known by tokens,

    @ros2_lv/<domain>/<session>/<node>/<node>/NN/<enclave>/<namespace>/<name>
    @ros2_lv/<domain>/<session>/<node>/<entity>/MP|MS/<enclave>/<namespace>/<name>/<topic>/<type>/<hash>/<qos>

in which `%` stands for `/`. Quality of service is `reliability:durability:history,depth:deadline:lifespan:liveliness`
as numbers of rmw, empty where it is the default. Humble has no hashes of types and writes `TypeHashNotSupported`.

rmw_zenoh delivers with any quality of service, and a type with another definition has another key, so its messages
do not arrive. `Matching` reports what DDS would refuse.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Final, NamedTuple

PUBLISHER: Final = "MP"
SUBSCRIPTION: Final = "MS"
NO_HASH: Final = "TypeHashNotSupported"

_SPACE: Final = "@ros2_lv"
_NODE: Final = "NN"
_PARTS: Final = 13
_RELIABLE, _BEST_EFFORT = "1", "2"
_TRANSIENT_LOCAL, _VOLATILE = "1", "2"
GID: Final = 16
"""Bytes that say who published a message."""


def mangled(name: str) -> str:
    """Return a name as one chunk of a key."""
    return name.replace("/", "%") or "%"


def dds_type(name: str) -> str:
    """Return the name of a type as keys have it: `std_msgs/msg/String` is `std_msgs::msg::dds_::String_`."""
    package, kind, message = name.split("/")
    return f"{package}::{kind}::dds_::{message}_"


def ros_type(name: str) -> str:
    """Return the name of a type as ROS has it, and other text as it is."""
    return name.replace("::dds_::", "::").removesuffix("_").replace("::", "/")


@dataclass(frozen=True)
class Qos:
    """Quality of service, as DDS has it: the offer must reach the request."""

    reliable: bool = True
    transient_local: bool = False
    depth: int = 10

    def token(self) -> str:
        reliability = "" if self.reliable else _BEST_EFFORT
        durability = _TRANSIENT_LOCAL if self.transient_local else ""
        return f"{reliability}:{durability}:,{self.depth}:,:,:,,"

    def lacks(self, offered: Qos) -> str:
        """Return what an offer lacks of this request, in words; empty when nothing."""
        if self.reliable and not offered.reliable:
            return "reliability: asked for RELIABLE, offered BEST_EFFORT"
        if self.transient_local and not offered.transient_local:
            return "durability: asked for TRANSIENT_LOCAL, offered VOLATILE"
        return ""


def parse_qos(text: str) -> Qos | None:
    """Return what a token says; None when it is no quality of service."""
    parts = text.split(":")
    if len(parts) < 3:  # noqa: PLR2004 - reliability, durability, history
        return None
    depth = parts[2].rpartition(",")[2]
    return Qos(parts[0] != _BEST_EFFORT, parts[1] == _TRANSIENT_LOCAL, int(depth) if depth.isdecimal() else 0)


class TopicKey(NamedTuple):
    """The parts of the key of a topic."""

    domain: int
    topic: str
    type: str
    hash: str

    @property
    def key(self) -> str:
        """The key that messages go to."""
        return f"{self.domain}/{self.topic.strip('/')}/{dds_type(self.type)}/{self.hash}"


def topic_pattern(domain: int, topic: str) -> str:
    """Return the key expression of a topic with any type: another type or hash is to be noticed, not missed."""
    return f"{domain}/{topic.strip('/')}/*/*"


def parse_topic(key: str) -> TopicKey | None:
    """Return the parts of a key; None when it is no topic's."""
    parts = key.split("/")
    if len(parts) < 4 or not parts[0].isdecimal():  # noqa: PLR2004 - domain, topic, type, hash
        return None
    return TopicKey(int(parts[0]), "/" + "/".join(parts[1:-2]), ros_type(parts[-2]), parts[-1])


@dataclass(frozen=True)
class Node:
    """A node of a Zenoh session."""

    domain: int
    session: str
    name: str
    namespace: str = "/"
    number: int = 0

    def token(self) -> str:
        where = f"{_SPACE}/{self.domain}/{self.session}/{self.number}/{self.number}/{_NODE}"
        return f"{where}/%/{mangled(self.namespace)}/{self.name}"


@dataclass(frozen=True)
class Endpoint:
    """A publisher or subscription of a node."""

    node: Node
    entity: int
    kind: str
    topic: str
    type: str
    hash: str
    qos: Qos

    @property
    def name(self) -> str:
        """The node's name with its namespace."""
        return f"{self.node.namespace.rstrip('/')}/{self.node.name}"

    def token(self) -> str:
        node = self.node
        where = f"{_SPACE}/{node.domain}/{node.session}/{node.number}/{self.entity}/{self.kind}"
        what = f"{mangled(self.topic)}/{dds_type(self.type)}/{self.hash}/{self.qos.token()}"
        return f"{where}/%/{mangled(node.namespace)}/{node.name}/{what}"


def graph_pattern(domain: int) -> str:
    """Return the key expression of all tokens of a domain."""
    return f"{_SPACE}/{domain}/**"


def parse_endpoint(key: str) -> Endpoint | None:
    """Return the publisher or subscription of a token; None for other tokens and other text."""
    parts = key.split("/")
    if len(parts) < _PARTS or parts[0] != _SPACE or parts[5] not in {PUBLISHER, SUBSCRIPTION}:
        return None
    _, domain, session, node, entity, kind, _, namespace, name, topic, type_, hash_, qos = parts[:_PARTS]
    offered = parse_qos(qos)
    if offered is None or not (domain.isdecimal() and node.isdecimal() and entity.isdecimal()):
        return None
    owner = Node(int(domain), session, name.replace("%", "/"), namespace.replace("%", "/"), int(node))
    return Endpoint(owner, int(entity), kind, topic.replace("%", "/"), ros_type(type_), hash_, offered)


def attachment(number: int, stamp_ns: int, gid: bytes) -> bytes:
    """Return the attachment of a message: its number, its time (ns since 1970), and its publisher (16 bytes)."""
    return struct.pack("<qqB", number, stamp_ns, GID) + gid


class Matching:
    """Endpoints of others that do not fit ours, with advice in words. Not for several threads.

    Args:
        ours: our endpoints.
        single: topics that one publisher alone may have.
    """

    def __init__(self, ours: tuple[Endpoint, ...], single: frozenset[str]) -> None:
        self._ours = ours
        self._single = single
        self._others: dict[str, Endpoint] = {}

    def change(self, endpoint: Endpoint, *, came: bool) -> tuple[str, ...]:
        """Note that an endpoint of another node came or went; return new problems."""
        before = set(self.problems())
        if came:
            self._others[endpoint.token()] = endpoint
        else:
            self._others.pop(endpoint.token(), None)
        return tuple(problem for problem in self.problems() if problem not in before)

    def problems(self) -> tuple[str, ...]:
        """Return all present problems, ordered."""
        found = {text for ours in self._ours for other in self._others.values() if (text := _wrong(ours, other))}
        for topic in self._single:
            count = sum(other.kind == PUBLISHER and other.topic == topic for other in self._others.values())
            if count > 1:
                found.add(f"{topic}: {count} publishers, their detections are taken for those of one sensor")
        return tuple(sorted(found))


def _wrong(ours: Endpoint, other: Endpoint) -> str:
    """Return the problem between two endpoints; empty when there is none, or they are no pair."""
    if ours.topic != other.topic or {ours.kind, other.kind} != {PUBLISHER, SUBSCRIPTION}:
        return ""
    verb = "publishes" if other.kind == PUBLISHER else "subscribes to"
    head = f"{ours.topic}: node {other.name} {verb} "
    if other.type != ours.type:
        return f"{head}{other.type}, expected {ours.type}"
    if other.hash not in {ours.hash, NO_HASH}:
        return f"{head}another definition of {ours.type} ({other.hash}, expected {ours.hash}): nothing is exchanged"
    request, offer = (ours.qos, other.qos) if ours.kind == SUBSCRIPTION else (other.qos, ours.qos)
    lack = request.lacks(offer)
    return f"{head}with a quality of service that does not match: {lack}" if lack else ""
