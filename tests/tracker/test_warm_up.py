"""A prepared installation compiles nothing: counted in a fresh process, by what numba says of every kernel."""

from __future__ import annotations

import ast
import json
import os
import platform
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import optipmb
from optipmb.compiled import PROCESSOR
from optipmb.warm import kernels

pytestmark = pytest.mark.timeout(300)  # they compile kernels

SUPPORT = Path(__file__).resolve().parents[1] / "support"

# Everything that a stream may bring, after the warm-up: with and without clouds, velocities, poses, calibration and
# modules; zones; arrays from messages, which are read-only; a density that was stored.
FRESH = """
import json, sys
from dataclasses import replace
sys.path.insert(0, sys.argv[1])
import numpy as np
import optipmb
from optipmb.learning.self_calibration import learned_noise
from optipmb.warm import compilations, kernels
from optipmb.world.zones import Zone, ZoneState, observe
from scenes import Options, random_parameters, scene

compiled = optipmb.warm_up(rejoin=True)
known = {name: len(kernel.signatures) for name, kernel in kernels().items()}

def read_only(array):
    return None if array is None else np.frombuffer(array.tobytes(), array.dtype).reshape(array.shape)

here = optipmb.Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
zones = (Zone("a", polygon=((-30, -30), (30, -30), (0.0, 30.0))), Zone("b", line=((-50, 0), (50, 0)), margin=2.0))
baselines = (optipmb.Modules(**{name: False}) for name in ("adp", "habm", "rpp", "ote"))
for seed, modules in enumerate([optipmb.Modules(), optipmb.Modules(), *baselines]):
    parameters = optipmb.parse_parameters(random_parameters(seed, calibrated=seed % 2 == 0))
    tracker = optipmb.Tracker(parameters, modules, rejoin=optipmb.Rejoin() if seed else None)
    density, state = tracker.initial(), ZoneState()
    for given in scene(seed, Options(frames=25, objects=25)):
        columns = given.columns()
        for name in ("label", "center", "size", "yaw", "score", "velocity"):
            columns[name] = read_only(columns[name])
        cloud = None
        if given.cloud is not None:
            pose = optipmb.Pose(given.cloud.pose.translation, given.cloud.pose.quaternion)
            cloud = optipmb.PointCloud(read_only(given.cloud.xyz), pose)
        view = optipmb.FieldOfView(pose=here if seed > 4 else None) if seed > 3 else None
        if seed > 2:
            columns["position_covariance"] = np.tile(np.eye(3), (len(columns["score"]), 1, 1))
        frame, _ = optipmb.make_frame(parameters, pose=here if seed else None, field_of_view=view, **columns)
        frame = replace(frame, cloud=cloud)  # as where a cloud comes after its frame
        result = tracker.step(density, frame)
        density, tracks = result.density, result.tracks
        state, _ = observe(zones, state, frame.stamp_ns, tracks, parameters.labels)
    stored = {name: read_only(column) for name, column in optipmb.columns_of(density).items()}
    density = optipmb.density_of(density.stamp_ns, density.next_id, stored, parameters.labels)
    tracker.step(density, frame)
generic = optipmb.Tracker("generic")  # which learns while it runs
box = {"labels": ("car",), "label": [0], "center": [[0.0, 0.0, 0.0]], "score": [0.9]}
frame, _ = optipmb.make_frame(generic.parameters, stamp_ns=0, **box)
learned_noise(generic.step(generic.initial(), frame).density)
grown = [name for name, kernel in kernels().items() if len(kernel.signatures) != known.get(name)]
print(json.dumps({"compiled": compiled, "later": compilations() - compiled, "grown": grown}))
"""


# Of a folder in PYTHONPATH: every process that starts with it has a warm-up of two kernels, in either order.
TWO_KERNELS = """
import os
import optipmb.warm
from optipmb.filter.calibration import log_odds
from optipmb.model.density import whole_periods

calls = [lambda: log_odds(0.5), lambda: whole_periods(0, 1, 1.0)]
optipmb.warm._run = lambda: [call() for call in calls[:: int(os.environ["ORDER"])]]
"""


