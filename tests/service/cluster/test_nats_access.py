"""NATS servers with access control: real servers, with certificates and users of each kind."""

import base64
import hashlib
import json
import socket
import subprocess
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from lease_log import Alone
from log_process import LogProcess
from nats_process import started
from optipmb_client import Connection, kept_tracks
from optipmb_service.app.cli import nats_server
from optipmb_service.app.configuration import SettingsInvalidError, load
from optipmb_service.cluster.jetstream import JetStream
from optipmb_service.cluster.nats_connection import access
from optipmb_service.cluster.store import StoreError
from protected import MAKE, make
from router import Node, Sensor, until
from routers import free_endpoint, open_router
from service_process import ServiceProcess

Serve = Callable[[str], str]

STREAM = "site/node/sensor"


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folders with certificates of one authority: of a router, which the servers here have, and of a service."""
    folder = tmp_path_factory.mktemp("tls")
    made = make(folder, "--service", "tracker")
    assert made.returncode == 0, made.stderr
    return folder


@pytest.fixture
def serve(tmp_path: Path) -> Iterator[Serve]:
    processes: list[subprocess.Popen[bytes]] = []

    def start(more: str) -> str:
        address = free_endpoint().removeprefix("tcp/")
        file = tmp_path / f"{len(processes)}.conf"
        store = tmp_path / f"{len(processes)}"
        file.write_text(f'listen: "{address}"\njetstream {{ store_dir: "{store}" }}\n{more}\n')
        server = nats_server()
        assert server is not None
        processes.append(started([server, "--config", str(file)], address, tmp_path / "nats.log"))
        return address.replace("127.0.0.1", "localhost")

    yield start
    for one in processes:
        one.kill()
        one.wait(60)


def protected(certificates: Path, *, asks: bool) -> str:
    of = certificates / "router"
    files = f'cert_file: "{of}/cert.pem", key_file: "{of}/key.pem", ca_file: "{of}/ca.pem"'
    return f"tls {{ {files}, verify: {json.dumps(asks)} }}\n"


def keeps(server: str, options: dict[str, Any] | None) -> None:
    """A member that has this access keeps checkpoints there."""
    store = JetStream([server], "test", options=options)

    def kept() -> bool:
        try:
            return Alone(store).save({STREAM: b"kept"}) == frozenset() and store.load(STREAM) == b"kept"
        except StoreError:
            return False

    until(kept, f"a checkpoint is kept at {server}")
    store.close(5.0)


def refused(server: str, options: dict[str, Any] | None, why: str) -> None:
    """Who has this access is not let in, and learns why; nothing secret is said."""
    store, said = JetStream([server], "test", options=options), [""]

    def told() -> bool:
        with pytest.raises(StoreError) as error:
            store.load(STREAM)
        said[0] = str(error.value)
        return why in said[0]

    until(told, f"{why} is the reason")
    assert "secret" not in said[0]
    store.close(5.0)


def file_of(folder: Path, name: str, text: str) -> Path:
    (folder / name).write_text(text)
    return folder / name


def test_certificates_are_looked_at_on_both_sides(certificates: Path, serve: Serve, tmp_path: Path) -> None:
    """The authority of the server is needed, and a certificate where the server asks for one."""
    server = f"tls://{serve(protected(certificates, asks=True))}"
    own = certificates / "service" / "tracker"
    without = tmp_path / "without"
    without.mkdir()
    (without / "ca.pem").write_bytes((own / "ca.pem").read_bytes())
    keeps(server, access(own))
    refused(server, None, "certificate verify failed")
    refused(server, access(without), "certificate required")


@pytest.mark.parametrize(
    ("users", "right", "wrong"),
    [
        ('authorization { user: "tracker", password: "secret" }', "tracker:secret\n", "tracker:secreter"),
        ('authorization { token: "secret" }', "secret\n", "secreter"),
    ],
)
def test_a_user_or_token_in_a_file(
    certificates: Path, serve: Serve, tmp_path: Path, users: str, right: str, wrong: str
) -> None:
    """One line in a file lets in, over TLS; another one does not, nor does none."""
    server = f"tls://{serve(protected(certificates, asks=False) + users)}"
    folder = certificates / "service" / "tracker"
    keeps(server, access(folder, file_of(tmp_path, "right", right)))
    refused(server, access(folder, file_of(tmp_path, "wrong", wrong)), "Authorization Violation")
    refused(server, access(folder), "Authorization Violation")


def test_nothing_is_said_to_a_server_without_tls(tmp_path: Path) -> None:
    """Where the address says tls:// and the server, or a proxy before it, offers none, no password leaves."""
    heard: list[bytes] = []
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def pose() -> None:
            connection, _ = listener.accept()
            with connection:
                info = {"server_id": "x", "version": "2.14.0", "max_payload": 1 << 20, "auth_required": True}
                connection.sendall(f"INFO {json.dumps(info)}\r\n".encode())
                while data := connection.recv(4096):
                    heard.append(data)

        thread = threading.Thread(target=pose, daemon=True)
        thread.start()
        options = access(None, file_of(tmp_path, "user", "tracker:secret"))
        store = JetStream([f"tls://127.0.0.1:{listener.getsockname()[1]}"], "test", options=options)
        thread.join(60.0)
        assert not thread.is_alive()
        store.close(5.0)
    assert heard == []


