"""The first ten minutes of six people: from an empty environment and the wheels to tracks, with what each of it took.

The commands come from the pages. Nothing of the source tree can be imported. A halt is a place where a reader cannot
go on: a command that fails, or output that is not what the page says. The last lines have, for each path, the processor
time of the installation and of all that follows, and the halts; with halts the status is 1.

Called as: python benchmarks/paths.py DIST [PATH...]
    DIST  folder with the two wheels
    PATH  those to walk: start csv python node web kitti; default: all
"""

import csv
import os
import re
import resource
import shlex
import shutil
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Callable, Sequence
from pathlib import Path

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
MESSAGES = (ROOT / "docs" / "messages.md").read_text()
GETTING_STARTED = (ROOT / "docs" / "getting-started.md").read_text()
LANGUAGES = (ROOT / "docs" / "languages.md").read_text()
CARS = ((0.0, 0.0, 8.0), (40.0, 4.0, -6.0))  # x, y, speed along x
LIMIT_S = 1800
NODE_MB = 140
KEPT = "(?i)(https?|no)_proxy$|ssl_|lang$"
PYTHONS_OWN = "pip|setuptools|pkg_resources|_distutils|distutils"
# Of downloads, so that a second run need not repeat them.
CACHE = subprocess.run(
    [sys.executable, "-m", "pip", "cache", "dir"], capture_output=True, text=True, check=True
).stdout.strip()


