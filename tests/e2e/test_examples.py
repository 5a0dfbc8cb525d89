"""The examples run as they stand, and the README shows them as they are."""

import itertools
import re
import subprocess
import sys
import threading
from pathlib import Path
from typing import IO

import pytest
from optipmb_client import Publisher
from optipmb_client.zenoh import DEFAULT_ENDPOINT
from real_data import REPOSITORY
from service_process import ServiceProcess
from without_numpy import command

EXAMPLES = REPOSITORY / "examples"
README = REPOSITORY / "README.md"


def example(name: str, service: ServiceProcess, folder: Path, *, numpy: bool) -> list[str]:
    """Give the command that runs an example against a service that does not listen at the default endpoint.

    Without numpy it publishes another stream, for the service keeps the tracks of a stream for those who come late.
    """
    text = (EXAMPLES / name).read_text()
    assert text.count(DEFAULT_ENDPOINT) == 1, "the example names the endpoint, once"
    path = folder / name
    text = text.replace(DEFAULT_ENDPOINT, service.endpoint)
    if numpy:
        path.write_text(text)
        return [sys.executable, str(path)]
    path.write_text(text.replace("robot-1", "robot-2"))
    return [*command("import runpy; runpy.run_path(sys.argv[2])"), str(path)]


@pytest.mark.parametrize("numpy", [True, False])
def test_publisher_and_subscriber(service: ServiceProcess, tmp_path: Path, *, numpy: bool) -> None:
    """The subscriber prints the car that the publisher publishes, under one identity, moving along x at 10 m/s.

    Both need no numpy.
    """
    stream = f"garage/robot-{1 if numpy else 2}/lidar"
    lines: list[str] = []
    listening, seen = threading.Event(), threading.Event()

    def read(output: IO[str]) -> None:
        for line in output:
            lines.append(line)
            listening.set()
            if line.startswith(stream):
                seen.set()

    with (
        Publisher("garage/test/probe", service.endpoint, frame="world") as probe,
        subprocess.Popen(
            example("subscriber.py", service, tmp_path, numpy=numpy), stdout=subprocess.PIPE, text=True
        ) as subscriber,
    ):
        assert subscriber.stdout is not None
        reader = threading.Thread(target=read, args=(subscriber.stdout,), daemon=True)
        reader.start()
        numbers = itertools.count()
        box = {"label": ["car"], "center": [[0, 0, 1]], "size": [[4, 2, 1.5]], "yaw": [0], "score": [0.9]}

        def drive_until(event: threading.Event) -> None:
            """Publish a car of another stream, so that the subscriber goes on listening."""
            for _ in range(600):
                probe.publish(stamp_ns=next(numbers) * 100_000_000, **box)
                if event.wait(0.1):
                    return

        drive_until(listening)
        with subprocess.Popen(example("publisher.py", service, tmp_path, numpy=numpy)) as publisher:
            drive_until(seen)
            assert publisher.wait(200) == 0
        reader.join(60.0)
        assert subscriber.wait(120) == 0
    rows = [line.split() for line in lines if line.startswith(f"{stream} ")]
    assert len(rows) >= 45
    assert {(row[2], row[3]) for row in rows} == {(rows[0][2], "car")}
    x = [float(row[5]) for row in rows]
    assert x == sorted(x)
    assert 44.0 < x[-1] < 54.0


def test_the_examples_are_short() -> None:
    """Five lines of code of one's own, imports and comments apart."""
    for path in EXAMPLES.glob("*.py"):
        body = re.sub(r'^""".*?"""', "", path.read_text(), flags=re.DOTALL)
        code = [line for line in body.splitlines() if line.strip() and not line.startswith(("import", "from", "#"))]
        assert len(code) <= 5, path


def blocks() -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", README.read_text(), flags=re.DOTALL | re.MULTILINE)


@pytest.mark.parametrize("name", ["Publisher", "Subscriber"])
def test_the_readme_shows_the_examples(name: str) -> None:
    """A block of the README that uses the class is the example's code, word for word."""
    used = [block for block in blocks() if f"{name}(" in block]
    if not used:
        pytest.skip(f"the README has no code with {name}")
    text = (EXAMPLES / f"{name.lower()}.py").read_text()
    code = re.sub(r'^""".*?"""\n', "", text, flags=re.DOTALL).strip()
    for block in used:
        assert block.strip() in (text.strip(), code)
