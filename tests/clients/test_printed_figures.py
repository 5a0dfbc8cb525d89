"""Figures that commands compute as they print them."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from optipmb_tools.commands import recordings, replay, track
from optipmb_tools.recordings.record import Recording


def said_by_track(capsys: pytest.CaptureFixture[str]) -> str:
    result: Any = SimpleNamespace(name="a", frames=150, tracks=7, seconds=2.0, step=None, joined=None, learned=())
    track._say_result(result)
    return capsys.readouterr().out


def said_by_replay(_: object) -> str:
    result: Any = SimpleNamespace(name="a", sent=151, returned=150, tracks=7, seconds=2.0, latency=None)
    return replay._line(result)


def said_by_record(_: object) -> str:
    return recordings._progress(Recording(Path("a.mcap"), messages=150, seconds=2.0, size=3_400_000), 10.0)


@pytest.mark.parametrize(
    ("line", "figures"),
    [
        (said_by_track, ["a: 150 frames, 7 tracks, 75 frames/s"]),
        (said_by_replay, ["151 frames sent, 150 returned, 7 tracks", "75 frames/s"]),
        (said_by_record, ["150 messages, 75 per second, 3.4 MB, 8 s left"]),
    ],
)
def test_a_rate_is_what_was_done_by_the_time_it_took(
    line: Any, figures: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    """Of frames and of messages, beside the number that it is the rate of."""
    said = line(capsys)
    assert [one for one in figures if one not in said] == []
