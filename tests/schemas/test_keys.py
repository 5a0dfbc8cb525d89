"""Keys of Zenoh."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from optipmb_schemas import Keys, MessageError

KEYS = Keys()
STREAM = "site/node/sensor"


def test_the_keys_of_a_stream() -> None:
    """The keys are as documented."""
    assert KEYS.detections(STREAM) == "optipmb/v1/site/node/sensor/detections"
    assert KEYS.points(STREAM) == "optipmb/v1/site/node/sensor/points"
    assert KEYS.tracks(STREAM) == "optipmb/v1/site/node/sensor/tracks"
    assert KEYS.problems(STREAM) == "optipmb/v1/site/node/sensor/problems"
    assert KEYS.query(STREAM, "state") == "optipmb/v1/site/node/sensor/q/state"
    assert KEYS.owner(STREAM, "host-1") == "optipmb/v1/owner/site/node/sensor/host-1"
    assert KEYS.alive("host-1") == "optipmb/v1/service/host-1/alive"
    assert KEYS.status("host-1") == "optipmb/v1/service/host-1/q/status"
    assert KEYS.discovered([STREAM, "a/b/c"], "m", "7") == "optipmb/v1/service/m/discovered/7/site%node%sensor,a%b%c"


def test_the_key_expressions() -> None:
    """Key expressions cover one topic each."""
    assert KEYS.all("detections") == "optipmb/v1/*/*/*/detections"
    assert KEYS.all_queries("state") == "optipmb/v1/*/*/*/q/state"
    assert KEYS.owners(STREAM) == "optipmb/v1/owner/site/node/sensor/*"
    assert KEYS.all_owners() == "optipmb/v1/owner/*/*/*/*"
    assert KEYS.all_alive() == "optipmb/v1/service/*/alive"
    assert KEYS.all_status() == "optipmb/v1/service/*/q/status"


def test_zenoh_agrees() -> None:
    """Zenoh takes every key as it is, and each expression matches its own topic and no other."""
    zenoh = pytest.importorskip("zenoh")
    topics = {"detections", "points", "tracks", "now", "events", "problems"}
    keys = {topic: getattr(KEYS, topic)(STREAM) for topic in topics}
    keys |= {"state": KEYS.query(STREAM, "state"), "owner": KEYS.owner(STREAM, "i"), "status": KEYS.status("i")}
    keys["discovered"] = KEYS.discovered([STREAM, "a/b/c"], "i", "7")
    for topic in topics:
        expression = zenoh.KeyExpr(KEYS.all(topic))
        assert {name for name, key in keys.items() if expression.intersects(zenoh.KeyExpr(key))} == {topic}
    for key in keys.values():
        assert str(zenoh.KeyExpr.autocanonize(key)) == key


chunks = st.from_regex(r"[A-Za-z0-9_-][A-Za-z0-9_.-]{0,9}", fullmatch=True)


@given(prefix=st.lists(chunks, min_size=1, max_size=3), site=chunks, node=chunks, sensor=chunks, instance=chunks)
def test_the_stream_of_every_key(prefix: list[str], site: str, node: str, sensor: str, instance: str) -> None:
    """The stream comes back from every key of the stream, under every prefix, and the instance from its keys."""
    keys, stream = Keys("/".join(prefix)), f"{site}/{node}/{sensor}"
    if site in {"owner", "service"}:
        with pytest.raises(MessageError):
            keys.detections(stream)
        return
    made = [keys.detections(stream), keys.points(stream), keys.tracks(stream), keys.problems(stream)]
    made += [keys.query(stream, "state"), keys.query(stream, "reset"), keys.query(stream, "parameters")]
    made.append(keys.owner(stream, instance))
    discovered = keys.discovered([stream, "a/b/c"], instance, site)
    assert [keys.discovered_by(discovered, one) for one in (site, f"{site}0")] == [True, False]
    assert (keys.discovered_streams(discovered), keys.instance_of(discovered)) == ([stream, "a/b/c"], instance)
    assert {keys.stream_of(key) for key in made} == {stream}
    for key in (keys.owner(stream, instance), keys.alive(instance), keys.status(instance)):
        assert keys.instance_of(key) == instance


BAD_STREAMS = ["", "a", "a/b", "a/b/c/d", "a//c", "/a/b", "a/b/c/", "a/*/c", "a/**/c", "a/b/$c", "a/b/@c", "a b/c/d"]
BAD_STREAMS += ["a/b/c\n", "ä/b/c", "a/b/..", "./b/c", "owner/b/c", "service/b/c", "a/b/" + "c" * 999, "\ud800/b/c"]


@pytest.mark.parametrize("stream", BAD_STREAMS)
def test_names_that_are_no_streams(stream: str) -> None:
    """A name with other characters, another number of parts or a reserved first part makes no key."""
    for make in (KEYS.detections, KEYS.owners, lambda s: KEYS.query(s, "state"), lambda s: KEYS.owner(s, "i")):
        with pytest.raises(MessageError) as caught:
            make(stream)
        assert caught.value.path == "stream"


@pytest.mark.parametrize("name", ["", "a/b", "*", "a b", "..", "@x", 5, None])
def test_names_that_are_no_chunks(name: str) -> None:
    """Instances and prefixes are made of chunks."""
    for make, path in (
        (KEYS.alive, "instance"),
        (KEYS.status, "instance"),
        (lambda n: KEYS.owner(STREAM, n), "instance"),
    ):
        with pytest.raises(MessageError) as caught:
            make(name)
        assert caught.value.path == path
    if isinstance(name, str) and name != "a/b":
        with pytest.raises(MessageError, match=r"^prefix"):
            Keys(name)


@pytest.mark.parametrize(
    "key",
    [
        "",
        "x",
        "optipmb/v1",
        "optipmb/v1/a/b",
        "optipmb/v2/a/b/c/tracks",
        "optipmb/v1/service/i/alive",
        "optipmb/v1/a/b/c/d/e/f",
    ],
)
def test_keys_of_no_stream(key: str) -> None:
    """A key that belongs to no stream is refused."""
    with pytest.raises(MessageError, match=r"^key"):
        KEYS.stream_of(key)


def test_topics_are_known() -> None:
    """A topic or query that there is not is refused."""
    with pytest.raises(MessageError, match=r"^topic"):
        KEYS.all("images")
    with pytest.raises(MessageError, match=r"^topic"):
        KEYS.query(STREAM, "stop")
    with pytest.raises(MessageError, match=r"^key"):
        KEYS.instance_of(KEYS.tracks(STREAM))
