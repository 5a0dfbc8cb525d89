#!/usr/bin/env python3
"""Builds the image, runs the compose file's stack in containers, and checks its behaviour; prints a table.

make containers

Docker is used where it answers, else Podman (`sh docker/install-engine.sh` installs it on Debian). Images that cannot
be pulled are made from Debian's packages under the same names; the table says which. The stack has a project name of
its own and is removed at the end with its networks and volumes; images are kept.
"""

from __future__ import annotations

import argparse
import json
import re
import signal
import sys
import tempfile
import time
import urllib.parse
import urllib.request
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import container_engine
import image_scan
from container_engine import Engine, EngineError, NoEngineError, SystemLog
from container_stack import CLIENT, OURS, CheckError, Stack

if TYPE_CHECKING:
    from collections.abc import Callable

HERE: Final = Path(__file__).parent
DATA: Final = "--dataset scene --sequences 0001 --option frames=300"
KILL_AT: Final = 30
"""Frames after which the service that tracks is killed; the rest is time for a slow machine to do so."""
READY_S: Final = 60.0
CHANGED_MB: Final = 20
"""Difference between the size of the image and that on its page."""
WAIT_S: Final = 90.0
INTERVALS: Final = {"$__rate_interval": "20s"}
"""Grafana's own variables: four scrape intervals."""
TERMINATED: Final = 128 + signal.SIGTERM
STATUSES: Final = {"replay": TERMINATED}
"""Exit statuses after the stop signal that are not 0: the replay is interrupted."""
MIDDLE_S: Final = (5.0, 15.0)
"""Since its start; it takes twenty seconds, and its container then starts again."""
CONFINED: Final = """\
id -u
sed -n 's/^\\(CapEff\\|CapBnd\\|NoNewPrivs\\|Seccomp\\):\\t*/\\1=/p' /proc/1/status
for place in / /opt/optipmb /etc /tmp; do touch $place/trial 2>/dev/null && echo writes=$place; done; rm -f /tmp/trial
cd /sys/fs/cgroup
cat memory.max memory/memory.limit_in_bytes 2>/dev/null | sed 's/^/memory=/'
cat cpu.max cpu/cpu.cfs_quota_us cpu/cpu.cfs_period_us 2>/dev/null | xargs | awk '{ print "cpus=" $1 / $2 }'
awk '$2 == "/" { print "root=" substr($4, 1, 2) } $2 == "/tmp" { print "tmp=" $4 }' /proc/mounts
"""
CONSUMERS: Final = """\
import json, os, subprocess, time, urllib.request
import grpc
from optipmb_schemas.protobuf import tracking_pb2 as pb, tracking_pb2_grpc as rpc
over_http, ends = [], time.monotonic() + 60
while not over_http and time.monotonic() < ends:
    with urllib.request.urlopen("http://edge:8080/api/v1/tracks?stream=*/*/*", timeout=10) as answer:
        over_http = [one["stream"] for one in json.load(answer)]
listed = rpc.TrackingServiceStub(grpc.insecure_channel("edge:50051")).ListStreams(pb.ListStreamsRequest(), timeout=10)
ready = []
for arguments, settings in (
    ("mqtt --broker mqtt://router:1883 --connect tcp/router:7447", {}),
    ("ros2 --connect tcp/router:7447", {"OPTIPMB_ROS2": '{"streams": {"a/b/c": {"detections": "/boxes"}}}'}),
    ("run", {"OPTIPMB_TRACES": "true", "OPTIPMB_STORE": "none"}),
):
    command = ["timeout", "60", "optipmb-service", *arguments.split()]
    with subprocess.Popen(command, env=os.environ | settings, stdout=subprocess.PIPE, text=True) as process:
        ready += [arguments.split()[0]] if process.stdout.readline().startswith("ready ") else []
        process.terminate()
print(json.dumps([over_http, [one.session.stream for one in listed.streams], ready]))
"""
"""What a consumer does: read JSON and gRPC of the gateway, and start the bridges and a service with traces."""


