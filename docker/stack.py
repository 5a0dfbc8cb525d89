#!/usr/bin/env python3
"""Runs the stack of `compose.yaml` as plain processes, without containers, and shows that it works.

.venv/bin/python docker/stack.py --work DIR      everything below, then the end; status 0 when all of it held
.venv/bin/python docker/stack.py --work DIR --keep     starts it and leaves it running until Ctrl-C

Each service of the file gets a loopback address of its own in place of its name, so commands, ports and Prometheus'
configuration hold as they are written. Entry point, environment, health check and stop signal are read from the
Dockerfile. `restart: always` is kept. Prometheus is Debian's package; Grafana is left out, and each query of its
dashboard is asked of Prometheus instead. Shown: all become healthy, tracks flow, Prometheus scrapes, every query has
data, the other instance takes over when the one that tracks is killed, everything ends in order.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
import urllib.parse
import urllib.request
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import dockerfile
import yaml
from optipmb_client import Subscriber
from optipmb_client.transport import Connection
from optipmb_schemas import Keys

if TYPE_CHECKING:
    from collections.abc import Callable

HERE: Final = Path(__file__).parent
OURS: Final = "optipmb:local"
LEFT_OUT: Final = {"grafana"}
DEADLINE_S: Final = 90.0
TAKEOVER_S: Final = 20.0
SCRAPE: Final = "1s"
STOPPED: Final = {0, 128 + signal.SIGTERM, -signal.SIGTERM}


class StackError(Exception):
    """Something of the stack does not do what it should."""


def say(text: str) -> None:
    """Print a line at once."""
    print(f"{time.strftime('%H:%M:%S')} {text}", flush=True)


class Stack:
    """The services of the file as processes.

    Args:
        work: folder for volumes, configurations and logs.
    """

    def __init__(self, work: Path) -> None:
        self.image = dockerfile.read(HERE / "Dockerfile")[-1]
        text = re.sub(r"\$\{\w+:-(\w+)\}", r"\1", (HERE / "compose.yaml").read_text(encoding="utf-8"))
        services: dict[str, dict[str, Any]] = yaml.safe_load(text)["services"]
        chosen = {name: value for name, value in services.items() if "profiles" not in value}
        self.services = {name: value for name, value in chosen.items() if name not in LEFT_OUT}
        self.addresses = {name: f"127.0.1.{number}" for number, name in enumerate(chosen, start=1)}
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self._work = work
        self._ends = threading.Event()
        self._keeper = threading.Thread(target=self._keep, daemon=True)

    def start(self) -> None:
        """Start everything, and start again what ends."""
        for name in self.services:
            self._start(name)
        self._keeper.start()

    def stop(self) -> dict[str, int]:
        """End everything by the image's stop signal; gives the exit statuses, None where it had to be killed."""
        self._ends.set()
        if self._keeper.is_alive():
            self._keeper.join()
        number = getattr(signal, self.image.last("STOPSIGNAL").value)
        statuses = {}
        for name, process in reversed(self.processes.items()):
            process.send_signal(number)
            with suppress(subprocess.TimeoutExpired):
                process.wait(float(str(self.services[name].get("stop_grace_period", "10s")).rstrip("s")))
            process.kill()
            statuses[name] = process.wait()
        return statuses

    def healthy(self, name: str) -> bool:
        """Ask a service as its container's health check would."""
        command = json.loads(self.image.last("HEALTHCHECK").value.partition("CMD")[2])
        environment = self._environment(name)
        return not subprocess.run(_found(command), env=environment, check=False, capture_output=True).returncode  # noqa: S603 - of the Dockerfile

    def endpoint(self, name: str, port: int) -> str:
        """Where a port of a service is."""
        return f"{self.addresses[name]}:{port}"

    def log(self, name: str) -> Path:
        """What a service has written."""
        return self._work / f"{name}.log"

    def _keep(self) -> None:
        while not self._ends.wait(0.2):
            for name, process in list(self.processes.items()):
                if process.poll() is not None and self.services[name].get("restart") == "always":
                    self._start(name)

    def _start(self, name: str) -> None:
        place = self._work / "volumes" / name
        place.mkdir(parents=True, exist_ok=True)
        with self.log(name).open("ab") as log:
            self.processes[name] = subprocess.Popen(  # noqa: S603 - commands of the compose file
                _found(self._command(name)), env=self._environment(name), cwd=place, stdout=log, stderr=log
            )

    def _command(self, name: str) -> list[str]:
        service = self.services[name]
        if service["image"] == OURS:
            entry = service.get("entrypoint") or self.image.last("ENTRYPOINT").words
        else:
            entry = [name, f"--web.listen-address={self.endpoint(name, 9090)}"]  # the only other one: Prometheus
        return [self._here(word, name) for word in (*entry, *service.get("command", []))]

    def _environment(self, name: str) -> dict[str, str]:
        service = self.services[name]
        values = self.image.environment() if service["image"] == OURS else {}
        values = {key: value for key, value in values.items() if key.startswith("OPTIPMB_")}
        values |= service.get("environment", {})
        clean = {key: value for key, value in os.environ.items() if not key.startswith("OPTIPMB_")}
        return clean | {key: self._here(value, name) for key, value in values.items()}

    def _here(self, text: str, name: str) -> str:
        """Put addresses for names, and folders of this machine for those of the container."""
        text = text.replace("0.0.0.0", self.addresses[name])  # noqa: S104 - it is what is replaced
        for host, address in self.addresses.items():
            text = re.sub(rf"\b{re.escape(host)}(?=:\d)", address, text)
        places = {"/tmp": self._work / "volumes" / name}  # noqa: S108 - it is what is replaced
        for volume in self.services[name].get("volumes", []):
            source, target = volume.split(":")[:2]
            places[target] = self._mounted(source)
        inside = "|".join(map(re.escape, sorted(places, key=len, reverse=True)))
        return re.sub(rf"(?<![\w/.])({inside})(?=/|$)", lambda match: str(places[match[1]]), text)

    def _mounted(self, source: str) -> Path:
        """Return a volume as a folder; a configuration as a copy with addresses for names."""
        folder = self._work / "volumes" / source.lstrip("./")
        folder.mkdir(parents=True, exist_ok=True)
        if source.startswith("."):
            for file in (HERE / source).iterdir():
                text = re.sub(r"(scrape|evaluation)_interval: \w+", rf"\1_interval: {SCRAPE}", file.read_text("utf-8"))
                for host, address in self.addresses.items():
                    text = re.sub(rf"\b{re.escape(host)}(?=:\d)", address, text)
                (folder / file.name).write_text(text, encoding="utf-8")
        return folder


