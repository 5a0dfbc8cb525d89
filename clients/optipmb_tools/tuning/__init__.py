"""Tuning: from a detector's results and labels to a parameter profile; ablation and parameter sweeps."""

from optipmb_tools.tuning.estimate import Estimate
from optipmb_tools.tuning.run import Curves, TuningData, calibrate_scores, estimate_all, tune_all
from optipmb_tools.tuning.scoring import Figures, plain_figures
from optipmb_tools.tuning.study import Plan, Tuned
from optipmb_tools.tuning.values import value_of
from optipmb_tools.tuning.variants import Row, Variant, ablation, measure_variants, sweep, write_sweep

__all__ = [
    "Curves",
    "Estimate",
    "Figures",
    "Plan",
    "Row",
    "Tuned",
    "TuningData",
    "Variant",
    "ablation",
    "calibrate_scores",
    "estimate_all",
    "measure_variants",
    "plain_figures",
    "sweep",
    "tune_all",
    "value_of",
    "write_sweep",
]
