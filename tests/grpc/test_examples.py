"""Independent clients: Python with the generated stubs alone, and Node from the .proto file alone."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from gateway import GatewayProcess

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples" / "grpc"
ADDRESS = "127.0.0.1:50051"


def copied(name: str, gateway: GatewayProcess, folder: Path) -> Path:
    """The example, for a gateway that does not listen at the default address."""
    text = (EXAMPLES / name).read_text()
    assert text.count(ADDRESS) == 1
    path = folder / name
    path.write_text(text.replace(ADDRESS, gateway.address))
    return path


def check(output: str) -> None:
    """One car under one number, that drives along x at 10 m/s."""
    rows = [line.split() for line in output.splitlines() if line.startswith("frame")]
    assert len(rows) >= 45, output
    assert len({row[3] for row in rows}) == 1
    x = [float(row[5]) for row in rows]
    assert x == sorted(x)
    assert x[-1] == pytest.approx(49.0, abs=1.0)


@pytest.mark.parametrize("time", [1, 2])
def test_python_with_stubs(gateway: GatewayProcess, tmp_path: Path, time: int) -> None:
    """The example prints the car's track for every frame, and again with the state that is left."""
    del time
    command = [sys.executable, str(copied("track.py", gateway, tmp_path))]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    check(done.stdout)


def test_node_from_the_schema(gateway: GatewayProcess, tmp_path: Path) -> None:
    """The example in another language, with packages of its own and the .proto file, prints the same."""
    if shutil.which("npm") is None:
        pytest.skip("npm is not installed")
    for name in ("package.json", "package-lock.json"):
        shutil.copy(EXAMPLES / name, tmp_path)
    install = ["npm", "ci", "--silent", "--no-audit", "--no-fund", "--ignore-scripts"]
    subprocess.run(install, cwd=tmp_path, check=True, timeout=120)
    schema = ROOT / "schemas" / "proto" / "optipmb" / "v1" / "tracking.proto"
    command = ["node", str(copied("track.mjs", gateway, tmp_path)), str(schema)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    check(done.stdout)
