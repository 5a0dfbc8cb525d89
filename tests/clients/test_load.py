"""A load: its frames, its search, and its counts, against a service that is queried too."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from load import FIRST, Run, chain, draw_runs, find_limit, generated, head, message, table_of
from optipmb_schemas import Detections, Points, decode

RUN = Run(
    streams=2, rate=10.0, objects=40.0, points=0.0, seconds=10.0, sent=200, received=200, repeated=0, cloudless=0,
    p50_ms=2.0, p99_ms=4.0, max_ms=5.0,
    stages_p50_ms=dict.fromkeys(("queue", "decode", "step", "deliver"), 0.5),
    stages_p99_ms=dict.fromkeys(("queue", "decode", "step", "deliver"), 1.0),
    late_p99_ms=0.1, generator_cpu=0.1,
)  # fmt: skip


def test_frames_are_messages_with_their_own_head() -> None:
    """A body under a head is the message with those four fields, for detections and clouds, and nothing else moves."""
    frames = generated(5, 100, rate=2.0)
    name = chain(("load-abc", "00007", "x"))
    for number, body in enumerate(frames.detections):
        begins = head(name, bytes(range(16)), FIRST + number, 1_600_000_000_000_000_000 + number)
        found = decode(message(body, begins), Detections)
        assert (found.stream, found.epoch, found.seq) == (name, bytes(range(16)), FIRST + number)
        assert found.stamp_ns == 1_600_000_000_000_000_000 + number
        assert (len(found.label), found.has_points) == (5, True)
    body = frames.clouds[0]
    assert body is not None
    assert decode(message(body, begins), Points).xyz.shape == (100, 3)


def test_generated_objects_go_round_without_a_jump() -> None:
    """From the last frame to the first an object moves as far as between any others."""
    frames = generated(9, 0, rate=10.0)
    begins = head(chain(("load-abc", "00007", "x")), bytes(16), FIRST, FIRST)
    centers = np.array([decode(message(body, begins), Detections).center for body in frames.detections])
    steps = np.linalg.norm(np.diff(np.concatenate([centers, centers[:1]]), axis=0)[..., :2], axis=2)
    assert steps.max() < 0.7
    assert abs(steps[-1].mean() - steps[:-1].mean()) < 0.1


@given(st.floats(0.5, 2000), st.floats(0.5, 200))
def test_the_limit_is_found(true: float, start: float) -> None:
    """The rate found holds, and one twentieth above it would not."""
    found, runs = find_limit(lambda rate: replace(RUN, rate=rate, p99_ms=10.0 if rate <= true else 30.0), start, 20.0)
    assert found <= true < found * 1.05 * (1 + 1e-9)
    assert len(runs) < 40


def test_a_lost_frame_does_not_hold() -> None:
    """Neither a lost frame, nor a cloud that was not used, nor a slow frame counts as held."""
    assert RUN.holds(4.0)
    assert not RUN.holds(3.9)
    assert not replace(RUN, received=199).holds(20.0)
    assert not replace(RUN, cloudless=1).holds(20.0)


def test_runs_are_shown(tmp_path: Path) -> None:
    """The table has a row per run, the picture is a PNG file."""
    runs = [RUN, replace(RUN, rate=20.0, received=190)]
    assert table_of(runs, 20.0).row_count == 2
    draw_runs(tmp_path / "folder" / "load.png", runs, 20.0)
    assert (tmp_path / "folder" / "load.png").read_bytes().startswith(b"\x89PNG")
