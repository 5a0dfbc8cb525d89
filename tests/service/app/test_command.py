"""The command: starting, stopping, wrong use, settings."""

import json
import resource
import signal
import socket
import sys
from pathlib import Path

import pytest
from optipmb_schemas import Keys, ServiceStatus, SessionParameters, decode
from optipmb_schemas.installation import install_command
from optipmb_service.app import cli, worker
from optipmb_service.app.configuration import load
from router import Node, Sensor
from routers import free_endpoint, open_router
from service_process import ServiceProcess

import optipmb

KEYS = Keys()
SENSOR = Sensor()
END_S = 30.0


def test_a_start_is_short_and_a_signal_ends_it_in_order() -> None:
    """With compiled kernels a start takes less than ten seconds of the processor, and SIGINT in a stream ends it well.

    Compiling would take more.
    """
    optipmb.warm_up()
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with ServiceProcess("--instance", "one", fresh=True) as service:
        assert service.wait_ready() == f"ready instance=one endpoints={service.endpoint}"
        with Node(service.endpoint) as node:
            node.send(*(SENSOR.detections(seq) for seq in range(5)))
            assert len(node.tracks(SENSOR.stream, 5)) == 5
            node.send(SENSOR.detections(5, has_points=True))
            status, _ = service.end(signal.SIGINT, deadline_s=END_S)
        assert (status, service.output) == (0, [])
        assert "Traceback" not in service.errors
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert 0.1 < after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < 10


def test_a_signal_during_the_start_ends_it() -> None:
    """Before it is ready, too, a signal ends it with status 0."""
    with ServiceProcess(fresh=True) as service:
        service.wait_log("starting")
        status, _ = service.end(signal.SIGTERM, deadline_s=END_S)
        assert status == 0


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2])
def test_other_signals_end_it_in_order(number: signal.Signals) -> None:
    """As SIGTERM does; the log says that settings hold from the start."""
    with ServiceProcess() as service:
        service.wait_ready()
        assert service.end(number, deadline_s=END_S)[0] == 0
        (asked,) = [line for line in service.errors.splitlines() if "stop_asked" in line]
        assert number.name in asked
        assert ("start it again" in asked) is (number is signal.SIGHUP)
        assert "stopped" in service.errors


def test_the_last_frames_are_tracked() -> None:
    """Frames received before a SIGTERM still become tracks, and it ends in order; more signals change nothing."""
    with ServiceProcess() as service:
        service.wait_ready()
        with Node(service.endpoint) as node:
            node.send(SENSOR.detections(0))
            node.tracks(SENSOR.stream, 1)
            gone = node.watch_alive(KEYS.all_alive())
            node.send(SENSOR.detections(1, has_points=True))
            node.ask(KEYS.query(SENSOR.stream, "parameters"), SessionParameters)
            for number in (signal.SIGTERM, signal.SIGINT, signal.SIGTERM):
                service.process.send_signal(number)
            node.tracks(SENSOR.stream, 2)
            gone.wait(lambda items: items[-1:] and items[-1][1] == b"-", "the end of the alive token")  # type: ignore[arg-type,return-value]  # a list is as good as its truth
        assert (service.wait_end(END_S), service.output) == (0, [])
        assert "Traceback" not in service.errors


def test_a_killed_service_is_seen_at_once_and_may_come_back() -> None:
    """After SIGKILL its token vanishes, and another start on the same port works and tracks the same publisher."""
    endpoint = free_endpoint()
    with open_router(endpoint), Node(endpoint) as node:
        tokens = node.watch_alive(KEYS.all_alive())
        first = ("--connect", endpoint, "--instance", "first")
        with ServiceProcess(*first, listen=False) as service:
            service.wait_ready()
            node.send(*(SENSOR.detections(seq) for seq in range(3)))
            node.tracks(SENSOR.stream, 3)
            service.process.kill()
            tokens.wait(lambda items: (KEYS.alive("first"), b"-", "") in items, "the end of the token")
        with ServiceProcess("--connect", endpoint, "--instance", "second", listen=False) as service:
            service.wait_ready()
            node.send(SENSOR.detections(3))
            received = node.tracks(SENSOR.stream, 7)
            assert [message.seq for message in received] == [0, 1, 2, 0, 1, 2, 3]
            assert service.end()[0] == 0