class Watch:
    """Notes when tracks come, and from which instance."""

    def __init__(self, endpoint: str) -> None:
        self.seen: list[tuple[float, str]] = []
        self._subscriber = Subscriber("*/*/*", connect=endpoint)
        threading.Thread(target=self._read, daemon=True).start()

    def close(self) -> None:
        """Listen no more."""
        self._subscriber.close()

    def _read(self) -> None:
        for message in self._subscriber:
            instance = message.delivery.instance if message.delivery else ""
            self.seen.append((time.monotonic(), instance))


def ask(stack: Stack, query: str) -> list[Any]:
    """Return what Prometheus answers to a query.

    Raises:
        StackError: it refuses the query.
    """
    query = query.replace("$__rate_interval", "10s")
    url = f"http://{stack.endpoint('prometheus', 9090)}/api/v1/query?{urllib.parse.urlencode({'query': query})}"
    try:
        with urllib.request.urlopen(url, timeout=10) as response:
            return list(json.load(response)["data"]["result"])
    except urllib.error.HTTPError as error:
        raise StackError(f"Prometheus refuses {query}: {error.read().decode()}") from error
    except OSError:
        return []  # it is starting


def queries() -> list[str]:
    """Return every query of the dashboard."""
    dashboard = json.loads((HERE / "grafana/dashboards/optipmb.json").read_text(encoding="utf-8"))
    return [target["expr"] for panel in dashboard["panels"] for target in panel["targets"]]


