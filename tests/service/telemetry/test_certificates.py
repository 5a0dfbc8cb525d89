"""Certificates of a process: how long the ones hold that are served, and renewals that cannot be used."""

import os
import subprocess
from pathlib import Path

import pytest
from optipmb_service.telemetry import certificates
from optipmb_service.telemetry.certificates import Certificates
from optipmb_service.telemetry.health import Component, ProcessHealth
from optipmb_service.telemetry.metrics import Metrics


def make(folder: Path, days: int) -> None:
    key = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes", "-keyout", str(folder / "key.pem"))
    names = ("-subj", "/CN=localhost", "-days", str(days), "-out", str(folder / "cert.pem"))
    command = ["openssl", "req", "-x509", *key, *names]
    subprocess.run(command, check=True, capture_output=True, timeout=60)


def test_a_renewal_that_does_not_fit_its_key_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The days are those of the certificate that is served; the process is degraded, with the reason, until it fits."""
    monkeypatch.setattr(certificates, "LOOK_S", 0.0)
    make(tmp_path, 5)
    held = Certificates({"http": tmp_path / "cert.pem"}, fixed="")
    health = ProcessHealth("one", Metrics())
    health.report(Component())
    health.tls = held
    assert (round(held.days()["http"]), health.state()) == (5, "ready")
    key = (tmp_path / "key.pem").read_bytes()
    make(tmp_path, 90)
    renewed = (tmp_path / "key.pem").read_bytes()
    for written, days, state in ((key, 5, "degraded"), (b"", 5, "degraded"), (renewed, 90, "ready")):
        (tmp_path / "key.pem").write_bytes(written)
        os.utime(tmp_path / "key.pem")
        assert (round(held.days()["http"]), health.state(), health.ready()) == (days, state, True)
        assert ("key.pem" in health.failure()) is (state == "degraded")
