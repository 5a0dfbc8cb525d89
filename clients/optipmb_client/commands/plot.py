"""`optipmb plot`: a picture of tracks from above."""

from pathlib import Path
from typing import Annotated

import typer

from optipmb_client.commands.evaluate import labels_of
from optipmb_client.commands.options import AsJson, LabelledOptions, open_sequences, print_json, say
from optipmb_client.errors import UsageError


def plot(
    data: LabelledOptions,
    *,
    tracks: Annotated[
        list[Path],
        typer.Option(
            help="Folder with the result files of track or replay, or a table of tracks; several times for several "
            "trackers side by side."
        ),
    ],
    out: Annotated[Path, typer.Option("--out", help="The PNG file, or a GIF file of a moving picture.")],
    score: Annotated[float | None, typer.Option(help="Least mean score of a track; default: the best one.")] = None,
    as_json: AsJson = False,
) -> None:
    """Draw the tracks of one sequence from above, with what was missed and confused where the truth is known."""
    from optipmb_client.drawing import draw_results  # noqa: PLC0415  loads the solvers of scipy
    from optipmb_client.evaluation import default_rules, evaluate_files  # noqa: PLC0415  as above

    if out.suffix == ".gif" and len(tracks) > 1:
        raise UsageError(f"--out {out}: a moving picture shows one --tracks, received {len(tracks)}; name a PNG file")
    asked = data.asked()
    _, chosen = open_sequences(asked, data.sequences)
    if len(chosen) != 1:
        raise UsageError(f"--sequences: one sequence makes a picture, received {len(chosen)}")
    (sequence,) = chosen
    known = sequence.truth() is not None
    rules = default_rules(asked.name)
    results = [evaluate_files(chosen, one, labels_of(chosen), rules) if known else [] for one in tracks]
    draw_results(out, sequence, tracks, results, score)
    if as_json:
        print_json({"command": "plot", "dataset": asked.name, "sequence": sequence.name, "picture": out})
    else:
        say(f"picture in {out}")
