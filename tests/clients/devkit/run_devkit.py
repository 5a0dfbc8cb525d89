"""Evaluate a nuScenes result file with the official tools and print the figures as JSON.

Runs in an environment of its own that has `nuscenes-devkit`, and needs nothing of this project:

    python run_devkit.py ROOT VERSION SPLIT RESULTS
"""

import contextlib
import json
import sys
import tempfile

from nuscenes.eval.common.config import config_factory
from nuscenes.eval.tracking.evaluate import TrackingEval


def main(root: str, version: str, split: str, results: str) -> None:
    with tempfile.TemporaryDirectory() as out, contextlib.redirect_stdout(sys.stderr):
        evaluation = TrackingEval(
            config=config_factory("tracking_nips_2019"),
            result_path=results,
            eval_set=split,
            output_dir=out,
            nusc_version=version,
            nusc_dataroot=root,
            verbose=False,
        )
        metrics, curves = evaluation.evaluate()
    summary = metrics.serialize()
    names = list(summary["label_metrics"])
    result = {
        "classes": {
            label: {name: summary["label_metrics"][name][label] for name in names} for label in metrics.class_names
        },
        "overall": {name: summary[name] for name in names},
        "curves": curves.serialize(),
    }
    json.dump(result, sys.stdout)


if __name__ == "__main__":
    main(*sys.argv[1:])
