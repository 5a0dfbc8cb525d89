"""Zenoh keys: where each message goes. A stream is `site/node/sensor`; chunks are letters, digits and `_ . -`.

<prefix>/<stream>/detections | points | tracks | now | events | problems     publications
<prefix>/<stream>/q/state | q/density | q/tracks | q/zones | q/reset | q/parameters    queries
<prefix>/links/<area>                                         publications: which objects of streams are one
<prefix>/links/<area>/q/links                                 query
<prefix>/owner/<stream>/<instance>                            liveliness: who tracks this stream
<prefix>/service/<instance>/alive                             liveliness: which services are there
<prefix>/service/<instance>/discovered/<run>/<streams>        liveliness: streams whose publishers say nothing
<prefix>/service/<instance>/q/status | q/metrics | q/move | q/drain     queries
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final, Literal, get_args

from optipmb_schemas.errors import MessageError, invalid
from optipmb_schemas.model import check_chunk, check_stream

Topic = Literal["detections", "points", "tracks", "now", "events", "problems"]
Query = Literal["state", "density", "tracks", "zones", "reset", "parameters"]

PREFIX: Final = "optipmb/v1"


@dataclass(frozen=True)
class Keys:
    """The keys under one prefix. Every method raises MessageError when a name is not a valid chunk or stream."""

    prefix: str = PREFIX

    def __post_init__(self) -> None:
        for chunk in self.prefix.split("/"):
            _named("prefix", check_chunk, chunk)

    def detections(self, stream: str) -> str:
        """Return the key of a stream's detections."""
        return self._topic(stream, "detections")

    def points(self, stream: str) -> str:
        """Return the key of a stream's point clouds."""
        return self._topic(stream, "points")

    def tracks(self, stream: str) -> str:
        """Return the key of a stream's tracks."""
        return self._topic(stream, "tracks")

    def now(self, stream: str) -> str:
        """Return the key of a stream's tracks predicted to now, at a fixed rate."""
        return self._topic(stream, "now")

    def events(self, stream: str) -> str:
        """Return the key of the events of a stream's zones and lines."""
        return self._topic(stream, "events")

    def problems(self, stream: str) -> str:
        """Return the key of the problems with a stream."""
        return self._topic(stream, "problems")

    def links(self, area: str) -> str:
        """Return the key of the links of an area."""
        return f"{self.prefix}/links/{_named('area', check_chunk, area)}"

    def links_query(self, area: str) -> str:
        """Return the key of the query for all links of an area."""
        return f"{self.links(area)}/q/links"

    def all_links(self) -> str:
        """Return the key expression of the links of all areas."""
        return f"{self.prefix}/links/*"

    def all_links_query(self) -> str:
        """Return the key expression of the queries for all links of all areas."""
        return f"{self.all_links()}/q/links"

    def query(self, stream: str, what: Query) -> str:
        """Return the key of a query about a stream."""
        return f"{self.prefix}/{_stream(stream)}/q/{_one_of(what, get_args(Query))}"

    def owner(self, stream: str, instance: str) -> str:
        """Return the liveliness key by which an instance says that it tracks a stream."""
        return f"{self.prefix}/owner/{_stream(stream)}/{_instance(instance)}"

    def alive(self, instance: str) -> str:
        """Return the liveliness key of an instance."""
        return f"{self.prefix}/service/{_instance(instance)}/alive"

    def status(self, instance: str) -> str:
        """Return the key of the status query of an instance."""
        return f"{self.prefix}/service/{_instance(instance)}/q/status"

    def metrics(self, instance: str) -> str:
        """Return the key of the metrics query of an instance."""
        return f"{self.prefix}/service/{_instance(instance)}/q/metrics"

    def move(self, instance: str) -> str:
        """Return the key of the query that moves a stream between the workers of an instance."""
        return f"{self.prefix}/service/{_instance(instance)}/q/move"

    def drain(self, instance: str) -> str:
        """Return the key of the query that has an instance give its streams to others."""
        return f"{self.prefix}/service/{_instance(instance)}/q/drain"

    def recent(self, instance: str = "") -> str:
        """Return the key of the query for what an instance received lately and does not track; default: of all."""
        return f"{self.prefix}/service/{_instance(instance) if instance else '*'}/q/recent"

    def discovered(self, streams: Iterable[str], instance: str, run: str) -> str:
        """Return the liveliness key by which a process says that streams exist, for their publishers do not.

        `run` tells it from all others, also from others of its name.
        """
        names = ",".join(_stream(stream).replace("/", "%") for stream in streams)
        return f"{self.prefix}/service/{_instance(instance)}/discovered/{_named('run', check_chunk, run)}/{names}"

    def all_discovered(self) -> str:
        """Return the key expression of all streams that instances have discovered."""
        return f"{self.prefix}/service/*/discovered/*/*"

    def discovered_streams(self, key: str) -> list[str]:
        """Return the streams that a key of `discovered` names."""
        match self._chunks(key):
            case ["service", _, "discovered", _, names]:
                return [_named("key", check_stream, name.replace("%", "/")) for name in names.split(",")]
        raise invalid("key", f"a key of discovered streams under {self.prefix}", key)

    def discovered_by(self, key: str, run: str) -> bool:
        """Return whether a key of `discovered` belongs to a process."""
        match self._chunks(key):
            case ["service", _, "discovered", of, _]:
                return of == run
        return False

    def all_publishers(self) -> str:
        """Return the key expression of the tokens of publishers of detections with a cache, which Zenoh declares."""
        return f"{self.all('detections')}/@adv/pub/**"

    def all(self, topic: Topic) -> str:
        """Return the key expression of a topic of all streams."""
        return f"{self.prefix}/*/*/*/{_one_of(topic, get_args(Topic))}"

    def matching(self, pattern: str, topic: Topic) -> str:
        """Return the key expression of a topic of the streams of a pattern: a stream's name with `*` for any parts."""
        named = "/".join("any" if part == "*" else part for part in pattern.split("/"))
        _named("pattern", check_stream, named)
        return f"{self.prefix}/{pattern}/{_one_of(topic, get_args(Topic))}"

    def all_queries(self, what: Query) -> str:
        """Return the key expression of a query about all streams."""
        return f"{self.prefix}/*/*/*/q/{_one_of(what, get_args(Query))}"

    def owners(self, stream: str) -> str:
        """Return the key expression of all owners of a stream."""
        return f"{self.prefix}/owner/{_stream(stream)}/*"

    def all_owners(self) -> str:
        """Return the key expression of the owners of all streams."""
        return f"{self.prefix}/owner/*/*/*/*"

    def all_alive(self) -> str:
        """Return the key expression of all instances."""
        return f"{self.prefix}/service/*/alive"

    def all_status(self) -> str:
        """Return the key expression of the status of all instances."""
        return f"{self.prefix}/service/*/q/status"

    def stream_of(self, key: str) -> str:
        """Return the stream that a key of a topic, a query or an owner belongs to."""
        match self._chunks(key):
            case (
                ["owner", site, node, sensor, _]
                | [site, node, sensor, _]
                | [site, node, sensor, "q", _]
                | [site, node, sensor, "detections", "@adv", "pub", *_]
            ):
                return _named("key", check_stream, f"{site}/{node}/{sensor}")
        raise invalid("key", f"a key of a stream under {self.prefix}", key)

    def instance_of(self, key: str) -> str:
        """Return the service instance that a key of an instance or an owner belongs to."""
        match self._chunks(key):
            case ["service", instance, *_] | ["owner", _, _, _, instance]:
                return _named("key", check_chunk, instance)
        raise invalid("key", f"a key of a service instance under {self.prefix}", key)

    def _chunks(self, key: str) -> list[str]:
        head = self.prefix + "/"
        return key.removeprefix(head).split("/") if key.startswith(head) else []

    def _topic(self, stream: str, topic: Topic) -> str:
        return f"{self.prefix}/{_stream(stream)}/{topic}"


def _named(name: str, check: Callable[[str], str], value: str) -> str:
    if not isinstance(value, str):
        raise invalid(name, "a text", value)
    try:
        return check(value)
    except MessageError as error:
        raise error.under(name) from None


def _stream(stream: str) -> str:
    return _named("stream", check_stream, stream)


def _instance(instance: str) -> str:
    return _named("instance", check_chunk, instance)


def _one_of(value: str, allowed: tuple[str, ...]) -> str:
    if value not in allowed:
        raise invalid("topic", f"one of {', '.join(allowed)}", value)
    return value
