"""What `make containers` does before there is a container."""

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from container_engine import call, index_settings, secrets

SCRIPT = Path(__file__).parents[2] / "docker" / "containers.py"


@pytest.mark.parametrize(("options", "status"), [((), 1), (("--optional",), 0)])
def test_no_engine(tmp_path: Path, options: tuple[str, ...], status: int) -> None:
    """Where no engine is, the first line says that nothing has run; that is a failure unless it was made optional."""
    command = [sys.executable, str(SCRIPT), "--work", str(tmp_path / "out"), *options]
    done = subprocess.run(
        command, env=os.environ | {"PATH": str(tmp_path)}, capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == status
    assert done.stdout.startswith("NO CONTAINER HAS RUN: neither Docker nor Podman")


def test_the_index_of_this_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A build gets what says where the index is, certificates too, in a file for this user; local folders stay out."""
    certificate = tmp_path / "ca.pem"
    certificate.write_text("certificate")
    configured = tmp_path / "mine.conf"
    configured.write_text(
        "[global]\nindex-url = https://me:word@index.example:8443/simple\nfind-links = /opt/wheels\n"
        f"cert = {certificate}\n"
        "extra-index-url = file:///opt/more https://pypi.org/simple\n"
    )
    for name in [name for name in os.environ if name.startswith("PIP_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("PIP_CONFIG_FILE", str(configured))
    settings, hosts = index_settings()
    assert settings["index-url"] == "https://me:word@index.example:8443/simple"
    assert settings["extra-index-url"].endswith("https://pypi.org/simple")
    assert "index.example" in hosts
    assert "pypi.org" not in hosts
    options = secrets(tmp_path, settings)
    assert f"id=ca.crt,src={certificate}" in options
    shown = Path(options[-1].partition("src=")[2])
    assert stat.S_IMODE(shown.stat().st_mode) == 0o600
    assert "cert = /run/secrets/ca.crt\n" in shown.read_text()
    assert "/opt/" not in shown.read_text()


def test_a_command_that_hangs() -> None:
    """It is ended after its time, and the status says so."""
    done = call(["sleep", "60"], dict(os.environ), 0.2)
    assert (done.returncode, done.stderr) == (124, "not within 0.2 s")
