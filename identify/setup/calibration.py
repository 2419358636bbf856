"""Probability of a finding: a logistic map of what the competition and the corrected model show."""

import numpy as np
from numpy.typing import NDArray

FEATURES = {
    "odds": 0.597,
    "error left at any joint": -0.027,
    "fall of the error of the joint that improves most": 0.734,
    "share of joints without friction": -1.816,
    "gain of plausibility": 1.112,
}
"""Coefficients by feature, see `Contest.features`; from ``python -m tests.evaluation.setup_calibration --out FILE``."""

INTERCEPT = -2.338

EXTREMES = (0.01, 0.995)
"""Least and largest probability: a thousand findings do not tell more."""

CORRECTED = 0.95
"""Probability from which on a correction is printed to copy, and applied."""

NAMED = 0.5
"""Probability below which a finding is none where the rigid model explains the set-up as configured."""


def probability(features: NDArray[np.float64]) -> float:
    """Probability that a finding is right."""
    log_odds = INTERCEPT + float(np.array(list(FEATURES.values())) @ features)
    return float(np.clip(1.0 / (1.0 + np.exp(-log_odds)), *EXTREMES))
