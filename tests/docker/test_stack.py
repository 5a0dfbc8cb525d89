"""The stack of the compose file, run as processes."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

STACK = Path(__file__).parents[2] / "docker" / "stack.py"
DEADLINE_S = 200


@pytest.mark.skipif(shutil.which("prometheus") is None, reason="needs prometheus, a package of Debian's")
def test_the_stack_works(tmp_path: Path) -> None:
    """Tracks flow, Prometheus scrapes, every query of the dashboard has data, one takes over, all end in order."""
    command = [sys.executable, str(STACK), "--work", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=DEADLINE_S, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "the other instance has taken over" in done.stdout
    assert done.stdout.rstrip().endswith("the stack works")
