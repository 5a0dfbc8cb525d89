"""Tracks of a time that has passed, as far as the service keeps them."""

from collections.abc import Iterator

from optipmb_schemas import PREFIX, Keys, Problem, Tracks, TracksRequest, decode, encode, encoding_of

from optipmb_client.errors import ServiceRefused, ServiceUnavailable
from optipmb_client.zenoh import Connection

__all__ = ["kept_tracks"]

QUERY_S = 15.0
"""Longest wait for an answer: a service reads its log for up to 3 s, and several queries in turn."""


def kept_tracks(
    connection: Connection, stream: str, from_ns: int = 0, to_ns: int | None = None, *, prefix: str = PREFIX
) -> Iterator[Tracks]:
    """Yield the tracks of a stream in a range of stamps, by stamp, each frame once, as far as they are kept.

    The service keeps the last 100 messages of a stream; with `--cluster` and `optipmb-service log` those of an hour, or
    of what the setting `log_tracks_s` says. The range is asked for part by part, as the iterator goes on.

    Args:
        connection: Where to ask.
        stream: Name of the stream, `site/node/sensor`.
        from_ns: First stamp, of the sensor's clock.
        to_ns: Last stamp; None: up to the newest frame.
        prefix: First part of all keys, as configured in the service.

    Raises:
        MessageError: The name or a stamp is not valid.
        ServiceUnavailable: No service answers completely in time.
        ServiceRefused: The service answers that it cannot; the text says why.
    """
    key = Keys(prefix).query(stream, "tracks")
    next_ns: int | None = from_ns
    while next_ns is not None:
        request = TracksRequest(from_ns=next_ns, to_ns=to_ns)
        answers = connection.query(key, encode(request), encoding_of(request), timeout=QUERY_S)
        if not answers:
            raise ServiceUnavailable(f"no tracking service answered for {stream} in {QUERY_S:g} s (prefix {prefix})")
        tracks = [one for one in answers if one.ok and one.encoding != encoding_of(request)]
        problems = [decode(one.payload, Problem) for one in answers if not one.ok]
        if not problems and len(tracks) == len(answers):
            raise ServiceUnavailable(f"the tracks of {stream} did not come completely in {QUERY_S:g} s; ask again")
        yield from (decode(one.payload, Tracks, encoding=one.encoding) for one in tracks)
        next_ns = _rest(next_ns, problems)


def _rest(asked_ns: int, problems: list[Problem]) -> int | None:
    """Return the stamp at which the rest begins, None where there is none.

    Raises:
        ServiceRefused: There is another problem.
    """
    for problem in problems:
        if problem.code != "cut" or problem.stamp_ns is None or problem.stamp_ns <= asked_ns:
            raise ServiceRefused(f"the service refused: {problem.message}")
        return problem.stamp_ns
    return None
