"""The small parts: problems, figures, profiles, settings, and what imports what."""

import re
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from optipmb_schemas import Problem
from optipmb_service.app.configuration import SettingsInvalidError, load
from optipmb_service.session.pending import CloudBuffer
from optipmb_service.session.problems import problem_of
from optipmb_service.streams.profiles import Profiles
from optipmb_service.telemetry.problem_reporter import LOGGED_PER_SECOND, PUBLISHED_PER_SECOND, ProblemReporter
from optipmb_service.telemetry.stream_meter import StreamMeter
from router import SECOND, Sensor
from structlog.testing import capture_logs

import optipmb

SENSOR = Sensor()


# Problems


def problem(stream: str = "a/b/c", code: str = "late", count: int = 1) -> Problem:
    return problem_of(code, stream=stream, instance="x", message="m", count=count)


@settings(deadline=None)
@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, SECOND)), max_size=80))
def test_no_problem_is_lost_and_few_are_published(steps: list[tuple[int, int]]) -> None:
    """Counts on the key and in the log add up to the reports, each kind at most once a second, once in ten."""
    published: list[Problem] = []
    one = ProblemReporter(published.append)
    now, last = 0, dict[str, int]()
    with capture_logs() as logged:
        for kind, step in steps:
            now += step
            before = len(published)
            one.report(problem(stream=f"a/b/{kind}"), now)
            for told in published[before:]:
                assert now - last.get(told.stream, -SECOND) >= SECOND
                last[told.stream] = now
        one.flush(now + 10 * SECOND)
    assert (
        sum(told.count for told in published)
        == sum(line["count"] for line in logged)
        == len(steps)
        == sum(one.counts().values())
    )


def test_a_flood_on_ever_new_keys_is_bounded() -> None:
    """Ten thousand kinds in one second make a few lines and messages, and a bounded memory."""
    published: list[Problem] = []
    one = ProblemReporter(published.append)
    with capture_logs() as logged:
        for number in range(10_000):
            one.report(problem(stream=f"a/b/{number}"), 5)
    assert (len(published), len(logged)) == (PUBLISHED_PER_SECOND, LOGGED_PER_SECOND)
    assert len(one.newest()) == 20


@settings(deadline=None)
@given(st.text(max_size=2000))
def test_a_problem_takes_any_text(text: str) -> None:
    """For any input, the problem can be made, and its texts are printable and bounded."""
    made = problem_of("x", stream="", instance="x", message=text, received=text, expected=text, path=text)
    assert made.message.isprintable()
    assert len(made.message) <= 500


# Figures