class Check:
    """One run through everything.

    Args:
        found: the engine.
        work: folder for logs and intermediate files.
    """

    def __init__(self, found: Engine, work: Path) -> None:
        self.engine = found
        self.work = work
        self.rows: list[tuple[str, str, str]] = []
        self.stack = Stack(found)

    def show(self, step: str, what: str, figure: str = "") -> None:
        """Note what a step has shown, and print it at once."""
        self.rows.append((step, what, figure))
        print(f"{time.strftime('%H:%M:%S')} {step}: {what}{f' ({figure})' if figure else ''}", flush=True)

    def table(self) -> str:
        """Everything that was shown, as Markdown."""
        rows = [("step", "shown", "figure"), ("---", "---", "---"), *self.rows]
        return "\n".join(f"| {' | '.join(row)} |" for row in rows)

    def images(self) -> None:
        """Build our image as the Dockerfile has it, and pull the others."""
        settings, hosts = container_engine.index_settings()
        began = time.monotonic()
        with tempfile.TemporaryDirectory() as secret:
            secrets = container_engine.secrets(Path(secret), settings) if settings else []
            options = [*self.engine.build_options(), *secrets, "--file", str(HERE / "Dockerfile"), "--tag", OURS]
            log = self.engine.run("build", *options, str(HERE.parent))
        (self.work / "build.log").write_text(log, encoding="utf-8")
        self.show("image", "built from the Dockerfile as it ships", f"{time.monotonic() - began:.0f} s")
        base = self.engine.inspect(container_engine.PYTHON_IMAGE)
        archive = self.work / "image.tar"
        try:
            self.engine.run("save", "--output", str(archive), OURS)
            found = image_scan.scan(archive, len(base["RootFS"]["Layers"]), hosts)
        finally:
            archive.unlink(missing_ok=True)
        if found.wrong:
            raise CheckError("in the image:\n" + "\n".join(found.wrong))
        size = f"{found.bytes / 1e6:.0f} MB, {found.added / 1e6:.0f} MB of them above the base image"
        self.show("size", "of all layers, not compressed", size)
        page = (HERE.parent / "docs/deployment.md").read_text(encoding="utf-8")
        said = [int(one) for one in re.findall(r"(\d+) MB above a base", page)]
        if not said or any(abs(one - found.added / 1e6) > CHANGED_MB for one in said):
            raise CheckError(
                f"docs/deployment.md says {said} MB above the base image, it is {found.added / 1e6:.0f} MB"
            )
        what = "only root can write, but in the volume; no program runs as its owner or its group; in our layers no "
        self.show("scan", what + "settings of pip, keys, tokens, passwords or private hosts", f"{found.files} files")
        for name, service in list(self.stack.services.items()):
            if service["image"] == OURS:
                continue
            try:
                self.show(f"image of {name}", self.engine.image(service["image"], self.work))
            except EngineError as error:
                self.show(f"image of {name}", f"left out: {error}")
                del self.stack.services[name]

    def start(self) -> None:
        """Start the stack and a client, and wait until all containers with a health check are healthy."""
        began = time.monotonic()
        self.stack.start()
        waiting = set(self.stack.checked)
        ready = {}
        while waiting:
            for name in sorted(waiting):
                if self.stack.healthy(name):
                    ready[name] = time.monotonic() - began
                    waiting.discard(name)
            if time.monotonic() - began > READY_S:
                raise CheckError(f"not healthy after {READY_S:g} s: {', '.join(sorted(waiting))}")
            time.sleep(0.2)
        what = f"{len(self.stack.services)} containers on a network; health checks of {', '.join(sorted(ready))} hold"
        self.show("start", what, f"healthy {max(ready.values()):.1f} s after `up`")
        starts = {name: _wait(partial(self.stack.ready_s, name), f"{name} is ready") for name in self.stack.checked}
        self.show("time to ready", "from the start of the container to the service's own word", _seconds(starts))
        if self.engine.works("exec", self.stack.container(CLIENT), "optipmb-service", "health"):
            raise CheckError("the health check holds where no service runs")
        self.show("health check", "fails in a container where no service runs")

    def confinement(self) -> None:
        """Ask from inside what each container may do."""
        for name in self.stack.ours:
            said = self.engine.run("exec", self.stack.container(name), "sh", "-c", CONFINED).split()
            facts = dict(word.partition("=")[::2] for word in said)
            expected = {"CapEff": "0" * 16, "CapBnd": "0" * 16, "NoNewPrivs": "1", "Seccomp": "2"}
            limits = self.stack.services[name]["deploy"]["resources"]["limits"]
            expected |= {
                "root": "ro",
                "writes": "/tmp",
                "memory": str(_bytes(limits["memory"])),
                "cpus": limits["cpus"],
            }
            wrong = {key: facts.get(key) for key, value in expected.items() if facts.get(key) != value}
            if wrong or said[0] != str(image_scan.USER) or "size=65536k" not in facts["tmp"]:
                raise CheckError(f"{name} is not confined as the compose file says: {said}")
        what = "user 10001, no capabilities, no new privileges, seccomp, read-only but for 64 MB of /tmp, "
        self.show(
            "confinement", f"{what}memory and processors limited, as seen from inside {', '.join(self.stack.ours)}"
        )

    def network(self) -> None:
        """Names resolve inside, and ports are open on the loopback only."""
        client = self.stack.container(CLIENT)
        for name in self.stack.services:
            if name != "replay" and not self.engine.works("exec", client, "getent", "hosts", name):
                raise CheckError(f"the name {name} does not resolve")
        published = []
        for name in self.stack.services:
            ports = self.engine.inspect(self.stack.container(name))["NetworkSettings"]["Ports"] or {}
            published += [(one["HostIp"], one["HostPort"]) for bound in ports.values() for one in bound or []]
        if {host for host, _ in published} != {"127.0.0.1"}:
            raise CheckError(f"ports are open to others: {published}")
        with urllib.request.urlopen("http://127.0.0.1:8080/readyz", timeout=10) as answer:
            state = json.load(answer)["state"]
        self.show("network", "services have names; ports open on 127.0.0.1 only", f"service-a says {state} on the host")

    def consumers(self) -> None:
        """Read tracks over HTTP and gRPC, and start what serves other consumers, from the same image."""
        client = self.stack.container(CLIENT)
        over_http, over_grpc, ready = json.loads(self.engine.run("exec", client, "python", "-c", CONSUMERS))
        if not over_http or not over_grpc or ready != ["mqtt", "ros2", "run"]:
            raise CheckError(f"JSON has {over_http}, gRPC {over_grpc}, ready are {ready}")
        what = "JSON and gRPC give the replay's stream; the bridges to MQTT and ROS 2 and a service with traces start"
        self.show("consumers", what)

    def senders(self) -> None:
        """Send a frame by the command that the first service prints."""
        found = re.search(r"'(http://\S+)' -H 'authorization: (\S+ \S+)' .* -d '(.*)'", self.stack.log("service-a"))
        if found is None:
            raise CheckError("the log of service-a has no command that sends detections")
        headers = {"authorization": found[2], "content-type": "application/json"}
        request = urllib.request.Request(found[1], found[3].encode(), headers)  # noqa: S310 - of the compose file
        with urllib.request.urlopen(request, timeout=30) as answer:  # noqa: S310 - likewise
            body = json.load(answer)
        if not body["accepted"] or not body["tracks"]:
            raise CheckError(f"service-a answers {body}")
        self.show("senders", "the `curl` command in the log of service-a sends a frame and gets its tracks")

    def takeover(self) -> None:
        """Replay a scene, kill the service that tracks it, and compare the result with tracking in one process."""
        client = self.stack.container(CLIENT)
        self.engine.run("exec", client, "sh", "-c", f"optipmb track {DATA} --out /tmp/track --json")
        command = f"optipmb replay {DATA} --speed 1 --patience 30 --connect tcp/router:7447 --out /tmp/replay --json"
        with ThreadPoolExecutor(1) as pool:
            replay = pool.submit(self.engine.run, "exec", client, "sh", "-c", command)
            owner = _wait(lambda: self.stack.owner(KILL_AT), f"{KILL_AT} frames of the replay were tracked")
            before = self.stack.container(owner)
            restarts = self.stack.restarts(before)
            # From outside, as the kernel does when memory runs out: `kill` of the engine would count as wanted.
            end = f"kill -KILL {self.engine.inspect(before)['State']['Pid']}"
            self.engine.run(*f"run --rm --pid host --user 0:0 --entrypoint sh {OURS} -c".split(), end)
            result = json.loads(replay.result())
        others = [
            name
            for name in self.stack.checked
            if name != owner and any(stream.endswith("/0001") for stream in self.stack.restored(name))
        ]
        if len(others) != 1:
            raise CheckError(f"{owner} was killed, and the replay's stream was continued by {others}")
        (sequence,) = result["sequences"]
        if (sequence["returned"], sequence["missing"]) != (sequence["frames"], 0):
            raise CheckError(f"frames are missing: {sequence}")
        if not self.engine.works("exec", client, "cmp", *(f"/tmp/{one}/0001.txt" for one in ("track", "replay"))):
            raise CheckError("the tracks are not those of a run without a kill")
        count = sequence["frames"]
        what = f"SIGKILL to {owner} in a replay; {others[0]} goes on: {count} frames of {count}, "
        waited = f"no frame waited longer than {result['latency']['max_ms'] / 1e3:.2f} s"
        self.show("takeover", f"{what}ids, boxes and times byte-equal to tracking without a service", waited)
        began = time.monotonic()
        _wait(lambda: self.stack.restarts(before) > restarts and self.stack.healthy(owner), f"{owner} is healthy again")
        self.show(
            "restart", f"`restart: always` starts {owner} again", f"healthy {time.monotonic() - began:.1f} s later"
        )

    def metrics(self) -> None:
        """Prometheus takes its configuration, scrapes everybody, and answers every query of the dashboard."""
        self.engine.run(
            "exec", self.stack.container("prometheus"), "promtool", "check", "config", "/etc/prometheus/prometheus.yml"
        )
        targets = len(self.stack.checked)
        _wait(lambda: len(ask('up{job="optipmb"} == 1')) == targets, f"Prometheus scrapes {targets} targets")
        dashboard = json.loads((HERE / "grafana/dashboards/optipmb.json").read_text(encoding="utf-8"))
        queries = {target["expr"] for panel in dashboard["panels"] for target in panel["targets"]}
        waiting = set(queries)

        def answered() -> bool:
            waiting.difference_update([query for query in waiting if ask(query)])
            return not waiting

        _wait(answered, f"these queries have data: {waiting}")
        figure = f"{len(queries)} queries, {targets} targets"
        self.show(
            "metrics",
            "configuration and alerts are valid, all are scraped, each query of the dashboard has data",
            figure,
        )
        if "grafana" in self.stack.services:
            with urllib.request.urlopen("http://127.0.0.1:3000/api/search?query=", timeout=10) as answer:
                titles = [one["title"] for one in json.load(answer)]
            if dashboard["title"] not in titles:
                raise CheckError(f"Grafana has {titles}, not {dashboard['title']}")
            self.show("Grafana", "has the dashboard")

    def stop(self) -> None:
        """End every container by its stop signal, within its time."""
        ends = {}
        for name in sorted(self.stack.services, key=lambda name: (name == "router", name != "replay")):
            container = self.stack.container(name)
            grace = float(str(self.stack.services[name].get("stop_grace_period", "10s")).rstrip("s"))
            if name in STATUSES:
                _wait(partial(self._in_the_middle, container), "the middle of a replay")
            began = time.monotonic()
            self.engine.run("stop", container)
            ends[name] = time.monotonic() - began
            status = self.engine.inspect(container)["State"]["ExitCode"]
            if status != STATUSES.get(name, 0) or ends[name] > grace:
                raise CheckError(f"{name} ended with status {status} after {ends[name]:.1f} s of {grace:g} s")
        what = f"the stop signal ends all with status 0, the replay with {TERMINATED}"
        self.show("stop", what, f"{max(ends.values()):.1f} s at most, of {grace:g} s")

    def _in_the_middle(self, container: str) -> bool:
        """Whether a replay is neither starting, when it would not heed a signal, nor about to end by itself."""
        return MIDDLE_S[0] < self.stack.age_s(container) < MIDDLE_S[1]


