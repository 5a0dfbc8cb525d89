"""Evaluation: tracks against the truth."""

from optipmb_tools.evaluation.cases import Rules, default_rules
from optipmb_tools.evaluation.clear import combine
from optipmb_tools.evaluation.evaluate import ClassResult, evaluate_files

__all__ = ["ClassResult", "Rules", "combine", "default_rules", "evaluate_files"]
