"""Evaluation: tracks against the truth."""

from optipmb_client.evaluation.cases import Case, Rules, prepare
from optipmb_client.evaluation.clear import ClearResult, Miss, Sweep, Switch, clear, combine, evaluate_clear, sweep
from optipmb_client.evaluation.overlap import iou_3d, iou_bev
from optipmb_client.evaluation.run import ClassResult, default_rules, evaluate_files

__all__ = [
    "Case",
    "ClassResult",
    "ClearResult",
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
