"""The containers of the compose file under a project name of their own, with a client container."""

from __future__ import annotations

import json
import re
import time
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import container_engine
import yaml
from container_engine import EngineError

if TYPE_CHECKING:
    from container_engine import Engine

COMPOSE: Final = Path(__file__).with_name("compose.yaml")
PROJECT: Final = "optipmb-check"
OURS: Final = "optipmb:local"
LABEL: Final = "com.docker.compose"
CLIENT: Final = "client"


class CheckError(Exception):
    """A check failed; the text says which."""


class Stack:
    """The services of the file that start by themselves.

    Args:
        found: the engine that runs them.

    Attributes:
        services: what the file says of each; those whose images are not to be had are taken out.
        ours: services with our image.
        checked: services of ours with a health check.
    """

    def __init__(self, found: Engine) -> None:
        self.engine = found
        services: dict[str, dict[str, Any]] = yaml.safe_load(COMPOSE.read_text(encoding="utf-8"))["services"]
        self.services = {name: one for name, one in services.items() if "profiles" not in one}
        self.ours = [name for name, one in self.services.items() if one["image"] == OURS]
        self.checked = [name for name in self.ours if not self.services[name].get("healthcheck", {}).get("disable")]

    def start(self) -> None:
        """Start the services, and a client that does nothing by itself."""
        self.compose("up", "-d", "--no-build", *self.services)
        labels = f"--label {LABEL}.project={PROJECT} --label {LABEL}.service={CLIENT}"
        confined = f"--read-only --tmpfs /tmp --cap-drop ALL --stop-signal KILL --network {PROJECT}_default"
        self.engine.run(*f"run --detach {labels} {confined} --entrypoint sleep {OURS} 1800".split())

    def remove(self) -> None:
        """Remove containers, networks and volumes of this project in any state."""
        mine = f"label={LABEL}.project={PROJECT}"
        for name in self.engine.run("ps", "--all", "--quiet", "--filter", mine).split():
            self.engine.run("rm", "--force", "--volumes", name)
        with suppress(CheckError):
            self.compose("down", "--volumes", "--remove-orphans")
        for kind in (["ps", "--all"], ["network", "ls"], ["volume", "ls"]):
            left = self.engine.run(*kind, "--quiet", "--filter", mine).split()
            if left:
                raise CheckError(f"left behind by {kind}: {left}")

    def logs(self, folder: Path) -> None:
        """Write what every container has said into a folder."""
        for name in self.services:
            with suppress(EngineError, CheckError):
                (folder / f"{name}.log").write_text(self.log(name), encoding="utf-8")

    def compose(self, *words: str) -> None:
        """Run a command of the compose tool.

        Raises:
            CheckError: it fails.
        """
        command = [*self.engine.compose, "--project-name", PROJECT, "--file", str(COMPOSE), *words]
        done = container_engine.call(command, self.engine.environment)
        if done.returncode:
            raise CheckError(f"{' '.join(command)}: status {done.returncode}: {done.stderr[-2000:]}")

    def container(self, service: str) -> str:
        """The container of a service.

        Raises:
            CheckError: there is not exactly one.
        """
        filters = [f"label={LABEL}.project={PROJECT}", f"label={LABEL}.service={service}"]
        words = [word for one in filters for word in ("--filter", one)]
        found = self.engine.run("ps", "--all", "--quiet", "--no-trunc", *words).split()
        if len(found) != 1:
            raise CheckError(f"{service} has {len(found)} containers")
        return found[0]

    def healthy(self, service: str) -> bool:
        """Whether the image's health check holds; Podman runs it when asked, as it needs systemd to do so by itself."""
        container = self.container(service)
        if self.engine.program == "podman":
            return self.engine.works("healthcheck", "run", container)
        return bool(self.engine.inspect(container)["State"]["Health"]["Status"] == "healthy")

    def restarts(self, container: str) -> int:
        """How often a container was started again by itself."""
        return int(self.engine.inspect(container)["RestartCount"])

    def age_s(self, container: str) -> float:
        """Seconds since a container started."""
        return time.time() - _instant(self.engine.inspect(container)["State"]["StartedAt"])

    def ready_s(self, service: str) -> float:
        """Seconds from the start of a container to the line in its log that says ready; 0 before that line."""
        container = self.container(service)
        text = self.engine.run("logs", "--timestamps", container)
        said = [line.split()[0] for line in text.splitlines() if line.split()[1:2] == ["ready"]]
        return _instant(said[0]) - _instant(self.engine.inspect(container)["State"]["StartedAt"]) if said else 0.0

    def restored(self, service: str) -> list[str]:
        """The streams that a service has continued, as its log says."""
        lines = self.log(service).splitlines()
        events = [json.loads(line) for line in lines if line.startswith("{")]
        return [one["stream"] for one in events if one["event"] == "session_restored"]

    def log(self, service: str) -> str:
        """What a container has said on both outputs."""
        said = container_engine.call([self.engine.program, "logs", self.container(service)], self.engine.environment)
        return said.stdout + said.stderr

    def owner(self, frames: int) -> str:
        """The service that tracks the replay's stream and has at least so many frames of it; none: empty."""
        text = self.engine.run(
            "exec", self.container(CLIENT), "optipmb", "status", "--json", "--connect", "tcp/router:7447"
        )
        for service in json.loads(text)["services"]:
            for session in service["sessions"]:
                if session["stream"].endswith("/0001") and session["frames"] >= frames:
                    return str(service["instance"])
        return ""


def _instant(text: str) -> float:
    return datetime.fromisoformat(re.sub(r"(\.\d{6})\d*", r"\1", text)).timestamp()
