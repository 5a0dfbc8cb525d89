"""Scores of boxes as probabilities."""

from dataclasses import replace
from typing import Final

import numpy as np

from optipmb_tools.datasets.table.draft import Draft, leave_out, numbers
from optipmb_tools.datasets.table.findings import Claim, Reading
from optipmb_tools.geometry import Floats, Ints

PERCENT: Final = 100.0
LOGIT: Final = 30.0  # beyond it a sigmoid is 0 or 1 in six decimals; scores beyond it are no logits
ROUNDING: Final = 1e-3  # scores up to so much above 1 are 1
FEW: Final = 0.05  # share of values outside of a range up to which they are mistakes and not of another kind


def step(reading: Reading, draft: Draft) -> Draft:
    """Read the scores."""
    return replace(draft, score=numbers(reading, draft, "score", 1.0))


def probabilities(reading: Reading, draft: Draft) -> Draft:
    """Turn scores into probabilities, and leave out rows without one."""
    if "score" not in draft.roles or not draft.scored:
        return draft
    kept, score = draft.kept, draft.score.copy()
    score[kept] = read_scores(reading, score[kept], np.flatnonzero(kept))
    kept = leave_out(reading, kept, np.isnan(score), "with a score that is none")
    return replace(draft, score=score, kept=leave_out(reading, kept, score == 0.0, "with a score of 0"))


def read_scores(reading: Reading, scores: Floats, rows: Ints) -> Floats:
    """Return scores (B,) of the boxes in `rows` of the table as probabilities; NaN where one is to be left out.

    Raises:
        DatasetError: Some are outside of 0 to 1, and no kind of score fits all.
    """
    kind = reading.chosen("score", ("probability", "logit", "percent"))
    rounded = (scores > 1.0) & (scores <= 1.0 + ROUNDING)
    outside = ((scores < 0.0) | (scores > 1.0)) & ~rounded
    low, high = float(scores.min(initial=0.0)), float(scores.max(initial=0.0))
    within = not len(scores) or float(np.mean(outside)) <= FEW
    percent = not within and low >= 0.0 and PERCENT / 4 < high <= PERCENT
    logit = not within and not percent and max(high, -low) <= LOGIT
    seen, option = f"({low:.3g} to {high:.4g})", "--option score=probability, logit, percent"
    claims = (
        Claim("probability", possible=within),
        Claim("percent", text=f"scores look like percent {seen}: divided by 100", option=option, possible=percent),
        Claim("logit", text=f"scores look like logits {seen}: taken through a sigmoid", option=option, possible=logit),
    )
    kind = kind or reading.decide(
        "score",
        claims,
        expected="scores that are probabilities, percent or logits; scale them to 0 to 1",
        received=f"scores from {low:.4g} to {high:.4g}",
    )
    if kind == "logit":
        return np.asarray(1.0 / (1.0 + np.exp(-np.clip(scores, -LOGIT, LOGIT))), dtype=np.float64)
    if kind == "percent":
        scores = scores / PERCENT
    elif rounded.any():
        reading.note("score", f"{int(rounded.sum())} scores up to {scores[rounded].max():.9g} are taken for 1")
        scores = np.where(rounded, 1.0, scores)
    wrong = (scores < 0.0) | (scores > 1.0)
    if wrong.any() and not reading.skips:
        place = int(np.flatnonzero(wrong)[0])
        option = "--option invalid=skip leaves such rows out; score=logit, percent reads others"
        reading.refuse("score", "a score from 0 to 1", f"{scores[place]:g}", option, int(rows[place]))
    return np.where(wrong, np.nan, scores)
