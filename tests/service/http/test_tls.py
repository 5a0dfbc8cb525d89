"""HTTPS: the certificate of the files, also of renewed ones, and warnings where tokens would be readable."""

import json
import ssl
import subprocess
from pathlib import Path

import pytest
import structlog
from optipmb_client.errors import ClientError
from optipmb_service.app.health_command import ask, main
from optipmb_service.edges.http import Server, application
from optipmb_service.settings import Settings
from watched import Watched, asked, served
from websocket import create_connection


def make(folder: Path) -> None:
    """Write a key and a certificate of its own."""
    subject = ("-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost,IP:127.0.0.1", "-days", "30")
    key = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes", "-keyout", str(folder / "key.pem"))
    command = ["openssl", "req", "-x509", *key, *subject, "-out", str(folder / "cert.pem")]
    subprocess.run(command, check=True, capture_output=True, timeout=60)


def shown(address: str) -> str:
    host, _, port = address.rpartition(":")
    return ssl.get_server_certificate((host, int(port)), timeout=60).strip()


def test_new_connections_have_the_certificate_of_the_files(tmp_path: Path, watched: Watched) -> None:
    """Renewed files hold without a restart; files that cannot be used are logged, and the one before holds."""
    make(tmp_path)
    server = Server(application(watched, Settings()), "127.0.0.1:0", 4096, tmp_path)
    try:
        first = (tmp_path / "cert.pem").read_text().strip()
        assert shown(server.address) == first
        assert ask(server.address, ready=True, certificate=tmp_path)[0]
        assert main(["--http", server.address]) == 1, "no answer without TLS"
        trusted = {"ca_certs": str(tmp_path / "cert.pem")}
        url = f"wss://{server.address}/api/v1/ws?stream=a/b/c"
        create_connection(url, timeout=60, suppress_origin=True, sslopt=trusted).shutdown()
        make(tmp_path)
        assert shown(server.address) == (tmp_path / "cert.pem").read_text().strip() != first
        assert not ask(server.address, ready=True, certificate=tmp_path / "none")[0]
        kept = shown(server.address)
        (tmp_path / "cert.pem").write_text("no certificate")
        with structlog.testing.capture_logs() as logged:
            assert shown(server.address) == kept
        assert [line["event"] for line in logged] == ["http_certificates"]
    finally:
        server.close()
    with pytest.raises(ClientError, match="setting http_tls: "):
        Server(application(watched, Settings()), "127.0.0.1:0", 4096, tmp_path)


def test_readiness_names_addresses_without_protection(watched: Watched) -> None:
    """Without tokens, or with readable ones, on an address of the network; with tokens and TLS all is said."""
    network = {"http": "0.0.0.0:80", "listen": []}
    tokens, tls = {"http_tokens": "watched:KEYS"}, {"http_tls": "tls"}
    said = ["http 0.0.0.0:80"]
    for settings, expected in (({}, said), (tls, said), (tokens, said), (tokens | tls, None)):
        with served(watched, **network, **settings) as address, asked(address, "/readyz") as response:
            assert json.loads(response.read()).get("unprotected") == expected