def test_a_client_waits_for_its_router() -> None:
    """Started before the router it connects when the router comes; a signal ends the waiting too."""
    endpoint = free_endpoint()
    with ServiceProcess("--connect", endpoint, listen=False) as service:
        service.wait_log("connecting")
        with open_router(endpoint):
            assert service.wait_ready().endswith(endpoint)
            assert service.end()[0] == 0
    with ServiceProcess("--connect", endpoint, listen=False) as service:
        service.wait_log("connecting")
        status, _ = service.end(deadline_s=END_S)
        assert status == 0


def test_a_port_in_use_is_one_clear_line() -> None:
    """Status 1 and one line that names the endpoint."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        with ServiceProcess("--listen", endpoint, "--log-level", "error", listen=False) as service:
            assert service.wait_end(120) == 1
            assert service.errors.count("\n") == 1
            assert service.errors.startswith(f"optipmb-service: cannot listen on {endpoint}: the address is in use")


@pytest.mark.parametrize(
    ("profile", "says"), [("unheard-of", "profile: expected one of generic, "), ("/no/such/file.toml",) * 2]
)
def test_a_profile_that_there_is_not_starts_nothing(
    profile: str, says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Status 2 and one line on stderr before anything is started; nothing is on stdout."""
    assert worker.run(load(None, {"profile": profile}).settings) == 2
    shown = capsys.readouterr()
    assert (shown.out, shown.err.count("\n")) == ("", 1)
    assert shown.err.startswith("optipmb-service: ")
    assert says in shown.err