def ask(query: str) -> list[Any]:
    """What Prometheus answers to a query; nothing while it starts."""
    for name, value in INTERVALS.items():
        query = query.replace(name, value)
    url = f"http://127.0.0.1:9090/api/v1/query?{urllib.parse.urlencode({'query': query})}"
    try:
        with urllib.request.urlopen(url, timeout=10) as response:
            return list(json.load(response)["data"]["result"])
    except urllib.error.HTTPError as error:
        raise CheckError(f"Prometheus refuses {query}: {error.read().decode()}") from error
    except OSError:
        return []


def _wait(true: Callable[[], Any], what: str) -> Any:
    """Ask until the answer is true, and return it."""
    end = time.monotonic() + WAIT_S
    while not (answer := true()):
        if time.monotonic() > end:
            raise CheckError(f"not within {WAIT_S:g} s: {what}")
        time.sleep(0.3)
    return answer


def _seconds(values: dict[str, float]) -> str:
    return ", ".join(f"{name} {value:.1f} s" for name, value in values.items())


def _bytes(text: str) -> int:
    return int(text[:-1]) << {"k": 10, "m": 20, "g": 30}[text[-1]]


def main(arguments: list[str]) -> int:
    """Run the command line; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path("out/containers"), help="folder for logs")
    parser.add_argument("--optional", action="store_true", help="status 0, said clearly, where no engine runs")
    options = parser.parse_args(arguments)
    options.work.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    log = SystemLog()
    try:
        found, origin = container_engine.find(options.work)
    except NoEngineError as error:
        log.close()
        print(f"NO CONTAINER HAS RUN: {error}", flush=True)
        return 0 if options.optional else 1
    check = Check(found, options.work)
    version = found.run("version", "--format", "{{.Client.Version}}").strip()
    how = ", with settings for a machine without systemd" if found.restricted else ""
    check.show("engine", f"{found.program} {version}{how}")
    check.show("base image", f"{container_engine.PYTHON_IMAGE}: {origin}", f"{time.monotonic() - began:.0f} s")
    failed = ""
    try:
        check.stack.remove()
        check.images()
        for step in (
            check.start,
            check.confinement,
            check.network,
            check.consumers,
            check.senders,
            check.takeover,
            check.metrics,
            check.stop,
        ):
            step()
    except (CheckError, EngineError, OSError, KeyboardInterrupt) as error:
        failed = str(error) or "interrupted"
    finally:
        check.stack.logs(options.work)
        check.stack.remove()
        log.close()
    if failed:
        print(f"FAILED: {failed}\nlogs are in {options.work}", flush=True)
        return 1
    check.show("end", "no container, network or volume is left", f"{time.monotonic() - began:.0f} s in all")
    print(f"\n{check.table()}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
