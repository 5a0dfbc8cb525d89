"""Pages of tracks that a browser opens without a network."""

import json
import re
from pathlib import Path

import numpy as np
from optipmb_tools.views.page import write_page
from tracks_message import tracks_message


def test_a_page_is_one_small_file_with_the_confirmed_tracks(tmp_path: Path) -> None:
    """A thousand frames of twenty tracks take less than 2 MB, refer to nothing else, and lack unconfirmed tracks."""
    ids = np.arange(1, 21)
    rng = np.random.default_rng(1)
    places = np.cumsum(rng.normal(0.0, 1.0, (1000, 20, 3)), axis=0)
    tracks = {
        k: tracks_message(
            "a/b/c", k, ids.tolist(), stamp_ns=k * 10**8, center=places[k], yaw=k / 10, confirmed=(ids < 20).astype(int)
        )
        for k in range(1000)
    }
    page = tmp_path / "new" / "page.html"
    write_page(page, "</title>", tracks)
    text = page.read_text()
    assert len(text) < 2_000_000
    assert not re.search(r"https?:|src=|href=|</title></", text)
    data = json.loads(re.search(r"const data = (.*?), colours", text)[1])  # type: ignore[index]  # it is there
    assert [track[0] for track in data["tracks"]] == ids[:-1].tolist()
    np.testing.assert_allclose(np.cumsum(data["tracks"][3][5]) / 100, places[:, 3, 0], atol=0.006)


def test_tracks_have_the_colour_of_their_class_in_the_legend(tmp_path: Path) -> None:
    """The class of a track is a place in the list of those that the page names, not of all of the profile."""
    page = tmp_path / "page.html"
    tracks = tracks_message("a/b/c", 0, [1, 2], labels=("car", "bus", "dog"), label=[2, 0], confirmed=np.ones(2, int))
    write_page(page, "two", {0: tracks})
    data = json.loads(re.search(r"const data = (.*?), colours", page.read_text())[1])  # type: ignore[index]  # as above
    assert [data["labels"][track[1]] for track in data["tracks"]] == ["dog", "car"]
