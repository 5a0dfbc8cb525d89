"""A container engine, Docker or Podman, with workarounds for no registry, no systemd and no full root."""

from __future__ import annotations

import json
import os
import re
import shutil
import socket
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

LABEL: Final = "optipmb.made-from"
"""Marks images that were made here in place of those that cannot be pulled."""
PYTHON_IMAGE: Final = "python:3.11-slim-bookworm"
TRIAL: Final = "optipmb-trial"
PULL_S: Final = 600
COMMAND_S: Final = 900

RESTRICTED: Final = """\
# For machines without systemd, with both kinds of control groups, where even root may not raise limits.
[containers]
default_ulimits = ["nofile=1024:1024", "nproc=1024:1024"]
[engine]
runtime = "runc"
cgroup_manager = "cgroupfs"
events_logger = "file"
[engine.runtimes]
runc = ["/usr/bin/runc", "/usr/sbin/runc", "/usr/local/sbin/runc"]
[network]
network_backend = "netavark"
"""
PROMETHEUS: Final = f"""\
FROM {PYTHON_IMAGE} AS package
WORKDIR /tmp
RUN apt-get update -qq && apt-get download -qq prometheus && dpkg -x prometheus_*.deb /opt/prometheus
FROM {PYTHON_IMAGE}
COPY --from=package /opt/prometheus/usr/bin /bin
RUN install -d -o nobody -g nogroup /prometheus
USER nobody
WORKDIR /prometheus
VOLUME /prometheus
ENTRYPOINT ["/bin/prometheus"]
LABEL {LABEL}="Debian's package"
"""
DEBIAN: Final = (
    "mmdebstrap", "--quiet", "--variant=minbase", "--include=python3,python3-venv,ca-certificates",
    "--dpkgopt=path-exclude=/usr/share/man/*", "--dpkgopt=path-exclude=/usr/share/locale/*",
    # The official image has its Python in /usr/local, with pip.
    '--customize-hook=chroot "$1" python3 -m venv /usr/local', "bookworm",
)  # fmt: skip


class EngineError(Exception):
    """A command of the engine failed; the text says which, and how."""


class NoEngineError(EngineError):
    """This machine has no engine that runs containers; the text lists the attempts."""


class Engine:
    """The commands of an engine.

    Args:
        program: `docker` or `podman`.
        environment: variables of its commands in addition to this process's own environment.
    """

    def __init__(self, program: str, environment: dict[str, str]) -> None:
        self.program = program
        self.environment = os.environ | environment
        self.restricted = "CONTAINERS_CONF" in environment
        self.quiet = ["--log-level", "error"]  # Podman warns at every call about missing systemd
        provider = [str(Path(sys.executable).with_name("podman-compose")), "--podman-args=--log-level=fatal"]
        self.compose = ["docker", "compose"] if program == "docker" else provider

    def run(self, *words: str, timeout_s: float = COMMAND_S, stdin: str = "") -> str:
        """Run a command of the engine and return its standard output.

        Args:
            words: the command.
            timeout_s: longest duration.
            stdin: its standard input.

        Raises:
            EngineError: it fails.
        """
        done = call([self.program, *self.quiet, *words], self.environment, timeout_s, stdin)
        if done.returncode:
            said = (done.stdout + done.stderr)[-2000:]
            raise EngineError(f"{self.program} {' '.join(words[:6])}: status {done.returncode}: {said}")
        return done.stdout

    def works(self, *words: str, timeout_s: float = COMMAND_S) -> bool:
        """Whether a command of the engine ends with status 0."""
        return not call([self.program, *self.quiet, *words], self.environment, timeout_s).returncode

    def inspect(self, name: str) -> dict[str, Any]:
        """What the engine knows of a container or image.

        Raises:
            EngineError: there is none.
        """
        return dict(json.loads(self.run("inspect", name))[0])

    def image(self, name: str, work: Path) -> str:
        """See that an image is here: as it is, pulled, or made from Debian's packages under its name; says how.

        Raises:
            EngineError: it is not to be had.
        """
        full = name if name.count("/") > 1 else f"docker.io/{name if '/' in name else f'library/{name}'}"
        if self.works("image", "inspect", full):
            made = (self.inspect(full).get("Config") or {}).get("Labels") or {}
            return f"made from {made[LABEL]}, kept" if LABEL in made else "here already"
        if self.works("pull", full, timeout_s=PULL_S):
            return "pulled"
        if name == PYTHON_IMAGE:
            return self._make_python(full, work)
        if name.startswith("prom/prometheus:"):
            self.run("build", *self.build_options(), "--tag", full, "--file", "-", str(_empty(work)), stdin=PROMETHEUS)
            return "made from Debian's package"
        raise EngineError(f"{name} cannot be pulled, and is in no package registry")

    def build_options(self) -> list[str]:
        """How images are built: Podman needs to be asked for health checks, and takes the machine's own network."""
        return [] if self.program == "docker" else ["--format", "docker", "--network", "host"]

    def _make_python(self, name: str, work: Path) -> str:
        if shutil.which("mmdebstrap") is None:
            raise NoEngineError(f"{name} cannot be pulled, and without mmdebstrap not be made")
        root = work / "base.tar"
        try:
            done = call([*DEBIAN, str(root), *_sources()], dict(os.environ))
            if done.returncode:
                raise NoEngineError(f"{name} cannot be pulled, and mmdebstrap cannot make it: {done.stderr[-1000:]}")
            changes = ("ENV PATH=/usr/local/bin:/usr/local/sbin:/usr/sbin:/usr/bin:/sbin:/bin", 'CMD ["python3"]')
            options = [part for one in (*changes, f'LABEL {LABEL}="Debian packages"') for part in ("--change", one)]
            self.run("import", *options, str(root), name)
        finally:
            root.unlink(missing_ok=True)
        return "made from Debian's packages"


