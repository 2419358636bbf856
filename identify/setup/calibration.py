"""Probability of a finding: a logistic map of what the competition and the corrected model show."""

import numpy as np
from numpy.typing import NDArray

FEATURES = {
    "odds": 0.3,
    "error left at its joints": -1.0,
    "error left at any joint": 0.0,
    "fall of the error at its joints": 0.0,
    "fall of the error at any joint": 0.0,
    "share of joints that get worse": -1.0,
    "mistakes": 0.0,
    "more joints without friction": 0.0,
    "joints without friction": 0.0,
    "power taken": 0.0,
    "serial correlation": 0.0,
    "wiring": 0.0,
    "gravity": 0.0,
    "time": 0.0,
    "every torque in its own unit": 0.0,
    "factor of any value": 0.0,
    "gain of plausibility": 0.0,
    "moving joints": 0.0,
}
"""Coefficients by feature, see `Contest.features`; from ``python -m tests.evaluation.setup_calibration --out FILE``."""

INTERCEPT = 0.0

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