class Environment:
    """A virtual environment with nothing but the packages installed here; its user has no home and no caches.

    Only the first environment compiles kernels; the later ones start with its machine code, which spares CI minutes.
    """

    def __init__(self, base: Path, name: str, *requirements: str) -> None:
        self.name = name
        self.base = base
        self.folder = base / name
        self.work = base / f"{name}-work"
        self.work.mkdir()
        kept = {name: value for name, value in os.environ.items() if re.match(KEPT, name)}
        self.variables = {
            "PATH": "/usr/bin:/bin",
            "HOME": str(self.work),
            "PIP_CACHE_DIR": CACHE,
            "COLUMNS": "80",
            **kept,
        }
        subprocess.run([sys.executable, "-m", "venv", self.folder], check=True)
        if requirements:
            self.install(*requirements)
            self.copy_kernels(base / "kernels", self.kernels)

    def install(self, *requirements: object) -> None:
        """Install packages, and count the processor time apart from what follows."""
        began = processor_s()
        self.run("python", "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *requirements)
        installing = processor_s() - began
        Walk.installing_s += installing
        said(f"{self.name}: pip install, {installing:.0f} s of processor time, {self.megabytes:.0f} MB beside Python")

    @property
    def kernels(self) -> Path:
        """Folder of the tracker, with its machine code."""
        return next(self.folder.glob("lib/python3.*/site-packages")) / "optipmb"

    @staticmethod
    def copy_kernels(source: Path, target: Path) -> None:
        if source.is_dir() and target.is_dir():
            for file in source.rglob("*.nb[ci]"):
                place = target / file.relative_to(source)
                place.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(file, place)

    def keep_kernels(self) -> None:
        """Keep this environment's machine code for the environments that follow."""
        (self.base / "kernels").mkdir()
        self.copy_kernels(self.kernels, self.base / "kernels")

    @property
    def megabytes(self) -> float:
        """What the packages take on the disk, as its blocks are counted."""
        (site,) = self.folder.glob("lib/python3.*/site-packages")
        ours = (one for one in site.iterdir() if not re.match(PYTHONS_OWN, one.name))
        files = (file for one in ours for file in (one.rglob("*") if one.is_dir() else (one,)))
        return sum(file.stat().st_blocks for file in files) * 512 / 2**20

    def run(self, program: str, *arguments: object, folder: Path | None = None, status: int = 0) -> str:
        """Run a program of the environment and return its output; it must end with the status."""
        command = [str(self.folder / "bin" / program), *map(str, arguments)]
        done = subprocess.run(
            command,
            cwd=folder or self.work,
            env=self.variables,
            capture_output=True,
            text=True,
            timeout=LIMIT_S,
            check=False,
        )
        checked(done.returncode == status, f"{program}: status {done.returncode}\n{done.stdout}{done.stderr}")
        return done.stdout if status == 0 else done.stderr

    def start(self, program: str, *arguments: object) -> "subprocess.Popen[str]":
        """Start a program of the environment; its standard error goes into a file."""
        command = [str(self.folder / "bin" / program), *map(str, arguments)]
        with (self.work / f"{program}.log").open("w") as log:
            return subprocess.Popen(
                command, cwd=self.work, env=self.variables, stdout=subprocess.PIPE, stderr=log, text=True
            )

    def import_ms(self, module: str) -> float:
        """Processor time of an import, without the start of the interpreter: median of five, after a first one."""
        self.run("python", "-c", f"import {module}")
        code = f"import time; b = time.process_time(); import {module}; print(time.process_time() - b)"
        return 1e3 * statistics.median(float(self.run("python", "-c", code)) for _ in range(5))


class Walk:
    """What the path that is walked has taken so far."""

    installing_s = 0.0
    halts = 0


def processor_s() -> float:
    """Return the processor time of all programs that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def said(text: str) -> None:
    print(text, flush=True)


def timed(what: str, call: Callable[[], str]) -> str:
    began = processor_s()
    result = call()
    said(f"  {what}: {processor_s() - began:.1f} s")
    return result


def blocks(text: str, language: str, mark: str) -> str:
    (found,) = (one for one in re.findall(rf"^```{language}\n(.*?)^```", text, re.DOTALL | re.MULTILINE) if mark in one)
    return found


def checked(claim: object, text: str) -> None:
    """Count a halt, and print the text, unless a claim holds."""
    if not claim:
        Walk.halts += 1
        said(f"HALT: {text}")


def free_port() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return str(probe.getsockname()[1])


def start(base: Path, wheel: Path, _node: Path) -> None:
    """Getting started, line by line: the live demo, a table, pictures, figures, Python, a service."""
    lines = [
        line
        for text in re.findall(r"^```sh\n(.*?)^```", GETTING_STARTED, re.MULTILINE | re.DOTALL)
        for line in text.splitlines()
    ]
    commands = [shlex.split(line, comments=True) for line in lines if not line.startswith("python3 -m venv")]
    (extras,) = (re.search(r"\[.*\]", command[-1])[0] for command in commands if command[0] == "pip")
    place = Environment(base, "start", f"{wheel}{extras}")
    shutil.copytree(ROOT / "examples", place.work / "examples")
    port, service = free_port(), None
    for command in commands:
        program, *words = command
        if program == "optipmb-service":
            words[words.index("--http") + 1] = f"127.0.0.1:{free_port()}"
            service = place.start(program, *words[:-1], "--listen", f"tcp/127.0.0.1:{port}")
        elif program == "kill" and service is not None:
            service.terminate()
            service.wait(60)
        elif "--live" in command:
            timed(
                "the live demo, with compilation, until objects are on its page", lambda words=words: live(place, words)
            )
            place.keep_kernels()
        elif program == "optipmb":
            end = ("--connect", f"tcp/127.0.0.1:{port}") if words[0] == "replay" else ()
            timed(f"optipmb {words[0]}", lambda words=(*words, *end): place.run("optipmb", *words))
    (place.work / "frames.py").write_text(blocks(GETTING_STARTED, "python", "groupby"))
    says = re.search(r"^OnlineTracks: .*$", GETTING_STARTED, re.MULTILINE)[0]
    printed = timed("the same in Python", lambda: place.run("python", "frames.py"))
    checked(says in printed, f"expected {says}, received {printed}")
    made = [one for one in ("tracks.csv", "crossing.png", "replayed.csv") if (place.work / one).is_file()]
    checked(len(made) == 3, f"expected three files, received {made}")


def live(place: Environment, words: Sequence[str]) -> str:
    """Start the live demo, read its page until objects are there, and end it as Ctrl-C does."""
    demo = place.start("optipmb", *words, "--no-browser")
    line = demo.stdout.readline() if demo.stdout else ""
    found = re.search(r"http://[\d.:]+", line)
    checked(found, f"expected the address of the live page, received {line}")
    url = f"{found[0]}/api/v1/tracks?stream=*/*/*" if found else ""
    for _ in range(LIMIT_S if found else 0):
        with urllib.request.urlopen(url) as answer:  # noqa: S310 - the address is of this machine
            if b'"class"' in answer.read():
                break
        time.sleep(1)
    demo.send_signal(signal.SIGINT)
    checked(demo.wait(60) == 0, f"expected the demo to end by Ctrl-C, received status {demo.returncode}")
    return line


def write_cars(path: Path) -> None:
    with path.open("w", newline="") as file:
        out = csv.writer(file)
        out.writerow(["time", "x", "y", "z", "length", "width", "height", "heading", "confidence", "category"])
        for k in range(50):
            for x, y, speed in CARS:
                heading = 0.0 if speed > 0 else 3.14
                out.writerow([k / 10, x + speed * k / 10, y, 0.8, 4.5, 1.9, 1.6, heading, 0.9, "car"])


def csv_in_and_out(base: Path, wheel: Path, _node: Path) -> None:
    """A table to a table: with pip, and with pipx and uv, which give a command an environment of its own."""
    place = Environment(base, "table", f"{wheel}[client]")
    for line in sorted(set(re.findall(r"pip (install -e (?:'\..*?'|\..*?)(?=[ `\n]))", README))):
        place.run("pip", "--quiet", *shlex.split(line), "--dry-run", "--no-deps", "--ignore-installed", folder=ROOT)
        said(f"  pip {line}: can be installed")
    (place.work / "examples").mkdir()
    write_cars(place.work / "examples" / "crossing.csv")
    command = blocks(README, "sh", "track examples/crossing.csv").splitlines()[-1].split()
    hint = place.run(*command, status=1).strip().rpartition("not installed: ")[2]
    place.install(*shlex.split(hint)[2:])
    timed("the first tracks", lambda: place.run(*command))
    with (place.work / "tracks.csv").open() as file:
        rows = list(csv.DictReader(file))
    checked(len({row["id"] for row in rows}) == len(CARS), f"expected {len(CARS)} tracks, received {rows[-3:]}")
    checked(all(abs(float(row["vx"])) > 5 for row in rows[-2:]), f"expected moving cars, received {rows[-2:]}")

    tools = Environment(base, "tools", "pipx", "uv")
    for name, *install in (("pipx", "pipx", "install"), ("uv", "uv", "tool", "install", "--python", sys.executable)):
        home = tools.work / name
        tools.variables |= {"PIPX_HOME": f"{home}", "PIPX_BIN_DIR": f"{home}/bin"}
        tools.variables |= {"UV_TOOL_DIR": f"{home}/tools", "UV_TOOL_BIN_DIR": f"{home}/bin"}
        timed(" ".join(install[:3]), lambda install=(*install, f"{wheel}[table]"): tools.run(*install))
        shown = tools.run(f"../../tools-work/{name}/bin/optipmb", "profiles")
        checked("nuscenes" in shown, f"{name}: expected the profiles, received {shown}")


def python(base: Path, wheel: Path, _node: Path) -> None:
    """The library alone, with the lines of the README."""
    place = Environment(base, "library", wheel)
    said(f"  import optipmb: {place.import_ms('optipmb'):.0f} ms of processor time")
    (place.work / "first.py").write_text(blocks(README, "python", "OnlineTracker()"))
    checked("tracks at 0.000 s" in place.run("python", "first.py"), "expected the tracks of the first frame")
    (place.work / "mine.py").write_text(blocks(README, "python", 'OnlineTracker("kitti")'))
    printed = timed("the first tracks", lambda: place.run("python", "mine.py"))
    checked("'car'" in printed.splitlines()[-1], f"expected a car, received {printed}")


def node(base: Path, wheel: Path, node_wheel: Path) -> None:
    """A service; a publisher and a subscriber without the tracker; a publisher with Zenoh alone."""
    place = Environment(base, "service", f"{wheel}[service]")
    nodes = Environment(base, "node", node_wheel)
    checked(nodes.megabytes < NODE_MB, f"expected a node of less than {NODE_MB} MB")
    said(f"  import optipmb_client: {nodes.import_ms('optipmb_client'):.0f} ms of processor time")
    plain = Environment(base, "zenoh", "eclipse-zenoh")
    port = free_port()
    programs = (
        (nodes, "publisher.py", blocks(README, "python", "Publisher(")),
        (nodes, "subscriber.py", blocks(README, "python", "Subscriber(")),
        (plain, "plain.py", blocks(MESSAGES, "python", "import zenoh")),
    )
    for where, name, text in programs:
        (where.work / name).write_text(text.replace("7447", port))
    service = place.start("optipmb-service", "--listen", f"tcp/127.0.0.1:{port}")
    try:
        checked(service.stdout and service.stdout.readline(), "expected the service to be ready")
        for where, program, _ in (one for one in programs if one[1] != "subscriber.py"):
            listening = nodes.start("python", "subscriber.py")
            where.run("python", program)
            printed, _ = listening.communicate(timeout=LIMIT_S)
            stream = "garage/robot-1/lidar" if program == "publisher.py" else "garage/robot-2/lidar"
            rows = [line for line in printed.splitlines() if line.startswith(stream)]
            checked(len(rows) > 10, f"expected tracks of {stream}, received {printed}")
            said(f"  {where.name}, {program}: {len(rows)} lines with tracks came")
    finally:
        service.terminate()
        service.wait(60)


def web(base: Path, wheel: Path, _node: Path) -> None:
    """A service with HTTP, JavaScript, C++: programs without packages that send detections and read tracks."""
    place = Environment(base, "web", f"{wheel}[service]")
    program = shutil.which("node")
    if program is None:
        said("  skipped: node is not installed")
        return
    (place.folder / "bin" / "node").symlink_to(program)
    port = free_port()
    (place.work / "car.mjs").write_text(blocks(LANGUAGES, "js", "fetch(").replace("8080", port))
    service = place.start("optipmb-service", "--http", f"127.0.0.1:{port}", "--listen", f"tcp/127.0.0.1:{free_port()}")
    try:
        checked(service.stdout and service.stdout.readline(), "expected the service to be ready")
        printed = timed("a program in JavaScript", lambda: place.run("node", "car.mjs"))
        checked(printed.count("track") > 10, f"expected tracks, received {printed}")
        if compiler := shutil.which("g++"):
            (place.work / "car.cpp").write_text(blocks(LANGUAGES, "cpp", "post(").replace("8080", port))
            command = [compiler, "-std=c++17", "-Wall", "-Werror", "car.cpp", "-o", place.folder / "bin" / "car"]
            subprocess.run(command, cwd=place.work, check=True)
            printed = timed("a program in C++", lambda: place.run("car"))
            checked(printed.count('"class"') > 10, f"expected tracks, received {printed}")
    finally:
        service.terminate()
        service.wait(60)


def kitti(base: Path, wheel: Path, _node: Path) -> None:
    """The three commands of the README on KITTI."""
    given = os.environ.get("KITTI_ROOT")
    places = [Path(given)] if given else sorted(ROOT.parent.glob("*/data/kitti"))
    data = next((one for one in places if (one / "detections").is_dir()), None)
    if data is None:
        said("kitti: skipped, no data: neither KITTI_ROOT nor data/kitti in a folder beside this repository")
        return
    place = Environment(base, "kitti", f"{wheel}[plot]")
    for line in blocks(README, "sh", "--dataset kitti").splitlines():
        words = line.replace("ROOT", str(data)).split()
        printed = timed(" ".join(words[:2]), lambda words=words: place.run(*words))
        if words[1] == "evaluate":
            checked("sAMOTA" in printed, f"expected the figures of KITTI, received {printed}")
            said(printed)
    checked((place.work / "0000.png").stat().st_size > 10_000, "expected a picture")


PATHS = {"start": start, "csv": csv_in_and_out, "python": python, "node": node, "web": web, "kitti": kitti}


def main(arguments: Sequence[str]) -> None:
    folder, *names = arguments
    (wheel,) = Path(folder).resolve().glob("optipmb-*-none-any.whl")
    (node_wheel,) = Path(folder).resolve().glob("optipmb_node-*.whl")
    base = Path(tempfile.mkdtemp(prefix="optipmb-paths-"))
    rows, halts = [], 0
    try:
        for name in names or PATHS:
            Walk.installing_s, Walk.halts = 0.0, 0
            began = processor_s()
            try:
                PATHS[name](base, wheel, node_wheel)
            except Exception as error:  # noqa: BLE001 - the path ends here, the others go on
                checked(False, f"{type(error).__name__}: {error}")
            following = processor_s() - began - Walk.installing_s
            who = (PATHS[name].__doc__ or "").partition(":")[0][:36]
            rows.append(f"{name:7} {Walk.installing_s:12.0f} {following:12.0f} {Walk.halts:6}  {who}")
            halts += Walk.halts
    finally:
        shutil.rmtree(base, ignore_errors=True)
    said("\npath     pip install s  processor s  halts  who")
    said("\n".join(rows))
    sys.exit(halts > 0)


if __name__ == "__main__":
    main(sys.argv[1:])
