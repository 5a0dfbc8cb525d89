"""Test that docs/operation.md and docs/reference.md describe the code."""

import ast
import re
import socket
from pathlib import Path
from typing import Any, get_args

import optipmb_schemas as schemas
import optipmb_service
import pytest
from optipmb_client import publisher
from optipmb_schemas import Code
from optipmb_service.app import cli
from optipmb_service.app.configuration import load
from optipmb_service.cluster import message_log, sqlite
from optipmb_service.edges import inputs as edge_inputs
from optipmb_service.edges import json_frames, mqtt, mqtt_inputs, queues, readers
from optipmb_service.edges.grpc import calls, publishing, subscribing
from optipmb_service.edges.grpc.server import OPTIONS
from optipmb_service.edges.http import detections, server
from optipmb_service.session.problems import CODES
from optipmb_service.settings import LimitSettings, Ros2Settings, Ros2Stream, Settings, SiteSettings
from optipmb_service.streams import persistence
from optipmb_service.telemetry.logs import EVENTS
from optipmb_service.zenoh import transport
from reference import docstrings, main, page

DOCS = Path(__file__).parents[2] / "docs"
OPERATION = DOCS / "operation.md"
REFERENCE = DOCS / "reference.md"
SOURCES = sorted(Path(optipmb_service.__file__).parent.rglob("*.py"))
options: dict[str, int] = dict(OPTIONS)
LEVELS = {"debug", "info", "warning", "error", "exception"}


def default(setting: str) -> Any:
    return Settings.model_fields[setting].default


def calls_of(names: set[str]) -> list[ast.Call]:
    found = []
    for source in SOURCES:
        for part in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
            if isinstance(part, ast.Call):
                name = part.func.attr if isinstance(part.func, ast.Attribute) else getattr(part.func, "id", "")
                if name in names:
                    found.append(part)
    return found


def texts(part: ast.AST) -> set[str]:
    """All words of small letters and digits that a part of the code holds as texts."""
    values = {node.value for node in ast.walk(part) if isinstance(node, ast.Constant) and isinstance(node.value, str)}
    return {value for value in values if re.fullmatch("[a-z][a-z0-9_]*", value)}


def test_the_tables_are_current() -> None:
    """`python docs/reference.py docs/reference.md` would change nothing."""
    assert page(REFERENCE.read_text(encoding="utf-8")) == REFERENCE.read_text(encoding="utf-8")
    assert main(["--check", str(REFERENCE)]) == 0


def test_a_page_that_is_not_current_is_found(tmp_path: Path) -> None:
    """The check finds a stale table, and writing updates it."""
    copy = tmp_path / "page.md"
    copy.write_text(REFERENCE.read_text(encoding="utf-8").replace("`cloud_wait_s`", "`cloud_wait`"), encoding="utf-8")
    assert main(["--check", str(copy)]) == 1
    assert main([str(copy)]) == 0
    assert main(["--check", str(copy)]) == 0


def test_every_setting_is_described() -> None:
    """Every setting has a description."""
    for table in (Settings, LimitSettings, SiteSettings, Ros2Settings, Ros2Stream):
        assert docstrings(table).keys() >= table.model_fields.keys()


def test_every_log_event_is_described() -> None:
    """The code logs the events of the table."""
    logged = set()
    for call in calls_of(LEVELS):
        receiver = call.func.value if isinstance(call.func, ast.Attribute) else None
        if (isinstance(receiver, ast.Name) and receiver.id == "log") or isinstance(receiver, ast.Call):
            logged |= texts(call.args[0])
    assert logged == set(EVENTS)


def test_every_problem_is_described() -> None:
    """The code and the schemas report the codes of the table."""
    reported = set(get_args(Code))
    for call in calls_of({"problem_of", "_problem", "of", "jumped", "CheckFinding", "_refuse", "_report", "report"}):
        code = call.args[0] if call.args else None
        reported |= texts(code) if isinstance(code, ast.Constant) else set()
        reported |= {text for keyword in call.keywords if keyword.arg == "code" for text in texts(keyword.value)}
    reported |= set(detections.STATUS) - edge_inputs.LATER - {"not_allowed"}
    assert reported == set(CODES)


