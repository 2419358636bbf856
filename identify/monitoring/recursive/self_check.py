"""Check at run time: the compiled update against filterpy's Kalman filter."""

from functools import cache
from typing import Any

import numpy as np

from armident.compiled import SHIPPED
from armident.configs import ArmidentError
from armident.identify.monitoring.recursive.kernels import update

TOLERANCE = 1e-9
"""Largest difference from filterpy, for values of about one: rounding errors of a few updates are below 1e-14."""


@cache
def check_update() -> None:
    """Compare the compiled update with filterpy once per process; raises ArmidentError if the machine code is wrong."""
    from filterpy.kalman import KalmanFilter

    make: Any = KalmanFilter
    random = np.random.default_rng(0)
    n, b = 2, 4
    state, covariance = np.zeros(b), np.eye(b)
    oracle = make(b, n)
    oracle.x, oracle.P, oracle.F, oracle.Q = np.zeros((b, 1)), np.eye(b), np.eye(b), 0.1 * np.eye(b)
    variance = np.array([0.5, 2.0])
    oracle.R = np.diag(variance)
    for _ in range(10):
        x, y = random.standard_normal((n, b)), random.standard_normal(n)
        oracle.H = x
        oracle.predict()
        oracle.update(y[:, None])
        covariance += oracle.Q
        update(state, covariance, x, x, y, variance, np.ones(n, np.bool_))
    if max(np.abs(state - oracle.x[:, 0]).max(), np.abs(covariance - oracle.P).max()) > TOLERANCE:
        raise ArmidentError(f"the compiled update differs from filterpy's: remove the folder {SHIPPED} and try again")
