"""A service in a process of its own gives the final tracks of the recordings.

How often tracks are corrected depends on which frames wait when a late one arrives, and that on the machine.
"""

import json

import pytest
from optipmb_schemas import Detections, Tracks, decode
from router import Node, until
from scenarios import FILE, PROFILE, SCENARIOS, SENSOR, Recorded
from service_process import ServiceProcess


@pytest.mark.parametrize("scenario", ["late", "jumps"])
def test_final_tracks_are_those_that_were_recorded(scenario: str) -> None:
    """Frames published over Zenoh, late and with jumps of their stamps, give the recorded tracks."""
    recorded = json.loads(FILE.read_text())[f"{scenario} filter"]["final"]
    with ServiceProcess("--profile", str(PROFILE)) as service:
        service.wait_ready()
        with Node(service.endpoint) as node:
            for step in SCENARIOS[scenario]():
                node.send(
                    *(one for one in (step if isinstance(step, tuple) else (step,)) if isinstance(one, Detections))
                )

            def final() -> str:
                out = Recorded()
                for key, payload, _ in tuple(node.tracks_seen.items):
                    assert key == node.keys.tracks(SENSOR.stream)
                    out.message(decode(payload, Tracks))
                return out.summary().get("final", "")

            until(lambda: final() == recorded, lambda: f"{recorded}, and not {final()}")
