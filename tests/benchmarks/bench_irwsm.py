"""IRWSM against a Kalman filter and RTS smoother of filterpy on the same series."""

import time

import numpy as np
from filterpy.kalman import KalmanFilter

from armident.identify.signals.irwsm import irwsm, optimal_nvr
from tests.benchmarks.harness import Row, best_of

SAMPLES = 50_000
NVR = 1e-2


def run() -> list[Row]:
    """Smoothing of one series of 50 000 samples, all of it by both."""
    rng = np.random.default_rng(0)
    y = np.sin(2 * np.pi * np.arange(SAMPLES) / 5000) + 1e-4 * rng.standard_normal(SAMPLES)

    kf = KalmanFilter(dim_x=2, dim_z=1)
    kf.F, kf.H = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[1.0, 0.0]])
    kf.Q, kf.R, kf.x, kf.P = np.diag([0.0, NVR]), np.eye(1), np.zeros((2, 1)), 1e7 * np.eye(2)
    start = time.perf_counter()
    means, covariances, _, _ = kf.batch_filter(y)
    states, _, _, _ = kf.rts_smoother(means, covariances)
    theirs = time.perf_counter() - start

    smooth = irwsm(y, 2, NVR)
    ours = best_of(lambda: irwsm(y, 2, NVR))
    level = float(np.abs(smooth.level - states[:, 0, 0]).max())
    slope = float(np.abs(smooth.slope - states[:-1, 1, 0]).max())
    note = f"{SAMPLES} samples; greatest difference {level:.1e} in level, {slope:.1e} in slope"

    positions = y[:45_000]
    optimal_nvr(positions, 2)

    def six_joints() -> None:
        for _ in range(6):
            first = irwsm(positions, 2, optimal_nvr(positions, 2))
            irwsm(first.slope, 2, optimal_nvr(first.slope, 2))

    return [
        Row("IRWSM vs filterpy Kalman filter + RTS smoother", ours, theirs, theirs / ours, "s", note),
        Row("IRWSM 1 of 6 x 45 000 samples, NVR by likelihood", best_of(six_joints), None, None, "s"),
    ]
