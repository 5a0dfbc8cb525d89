"""Pictures of sequences from above."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import run_here
from evaluation_cases import evaluate_clear
from optipmb_client.errors import ClientError
from optipmb_tools.cli import run
from optipmb_tools.datasets import DataSequence, Truth, open_dataset
from optipmb_tools.evaluation import Rules
from optipmb_tools.evaluation.clear import ClearResult
from optipmb_tools.results import ResultTable, full_table
from optipmb_tools.views import pictures
from optipmb_tools.views.comparison import draw_comparison
from optipmb_tools.views.pictures import WIDTH_PX, Panel, animate_tracks, draw_tracks
from PIL import Image

PNG = b"\x89PNG\r\n\x1a\n"
RULES = Rules(measure="distance", limit=2.0)


def scene() -> tuple[DataSequence, Truth, ResultTable]:
    sequence = open_dataset("scene", frames=20).sequences(["all"])[0]
    truth = sequence.truth()
    assert truth is not None
    rows = truth.take(~truth.ignored & (truth.frame % 7 != 3))
    identity = np.where((rows.id == rows.id[0]) & (rows.frame > 10), 900, rows.id)
    columns = (rows.frame, identity, rows.label, rows.center, rows.size, rows.yaw)
    return sequence, truth, ResultTable(rows.labels, *columns, np.ones(len(rows)), rows.box2d)


def figure_of(path: Path, monkeypatch: pytest.MonkeyPatch, *arguments: object) -> Any:
    from matplotlib.figure import Figure  # noqa: PLC0415 - matplotlib is an extra

    found: list[Figure] = []
    save = Figure.savefig

    def remember(figure: Figure, *args: object, **options: object) -> None:
        save(figure, *args, **options)
        found.append(figure)

    monkeypatch.setattr(Figure, "savefig", remember)
    draw_tracks(path, *arguments)  # type: ignore[arg-type]  # passed on as they are
    return found[0]


def text_of(path: Path, monkeypatch: pytest.MonkeyPatch, *arguments: object) -> list[str]:
    from matplotlib.text import Text  # noqa: PLC0415 - matplotlib is an extra

    return [text.get_text() for text in figure_of(path, monkeypatch, *arguments).findobj(Text)]


def test_tracks_and_truth_are_inside_the_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With room for the boxes around the outermost centres."""
    sequence, truth, tracks = scene()
    axes = figure_of(tmp_path / "a.png", monkeypatch, sequence, [Panel(tracks, [])], truth).axes[0]
    places = np.vstack((truth.center, tracks.center))[:, :2]
    for limits, along in zip((axes.get_xlim(), axes.get_ylim()), places.T, strict=True):
        assert limits[0] < along.min() - 2.0
        assert limits[1] > along.max() + 2.0


