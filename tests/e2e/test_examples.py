"""The examples run as they stand, and the README shows them as they are."""

import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager

import pytest
from optipmb_client.zenoh import DEFAULT_ENDPOINT
from real_data import REPOSITORY
from service_process import ServiceProcess

EXAMPLES = REPOSITORY / "examples"
README = REPOSITORY / "README.md"


def block(page: str, language: str) -> str:
    """Return the first block of a page in a language."""
    found = re.search(rf"^```{language}\n(.*?)^```", (REPOSITORY / "docs" / page).read_text(), re.DOTALL | re.MULTILINE)
    assert found
    return found[1]


def connected(text: str, endpoint: str) -> str:
    """Return a program that talks to this endpoint, and prints a line when it listens to something."""
    text = text.replace(f', connect="{DEFAULT_ENDPOINT}"', "")
    text, count = re.subn(r"((?:Publisher|Subscriber)\([^()]+)\)", rf'\1, connect="{endpoint}")', text)
    assert count
    return re.sub(
        r"^(with .*Subscriber.* as \w+:.*)$", r'\1\n    print("listens", flush=True)', text, flags=re.MULTILINE
    )


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServiceProcess]:
    """A service with the settings of the pages on zones and on a fixed rate."""
    file = tmp_path_factory.mktemp("settings") / "service.toml"
    file.write_text(block("zones.md", "toml") + block("fixed-rate.md", "toml"))
    with ServiceProcess("--settings", str(file)) as process:
        process.wait_ready()
        yield process


@pytest.fixture(scope="module")
def fused(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServiceProcess]:
    """A service with the settings of the page on several sensors."""
    file = tmp_path_factory.mktemp("settings") / "fusion.toml"
    file.write_text(block("fusion.md", "toml"))
    with ServiceProcess("--settings", str(file)) as process:
        process.wait_ready()
        yield process


class Program(AbstractContextManager["Program"]):
    """A program that runs until it ends or the test has read enough of it."""

    def __init__(self, text: str) -> None:
        self.process = subprocess.Popen([sys.executable, "-c", text], stdout=subprocess.PIPE, text=True)
        self.lines: list[str] = []
        self._came = threading.Condition()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait(60)
        self._reader.join(60)
        assert self.process.stdout is not None
        self.process.stdout.close()

    def until(self, pattern: str) -> list[str]:
        """Return the lines up to one that begins like this."""
        with self._came:
            assert self._came.wait_for(lambda: any(re.match(pattern, one) for one in self.lines), 60), self.lines
            last = next(place for place, one in enumerate(self.lines) if re.match(pattern, one))
            return self.lines[: last + 1]

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            with self._came:
                self.lines.append(line.rstrip("\n"))
                self._came.notify_all()


def test_the_examples_work_twice(service: ServiceProcess) -> None:
    """Readers of the examples and the pages print the promised lines of the published car, also with kept state."""
    texts = [(EXAMPLES / f"{name}.py").read_text() for name in ("subscriber", "publisher")]
    assert all(text.count(DEFAULT_ENDPOINT) == 1 for text in texts), "an example names the endpoint, once"
    subscriber, publisher = (connected(text, service.endpoint) for text in texts)
    promised = (REPOSITORY / "docs/zones.md").read_text().partition("It prints:\n\n```\n")[2].partition("```")[0]
    for time in (1, 2):
        with (
            Program(subscriber.replace("timeout=5", "timeout=100")) as tracks,
            Program(connected(block("zones.md", "python"), service.endpoint)) as events,
            Program(connected(block("fixed-rate.md", "python"), service.endpoint)) as outputs,
        ):
            for one in (tracks, events, outputs):
                one.until("listens")
            with Program(publisher) as car:
                assert car.process.wait(200) == 0
            rows = [line.split() for line in tracks.until(r".* at (4[89]|5\d)\.")[1:]]
            said = [line.split() for line in events.until(f"yard left .* {time}$")[1:]]
            predicted = outputs.until(r"frame 4\d")[1:]
        assert len(rows) >= 45
        assert {tuple(row[:4]) for row in rows} == {("garage/robot-1/lidar", "track", rows[0][2], "car")}
        x = [float(row[5]) for row in rows]
        assert x == sorted(x)
        # A reader of events first gets the kept ones.
        assert [one[:-2] for one in said] == time * [line.split()[:-2] for line in promised.splitlines()]
        assert [one[-1] for one in said[-4:]] == 4 * [str(time)]
        assert all(re.fullmatch(r"frame \d+, -?\d+ ms later: x = \[.*\]", line) for line in predicted)


def test_two_sensors_work_twice(fused: ServiceProcess) -> None:
    """The radar goes on with the track and the box of the lidar, and does so again with the state that is left."""
    for time in (1, 2):
        with Program(connected(block("fusion.md", "python"), fused.endpoint)) as program:
            lines = program.until(r"radar: track \d+ at 58\.")
        if time == 1:
            promised = (REPOSITORY / "docs/fusion.md").read_text().partition("for each frame with a track:\n\n```\n")[2]
            assert lines[1:3] == promised.splitlines()[:2]
            assert lines[-1] == promised.splitlines()[3]
        assert len({line.split()[2] for line in lines[-20:]}) == 1
        assert all(line.endswith("4.5 m long, heading 0.0") for line in lines[-20:])


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
