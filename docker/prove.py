#!/usr/bin/env python3
"""Runs the Dockerfile without a container engine: its commands in order, then its entry point as its user.

debootstrap --variant=minbase --include=python3,python3-venv,ca-certificates bookworm ROOT
python3 docker/prove.py --root ROOT --work DIR

Every stage begins as a copy of ROOT, which stands for the base image: `python` there is Debian's. RUN is executed by
chroot, COPY takes what `.dockerignore` lets through, ENV, WORKDIR and USER hold as written. Of the image that results,
the entry point is started, HEALTHCHECK asked, a scene replayed, STOPSIGNAL sent. Needs root and a package index.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Final

import dockerfile

HERE: Final = Path(__file__).parent
CONTEXT: Final = HERE.parent
BASE_PATH: Final = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
ENDPOINT: Final = "tcp/127.0.0.1:27470"
HTTP: Final = "127.0.0.1:28080"
READY_S: Final = 20.0
"""Longest start: with kernels compiled it takes a second or two, without a minute and more."""
NETWORK: Final = ("/etc/resolv.conf", "/etc/hosts", "/etc/pip.conf", "/etc/ssl/certs/ca-certificates.crt")


class ProofError(Exception):
    """Something is not as the Dockerfile says."""


def say(text: str) -> None:
    """Print a line at once."""
    print(f"{time.strftime('%H:%M:%S')} {text}", flush=True)


class Root:
    """A root file system that a stage is made in."""

    def __init__(self, folder: Path, base: Path) -> None:
        self.folder = folder
        self.close()
        if any((folder / name).is_mount() for name in ("proc", "dev")):
            raise ProofError(f"{folder} still has mounts: removing it would remove what is mounted")
        shutil.rmtree(folder, ignore_errors=True)
        folder.parent.mkdir(parents=True, exist_ok=True)
        _run(["cp", "-a", str(base), str(folder)])
        for name in NETWORK:
            if Path(name).exists():
                shutil.copyfile(name, folder / name.lstrip("/"))
        for name in ("proc", "dev"):
            _run(["mount", "--bind", f"/{name}", str(folder / name)])
        if not (folder / "usr/local/bin/python").exists():
            # The base image has a Python with pip in /usr/local; Debian's, in a virtual environment, stands for it.
            self.shell("python3 -m venv /usr/local/python", {})
            stand_in = self.folder / "usr/local/bin/python"
            stand_in.write_text('#!/bin/sh\nexec /usr/local/python/bin/python "$@"\n', encoding="utf-8")
            stand_in.chmod(0o755)

    def close(self) -> None:
        """Take away what was mounted."""
        for name in ("proc", "dev"):
            if (self.folder / name).is_mount():
                subprocess.run(["umount", str(self.folder / name)], check=False)  # noqa: S603, S607 - fixed

    def command(self, words: list[str], environment: dict[str, str], user: str = "0:0", place: str = "/") -> list[str]:
        """Return the command that runs something inside."""
        index = {
            name: value for name, value in os.environ.items() if name.startswith("PIP_") or name == "SSL_CERT_FILE"
        }
        values = {"PATH": BASE_PATH, "HOME": "/tmp", **index, **environment}  # noqa: S108 - inside the root
        settings = [f"{name}={value}" for name, value in values.items()]
        script = f"cd {shlex.quote(place)} && exec {shlex.join(words)}"
        return ["chroot", f"--userspec={user}", str(self.folder), "env", "-i", *settings, "sh", "-c", script]

    def shell(self, script: str, environment: dict[str, str], place: str = "/") -> None:
        """Run a script as RUN does."""
        _run(self.command(["/bin/sh", "-c", script], environment, place=place))


def build(base: Path, work: Path) -> tuple[Root, dockerfile.Stage, list[Root]]:
    """Carry out all stages; returns the root of the last one, that stage, and all roots."""
    roots: dict[str, Root] = {}
    stage, root = None, None
    for number, stage in enumerate(dockerfile.read(HERE / "Dockerfile")):
        say(f"FROM {stage.base} AS {stage.name or number}")
        root = roots[stage.name or str(number)] = Root(work / (stage.name or f"stage-{number}"), base)
        place = "/"
        for instruction in stage.instructions:
            began = time.monotonic()
            if instruction.name == "WORKDIR":
                place = instruction.value
                (root.folder / place.lstrip("/")).mkdir(parents=True, exist_ok=True)
            elif instruction.name == "RUN":
                environment = {name: _expanded(value) for name, value in instruction.environment.items()}
                root.shell(instruction.value, environment, place)
            elif instruction.name == "COPY":
                copy(instruction.words, roots, root, place)
            say(f"  {time.monotonic() - began:5.1f} s  {instruction.name} {instruction.value[:90]}")
    if stage is None or root is None:
        raise ProofError("no stage")
    return root, stage, list(roots.values())


def copy(words: list[str], roots: dict[str, Root], root: Root, place: str) -> None:
    """Carry out COPY."""
    source = CONTEXT
    if words[0].startswith("--from="):
        source = roots[words.pop(0).removeprefix("--from=")].folder
    *names, target = words
    allowed = (CONTEXT / ".dockerignore").read_text(encoding="utf-8").splitlines()
    into = root.folder / (place.lstrip("/") if not target.startswith("/") else "") / target.lstrip("/")
    for name in names:
        if source is CONTEXT and f"!{name}" not in allowed:
            raise ProofError(f"COPY {name}: .dockerignore keeps it out")
        there = source / name.lstrip("/")
        many = target.endswith("/") or len(names) > 1
        goal = into / there.name if many else into
        goal.parent.mkdir(parents=True, exist_ok=True)
        ignored = shutil.ignore_patterns("__pycache__") if source is CONTEXT else None
        if not there.is_dir():
            shutil.copy2(there, goal)
        elif ignored:
            shutil.copytree(there, goal, dirs_exist_ok=True, ignore=ignored)
        else:
            _run(["cp", "-a", "--no-target-directory", str(there), str(goal)])


def exercise(root: Root, stage: dockerfile.Stage) -> None:
    """Start the entry point as a container would, ask, replay, stop."""
    environment = {name: _expanded(value) for name, value in stage.environment().items()} | {"OPTIPMB_HTTP": HTTP}
    user, place = stage.last("USER").value, stage.last("WORKDIR").value
    health = json.loads(stage.last("HEALTHCHECK").value.partition("CMD")[2])
    entry = stage.last("ENTRYPOINT").words
    if user.startswith(("0", "root")):
        raise ProofError("the image runs as root")

    def inside(words: list[str]) -> list[str]:
        return root.command(words, environment, user, place)

    def healthy() -> int:
        return subprocess.run(inside(health), check=False, capture_output=True).returncode  # noqa: S603 - of the file

    _expect("health check before the start", healthy(), 1)
    before = _files(root.folder)
    began = time.monotonic()
    service = subprocess.Popen(inside([*entry, "--listen", ENDPOINT]), stdout=subprocess.PIPE)  # noqa: S603 - of the file
    try:
        ready = (service.stdout or sys.stdin).readline()
        seconds = time.monotonic() - began
        say(f"ENTRYPOINT {entry}: {ready!r} after {seconds:.1f} s")
        _expect(f"ready within {READY_S:g} s", seconds < READY_S, expected=True)
        _expect("health check of the running service", healthy(), 0)
        replay = ["optipmb", "replay", "--dataset", "scene", "--option", "frames=50", "--connect", ENDPOINT]
        _run(inside([*replay, "--sequences", "0000", "--out", "/tmp/replay"]))  # noqa: S108 - inside the root
        say("a scene of 50 frames was tracked")
        began = time.monotonic()
        service.send_signal(getattr(signal, stage.last("STOPSIGNAL").value))
        _expect("exit status after the stop signal", service.wait(10), 0)
        say(f"it ended after {time.monotonic() - began:.1f} s")
    finally:
        service.kill()
        service.wait()
    _expect("health check after the end", healthy(), 1)
    written = {name for name in _files(root.folder) - before if not name.startswith(("tmp/", "var/lib/optipmb/"))}
    _expect("files written outside /tmp and the volume", written, set())


def main(arguments: list[str]) -> int:
    """Run the command line; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, required=True, help="a bare root file system with Python")
    parser.add_argument("--work", type=Path, required=True, help="folder for the stages; kept at the end")
    options = parser.parse_args(arguments)
    roots: list[Root] = []
    try:
        root, stage, roots = build(options.root, options.work)
        exercise(root, stage)
        size = sum(file.stat().st_size for file in (root.folder / "opt/optipmb").rglob("*") if file.is_file())
        say(f"the image adds {size / 1e6:.0f} MB to its base")
    except (ProofError, subprocess.CalledProcessError) as error:
        say(f"NOT PROVEN: {error}")
        return 1
    finally:
        for one in roots:
            one.close()
    say("PROVEN")
    return 0


def _expect(what: str, received: object, expected: object) -> None:
    if received != expected:
        raise ProofError(f"{what}: expected {expected}, received {received}")
    say(f"{what}: {received}, as it should")


def _files(folder: Path) -> set[str]:
    """Return all files of a root but those that the kernel shows."""
    mounted = (folder / "proc", folder / "dev")
    found = set()
    for place, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if Path(place, name) not in mounted]
        found |= {str(Path(place, name).relative_to(folder)) for name in names}
    return found


def _expanded(value: str) -> str:
    return value.replace("$PATH", BASE_PATH)


def _run(command: list[str]) -> None:
    subprocess.run(command, check=True)  # noqa: S603 - commands of the Dockerfile


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
