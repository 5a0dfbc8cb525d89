"""What tests have started ends with them."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import guard
from processes import wait_until_ended

STARTS = """
import subprocess, sys
import forked, guard
guard.begin()
forked.ALLOWED = True
endless = "import signal; signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM}); print(flush=True); signal.pause()"
nested = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {endless!r}], start_new_session=True)"
service = forked.start("optipmb_service", "--listen", "tcp/127.0.0.1:0", "--store", "none", stderr=subprocess.DEVNULL)
started = [subprocess.Popen([sys.executable, "-c", one], stdout=subprocess.PIPE) for one in (endless, nested)]
for one in started:
    one.stdout.readline()
print(service.pid, *(one.pid for one in started), flush=True)
service.wait()
"""


def test_what_a_killed_test_process_has_started_ends_too() -> None:
    """SIGKILL of a test process ends its forked services, its new interpreters, and what these have started."""
    support = Path(__file__).parents[1] / "support"
    command = [sys.executable, "-c", STARTS]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, env=os.environ | {"PYTHONPATH": str(support)}
    ) as tests:
        assert tests.stdout is not None
        pids = {int(word) for word in tests.stdout.readline().split()}
        below = guard.marked(f"{guard.VARIABLE}={tests.pid}")
        assert len(pids) == 3
        assert len(below) > 3
        tests.send_signal(signal.SIGKILL)
    assert wait_until_ended(pids | below, 60.0) == set()