def refused(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *options: str, says: str) -> None:
    """Run the command in this process, which must refuse its options before anything is started."""
    monkeypatch.setattr(worker, "run", lambda _: pytest.fail("it was started"))
    # Some options are refused when the log goes to the standard error of this test already, which ends with it.
    monkeypatch.setattr(cli.logs, "configure", lambda *_: None)
    with pytest.raises(SystemExit) as ended:
        cli.main(options)
    shown = capsys.readouterr()
    assert (ended.value.code, shown.out, shown.err.count("\n")) == (2, "", 1)
    assert shown.err.startswith("optipmb-service: ")
    assert says in shown.err


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--nonsense",), "No such option"),
        (("nonsense",), "No such command"),
        (("--listen", "7447"), "an endpoint looks like"),
        (("--settings", "/no/such/file.toml"), "No such file"),
        (("--instance", "a/b"), "instance"),
        (("--log-format", "xml"), "'console' or 'json'"),
        (("--cluster", "localhost:4222"), "a NATS server looks like nats://"),
        (("nats", "--listen", "4222"), "option listen: an address looks like"),
        (("nats", "--store", "/proc/none"), "/proc/none: No such file"),
    ],
)
def test_wrong_use_is_one_clear_line(
    options: tuple[str, ...], says: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Status 2 and one line on stderr about the error; nothing on stdout."""
    refused(capsys, monkeypatch, *options, says=says)


def test_grpc_without_its_extra_is_one_clear_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before the tracker is loaded, one line says how to install it."""
    monkeypatch.setitem(sys.modules, "grpc", None)
    refused(capsys, monkeypatch, "--grpc", "127.0.0.1:0", says=install_command("grpc"))


def test_a_cluster_without_its_extra_is_one_clear_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without the client of NATS, or without the server, one line says how to install it."""
    line = install_command("cluster")
    monkeypatch.setattr(cli, "nats_server", lambda: None)
    refused(capsys, monkeypatch, "nats", says=line)
    monkeypatch.setitem(sys.modules, "nats.aio.client", None)
    for module in ("jetstream", "nats_connection"):
        monkeypatch.delitem(sys.modules, f"optipmb_service.cluster.{module}", raising=False)
    refused(capsys, monkeypatch, "--cluster", "nats://127.0.0.1:4222", says=line)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("cloud_wait_s = -1", "cloud_wait_s (from the file)"),
        ("no_such_setting = 1", "no_such_setting"),
        ("listen = 'tcp/[", "settings file"),
        ("[limits]\nmax_bytes = 'many'", "limits.max_bytes"),
    ],
)
def test_a_bad_settings_file_is_one_clear_line(
    tmp_path: Path, text: str, says: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Status 2 and one line that names the setting and where it came from."""
    file = tmp_path / "settings.toml"
    file.write_text(text)
    refused(capsys, monkeypatch, "--settings", str(file), says=says)


def test_json_logs_and_an_own_profile(tmp_path: Path) -> None:
    """Log lines are JSON objects when asked for; a profile from a file is tracked with."""
    from importlib import resources  # noqa: PLC0415 - this test alone reads a shipped profile

    text = resources.files("optipmb.model").joinpath("profiles", "nuscenes.toml").read_text()
    profile = tmp_path / "own.toml"
    profile.write_text(text.replace('name = "nuscenes"', 'name = "own"'))
    with ServiceProcess("--log-format", "json", "--profile", str(profile), "--instance", "x") as service:
        service.wait_ready()
        with Node(service.endpoint) as node:
            node.send(SENSOR.detections(0))
            assert node.tracks(SENSOR.stream, 1)[0].profile == "own"
            assert node.ask(KEYS.status("x"), ServiceStatus).sessions[0].profile == "own"
        service.end()
        events = [json.loads(line)["event"] for line in service.errors.splitlines()]
    expected = ["starting", "ready", "session_opened", "session_begun", "stop_asked", "stopped"]
    assert [event for event in events if event in expected] == expected


def config(capsys: pytest.CaptureFixture[str], *options: str) -> str:
    with pytest.raises(SystemExit) as ended:
        cli.main(("config", *options))
    shown = capsys.readouterr()
    assert (ended.value.code, shown.err) == (0, "")
    return shown.out


def test_settings_have_an_order(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """An option is above the environment, the environment above the file, and `config` says which it was."""
    file = tmp_path / "settings.toml"
    file.write_text(
        "instance = 'file'\nprefix = 'file/v1'\nmax_sessions = 3\n[limits]\nmax_points = 10\nmax_bytes = 5000\n"
    )
    for name, value in (("INSTANCE", "environment"), ("PREFIX", "env/v1"), ("LIMITS__MAX_POINTS", "20")):
        monkeypatch.setenv(f"OPTIPMB_{name}", value)
    printed = json.loads(config(capsys, "--json", "--settings", str(file), "--instance", "option"))
    values, sources = printed["settings"], printed["sources"]
    assert (values["instance"], values["prefix"], values["max_sessions"]) == ("option", "env/v1", 3)
    assert (values["limits"]["max_points"], values["limits"]["max_bytes"]) == (20, 5000)
    assert [sources[name] for name in ("instance", "prefix", "max_sessions", "listen")] == [
        "option",
        "environment",
        "file",
        "default",
    ]


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ("rewind = 1", "unknown setting; did you mean rewind_s?"),
        ("limits.max_byte = 2000", "unknown setting; did you mean max_bytes?"),
        ('profiles = {"a/*/*" = "there-is-none.toml"}', "there-is-none.toml: no such file"),
        ('zenoh_config = "there-is-none.json5"', "there-is-none.json5: no such file"),
        ('http = "127.0.0.1:99999"', "setting http (from the file): a port is a number up to 65535"),
        ('grpc = "127.0.0.1:65536"', "setting grpc (from the file): a port is a number up to 65535"),
        (
            'mqtt.broker = "mqtt://127.0.0.1:mqtt"',
            "setting mqtt.broker (from the file): a port is a number up to 65535",
        ),
        ('cluster = ["nats://user:secret@10.0.0.1:70000"]', "received 'nats://***@10.0.0.1:70000'"),
        (
            'outputs = {"*/*/*" = {rate_hz = 5}, "garage/*/*" = {rate_hz = 20}}',
            "setting outputs.garage/*/*: never applies, for */*/* is before it and matches all of it",
        ),
    ],
)
def test_config_names_what_is_wrong(
    content: str, text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """An unknown setting, a missing file, a port that is none, a pattern that never applies; no password is shown."""
    file = tmp_path / "settings.toml"
    file.write_text(content)
    with pytest.raises(SystemExit):
        cli.main(("config", "--settings", str(file)))
    assert text in capsys.readouterr().err


def test_config_prints_no_password(capsys: pytest.CaptureFixture[str]) -> None:
    """User, password and token in the address of a NATS server are not shown."""
    servers = "nats://user:secret@10.0.0.1:4222,nats://token@10.0.0.2:4222,nats://10.0.0.3:4222"
    for option in ("--json", "--no-router"):
        shown = config(capsys, option, "--connect", "tcp/127.0.0.1:1", "--cluster", servers)
        assert "secret" not in shown
        assert "token@" not in shown
        assert "nats://***@10.0.0.1:4222" in shown
        assert "nats://10.0.0.3:4222" in shown


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--listen", "tcp/0.0.0.0:0"), ["tcp/0.0.0.0:0"]),
        (("--listen", "tcp/[::]:0,tcp/127.0.0.1:0"), ["tcp/[::]:0"]),
        (("--listen", "tcp/localhost:0", "--grpc", "10.0.0.1:1"), ["grpc 10.0.0.1:1"]),
        (("--listen", "tcp/[::1]:0", "--grpc", "127.0.0.1:1"), []),
        (("--listen", "unixsock-stream//tmp/a"), []),
        (("--listen", "tcp/0.0.0.0:0", "--zenoh-config", "own.json5"), []),
    ],
)
def test_who_listens_for_others_without_protection_is_told(options: tuple[str, ...], said: list[str]) -> None:
    """Addresses beyond this machine without TLS or access control are named; addresses of this machine are not."""
    pairs = dict(zip(options[::2], options[1::2], strict=True))
    assert (
        list(load(None, {name[2:].replace("-", "_"): value for name, value in pairs.items()}).settings.unprotected)
        == said
    )


