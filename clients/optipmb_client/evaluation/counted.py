"""What counts: a case without the truth that is ignored and without the tracks that are neither right nor wrong.

The rules are those with which the HOTA of KITTI's benchmark is computed (TrackEval), for any similarity in [0, 1]. In
each frame, tracks and truth are matched so that the total similarity of pairs with at least a half is the greatest. A
track that is matched to ignored truth goes; so does one that is matched to nothing and is excused. Ignored truth goes.
Unlike the counts of CLEAR MOT and of AB3DMOT this is done once, before anything is measured.
"""

from dataclasses import replace

import numpy as np

from optipmb_client.evaluation.assignment import assign_frames, best_pairs
from optipmb_client.evaluation.cases import Case, Rules
from optipmb_client.geometry import Floats

HALF = 0.5
_EPSILON = float(np.finfo(np.float64).eps)


def similarity(case: Case, rules: Rules) -> Floats:
    """Return the similarity (P,) of the pairs in [0, 1].

    It is the intersection over union; or, with D_0 the distance up to which pairs may match, max(0, 1 - d / D_0).
    """
    scale = rules.limit if rules.measure == "distance" else 1.0
    return np.maximum(0.0, 1.0 - case.cost / scale)


def counted(case: Case, rules: Rules) -> Case:
    """Return the case with what counts; nothing in it is ignored, and nothing excused."""
    alike = similarity(case, rules)
    near = np.flatnonzero(alike >= HALF - _EPSILON)
    truth, track = case.truth_row[near], case.track_row[near]
    taken = assign_frames(case.truth_frame[truth], truth, track, alike[near], best_pairs)
    gone = case.excused.copy()
    gone[track[taken]] = case.ignored[truth[taken]]
    left = case.keep(~gone)
    wanted = ~case.ignored
    pairs = wanted[left.truth_row]
    place = np.cumsum(wanted) - 1
    return replace(
        left,
        truth_frame=case.truth_frame[wanted],
        truth_id=case.truth_id[wanted],
        ignored=case.ignored[wanted],
        excused=np.zeros(len(left.track_frame), dtype=np.bool_),
        truth_row=place[left.truth_row[pairs]].astype(np.int64),
        track_row=left.track_row[pairs],
        cost=left.cost[pairs],
        similarity=left.similarity[pairs],
    )
