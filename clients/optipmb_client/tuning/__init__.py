"""Tuning: from a detector's results and labels to a parameter profile; ablation and parameter sweeps."""

from optipmb_client.tuning.display import TrialDisplay
from optipmb_client.tuning.estimate import Estimate
from optipmb_client.tuning.refine import Plan, Refined
from optipmb_client.tuning.run import Curves, Source, calibrate_scores, estimate_all, tune_all
from optipmb_client.tuning.scoring import Figures, plain_figures
from optipmb_client.tuning.values import value_of
from optipmb_client.tuning.variants import ROWS, Row, Variant, ablation, measure_variants, sweep, write_sweep

__all__ = [
    "ROWS",
    "Curves",
    "Estimate",
    "Figures",
    "Plan",
    "Refined",
    "Row",
    "Source",
    "TrialDisplay",
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
