"""HOTA of image boxes, as the KITTI tracking benchmark ranks by it, through the package TrackEval.

Conventions: image boxes in pixels; the similarity is their intersection over union. What is ignored is the benchmark's
own rule (`optipmb_client.evaluation.counted`): truth boxes that are largely invisible, cut by the image's border or of
a class alike, and unmatched tracks at most 25 pixels high or in unannotated regions. The benchmark ranks cars and
pedestrians; cyclists are treated in the same way.
"""

import importlib
from collections.abc import Sequence
from types import ModuleType
from typing import Any

import numpy as np

from optipmb_client.errors import ClientError
from optipmb_client.evaluation.cases import Case, Rules
from optipmb_client.evaluation.counted import counted, similarity
from optipmb_client.evaluation.hota import NOTHING, HotaResult

_ALIKE = {"Car": ("Van",), "Pedestrian": ("Person", "Person_sitting")}
_MIN_HEIGHT = 25.0


def hota_2d_rules() -> Rules:
    """Return the rules for cases of image boxes."""
    return Rules("iou_2d", 0.0, continuity=False, neighbours=_ALIKE, min_height=_MIN_HEIGHT, regions=True)


def evaluate_hota_2d(cases: Sequence[Case]) -> HotaResult:
    """Return the figures of one class over all sequences; cases by `hota_2d_rules`.

    Raises:
        ClientError: TrackEval is not installed.

    """
    metric = _trackeval().metrics.HOTA()
    total = NOTHING
    for case in cases:
        found = metric.eval_sequence(_data(counted(case, hota_2d_rules())))
        true = np.asarray(found["HOTA_TP"], dtype=np.float64)
        total += HotaResult(
            true=true,
            missed=np.asarray(found["HOTA_FN"], dtype=np.float64),
            false=np.asarray(found["HOTA_FP"], dtype=np.float64),
            association=np.asarray(found["AssA"] * true, dtype=np.float64),
            location=np.asarray(found["LocA"] * true, dtype=np.float64),
        )
    return total


def _trackeval() -> ModuleType:
    try:
        return importlib.import_module("trackeval")
    except ImportError as error:
        text = "HOTA of image boxes needs TrackEval, which is not installed: pip install 'optipmb[evaluation]'"
        raise ClientError(text) from error


def _data(case: Case) -> dict[str, Any]:
    """Return one sequence as TrackEval's metrics take it."""
    alike = similarity(case, hota_2d_rules())
    _, object_of = np.unique(case.truth_id, return_inverse=True)
    _, track_of = np.unique(case.track_id, return_inverse=True)
    frames = np.unique(np.concatenate([case.truth_frame, case.track_frame]))
    objects, tracks, tables = [], [], []
    for frame in frames:
        begin, end = np.searchsorted(case.truth_frame, [frame, frame + 1])
        start, stop = np.searchsorted(case.track_frame, [frame, frame + 1])
        table = np.zeros((end - begin, stop - start))
        pairs = slice(*np.searchsorted(case.truth_row, [begin, end]))  # pairs stand in the order of their truth rows
        table[case.truth_row[pairs] - begin, case.track_row[pairs] - start] = alike[pairs]
        objects.append(object_of[begin:end])
        tracks.append(track_of[start:stop])
        tables.append(table)
    return {
        "num_timesteps": len(frames),
        "num_gt_ids": len(np.unique(object_of)),
        "num_tracker_ids": len(np.unique(track_of)),
        "num_gt_dets": len(object_of),
        "num_tracker_dets": len(track_of),
        "gt_ids": objects,
        "tracker_ids": tracks,
        "similarity_scores": tables,
    }
