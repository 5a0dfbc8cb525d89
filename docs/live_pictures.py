"""Pictures of the live page: `python docs/live_pictures.py docs/images`; needs Chromium and the extra `dev`."""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Final

from optipmb_client.zenoh import Connection
from optipmb_tools.commands.demo import START_S, STREAM, drive
from optipmb_tools.datasets import open_dataset
from optipmb_tools.run.service_process import ServiceProcess, free_port
from selenium import webdriver

ZONES: Final = {
    "street": {"streams": [STREAM], "polygon": [[-22, -34], [22, -34], [22, -18], [-22, -18]]},
    "gate": {"streams": [STREAM], "line": [[-4, -38], [-4, -14]]},
}
SIZES: Final = {"live": (1100, 700, "light"), "live-phone": (390, 760, "dark")}
SELECT: Final = """
for (let k = 0; k < 3; k++) document.getElementById("closer").click();
const speed = (one) => Math.hypot(one[VX], one[VY]);
selected = frame.tracks.filter((one) => one[MISSED] === 0).sort((a, b) => speed(b) - speed(a))[0][ID];
"""
"""Come closer, and show the figures of the fastest track."""
FRAMES: Final = 200
SHOWN_S: Final = 15.0
"""Time since the first frame, so that there are trails and events."""


def main(folder: Path) -> None:
    """Drive generated traffic through a service, and take pictures of its page."""
    (scene,) = open_dataset("scene", frames=FRAMES, seed=4, clouds=0).sequences(["0000"])
    frames = list(scene.frames())
    place = f"127.0.0.1:{free_port()}"
    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or ""
    with (
        tempfile.TemporaryDirectory() as profile,
        ServiceProcess(["--http", place], environment={"OPTIPMB_ZONES": json.dumps(ZONES)}) as service,
    ):
        for flag in ("headless", "no-sandbox", "disable-gpu", f"user-data-dir={profile}"):
            options.add_argument(f"--{flag}")
        service.wait_until_ready(START_S)
        with Connection(service.endpoint) as connection:
            driving = threading.Thread(target=drive, args=(connection, frames), daemon=True)
            driving.start()
            began = time.monotonic()
            chrome = webdriver.Chrome(options, webdriver.ChromeService(shutil.which("chromedriver")))
            chrome.get(f"http://{place}/#{STREAM}")
            time.sleep(max(0.0, began + SHOWN_S - time.monotonic()))
            chrome.execute_script(SELECT)
            for name, (width, height, scheme) in SIZES.items():
                metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < height}
                feature = {"name": "prefers-color-scheme", "value": scheme}
                chrome.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
                chrome.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [feature]})
                time.sleep(1.0)
                chrome.save_screenshot(str(folder / f"{name}.png"))
            chrome.quit()
            driving.join()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
