"""Endpoints of others that do not fit ours: what is wrong, in words that say what to do.

rmw_zenoh delivers whatever the quality of service, and drops nothing aloud: a type with another definition has another
key, and its messages just do not arrive. So what DDS would refuse is reported here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from optipmb_service.ros2.graph import NO_HASH, PUBLISHER, SUBSCRIPTION

if TYPE_CHECKING:
    from optipmb_service.ros2.graph import Endpoint, Qos

__all__ = ["Matching", "Wanted"]


@dataclass(frozen=True)
class Wanted:
    """An endpoint of ours: publisher (`MP`) or subscription (`MS`), topic, type, hash, quality of service."""

    kind: str
    topic: str
    type: str
    hash: str
    qos: Qos


class Matching:
    """The endpoints of others on our topics, as they come and go. Not for several threads.

    Args:
        wanted: ours.
        single: topics that one publisher alone may have.
    """

    def __init__(self, wanted: tuple[Wanted, ...], single: frozenset[str]) -> None:
        self._wanted = wanted
        self._single = single
        self._others: dict[str, Endpoint] = {}

    def change(self, endpoint: Endpoint, *, came: bool) -> tuple[str, ...]:
        """Take in that an endpoint of another node came or went; return what is newly wrong."""
        before = set(self.problems())
        if came:
            self._others[endpoint.token()] = endpoint
        else:
            self._others.pop(endpoint.token(), None)
        return tuple(problem for problem in self.problems() if problem not in before)

    def publishers(self, topic: str) -> int:
        """Return how many publishers of others a topic has."""
        return sum(other.kind == PUBLISHER and other.topic == topic for other in self._others.values())

    def problems(self) -> tuple[str, ...]:
        """Return what is wrong now, ordered."""
        found = {text for ours in self._wanted for other in self._others.values() if (text := _wrong(ours, other))}
        for topic in self._single:
            if (count := self.publishers(topic)) > 1:
                found.add(f"{topic}: {count} publishers, their detections are taken for those of one sensor")
        return tuple(sorted(found))


def _wrong(ours: Wanted, other: Endpoint) -> str:
    """Return what is wrong between two endpoints of one topic; empty when nothing, or they are no pair."""
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