# With a folder for `SHIPPED`: how many kernels are compiled for one call.
WITH_SHIPPED = """
import sys
from pathlib import Path
import optipmb.compiled
from optipmb.filter.predict import wrap
from optipmb.warm import compilations

optipmb.compiled.SHIPPED = Path(sys.argv[1])
lacking = sys.argv[2:]
features = optipmb.compiled.get_host_cpu_features()
optipmb.compiled.get_host_cpu_features = lambda: {name: has and name not in lacking for name, has in features.items()}
wrap(0.5)
print(compilations())
"""


def fresh() -> dict[str, Any]:
    """What a new process had to compile."""
    command = [sys.executable, "-c", FRESH, str(SUPPORT)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=280, check=True)
    counts: dict[str, Any] = json.loads(done.stdout)
    return counts


def test_after_a_warm_up_nothing_is_compiled() -> None:
    """The first process may prepare; the next one loads everything, and no frame brings a kernel anything new."""
    optipmb.warm_up(rejoin=True)
    assert fresh() == {"compiled": 0, "later": 0, "grown": []}


def test_all_kernels_are_counted() -> None:
    """`kernels` has every kernel that a module defines."""
    folder = Path(optipmb.__file__).parent
    defined = set()
    for path in folder.rglob("*.py"):
        module = ".".join(("optipmb", *path.relative_to(folder).with_suffix("").parts))
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.FunctionDef):
                if {"kernel", "long_kernel"} & {ast.unparse(one) for one in node.decorator_list}:
                    defined.add(f"{module}.{node.name}")
            elif isinstance(node, ast.AnnAssign) and ast.unparse(node.value or node).startswith("views_of("):
                defined.add(f"{module}.{ast.unparse(node.target)}")
    assert set(kernels()) == defined


def test_kernels_are_counted_while_another_thread_imports(monkeypatch: pytest.MonkeyPatch) -> None:
    """A module that is imported while the loaded ones are looked through does no harm."""

    class Importing(str):
        """A module's name that imports another module whenever it is looked at."""

        __slots__ = ()

        def startswith(self, *prefix: Any) -> bool:
            monkeypatch.setitem(sys.modules, "imported_meanwhile", ModuleType("imported_meanwhile"))
            return super().startswith(*prefix)

    monkeypatch.setitem(sys.modules, Importing("looked_at"), ModuleType("looked_at"))
    assert kernels()
    assert "imported_meanwhile" in sys.modules


def test_programs_that_start_at_once_compile_once_together(tmp_path: Path) -> None:
    """One of them has the kernels compiled, by several processes; the other waits and loads them.

    Two kernels of different folders stand for all: what the warm-up calls is compiled, and nothing else differs.
    """
    program = "import optipmb; print(optipmb.warm_up())"
    (tmp_path / "sitecustomize.py").write_text(TWO_KERNELS)
    with tempfile.TemporaryDirectory() as cache:
        environment = os.environ | {"NUMBA_CACHE_DIR": cache, "OPTIPMB_COMPILE_PROCESSES": "2"}
        environment["PYTHONPATH"] = f"{tmp_path}:{environment.get('PYTHONPATH', '')}"
        command = [sys.executable, "-c", program]
        started = [
            subprocess.Popen(
                command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment | {"ORDER": order}
            )
            for order in ("1", "-1")
        ]
        answers = [one.communicate(timeout=280) for one in started]
    assert [one.returncode for one in started] == [0, 0], answers
    (none, waited), (compiled, announced) = sorted(answers, key=lambda answer: int(answer[0]))
    assert int(none) == 0 < int(compiled)
    assert waited == "optipmb: waiting for another process, which compiles the tracker\n"
    assert announced.startswith("optipmb: compiling the tracker, once after an installation")


