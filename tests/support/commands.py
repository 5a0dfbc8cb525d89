"""The client's command, run as users run it: in a process of its own."""

import json
import signal
import subprocess
import sys
from typing import Any

import forked
import pytest
from optipmb_tools.cli import run


def optipmb(*arguments: object, timeout: float = 240.0) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-m", "optipmb_tools", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False)


def run_here(capsys: pytest.CaptureFixture[str], *arguments: object) -> "subprocess.CompletedProcess[str]":
    """Run the client's command in this process, where the process is not the claim: imports take two seconds."""
    words = [str(one) for one in arguments]
    capsys.readouterr()
    status = run(words)
    shown = capsys.readouterr()
    return subprocess.CompletedProcess(words, status, shown.out, shown.err)


def start(*arguments: object, fresh: bool = False, **how: Any) -> "subprocess.Popen[str]":
    """Start the client's command and return the running process; a new interpreter where a start is the claim."""
    command = ("optipmb_tools", *map(str, arguments))
    return forked.start(*command, fresh=fresh, stdout=subprocess.PIPE, stderr=subprocess.PIPE, **how)


def result_of(done: "subprocess.CompletedProcess[str]") -> Any:
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def kill(process: "subprocess.Popen[str]") -> None:
    process.send_signal(signal.SIGKILL)
    process.communicate(timeout=120)
