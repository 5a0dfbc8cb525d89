"""A world that moves, through a real service: the example of the documentation, recorded and played again."""

import re
import subprocess
import sys
from pathlib import Path

from commands import kill, run_here
from optipmb_client.zenoh import DEFAULT_ENDPOINT
from optipmb_tools.run.service_process import ServiceProcess
from real_data import REPOSITORY
from test_record_and_play import recording


def test_a_car_keeps_its_id_where_the_world_moves(service: ServiceProcess, tmp_path: Path) -> None:
    """The example prints one track, in both worlds; its recording plays to the same bytes."""
    page = (REPOSITORY / "docs" / "operation.md").read_text(encoding="utf-8")
    found = re.search(r"## When the world moves.*?```python\n(.*?)```", page, re.DOTALL)
    assert found is not None
    where = f', connect="{service.endpoint}"'
    code = found[1].replace("timeout=10)", f"timeout=60{where})").replace('frame="world")', f'frame="world"{where})')
    assert code.count(where) == 2, DEFAULT_ENDPOINT
    path = tmp_path / "moved.mcap"
    with recording(service, path) as recorder:
        run = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True, timeout=200)
        kill(recorder)
    lines = [line.split() for line in run.stdout.splitlines()]
    assert {(line[1], line[3]) for line in lines} == {("0", "1"), ("1", "1")}
    x, y = map(float, lines[-1][5:])
    assert abs(x - 100.0) < 0.3
    assert abs(y - 59.5) < 0.3
    played = run_here("replay", path, "--connect", service.endpoint)
    assert played.code == 0
