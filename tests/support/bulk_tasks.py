"""Twenty small recordings, and tasks that die in the middle, for the tests of work in bulk."""

import os
import signal
import sys
import time
from collections.abc import Set as AbstractSet
from concurrent.futures import Future
from pathlib import Path
from typing import Any, Self

import numpy as np
from optipmb_tools.datasets import DatasetArguments
from optipmb_tools.run.bulk import Executor
from optipmb_tools.run.profiles import profile_for
from optipmb_tools.run.tracking import Tracking, track
from optipmb_tools.table_files import write_table
from own_tables import FRAMES, boxes

RECORDINGS = 20
LONG = 5
"""Frames of each."""


def recordings(folder: Path) -> Path:
    rows = 3 * LONG
    table = {name: np.tile(values[:rows], RECORDINGS) for name, values in boxes().items()}
    number = np.repeat(np.arange(RECORDINGS), rows)
    assert rows <= 3 * FRAMES
    table["x"] = table["x"] + 0.01 * number
    table["log"] = np.array([f"r{one:03d}" for one in number])
    write_table(folder / "d.csv", table)
    return folder / "d.csv"


def bytes_of(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def tracked_plainly(data: Path, out: Path) -> dict[str, bytes]:
    opened = DatasetArguments("table", data).open()
    sequences = opened.sequences(["all"])
    assert len(list(track(opened, sequences, out, Tracking(profile_for("kitti", sequences))))) == RECORDINGS
    return bytes_of(out)


def dying(shared: tuple[Any, Any, Path, AbstractSet[str], AbstractSet[str]], task: str) -> Any:
    """Run a task, but the first time some of them leave half a file and are killed, or stay until their node is."""
    function, given, folder, killed, stuck = shared
    mark = folder / f"{task}.begun"
    if task in killed | stuck and not mark.exists():
        (given.out / f".{task}.csv.half").write_text("half a f")
        mark.write_text(sys.modules["ray"].get_runtime_context().get_node_id() if "ray" in sys.modules else "here")
        if task in killed:
            os.kill(os.getpid(), signal.SIGKILL)
        while True:
            time.sleep(1.0)
    return function(given, task)


class Dying:
    """An executor some of whose tasks are killed in the middle when they run for the first time."""

    def __init__(
        self, executor: Executor, folder: Path, killed: AbstractSet[str], stuck: AbstractSet[str] = frozenset()
    ) -> None:
        self._executor = executor
        self._given = folder, killed, stuck
        self.attempts, self.here = executor.attempts, executor.here

    @property
    def width(self) -> int:
        return self._executor.width

    def start(self, function: Any, shared: Any) -> None:
        self._executor.start(dying, (function, shared, *self._given))

    def submit(self, task: Any) -> Future[Any]:
        return self._executor.submit(task)

    def take(self, future: Future[Any]) -> Any:
        return self._executor.take(future)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """The caller closes the executor."""