def test_the_exit_statuses_are_those_of_the_table(capsys: pytest.CaptureFixture[str]) -> None:
    """The table has each exit status of a command: a printed answer, no service, a wrong option."""
    (table,) = re.findall(r"\| exit status \|.*?\n\n", OPERATION.read_text(encoding="utf-8"), re.DOTALL)
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))  # and does not listen
        address = f"127.0.0.1:{silent.getsockname()[1]}"
        commands = {0: ["config"], 1: ["health", "--http", address], 2: ["--wrong"]}
        assert [int(status) for status in re.findall(r"^\| (\d+) \|", table, re.MULTILINE)] == list(commands)
        for status, command in commands.items():
            with pytest.raises(SystemExit) as ended:
                cli.main(command)
            assert ended.value.code == status
    assert "No such option: --wrong" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("page", "table"),
    [("operation.md", "sites"), ("zones.md", "zones"), ("fixed-rate.md", "outputs"), ("standards.md", "cpm")],
)
def test_the_settings_of_a_page_are_accepted(tmp_path: Path, page: str, table: str) -> None:
    """All TOML of the page is one file of settings, which has what the page is about."""
    examples = re.findall(r"```toml\n(.*?)```", (DOCS / page).read_text(encoding="utf-8"), re.DOTALL)
    file = tmp_path / "settings.toml"
    file.write_text("\n".join(examples), encoding="utf-8")
    assert getattr(load(file).settings, table)


FIGURES = {
    "grpc.md": {
        f"size of a message | {schemas.DEFAULT.max_bytes // 2**20} MB |",
        f"points of a cloud | {schemas.DEFAULT.max_detections:,}, {schemas.DEFAULT.max_points:,} |",
        f"`Publish` | {publishing.MAX_CACHE:,}, {publishing.MAX_CACHE_CLOUDS} |",
        f"(default {subscribing.QUEUE}, at most {subscribing.MAX_QUEUE}), {queues.BYTES // 2**20} MB in total",
        f"no message within {calls.FIRST_S:.0f} s of opening a call",
        f"no service answered within {subscribing.QUERY_S:.0f} s",
        f"`grpc_calls` ({default('grpc_calls'):,}), `grpc_connections` ({default('grpc_connections'):,})",
        f"metadata of a call | {options['grpc.max_metadata_size'] // 2**10} KiB |",
        f"at least {options['grpc.http2.min_ping_interval_without_data_ms'] // 1000} s |",
        f"closed after {options['grpc.max_connection_idle_ms'] // 60_000} minutes |",
    },
    "json.md": {
        f"{readers.BOUNDS.seconds / 60:.0f} minutes longer: {readers.BOUNDS.events:,} of each stream, ",
        f"of each stream, {readers.BOUNDS.size // 2**20} MiB in all",
        f"you took nothing for {server.SEND_S:.0f} s",
        f"for `stale_s` ({default('stale_s'):g} s)",
        f"{mqtt.EVENTS:,} events of each stream ({mqtt.EVENT_BYTES // 2**20} MiB in all)",
        f"for {mqtt.FORGET_S / 60:.0f} minutes what is as large",
        f"tries again after {mqtt.TAKEN_OVER_S:.0f} s",
        f"`http_senders` ({default('http_senders')})",
        f"up to {mqtt_inputs.RECEIVED} with MQTT 5",
        f"{mqtt_inputs.WAITING:,} messages with QoS 0",
        f"array of 1 to {json_frames.MOST_FRAMES} frames",
        f"up to {detections.WAIT_S:.0f} s; one frame",
        f"the body took longer than {detections.BODY_S:.0f} s",
        f"| {edge_inputs.WINDOW} frames of the stream are without tracks",
        f"the newest {edge_inputs.CACHE} frames",
        f"The newest {edge_inputs.FRAMES:,} frames",
        f"in the last {edge_inputs.OFFSETS} frames",
    },
    "messages.md": {
        f"`max_json_bytes` {LimitSettings().max_json_bytes:,} and `max_values` {LimitSettings().max_values:,}",
    },
    "deployment.md": {
        f"a bridge holds {message_log.HELD_BYTES // 2**20} MB",
        f"`standby_mb` ({default('standby_mb')}) of",
    },
    "operation.md": {
        f"`idle_s` ({default('idle_s'):g}) without messages, ",
        f"`keep_days` ({default('keep_days'):g}); last ids of {sqlite.NUMBERS:,} streams",
        f"table `aside`: the newest {sqlite.ASIDE};",
        f"`store/{persistence.DUMPS}`: the newest {persistence.MAX_DUMPS} |",
        f"`log_s` ({default('log_s'):g}), `log_tracks_s` ({default('log_tracks_s'):g}) |",
        f"memory of the publisher: {publisher.CACHE} detections",
        f"of the service: {transport.TRACKS_CACHE} messages of each stream",
        f"{readers.BOUNDS.seconds / 60:.0f} minutes after the last reader",
    },
    "watching.md": {f"`http_clients` ({default('http_clients')}) readers"},
}
"""Figures in the text of pages, as the code has them."""


@pytest.mark.parametrize("name", FIGURES)
def test_figures_of_the_pages_are_those_of_the_code(name: str) -> None:
    """A limit that changes is changed on the page as well."""
    text = " ".join((DOCS / name).read_text(encoding="utf-8").split())
    assert not [figure for figure in sorted(FIGURES[name]) if figure not in text]