def test_figures_of_a_stream() -> None:
    """Rate and latencies of the last frames; the rate falls to zero in silence; without frames all are zero."""
    meter = StreamMeter(0)
    assert (meter.rate_hz(SECOND), meter.latency_ms(), meter.age_s(SECOND)) == (0.0, (0.0, 0.0), None)
    for frame in range(21):
        meter.arrived(frame * SECOND // 10, frame=True)
        meter.published((frame + 1) * 1_000_000)
    assert meter.rate_hz(2 * SECOND) == pytest.approx(10)
    assert meter.rate_hz(5 * SECOND) == pytest.approx(21 / 5)
    assert meter.rate_hz(6 * SECOND) == pytest.approx(11 / 5)
    assert meter.rate_hz(20 * SECOND) == 0.0
    assert meter.latency_ms() == (11.0, 21.0)
    assert meter.age_s(3 * SECOND) == 1.0


def test_the_rate_is_of_the_last_seconds() -> None:
    """A pause, and another rate before, are forgotten after five seconds; a slow stream has the rate of two frames."""
    meter = StreamMeter(0)
    for frame in range(50):
        meter.arrived(frame * SECOND // 50, frame=True)
    for frame in range(26):
        meter.arrived(600 * SECOND + frame * SECOND // 5, frame=True)
    assert meter.rate_hz(605 * SECOND) == pytest.approx(5)
    for frame in range(2):
        meter.arrived((620 + 10 * frame) * SECOND, frame=True)
    assert meter.rate_hz(631 * SECOND) == pytest.approx(0.1)
    assert meter.rate_hz(700 * SECOND) == 0.0
    for frame in range(10_000):
        meter.arrived(800 * SECOND + frame * SECOND // 1000, frame=True)
    assert meter.rate_hz(810 * SECOND) == pytest.approx(1000, rel=0.01)


def test_clouds_of_other_publishers() -> None:
    """A cloud of an epoch with detections belongs to them alone; one of a program of its own to any frame."""
    clouds = CloudBuffer(3)
    clouds.add(SENSOR.points(0, epoch=b"f" * 16))
    assert clouds.get(SENSOR.epoch, SENSOR.stamp_ns(0), lambda _: True) is None
    assert clouds.get(SENSOR.epoch, SENSOR.stamp_ns(0), lambda _: False) is not None


# Settings and profiles


def test_profiles_that_cannot_be_named_in_messages_are_refused(tmp_path: Path) -> None:
    """A profile whose name no message could carry ends the start, not the first frame."""
    own = tmp_path / "own.toml"
    text = Path(optipmb.__file__).parent.joinpath("model/profiles", "kitti.toml").read_text()
    own.write_text(text.replace('name = "kitti"', 'name = "not a name"'))
    with pytest.raises(optipmb.ParameterError, match="name"):
        Profiles.read(str(own), {})


def test_every_profile_of_an_incomplete_stream_keeps_objects_for_its_time() -> None:
    """That of the settings, and one that is asked for by its name."""
    profiles = Profiles.read("generic", {"a/*/*": "kitti"}, None, lambda stream: 9.0 if stream == "a/b/c" else None)
    found = (profiles.of("a/b/c"), profiles.named("nuscenes", "a/b/c"), profiles.of("a/b/d"))
    assert [(one.name, one.unseen_time) for one in found if one] == [("kitti", 9.0), ("nuscenes", 9.0), ("kitti", 6.0)]


@pytest.mark.parametrize(
    ("variable", "value", "says"),
    [
        ("OPTIPMB_CLOUD_WAIT_S", "soon", "cloud_wait_s (from the environment)"),
        ("OPTIPMB_LISTEN", "tcp/1.2.3.4:1,7447", "listen.1 (from the environment)"),
        ("OPTIPMB_CONNECT", "[tcp", "connect (from the environment): names separated by commas"),
        ("OPTIPMB_PROFILES", "a:b", "OPTIPMB_PROFILES: tables are written as JSON"),
        ("OPTIPMB_PREFIX", "a//b", "prefix"),
        ("OPTIPMB_LIMITS__MAX_BYTES", "0", "limits.max_bytes"),
    ],
)
def test_a_wrong_variable_is_named(monkeypatch: pytest.MonkeyPatch, variable: str, value: str, says: str) -> None:
    """An environment variable that cannot be used is one clear error."""
    monkeypatch.setenv(variable, value)
    with pytest.raises(SettingsInvalidError, match=re.escape(says)) as raised:
        load()
    assert "\n" not in str(raised.value)


def test_a_misspelt_variable_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    """A variable that looks like a setting and is none is reported, unless it is the tracker's."""
    monkeypatch.setenv("OPTIPMB_COMPILE_PROCESSES", "1")
    monkeypatch.setenv("OPTIPMB_CLOUD_WAIT", "1")
    assert load().unknown == ("OPTIPMB_CLOUD_WAIT; did you mean OPTIPMB_CLOUD_WAIT_S?",)


def test_a_variable_in_a_table_leaves_the_rest_of_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A variable inside a table replaces its one setting of the file; the table of profiles is replaced as a whole."""
    file = tmp_path / "service.toml"
    file.write_text(
        '[limits]\nmax_points = 5\n[profiles]\n"a/*/*" = "kitti"\n[ros2]\ndomain = 3\nnode = "of_file"\n'
        '[ros2.streams."a/b/c"]\ndetections = "/of/file"\n'
    )
    monkeypatch.setenv("OPTIPMB_ROS2__DOMAIN", "7")
    monkeypatch.setenv("OPTIPMB_LIMITS__MAX_BYTES", "2048")
    monkeypatch.setenv("OPTIPMB_PROFILES", '{"b/*/*": "nuscenes"}')
    settings = load(file).settings
    assert (settings.ros2.domain, settings.ros2.node, list(settings.ros2.streams)) == (7, "of_file", ["a/b/c"])
    assert (settings.limits.max_bytes, settings.limits.max_points) == (2048, 5)
    assert settings.profiles == {"b/*/*": "nuscenes"}


@pytest.mark.parametrize("value", ["tcp/1.2.3.4:1,tcp/[::]:2", '["tcp/1.2.3.4:1", "tcp/[::]:2"]'])
def test_lists_in_the_environment(monkeypatch: pytest.MonkeyPatch, value: str) -> None:
    """Several endpoints in one variable, with commas or as JSON."""
    monkeypatch.setenv("OPTIPMB_LISTEN", value)
    monkeypatch.setenv("OPTIPMB_CONNECT", value)
    settings = load().settings
    assert settings.listen == settings.connect == ("tcp/1.2.3.4:1", "tcp/[::]:2")


def test_router_or_client() -> None:
    """A router listens by default; with routers to connect to it is a client, unless both are wanted."""
    router, client = load().settings, load(None, {"connect": ["tcp/1.2.3.4:7447"]}).settings
    both = load(None, {"connect": ["tcp/1.2.3.4:7447"], "router": True}).settings
    assert (router.is_router, router.endpoints) == (True, ("tcp/127.0.0.1:7447",))
    assert (client.is_router, client.endpoints) == (False, ())
    assert (both.is_router, both.endpoints) == (True, ("tcp/127.0.0.1:7447",))
