"""The decoders stand a short coverage-guided search, begun from the kept corpus (long: `OPTIPMB_TEST_FUZZ_S=600`)."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parent
SECONDS = int(os.environ.get("OPTIPMB_TEST_FUZZ_S", "4"))


@pytest.mark.timeout(SECONDS + 120)
@pytest.mark.parametrize("name", ["messages", "checkpoints"])
def test_no_bytes_get_past_the_decoder(name: str, tmp_path: Path) -> None:
    """Whatever the bytes, they are read, or refused with the one error of the decoder; nothing else is raised."""
    if importlib.util.find_spec("atheris") is None:
        pytest.skip("atheris is not installed")
    shutil.copytree(FOLDER / "corpus" / name, tmp_path / "corpus")
    command = [sys.executable, str(FOLDER / f"fuzz_{name}.py"), f"-max_total_time={SECONDS}", "-max_len=8192"]
    done = subprocess.run(
        [*command, "-rss_limit_mb=4096", str(tmp_path / "corpus")],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert "Done " in done.stderr