class Key:
    """A key of NATS, as its tools make it: `kind` is the byte that the letter in front of its name stands for."""

    def __init__(self, kind: int, number: int = 0) -> None:
        seed = hashlib.sha256(bytes([kind, number])).digest()
        self._private = Ed25519PrivateKey.from_private_bytes(seed)
        raw = self._private.public_key().public_bytes_raw()
        self.name = _written(bytes([kind]) + raw)
        self.seed = _written(bytes([(18 << 3) | (kind >> 5), (kind & 31) << 3]) + seed)

    def signed(self, subject: str, name: str, nats: dict[str, Any]) -> str:
        """A JWT of this key about another one."""
        claims = {"jti": name, "iat": 1, "iss": self.name, "name": name, "sub": subject, "nats": {**nats, "version": 2}}
        parts = [{"typ": "JWT", "alg": "ed25519-nkey"}, claims]
        text = ".".join(_url(json.dumps(part).encode()) for part in parts)
        return f"{text}.{_url(self._private.sign(text.encode()))}"


def _url(data: bytes) -> str:
    return base64.urlsafe_b64encode(data).decode().rstrip("=")


def _written(raw: bytes) -> str:
    check = 0
    for byte in raw:  # CRC-16 of XMODEM
        check ^= byte << 8
        for _ in range(8):
            check = (check << 1) ^ (0x1021 if check & 0x8000 else 0)
        check &= 0xFFFF
    return base64.b32encode(raw + check.to_bytes(2, "little")).decode().rstrip("=")


def test_credentials_of_a_user(certificates: Path, serve: Serve, tmp_path: Path) -> None:
    """A file with JWT and seed, as NATS' tools write it, lets the user in whom an account names; another one not."""
    operator, account, system, user = Key(14 << 3), Key(0), Key(0, 1), Key(20 << 3)
    few = {"subs": -1, "data": -1, "payload": -1}
    kept = {"mem_storage": -1, "disk_storage": -1, "streams": -1, "consumer": -1}
    limits = {**few, **kept, "imports": -1, "exports": -1, "wildcards": True, "conn": -1, "leaf": -1}
    of_operator = operator.signed(operator.name, "test", {"type": "operator"})
    of_account = operator.signed(account.name, "test", {"type": "account", "limits": limits})
    of_system = operator.signed(
        system.name, "system", {"type": "account", "limits": {**limits, **dict.fromkeys(kept, 0)}}
    )
    of_user = account.signed(user.name, "test", {"type": "user", "pub": {}, "sub": {}, **few})
    preloaded = f"resolver_preload: {{ {account.name}: {of_account}, {system.name}: {of_system} }}"
    accounts = f"operator: {of_operator}\nsystem_account: {system.name}\nresolver: MEMORY\n{preloaded}\n"
    server = f"tls://{serve(accounts + protected(certificates, asks=False))}"

    def credentials(name: str, seed: str) -> Path:
        jwt = f"-----BEGIN NATS USER JWT-----\n{of_user}\n------END NATS USER JWT------\n"
        text = f"{jwt}\n-----BEGIN USER NKEY SEED-----\n{seed}\n------END USER NKEY SEED------\n"
        return file_of(tmp_path, name, text)

    folder = certificates / "service" / "tracker"
    keeps(server, access(folder, credentials("right", user.seed)))
    refused(server, access(folder, credentials("wrong", account.seed)), "Authorization Violation")