def show(stack: Stack) -> None:
    """Go through all that the stack must do.

    Raises:
        StackError: it does not.
    """
    ours = [name for name, service in stack.services.items() if not service.get("healthcheck", {}).get("disable")]
    ours = [name for name in ours if stack.services[name]["image"] == OURS]
    _until(lambda: all(stack.healthy(name) for name in ours), f"{', '.join(ours)} are healthy")
    watch = Watch(f"tcp/{stack.endpoint('router', 7447)}")
    try:
        _until(lambda: len(watch.seen) > 20, "tracks of the demo flow")  # noqa: PLR2004 - two seconds of them
        targets = len(ours)
        _until(lambda: len(ask(stack, 'up{job="optipmb"} == 1')) == targets, f"Prometheus scrapes {targets} targets")
        _until(lambda: all(map(lambda query: ask(stack, query), queries())), f"all {len(queries())} queries have data")  # noqa: C417 - reads as said
        _take_over(stack, watch)
    finally:
        watch.close()


def _take_over(stack: Stack, watch: Watch) -> None:
    """Kill the instance that tracks, and wait for another one's tracks."""
    with Connection(f"tcp/{stack.endpoint('router', 7447)}") as connection:
        owners = {token.rpartition("/")[2] for token in connection.alive(Keys().all_owners())}
    if len(owners) != 1:
        raise StackError(f"expected one owner of the stream, found {sorted(owners) or 'none'}")
    (owner,) = owners
    _until(lambda: watch.seen[-1][1] == owner, f"tracks come from {owner}")
    killed = time.monotonic()
    stack.processes[owner].kill()
    say(f"killed {owner}")

    def taken() -> bool:
        return any(at > killed and instance not in {owner, ""} for at, instance in watch.seen)

    _until(taken, "the other instance has taken over", TAKEOVER_S)
    first = next(at for at, instance in watch.seen if at > killed and instance != owner)
    say(f"the first tracks of the other instance came {first - killed:.2f} s after the kill")
    _until(lambda: stack.healthy(owner), f"{owner} is back")


def _until(true: Callable[[], Any], what: str, deadline_s: float = DEADLINE_S) -> None:
    """Ask again and again.

    Raises:
        StackError: it is not true at the deadline.
    """
    began = time.monotonic()
    while not true():
        if time.monotonic() - began > deadline_s:
            raise StackError(f"not within {deadline_s:g} s: {what}")
        time.sleep(0.2)
    say(f"{what} (after {time.monotonic() - began:.1f} s)")


def _found(command: list[str]) -> list[str]:
    """Take a program from beside this Python, where it is there."""
    beside = Path(sys.executable).parent / command[0]
    return [str(beside) if beside.exists() else command[0], *command[1:]]


def main(arguments: list[str]) -> int:
    """Run the command line; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True, help="folder for volumes and logs")
    parser.add_argument("--keep", action="store_true", help="start it, and leave it running until Ctrl-C")
    options = parser.parse_args(arguments)
    if shutil.which("prometheus") is None:
        parser.error("there is no prometheus command; Debian's package is called prometheus")
    stack = Stack(options.work.absolute())
    failed = ""
    try:
        stack.start()
        if options.keep:
            say(f"router tcp/{stack.endpoint('router', 7447)}, Prometheus http://{stack.endpoint('prometheus', 9090)}")
            signal.pause()
        show(stack)
    except (StackError, KeyboardInterrupt) as error:
        failed = str(error)
    statuses = stack.stop()
    wrong = {name: status for name, status in statuses.items() if status not in STOPPED}
    say(f"ended with {statuses}")
    if failed or wrong:
        say(f"FAILED: {failed or 'not ended in order: ' + str(wrong)}; logs are in {options.work}")
        return 1
    say("the stack works")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
