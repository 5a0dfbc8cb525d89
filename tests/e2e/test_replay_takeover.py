"""A replay with clouds at the recorded rate, while the service that tracks it freezes and another one takes over."""

import threading
from pathlib import Path

import pytest
from commands import run_here
from fleet import Fleet, freeze
from router import Node, until
from takeovers import KEYS

SCENE = ("--dataset", "scene", "--profile", "kitti", "--option", "frames=70", "--option", "vehicles=6")


def test_no_cloud_is_lost_by_a_takeover(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The result equals offline tracking, byte for byte, though the takeover takes longer than the cloud cache."""
    done = run_here(capsys, "track", *SCENE, "--out", str(tmp_path / "offline"))
    assert done.returncode == 0, done.stderr
    with Fleet(tmp_path / "store", checkpoint_s=0.3) as fleet, Node(fleet.endpoint) as node:
        (tmp_path / "store").mkdir()
        services = {name: fleet.service(name) for name in "ab"}

        def disturb() -> None:
            until(lambda: len(node.tracks_seen.items) > 20, "some frames are tracked")
            (owner,) = node.alive(KEYS.all_owners())
            freeze(services[KEYS.instance_of(owner)])

        disturbing = threading.Thread(target=disturb, daemon=True)
        disturbing.start()
        out = tmp_path / "replayed"
        done = run_here(capsys, "replay", *SCENE, "--speed", "1", "--connect", fleet.endpoint, "--out", str(out))
        disturbing.join(60)
        assert done.returncode == 0, done.stdout + done.stderr
    assert (out / "0000.txt").read_bytes() == (tmp_path / "offline" / "0000.txt").read_bytes()
