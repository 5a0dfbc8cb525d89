"""Evaluate KITTI result files with AB3DMOT's published evaluation and print the figures as JSON.

Runs in an environment of its own that has `eval-ab-3d-mot`, which repackages the published code, and needs nothing of
this project:

    python run_ab3dmot.py LABELS RESULTS SEQUENCE=FRAMES...

Two accidents of the code are taken out, so that figures depend on nothing but tracks and truth:

- The loop over thresholds keeps or drops the tracks that are exactly at a threshold by the rounding of a mean that is
  taken again and again (the repackaged one drops them all). This rewrite keeps them.
- A track box that was matched at one threshold is remembered as matched at all later ones: if nothing matches it there,
  it is false even where it would not count otherwise. Here this is forgotten between thresholds.
"""

import json
import sys
from typing import Any

import eval_ab_3d_mot.core.tracking_evaluation as published
from eval_ab_3d_mot.thresholds import get_thresholds

POINTS = 40
ROUNDING = 1e-9


def keep_reached(scores: dict[int, list[float]], threshold: float) -> tuple[dict[int, float], list[int]]:
    """Return the mean scores of tracks, and the tracks that do not reach the threshold."""
    means = {identity: sum(values) / len(values) for identity, values in scores.items()}
    return means, [identity for identity, mean in means.items() if mean < threshold - ROUNDING]


def count(tool: published.TrackingEvaluation, threshold: float = -1e4, recall: float = 1.0) -> None:
    """Count with the tracks from a mean score on."""
    for box in (box for sequence in tool.tracker for frame in sequence for box in frame):
        box.valid = False
    tool.reset()
    tool.compute_3rd_party_metrics(threshold, recall)


def evaluate(labels: str, results: str, lengths: dict[str, int], name: str, limit: float) -> dict[str, Any]:
    published.filter_low_confidence = keep_reached
    tool = published.TrackingEvaluation("run", lengths, cls=name, thres=limit)
    tool.t_path, tool.gt_path = results, labels
    tool.load_data(is_ground_truth=False)
    tool.load_data(is_ground_truth=True)
    count(tool)
    thresholds, recalls = get_thresholds(list(tool.scores), tool.num_gt)
    sums = {"sAMOTA": 0.0, "AMOTA": 0.0, "AMOTP": 0.0}
    best, threshold = 0.0, None
    for score, recall in zip(thresholds, recalls, strict=True):
        count(tool, score, recall)
        sums["sAMOTA"] += tool.sMOTA / POINTS
        sums["AMOTA"] += tool.MOTA / POINTS
        sums["AMOTP"] += tool.MOTP / POINTS
        mota = float(tool.MOTA)
        if mota > best:
            best, threshold = mota, score
    count(tool, -1e4 if threshold is None else threshold)
    return {
        **sums,
        "points": len(thresholds),
        "score": threshold,
        "MOTA": tool.MOTA,
        "MOTP": tool.MOTP,
        "precision": tool.precision,
        "recall": tool.recall,
        "GT": tool.n_gt,
        "TP": tool.tp,
        "FP": tool.fp,
        "FN": tool.fn,
        "IDS": tool.id_switches,
        "FRAG": tool.fragments,
        "MT": tool.MT,
        "ML": tool.ML,
    }


def main(labels: str, results: str, *sequences: str) -> None:
    lengths = {name: int(count) for name, _, count in (text.partition("=") for text in sequences)}
    found = {
        f"{name} {limit:g}": evaluate(labels, results, lengths, name.lower(), limit)
        for name in ("Car", "Pedestrian", "Cyclist")
        for limit in (0.25, 0.5, 0.7)
    }
    json.dump(found, sys.stdout)


if __name__ == "__main__":
    main(*sys.argv[1:])
