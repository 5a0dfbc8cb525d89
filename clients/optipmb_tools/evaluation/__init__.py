"""Evaluation: tracks against the truth."""

from optipmb_tools.evaluation.cases import Case, Rules, default_rules, prepare
from optipmb_tools.evaluation.clear import (
    ClearResult,
    Counts,
    Miss,
    Sweep,
    Switch,
    clear,
    combine,
    evaluate_clear,
    sweep,
)
from optipmb_tools.evaluation.evaluate import ClassResult, evaluate_files
from optipmb_tools.evaluation.overlap import iou_3d, iou_bev

__all__ = [
    "Case",
    "ClassResult",
    "ClearResult",
    "Counts",
    "Miss",
    "Rules",
    "Sweep",
    "Switch",
    "clear",
    "combine",
    "default_rules",
    "evaluate_clear",
    "evaluate_files",
    "iou_3d",
    "iou_bev",
    "prepare",
    "sweep",
]
