"""What one and two members carry on this machine, and what a frame costs in each process, at rates that are asked for.

python benchmarks/members.py [--rates HZ,HZ,...] [--objects N] [--streams N] [--seconds S] [--turns N]

In turns with one member and with two: a NATS server, a router, the members, and `load.py`, which sends at the same
rate however much is tracked. Frames are counted by the members.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

from optipmb_schemas import ServiceStatus
from scaling import KEYS, Cluster, even, used, wait

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))

from router import Node

import optipmb

SETTLE_S = 3.0


def measured(arguments: argparse.Namespace, count: int, rate: float) -> str:
    """Return a line for so many members and frames per second."""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as context:
        cluster = Cluster(Path(folder), context)
        for _ in range(count):
            cluster.add()
        even(cluster)
        node = context.enter_context(Node(cluster.router.endpoint))

        def frames() -> int:
            return sum(node.ask(KEYS.status(f"m{index}"), ServiceStatus).frames for index in range(count))

        command = [sys.executable, str(Path(__file__).with_name("load.py")), "--connect", cluster.router.endpoint]
        load = {"streams": arguments.streams, "rate": rate / arguments.streams, "objects": arguments.objects}
        options = [f"--{name}={value}" for name, value in (load | {"seconds": 10 * arguments.seconds}).items()]
        quiet = subprocess.DEVNULL
        with subprocess.Popen([*command, *options], stdout=quiet, stderr=quiet) as generator:  # noqa: S603 - this project's
            try:
                wait("frames of all streams", lambda: frames() > rate)
                time.sleep(SETTLE_S)
                before, tracked, sent = cluster.sample(), frames(), used(generator.pid)[0]
                time.sleep(arguments.seconds)
                after, tracked, sent = cluster.sample(), frames() - tracked, used(generator.pid)[0] - sent
            finally:
                generator.kill()
    spent = {
        "members": after.members_cpu_s - before.members_cpu_s,
        "router": after.router_cpu_s - before.router_cpu_s,
        "NATS": after.nats_cpu_s - before.nats_cpu_s,
        "generator": sent,
    }
    each = ", ".join(f"{name} {1e3 * seconds / tracked:.2f}" for name, seconds in spent.items())
    carried = tracked / (after.at_s - before.at_s)
    return f"{count} members, {rate:g} frames a second sent: {carried:.0f} tracked; ms of a frame: {each}"


def main() -> None:
    """Measure, and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rates", default="100,300,900", help="frames per second of all streams")
    parser.add_argument("--objects", type=int, default=100)
    parser.add_argument("--streams", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=12.0)
    parser.add_argument("--turns", type=int, default=2)
    arguments = parser.parse_args()
    optipmb.warm_up()
    for rate in map(float, arguments.rates.split(",")):
        for count in (1, 2) * arguments.turns:
            print(measured(arguments, count, rate), flush=True)  # noqa: T201 - the result


if __name__ == "__main__":
    main()