def find(work: Path) -> tuple[Engine, str]:
    """Find the engine that runs containers here, with the base image; says how that was come by.

    Docker first, then Podman as it is configured, then Podman with settings for restricted machines.

    Raises:
        NoEngineError: none does.
    """
    if shutil.which("docker") and Engine("docker", {"DOCKER_BUILDKIT": "1"}).works("info", timeout_s=60):
        engine = Engine("docker", {"DOCKER_BUILDKIT": "1"})
        engine.quiet = []
        if not engine.works("compose", "version"):
            raise NoEngineError("Docker is here, but not its plugin `docker compose`")
        return engine, engine.image(PYTHON_IMAGE, work)
    if shutil.which("podman") is None:
        raise NoEngineError("neither Docker nor Podman answers; as root on Debian: sh docker/install-engine.sh")
    settings = work / "containers.conf"
    settings.write_text(RESTRICTED, encoding="utf-8")
    origin = Engine("podman", {}).image(PYTHON_IMAGE, work)
    tried = ""
    for environment in ({}, {"CONTAINERS_CONF": str(settings.absolute())}):
        engine = Engine("podman", environment)
        try:
            _try(engine)
        except EngineError as error:
            tried = str(error)
        else:
            return engine, origin
    raise NoEngineError(f"Podman is here and runs nothing: {tried}")


def _try(engine: Engine) -> None:
    """Run a container with a network and limits.

    Raises:
        EngineError: it does not run.
    """
    engine.works("network", "rm", "--force", TRIAL)
    engine.run("network", "create", TRIAL)
    try:
        limits = ("--memory", "64m", "--cpus", "0.5", "--network", TRIAL)
        engine.run("run", "--rm", *limits, PYTHON_IMAGE, "python", "--version", timeout_s=120)
    finally:
        engine.works("network", "rm", "--force", TRIAL)


def call(
    command: list[str], environment: dict[str, str], timeout_s: float = COMMAND_S, stdin: str = ""
) -> subprocess.CompletedProcess[str]:
    """Run a command and keep its output; one that takes too long is ended, with status 124."""
    try:
        return subprocess.run(  # noqa: S603 - fixed commands
            command, input=stdin, env=environment, capture_output=True, text=True, timeout=timeout_s, check=False
        )
    except subprocess.TimeoutExpired:
        return subprocess.CompletedProcess(command, 124, "", f"not within {timeout_s:g} s")


def index_settings() -> tuple[dict[str, str], list[str]]:
    """How pip reaches its index on this machine: settings, and the hosts of indexes that are not the public one."""
    text = call([sys.executable, "-m", "pip", "config", "list"], dict(os.environ), 60).stdout
    found = {}
    for name, value in re.findall(r"^\S+\.([a-z-]+)='(.*)'$", text, re.MULTILINE):
        remote = " ".join(word for word in value.split() if not word.startswith(("file:", "/")))
        if name in {"index-url", "extra-index-url", "trusted-host", "proxy"} and remote:
            found[name] = remote
        elif name == "cert" and Path(value).is_file():
            found[name] = value
    words = " ".join(value for name, value in found.items() if name != "cert").split()
    hosts = {urlsplit(word if "//" in word else f"//{word}").hostname for word in words}
    return found, sorted(host for host in hosts if host and not host.endswith("pypi.org"))


def secrets(folder: Path, settings: dict[str, str]) -> list[str]:
    """Write the settings as files that only this user reads; returns the options that show them to a build."""
    options = []
    lines = ["[global]", "timeout = 180"]
    for name, value in settings.items():
        lines.append(f"{name} = {'/run/secrets/ca.crt' if name == 'cert' else value}")
        if name == "cert":
            options += ["--secret", f"id=ca.crt,src={value}"]
    file = folder / "pip.conf"
    file.touch(mode=0o600)
    file.write_text("\n".join([*lines, ""]), encoding="utf-8")
    return [*options, "--secret", f"id=pip.conf,src={file}"]


class SystemLog:
    """Somebody who listens at /dev/log: without, the name server of Podman's networks ends as soon as it starts."""

    def __init__(self) -> None:
        self._socket: socket.socket | None = None
        if os.geteuid() == 0 and not _listens("/dev/log"):
            Path("/dev/log").unlink(missing_ok=True)
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            self._socket.bind("/dev/log")
            threading.Thread(target=self._read, args=(self._socket,), daemon=True).start()

    def close(self) -> None:
        """Listen no more."""
        if self._socket:
            self._socket.close()
            Path("/dev/log").unlink(missing_ok=True)

    @staticmethod
    def _read(log: socket.socket) -> None:
        with suppress(OSError):
            while log.recv(65536):
                pass


def _listens(name: str) -> bool:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as probe:
        return probe.connect_ex(name) == 0


def _sources() -> list[str]:
    """Where this machine gets Debian's packages; mmdebstrap knows the public mirror itself."""
    files = (Path("/etc/apt/sources.list.d/debian.sources"), Path("/etc/apt/sources.list"))
    return [str(file) for file in files if file.exists() and "bookworm" in file.read_text(encoding="utf-8")][:1]


def _empty(work: Path) -> Path:
    folder = work / "empty"
    folder.mkdir(exist_ok=True)
    return folder