def test_a_service_without_protection_says_so() -> None:
    """The log has one warning about it, and none on the loopback interface."""
    with ServiceProcess("--listen", "tcp/0.0.0.0:0", "--log-format", "json", listen=False) as service:
        service.wait_ready()
        assert service.errors.count('"event": "unprotected"') == 1
        assert service.end()[0] == 0


def test_a_store_that_never_opened_is_a_failure_at_the_end(tmp_path: Path) -> None:
    """A service that could not keep anything tracks, and ends with status 1."""
    (tmp_path / "file").write_text("")
    with ServiceProcess(environment={"OPTIPMB_STORE": str(tmp_path / "file" / "folder")}) as service:
        service.wait_ready()
        assert service.end()[0] == 1


def test_a_stream_name_with_a_part_too_many_is_reported() -> None:
    """Detections under two or four names are refused with a line that has the key; the others are tracked."""
    with ServiceProcess("--log-format", "json") as service:
        service.wait_ready()
        with Node(service.endpoint) as node:
            wrong = f"{KEYS.prefix}/plant/hall/robot/lidar/detections"
            for seq in range(5):
                node.send_raw(wrong, b"anything")
                node.send(SENSOR.detections(seq))
            node.tracks(SENSOR.stream, 5)
            node.send_raw(f"{KEYS.prefix}/robot/lidar/detections", b"anything")
            service.wait_log(wrong)
            (status,) = [decode(one[2], ServiceStatus) for one in node.query(KEYS.all_status())]
        assert status.refused >= 5


def test_what_config_prints_is_a_settings_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The output of `config` can be given to `--settings`."""
    file = tmp_path / "settings.toml"
    file.write_text(config(capsys, "--instance", "one", "--connect", "tcp/127.0.0.1:1"))
    values = json.loads(config(capsys, "--json", "--settings", str(file)))["settings"]
    assert (values["instance"], values["connect"], values["router"]) == ("one", ["tcp/127.0.0.1:1"], False)