def test_a_process_that_cannot_start_others_compiles_alone() -> None:
    """Without the right to run the interpreter a kernel is compiled where it is called, and one line says so."""
    program = (
        "import sys; sys.executable = '/no/interpreter'\nfrom optipmb.filter.predict import wrap; print(wrap(0.5))"
    )
    with tempfile.TemporaryDirectory() as cache:
        environment = os.environ | {"NUMBA_CACHE_DIR": cache, "OPTIPMB_COMPILE_PROCESSES": "2"}
        command = [sys.executable, "-W", "ignore", "-c", program]
        done = subprocess.run(command, capture_output=True, text=True, timeout=110, check=True, env=environment)
    assert done.stdout == "0.5\n"
    line = "optipmb: cannot start other processes ([Errno 2] No such file or directory: '/no/interpreter'): "
    assert done.stderr.count(f"{line}this one compiles alone\n") == 1


def test_without_locks_of_files_kernels_are_compiled_and_kept() -> None:
    """Windows has no `fcntl`: the library can be imported, and the second process compiles nothing."""
    program = (
        "import sys; sys.modules['fcntl'] = None\n"
        "from optipmb.filter.predict import wrap; from optipmb.warm import compilations\n"
        "wrap(0.5); print(compilations())"
    )
    with tempfile.TemporaryDirectory() as cache:
        environment = os.environ | {"NUMBA_CACHE_DIR": cache, "OPTIPMB_COMPILE_PROCESSES": "0"}
        command = [sys.executable, "-W", "ignore", "-c", program]
        runs = [subprocess.run(command, capture_output=True, text=True, check=True, env=environment) for _ in range(2)]
    assert [int(one.stdout) for one in runs] == [1, 0]


@pytest.mark.parametrize("setting", ["OPTIPMB_COMPILE_PROCESSES", "NUMBA_OPT"])
def test_a_compilation_is_announced_once_with_its_progress(setting: str) -> None:
    """A process without cached kernels says once that it compiles, then how many are compiled, on standard error.

    Without optimization nothing can be cached: no other processes compile.
    """
    program = (
        "import optipmb.compiled as compiled; compiled.STEPS = 1000\nfrom optipmb.filter.predict import wrap; wrap(0.5)"
    )
    with tempfile.TemporaryDirectory() as cache:
        environment = os.environ | {"NUMBA_CACHE_DIR": cache, setting: "0"}
        command = [sys.executable, "-W", "ignore", "-c", program]
        done = subprocess.run(command, capture_output=True, text=True, timeout=280, check=True, env=environment)
    first, *progress = done.stderr.splitlines()
    assert first == "optipmb: compiling the tracker, once after an installation; it takes up to a minute"
    counts = [re.fullmatch(r"optipmb: compiled (\d+) of (\d+) kernels", line) for line in progress]
    assert [int(found[1]) for found in counts if found] == list(range(1, len(progress) + 1))
    assert len(progress) < 10


def compiled_with(shipped: Path, *lacking: str, **environment: str) -> int:
    """How many kernels a call compiles in a process with an empty cache and machine code of a wheel."""
    with tempfile.TemporaryDirectory() as cache:
        variables = os.environ | {"NUMBA_CACHE_DIR": cache, "OPTIPMB_COMPILE_PROCESSES": "0"} | environment
        command = [sys.executable, "-W", "ignore", "-c", WITH_SHIPPED, str(shipped), *lacking]
        done = subprocess.run(command, capture_output=True, text=True, timeout=280, check=True, env=variables)
        for file in Path(cache).rglob("*.nb[ci]"):
            if "NUMBA_CPU_NAME" in environment:
                file.rename(shipped / file.name)
    return int(done.stdout)


@pytest.mark.skipif(platform.machine() != "x86_64", reason="wheels have machine code of x86-64 alone")
def test_machine_code_of_a_wheel_runs_where_the_processor_can(tmp_path: Path) -> None:
    """Compiled for all processors, it is found without a cache; one that lacks a feature of theirs compiles."""
    portable = {"NUMBA_CPU_NAME": PROCESSOR, "NUMBA_CPU_FEATURES": ""}
    assert compiled_with(tmp_path, **portable) > 0
    assert any(tmp_path.glob("*.nbc"))
    assert compiled_with(tmp_path) == 0
    assert compiled_with(tmp_path, "sse4.2") > 0
    assert compiled_with(tmp_path, NUMBA_CPU_FEATURES="-avx") > 0
