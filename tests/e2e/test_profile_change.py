"""A profile that changes in the settings, for a stream that has a checkpoint."""

import json
from pathlib import Path

import pytest
from commands import run_here
from router import Node, Sensor, until
from service_process import ServiceProcess

SENSOR = Sensor()


def test_a_profile_that_differs_from_the_settings_is_shown_and_changed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The log and the status name both profiles; `optipmb set … --restart` changes the one in force."""
    environment = {"OPTIPMB_STORE": str(tmp_path)}

    def started(profile: str) -> ServiceProcess:
        return ServiceProcess("--profile", profile, "--instance", "one", environment=environment)

    with started("kitti") as service:
        service.wait_ready()
        with Node(service.endpoint) as node:
            node.send(*(SENSOR.detections(seq) for seq in range(5)))
            node.tracks(SENSOR.stream, 5)
        assert service.end()[0] == 0
    with started("nuscenes") as service:
        service.wait_ready()

        def profiles() -> list[tuple[str, str | None]]:
            done = run_here(capsys, "status", "--connect", service.endpoint, "--json")
            assert done.returncode == 0, done.stderr
            sessions = json.loads(done.stdout)["services"][0]["sessions"]
            return [(one["profile"], one.get("configured")) for one in sessions]

        with Node(service.endpoint) as node:
            node.send(SENSOR.detections(5))
            node.tracks(SENSOR.stream, 1)
        service.wait_log("profile_differs")
        until(lambda: profiles() == [("kitti", "nuscenes")], "both are shown")
        assert "kitti, not nuscenes" in run_here(capsys, "status", "--connect", service.endpoint).stdout
        change = ("set", SENSOR.stream, "--profile", "nuscenes", "--connect", service.endpoint)
        refused = run_here(capsys, *change)
        assert (refused.returncode, refused.stderr.count("\n")) == (1, 1)
        assert "restart = true" in refused.stderr
        done = run_here(capsys, *change, "--restart")
        assert (done.returncode, done.stdout) == (0, f"{SENSOR.stream} is tracked with nuscenes\n")
        assert profiles() == [("nuscenes", None)]
        unknown = run_here(capsys, "set", SENSOR.stream, "--profile", "other", "--connect", service.endpoint)
        assert "one of" in unknown.stderr
