"""Sensors of a fused session that differ: settings, bytes over a restart, dumps, and reports."""

from collections.abc import Callable
from typing import Any

import numpy as np
import optipmb_schemas as schemas
import pytest
from fusing import FRONT, FUSED, REAR, SIDE, drive
from optipmb_schemas import Detections, Keys, SessionParameters, SessionState
from optipmb_service.app.configuration import load, missing_files
from optipmb_service.session.checkpoint import decode_checkpoint, encode_checkpoint, state_bytes
from optipmb_service.session.policy import Policy
from optipmb_service.session.session import Session
from optipmb_service.streams.profiles import Profiles
from optipmb_tools.run import dumps as client
from router import Node, until
from sessions import Failing, Merged, dumps, problems, tracks

import optipmb

KEYS = Keys()
NUSCENES = optipmb.load_profile("nuscenes")
UNEQUAL = optipmb.Sensors.read({
    "site/*/rear": {"profile": "kitti", "starts_tracks": False},
    "site/*/side": {"trust_size": False, "trust_heading": False},
})  # fmt: skip


def fused(sensors: optipmb.Sensors, **options: Any) -> Session:
    """A session of sensors that differ, which waits for nothing at its beginning."""
    policy = Policy(recovery_wait_ns=0, sensors=sensors, needs_view=bool(sensors.uses))
    return Session(FUSED, NUSCENES, policy, fused=True, **options)


def given_to(session: Session, frames: list[Detections]) -> list[Any]:
    return [output for frame in frames for output in session.on_detections(frame, 0)]


def in_order(count: int = 12) -> list[Detections]:
    frames = [sensor.detections(seq) for sensor in (FRONT, REAR, SIDE) for seq in range(count)]
    return sorted(frames, key=lambda one: (one.stamp_ns, one.stream))


def test_an_empty_entry_changes_no_byte() -> None:
    """Tracks, session ids and the state equal a session without the setting."""
    one, other = fused(optipmb.Sensors()), fused(optipmb.Sensors.read({"site/node/*": {}}))
    found, again = tracks(given_to(one, drive(30))), tracks(given_to(other, drive(30)))
    assert [schemas.encode(message) for message in found] == [schemas.encode(message) for message in again]
    assert state_bytes(one.snapshot()) == state_bytes(other.snapshot())


def test_any_order_and_a_restart_give_the_bytes_of_frames_in_order() -> None:
    """Frames of each sensor are used as its entry says, also when they are processed again or after a restore."""
    frames, rng = in_order(6), np.random.default_rng(2)
    one, other, merged, again = fused(UNEQUAL), fused(UNEQUAL), Merged(), Merged()
    merged.take(given_to(one, frames))
    order = [frames[at] for at in rng.permutation(len(frames))]
    again.take(given_to(other, order[:10]))
    policy = Policy(recovery_wait_ns=0, sensors=UNEQUAL)
    other = Session.restore(decode_checkpoint(encode_checkpoint(other.snapshot())), 0, policy)
    again.take(given_to(other, order[10:]), other.run)
    again.take(other.recovered(0), other.run)
    assert merged.plain() == again.plain()
    assert state_bytes(one.snapshot()) == state_bytes(other.snapshot())
    plain = Merged()
    plain.take(given_to(fused(optipmb.Sensors()), frames))
    assert plain.plain() != merged.plain()


def test_a_sensor_without_field_of_view_is_reported_once() -> None:
    """Of each sensor that sends none; in sessions whose sensors are alike nothing is said."""
    found = [one for one in problems(given_to(fused(UNEQUAL), in_order())) if one.code == "no_view"]
    assert [(one.stream, one.path) for one in found] == [
        (sensor.stream, "field_of_view") for sensor in (FRONT, SIDE, REAR)
    ]
    assert not [one for one in problems(given_to(fused(UNEQUAL), drive())) if one.code == "no_view"]
    assert not [one for one in problems(given_to(fused(optipmb.Sensors()), in_order())) if one.code == "no_view"]


def test_a_dump_is_replayed_with_the_parameters_of_each_sensor() -> None:
    """The frame that failed is the same one, and the densities before it were."""
    one = fused(UNEQUAL, tracker=Failing)
    given_to(one, in_order(6))
    outputs = one.on_detections(REAR.detections(6, objects=7), 0)
    dump = schemas.decode_dump(dumps(outputs)[0].dump)
    assert dump.sensors.keys() == {REAR.stream, SIDE.stream}
    densities: list[Any] = []

    class Noting(Failing):
        def step(self, density: optipmb.Density, frame: optipmb.Frame) -> optipmb.StepResult:
            densities.append(density)
            return super().step(density, frame)

    assert client.replay(dump, Noting).same
    assert optipmb.bytes_of(densities[-1]) == optipmb.bytes_of(one.density)


def test_scores_are_compared_with_the_filter_of_the_sensor() -> None:
    """Half of them lost by one sensor is reported, though the other's filter lets all pass."""
    strict = NUSCENES.model_dump(mode="json") | {"name": "strict"}
    for values in strict["classes"].values():
        values["score_filter"] = 0.99
    use = optipmb.Sensor(optipmb.parse_parameters(strict))
    one = fused(optipmb.Sensors((("site/*/rear", use),)))
    frames = [sensor.detections(seq, objects=20) for seq in range(60) for sensor in (FRONT, REAR)]
    found = [problem for problem in problems(given_to(one, frames)) if problem.code == "score_filter"]
    assert {problem.stream for problem in found} == {REAR.stream}


def test_the_service_uses_and_shows_the_setting(start: Callable[..., Any]) -> None:
    """`q/parameters` of the fused session has it, other sessions have not."""
    sensors = {"site/*/rear": {"profile": "kitti", "trust_size": False}, "yard/*/*": {"trust_size": False}}
    _, endpoint = start(fuse=["site/node/*"], sensors=sensors)
    frames = drive(20)
    wanted = fused(optipmb.Sensors.read({"site/*/rear": sensors["site/*/rear"]}))
    given_to(wanted, frames)
    with Node(endpoint) as node:
        node.send(*frames)
        until(lambda: node.ask(KEYS.query(FUSED, "state"), SessionState).frames == len(frames), "all are tracked")
        assert node.ask(KEYS.query(FUSED, "state"), SessionState).session == wanted.session
        shown = node.ask(KEYS.query(FUSED, "parameters"), SessionParameters)
        assert shown.sensors == {"site/*/rear": {"profile": "kitti", "trust_size": False}}
        assert node.ask(KEYS.query("other/node/lidar", "parameters"), SessionParameters).sensors is None


def test_a_profile_that_is_not_there_is_named() -> None:
    """By the check of the settings, and at the start."""
    settings = load(None, {"sensors": {"site/*/rear": {"profile": "none.toml"}}}).settings
    assert missing_files(settings) == ["setting sensors.site/*/rear.profile: none.toml: no such file"]
    with pytest.raises(optipmb.ParameterError, match=r"sensors\.site/\*/rear\.profile: expected one of"):
        Profiles.read("kitti", {}, settings.sensors)
