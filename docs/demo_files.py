"""A recording of generated traffic for Foxglove and for Rerun: `python docs/demo_files.py out/demo`."""

from __future__ import annotations

import sys
import threading
import time
from pathlib import Path
from typing import Final

from optipmb_client.zenoh import Connection
from optipmb_tools.cli import run
from optipmb_tools.commands.demo import SEED, START_S, STREAM, drive
from optipmb_tools.datasets import open_dataset
from optipmb_tools.recordings.record import Wanted, record
from optipmb_tools.run.service_process import ServiceProcess

FRAMES: Final = 200
WAIT_S: Final = 1.0
"""Until the recorder has subscribed, and after the last frame."""


def main(folder: Path) -> int:
    """Record what a service makes of a scene, and write the recording as a file of Rerun too."""
    (scene,) = open_dataset("scene", frames=FRAMES, seed=SEED, clouds=0).sequences(["0000"])
    frames = list(scene.frames())
    files = [folder / "demo.mcap", folder / "demo.rrd"]
    folder.mkdir(parents=True, exist_ok=True)
    for file in files:
        file.unlink(missing_ok=True)
    with ServiceProcess() as service:
        service.wait_until_ready(START_S)
        stop = threading.Event()
        with Connection(service.endpoint) as sending, Connection(service.endpoint) as receiving:
            wanted = Wanted([STREAM], points=False)
            recording = threading.Thread(target=record, args=(receiving, files[0], wanted), kwargs={"stop": stop})
            recording.start()
            time.sleep(WAIT_S)
            drive(sending, frames)
            time.sleep(WAIT_S)
            stop.set()
            recording.join()
    return run(["watch", str(files[0]), "--save", str(files[1])])


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
