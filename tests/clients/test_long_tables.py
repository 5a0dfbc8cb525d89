"""Memory of the readers of tables, by the number of rows."""

import subprocess
import sys
from pathlib import Path

import numpy as np
from optipmb_tools.table_files import write_table

ROWS = 500_000
MOST = 240
"""Bytes of memory for each row of a text table with eleven columns; 190 are used, 88 are the numbers themselves."""


def peak(path: Path) -> int:
    """Return the largest memory in bytes of a process that checks a table."""
    code = "import resource, sys; from optipmb_tools.cli import run; assert run(['check', sys.argv[1]]) == 0;"
    code += "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)"
    done = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=True)
    return int(done.stdout.split()[-1]) * 1024


def test_a_long_table_is_not_held_as_text(tmp_path: Path) -> None:
    """A row takes a few times the memory of its numbers, so that five million rows take less than 1.5 gigabytes."""
    frame, car = np.divmod(np.arange(ROWS), 100)
    columns = {
        "recording": np.char.add("drive_", (frame // 500).astype(np.str_)),
        "t": 1.7e9 + frame * 0.1,
        "class": np.where(car % 5 == 0, "truck", "car"),
        "x": car % 10 * 25.0 + (car % 3) * 0.8 * (frame % 200),
        "y": car // 10 * 25.0,
        **{name: np.full(ROWS, value) for name, value in (("z", 0.8), ("h", 1.6), ("yaw", 0.0), ("score", 0.8))},
        "l": np.where(car % 5 == 0, 9.0, 4.5),
        "w": np.where(car % 5 == 0, 2.6, 1.9),
    }
    write_table(tmp_path / "long.csv", columns)
    write_table(tmp_path / "short.csv", {name: one[:200] for name, one in columns.items()})
    assert peak(tmp_path / "long.csv") - peak(tmp_path / "short.csv") < MOST * ROWS
