"""`optipmb replay --connect grpc://…`: the same files as over Zenoh and offline, also when a gateway goes."""

import json
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from commands import result_of, run_here, start
from gateway import GatewayProcess
from optipmb_client import Publisher, Subscriber
from optipmb_client.errors import ConnectionFailed
from optipmb_schemas.protobuf import tracking_pb2 as pb
from real_data import kitti_root
from routers import free_endpoint
from service_process import ServiceProcess

SCENE = ("--dataset", "scene", *(f"--option={one}" for one in ("vehicles=6", "pedestrians=3", "cyclists=1")))


@pytest.fixture(scope="module")
def gateways(service: ServiceProcess, gateway: GatewayProcess) -> Iterator[list[GatewayProcess]]:
    with GatewayProcess(service.endpoint) as second, GatewayProcess(service.endpoint) as third:
        for process in (second, third):
            process.wait_ready()
        yield [gateway, second, third]


def connect(*gateways: GatewayProcess) -> list[str]:
    return [part for gateway in gateways for part in ("--connect", f"grpc://{gateway.address}")]


def compare(out: Path, folders: tuple[str, ...], names: list[str]) -> None:
    for name in names:
        first, *others = ((out / folder / f"{name}.txt").read_bytes() for folder in folders)
        assert len(first.splitlines()) > 100
        assert all(other == first for other in others), name


def test_a_scene_with_clouds(
    service: ServiceProcess, gateways: list[GatewayProcess], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Through gRPC, through Zenoh and offline a scene gives the same file; no frame and no cloud is missing."""
    scene = (*SCENE, "--option", "frames=30")
    run_here(capsys, "track", *scene, "--out", tmp_path / "track")
    run_here(capsys, "replay", *scene, "--connect", service.endpoint, "--out", tmp_path / "zenoh")
    result = result_of(run_here(capsys, "replay", *scene, *connect(gateways[0]), "--out", tmp_path / "grpc", "--json"))
    compare(tmp_path, ("track", "zenoh", "grpc"), ["0000"])
    (sequence,) = result["sequences"]
    assert (sequence["clouds"], sequence["clouds_missed"], sequence["problems"], sequence["missing"]) == (30, 0, 0, 0)


def test_kitti_through_three_gateways_at_once(
    service: ServiceProcess, gateways: list[GatewayProcess], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Recorded sequences with clouds, each by a process and gateway of its own: the files of Zenoh and offline."""
    data = ("--dataset", "kitti", "--root", kitti_root(), "--detections", "pointrcnn")
    names = ["0000", "0003", "0017"]
    run_here(capsys, "track", *data, "--sequences", *names, "--out", tmp_path / "track")
    zenoh = ("--connect", service.endpoint, "--out", tmp_path / "zenoh")
    run_here(capsys, "replay", *data, "--sequences", *names, *zenoh)
    options = ("--json", "--out", str(tmp_path / "grpc"), *map(str, data))
    commands = [
        ["replay", *options, "--sequences", name, *connect(gateway)]
        for name, gateway in zip(names, gateways, strict=True)
    ]
    running = [start(*command) for command in commands]
    printed = [process.communicate(timeout=240)[0] for process in running]
    assert [process.returncode for process in running] == [0, 0, 0]
    assert json.loads(printed[0])["sequences"][0]["clouds"] > 0
    compare(tmp_path, ("track", "zenoh", "grpc"), names)


def test_a_gateway_that_is_killed_loses_nothing(
    service: ServiceProcess, gateways: list[GatewayProcess], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A gateway killed in the middle: the client goes on at another, every frame comes back once, the file is equal."""
    scene = (*SCENE, "--option", "frames=50", "--option", "seed=5")
    run_here(capsys, "track", *scene, "--out", tmp_path / "track")
    with GatewayProcess(service.endpoint) as doomed:
        doomed.wait_ready()
        # At five frames a second the sixteen clouds that a publisher keeps bridge three seconds without a gateway.
        command = ["replay", *scene, "--speed", "0.5", "--json", *connect(doomed, gateways[1])]
        with start(*command, "--out", tmp_path / "grpc") as replay:
            wait_for_frames(gateways[1], 15)
            doomed.process.send_signal(signal.SIGKILL)
            output, errors = replay.communicate(timeout=120)
    result: Any = result_of(subprocess.CompletedProcess(command, replay.returncode, output, errors))
    assert replay.returncode == 0
    compare(tmp_path, ("track", "grpc"), ["0000"])
    assert (result["sequences"][0]["returned"], result["missing"]) == (50, 0)


def wait_for_frames(gateway: GatewayProcess, frames: int) -> None:
    stub, ends = gateway.stub(), time.monotonic() + 60
    while time.monotonic() < ends:
        listed = stub.ListStreams(pb.ListStreamsRequest(pattern="replay/*/*"), wait_for_ready=True).streams
        if any(frames <= one.session.frames < 2 * frames for one in listed):
            return
        time.sleep(0.02)
    raise AssertionError(f"no stream with {frames} frames")


def test_publisher_and_subscriber_at_different_gateways(gateways: list[GatewayProcess], stream: str) -> None:
    """What one publishes at a gateway another gets at the next, problems too."""
    problems = []
    car: dict[str, Any] = {"center": [[1, 2, 0.8]], "size": [[4.5, 1.9, 1.6]], "yaw": [0.5], "score": [0.9]}
    with (
        Subscriber(
            stream, f"grpc://{gateways[1].address}", timeout=60.0, on_problem=lambda one: problems.append(one.code)
        ) as tracks,
        Publisher(stream, f"grpc://{gateways[0].address}", frame="world") as publisher,
    ):
        for k in range(20):
            publisher.publish(stamp_ns=10**18 + k * 10**8, label=["car" if k < 19 else "unicorn"], **car)
        arriving = iter(tracks)
        received = [message.seq for _, message in zip(range(20), arriving, strict=False)]
        for k in range(20, 220):  # problems have a path of their own: the next frames are waited for until it is here
            if problems:
                break
            publisher.publish(stamp_ns=10**18 + k * 10**8, label=["car"], **car)
            next(arriving)
    assert received == list(range(20))
    assert problems == ["unknown_class"]


def test_nobody_there_is_one_clear_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A gateway that does not answer is an error with its address, not a wait."""
    address = free_endpoint().removeprefix("tcp/")
    with pytest.raises(ConnectionFailed, match=address):
        Publisher("a/b/c", f"grpc://{address}", timeout=0.5)
    scene = (*SCENE, "--option", "frames=2")
    done = run_here(capsys, "replay", *scene, "--connect", f"grpc://{address}", "--wait", 0.5, "--out", tmp_path)
    assert done.returncode == 1
    assert address in done.stderr
    assert len(done.stderr.splitlines()) == 1
