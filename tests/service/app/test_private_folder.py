"""Folders of processes: removed at their end, or at the next start after a kill."""

import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from optipmb_service.app.workers import HELD, private_folder

HOLDS = """
import sys
from optipmb_service.app.workers import private_folder

with private_folder() as folder:
    print(folder, flush=True)
    sys.stdin.read()
"""


def holder() -> tuple[subprocess.Popen[str], Path]:
    """A process with a folder, which ends with its stdin."""
    process = subprocess.Popen([sys.executable, "-c", HOLDS], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    return process, Path(process.stdout.readline().strip())


def test_what_a_killed_process_left_is_removed_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The folder of a killed process goes with the next start; the folder of a living one, and other folders, stay."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)  # it is remembered otherwise
    (tmp_path / "optipmb-other").mkdir()
    (tmp_path / "another").mkdir()
    (tmp_path / "another" / HELD).touch()
    lives, kept = holder()
    killed, left = holder()
    killed.kill()
    killed.communicate(timeout=60)
    (left / "router").touch()
    assert {kept, left} < set(tmp_path.iterdir())
    with private_folder() as own:
        assert set(tmp_path.iterdir()) == {kept, own, tmp_path / "optipmb-other", tmp_path / "another"}
        assert own.stat().st_mode & 0o077 == 0
    lives.communicate(timeout=60)
    assert lives.returncode == 0
    assert set(tmp_path.iterdir()) == {tmp_path / "optipmb-other", tmp_path / "another"}