def test_a_miss_with_a_track_that_is_not_confirmed_shows_that_track(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A dotted line in the place of crosses, where such a track is at the object."""
    sequence, truth, tracks = scene()
    results: list[ClearResult] = [evaluate_clear(truth, tracks, name, RULES) for name in truth.labels]
    rows = truth.take(~truth.ignored & (truth.frame % 7 == 3))
    columns = (rows.frame, rows.id, rows.label, rows.center, rows.size, rows.yaw)
    others = ResultTable(rows.labels, *columns, np.ones(len(rows)), rows.box2d)
    texts = text_of(tmp_path / "a.png", monkeypatch, sequence, [Panel(tracks, results, "", others)], truth)
    assert "track that is not confirmed" in texts
    assert "miss" not in texts


def test_a_comparison_has_the_identity_switches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside the shares of each class, with its number at each bar."""
    from matplotlib.axes import Axes  # noqa: PLC0415 - matplotlib is an extra

    numbers: list[str] = []
    monkeypatch.setattr(Axes, "bar_label", lambda _axes, _bar, labels, **_: numbers.extend(labels))
    draw_comparison(
        tmp_path / "c.png", {"car": {"a": {"MOTA": 0.5}, "b": {"MOTA": 0.6}}}, {"car": {"a": 7.0, "b": None}}
    )
    assert numbers == ["7", "-"]


def test_a_picture_shows_tracks_truth_sensor_and_failures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Axes in metres, a legend for each kind of line and mark, every track's id, and the change of identity by name."""
    sequence, truth, tracks = scene()
    results: list[ClearResult] = [evaluate_clear(truth, tracks, name, RULES) for name in truth.labels]
    assert sum(result.switches for result in results) == 1
    path = tmp_path / "new" / "tracks.png"
    texts = text_of(path, monkeypatch, sequence, [Panel(tracks, results)], truth)
    assert path.read_bytes().startswith(PNG)
    assert any("(m)" in text for text in texts)
    for name in ("truth", "sensor", "miss", "change of id"):
        assert name in texts
    assert {str(identity) for identity in np.unique(tracks.id)} <= set(texts)
    assert f"{tracks.id[0]} to 900" in texts


def test_the_same_tracks_give_the_same_bytes(tmp_path: Path) -> None:
    """A picture has no date in it."""
    sequence, truth, tracks = scene()
    for name in ("a.png", "b.png"):
        draw_tracks(tmp_path / name, sequence, [Panel(tracks)], truth)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_a_sequence_without_tracks_or_truth_is_drawn_too(tmp_path: Path) -> None:
    """Only the sensor's path, and also when there is a single track far away."""
    sequence, truth, tracks = scene()
    draw_tracks(tmp_path / "none.png", sequence, [Panel(full_table((), {}))])
    draw_tracks(tmp_path / "truth.png", sequence, [Panel(full_table((), {}))], truth)
    far = tracks.take(np.arange(1))
    far = replace(far, center=far.center + np.array([900.0, 0.0, 0.0]))
    draw_tracks(tmp_path / "far.png", sequence, [Panel(far)])
    assert len(list(tmp_path.glob("*.png"))) == 3


def test_without_matplotlib_the_error_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One clear error, which names the extra of the installation, and no import error."""
    sequence, _, tracks = scene()
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ClientError, match=r"pip install .*\[plot\]"):
        draw_tracks(tmp_path / "a.png", sequence, [Panel(tracks)])


def test_a_gif_shows_every_frame_in_the_time_of_the_sequence(tmp_path: Path) -> None:
    """One picture for each frame, shown as long as the frame lasts, in colours of tracks; the same bytes again."""
    sequence, truth, tracks = scene()
    for name in ("a.gif", "b.gif"):
        animate_tracks(tmp_path / name, sequence, tracks, truth)
    assert (tmp_path / "a.gif").read_bytes() == (tmp_path / "b.gif").read_bytes()
    with Image.open(tmp_path / "a.gif") as picture:
        durations = []
        for one in range(getattr(picture, "n_frames", 1)):
            picture.seek(one)
            durations.append(picture.info["duration"])
        assert (picture.width, durations) == (WIDTH_PX, [100] * (len(sequence) - 1) + [1000])
        shown = {colour for _, colour in picture.convert("RGB").getcolors(1 << 24) or ()}
    assert len(shown) > 10


def test_a_gif_follows_a_sensor_that_drives_far(tmp_path: Path) -> None:
    """Tracks over more than one view are drawn around the sensor, and without tracks or truth only what there is."""
    sequence, truth, tracks = scene()
    far = np.concatenate([tracks.center[:-20], tracks.center[-20:] + np.array([900.0, 0.0, 0.0])])
    animate_tracks(tmp_path / "far.gif", sequence, replace(tracks, center=far), truth)
    animate_tracks(tmp_path / "none.gif", sequence, full_table((), {}))
    with Image.open(tmp_path / "far.gif") as wide, Image.open(tmp_path / "none.gif") as empty:
        assert wide.height < wide.width == empty.width


def test_several_trackers_are_drawn_on_the_same_axes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """One panel for each --tracks, named by it, by its path where names are alike; a GIF shows one tracker."""
    from matplotlib.figure import Figure  # noqa: PLC0415 - matplotlib is an extra

    drawn: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_args, **_options: drawn.append(figure))
    data = ["--dataset", "scene", "--option", "frames=16", "--option", "clouds=0", "--sequences", "0000"]
    folders = [tmp_path / "one" / "x", tmp_path / "two" / "x", tmp_path / "wide.v2"]
    for folder, profile in zip(folders, ("scene", "kitti", "generic"), strict=True):
        assert run_here(capsys, "track", *data, "--profile", profile, "--out", folder).returncode == 0
    for chosen, names in (
        (folders[1:], ["x", "wide.v2"]),
        (folders[:2], [str(folder) for folder in folders[:2]]),
        (folders[:1], ["Sequence 0000"]),
    ):
        words = [word for folder in chosen for word in ("--tracks", folder)]
        done = run_here(capsys, "plot", *data, *words, "--out", tmp_path / "a.png")
        assert done.returncode == 0, done.stderr
        panels = drawn[-1].axes
        assert [panel.get_title().partition(":")[0] for panel in panels] == names
        assert len({(panel.get_xlim(), panel.get_ylim()) for panel in panels}) == 1
    words = [word for folder in folders for word in ("--tracks", folder)]
    done = run_here(capsys, "plot", *data, *words, "--out", tmp_path / "a.gif")
    assert done.returncode == 2
    assert "received 3" in done.stderr


def test_a_picture_of_own_data_shows_confirmed_tracks_and_no_sensor(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without truth and poses there are neither tracks of nothing nor a place of a sensor."""
    head, row = "t,x,y,z,l,w,h,yaw,score,class", "0.{},{},0,1,4.5,1.9,1.6,0,0.9,car"
    rows = [row.format(k, 10 * k) for k in range(3)]
    boxes, tracks = tmp_path / "boxes.csv", tmp_path / "tracks.csv"
    boxes.write_text("\n".join([head, *rows]))
    marked = [f"{one},{identity},{confirmed}" for one in rows for identity, confirmed in ((1, 1), (901, 0))]
    tracks.write_text("\n".join([f"{head},id,confirmed", *marked]))
    seen: list[Any] = []
    monkeypatch.setattr(pictures, "draw_tracks", lambda _path, *given: seen.extend(given))
    out = tmp_path / "own.png"
    assert run(["plot", str(boxes), "--tracks", str(tracks), "--out", str(out)]) == 0
    texts = text_of(out, monkeypatch, *seen)
    assert {"1", "start of a car"} <= set(texts)
    assert not {"901", "sensor"} & set(texts)