def test_a_service_with_certificates_and_a_password(certificates: Path, serve: Serve, tmp_path: Path) -> None:
    """`--cluster-tls` and `--cluster-credentials` make it a member; it holds all partitions."""
    users = 'authorization { user: "tracker", password: "secret" }'
    server = f"tls://{serve(protected(certificates, asks=True) + users)}"
    secret = file_of(tmp_path, "secret", "tracker:secret")
    options = ("--cluster", server, "--cluster-tls", str(certificates / "service" / "tracker"))
    with ServiceProcess(*options, "--cluster-credentials", str(secret)) as service:
        service.wait_log("held=64")
        assert service.end()[0] == 0
        assert "secret" not in service.errors.replace(str(secret), "")


def test_the_permissions_of_the_page_are_enough(serve: Serve) -> None:
    """With these, and no others, a service keeps its state, and a bridge its log, which the service reads."""
    publish = [
        "$JS.API.>",
        "OPTIPMB_optipmb_2fv1.>",
        "OPTIPMB-DETECTIONS_optipmb_2fv1.>",
        "OPTIPMB-TRACKS_optipmb_2fv1.>",
    ]
    subscribe = ["_INBOX.>"]
    page = (MAKE.parents[2] / "docs" / "security.md").read_text()
    assert all(f"`{subject}`" in page for subject in publish + subscribe)
    allowed = json.dumps({"publish": publish, "subscribe": subscribe})
    user = f'{{ user: "tracker", password: "secret", permissions: {allowed} }}'
    server = f"nats://tracker:secret@{serve(f'authorization {{ users: [{user}] }}')}"
    endpoint, sensor = free_endpoint(), Sensor()
    with open_router(endpoint), Node(endpoint) as node, LogProcess(endpoint, server) as bridge:
        bridge.wait_receiving(node)
        options = ("--connect", endpoint, "--cluster", server, "--instance")
        with ServiceProcess(*options, "a", listen=False) as service, Connection(endpoint) as connection:
            service.wait_log("held=64")
            node.send(*(sensor.detections(seq) for seq in range(60)))
            node.tracks(sensor.stream, 60)
            until(lambda: len(list(kept_tracks(connection, sensor.stream))) == 60, "the service reads the log")
            assert service.end()[0] == 0
        with ServiceProcess(*options, "b", listen=False) as service:
            service.wait_log("held=64")
            node.send(*(sensor.detections(seq) for seq in range(60, 65)))
            assert [one.gap for one in node.tracks(sensor.stream, 65)] == [0] * 65


def test_what_is_wrong_is_said_in_one_line(certificates: Path, tmp_path: Path) -> None:
    """A folder without certificates, servers without TLS, a file that is none: each by the name of its setting."""
    server, folder, none = "tls://localhost:4222", certificates / "service" / "tracker", tmp_path / "none"
    for options, why in (
        ({"cluster_tls": folder}, "cluster_tls: without servers"),
        ({"cluster": ["nats://localhost:4222"], "cluster_tls": folder}, "cluster_tls: servers in `cluster` as tls://"),
        ({"cluster": [server], "cluster_tls": tmp_path}, "cluster_tls: .*no file ca.pem"),
        ({"cluster": [server], "cluster_credentials": none}, "cluster_credentials: .*no such file"),
    ):
        with pytest.raises(SettingsInvalidError, match=why):
            load(None, options)
    for text, why in (("two words", "one line"), ("-----BEGIN NATS USER JWT-----\nx\n-----END", "JWT and seed")):
        with pytest.raises(StoreError, match=f"^cluster_credentials: .*{why}"):
            access(None, file_of(tmp_path, "file", text))
    file_of(tmp_path, "ca.pem", "no certificate")
    with pytest.raises(StoreError, match=r"^cluster_tls: "):
        access(tmp_path)
