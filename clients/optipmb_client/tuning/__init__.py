"""Tuning: from a detector's results and labels to a parameter profile; ablation and parameter sweeps."""

from optipmb_client.tuning.display import TrialDisplay
from optipmb_client.tuning.estimate import Estimate, estimate
from optipmb_client.tuning.refine import Plan, Refined, refine
from optipmb_client.tuning.run import Curves, Source, Tuned, calibrate_scores, estimate_all, tune_all
from optipmb_client.tuning.scoring import METRICS, Figures, plain_figures
from optipmb_client.tuning.values import value_of
from optipmb_client.tuning.variants import ROWS, Row, Variant, ablation, measure_variants, sweep, write_sweep

__all__ = [
    "METRICS",
    "ROWS",
    "Curves",
    "Estimate",
    "Figures",
    "Plan",
    "Refined",
    "Row",
    "Source",
    "TrialDisplay",
    "Tuned",
    "Variant",
    "ablation",
    "calibrate_scores",
    "estimate",
    "estimate_all",
    "measure_variants",
    "plain_figures",
    "refine",
    "sweep",
    "tune_all",
    "value_of",
    "write_sweep",
]
