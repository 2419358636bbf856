"""Live velocities: filterpy's filter, what a causal filter may and may not do, gaps, batches."""

from typing import Any

import numpy as np
import pytest
from filterpy.common import Q_continuous_white_noise
from filterpy.kalman import KalmanFilter
from numpy.typing import NDArray

from armident.configs import DataError
from armident.identify.signals.irwsm import automatic_nvr
from armident.identify.signals.live import PRIOR, VelocityFilter

DT = 2e-4
NOISE = 1e-6


def motion(samples: int = 20000) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    t = np.arange(samples)[:, None] * DT
    w = 2 * np.pi * np.array([0.7, 1.9])
    amplitude = np.array([0.5, 0.1])
    return amplitude * np.sin(w * t), amplitude * w * np.cos(w * t), -amplitude * w**2 * np.sin(w * t)


def measured(seed: int = 0) -> NDArray[np.float64]:
    q, _, _ = motion()
    return q + NOISE * np.random.default_rng(seed).standard_normal(q.shape)


def oracle(y: NDArray[np.float64], nvr: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """States (N, 3) in samples and the last covariance of filterpy's filter on one joint."""
    kf: Any = KalmanFilter(dim_x=3, dim_z=1)
    kf.F, kf.H, kf.R = np.array([[1.0, 1.0, 0.5], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]]), np.eye(3)[:1], np.eye(1)
    kf.Q = Q_continuous_white_noise(3, dt=1.0, spectral_density=nvr)
    kf.x = np.zeros((3, 1))
    kf.x[0] = y[0]
    kf.P = np.diag([1.0, PRIOR, PRIOR])
    states = [kf.x[:, 0].copy()]
    for value in y[1:]:
        kf.predict()
        kf.update(None if np.isnan(value) else value)
        states.append(kf.x[:, 0].copy())
    return np.array(states), kf.P


@pytest.mark.parametrize("nvr", [1e-7, 1e-2])
def test_states_and_covariance_are_those_of_filterpy(nvr: float) -> None:
    y = measured()[:1500]
    y[700:720, 0] = np.nan
    ours = VelocityFilter(2, DT, nvr)
    found = ours.handle(y)
    for j in range(2):
        states, covariance = oracle(y[:, j], nvr)
        # The diffuse prior makes the first few samples ill-conditioned in both.
        np.testing.assert_allclose(found.q[10:, j], states[10:, 0], atol=1e-9)
        np.testing.assert_allclose(found.qd[10:, j] * DT, states[10:, 1], atol=1e-9)
        np.testing.assert_allclose(found.qdd[10:, j] * DT**2, states[10:, 2], atol=1e-9)
        np.testing.assert_allclose(ours._p[j], covariance, rtol=1e-6)


def test_samples_one_by_one_and_in_batches_give_the_same_bits() -> None:
    y = measured()[:500]
    whole = VelocityFilter(2, DT, [1e-4, 1e-6]).handle(y)
    stream = VelocityFilter(2, DT, [1e-4, 1e-6])
    parts = [stream.handle(y[:1]), stream.handle(y[1:200]), stream.handle(y[200:200]), stream.handle(y[200:499])]
    last = stream.handle(y[499])
    qd = np.concatenate([*(p.qd for p in parts), last.qd])
    np.testing.assert_array_equal(qd, whole.qd)


def test_velocity_is_at_least_four_times_better_than_differences_and_acceleration_usable() -> None:
    y = measured()
    _, qd, qdd = motion()
    nvr = [automatic_nvr(measured(seed=1)[:, j], 3) for j in range(2)]
    found = VelocityFilter(2, DT, nvr).handle(y)
    after = slice(1000, None)

    def error(estimate: NDArray[np.float64], truth: NDArray[np.float64]) -> NDArray[np.float64]:
        relative: NDArray[np.float64] = np.linalg.norm((estimate - truth)[after], axis=0) / np.linalg.norm(
            truth[after], axis=0
        )
        return relative

    assert (error(found.qdd, qdd) < 0.1).all()
    assert (error(found.qd, qd) < 0.25 * error(np.diff(y, axis=0, prepend=y[:1]) / DT, qd)).all()


def test_a_reset_filter_is_a_new_one() -> None:
    y = measured()[:300]
    used = VelocityFilter(2, DT, 1e-5)
    used.handle(y[::-1])
    used.reset()
    np.testing.assert_array_equal(used.handle(y).qd, VelocityFilter(2, DT, 1e-5).handle(y).qd)


def test_a_joint_that_is_not_measured_yet_does_not_hold_up_the_others() -> None:
    y = measured()[:400]
    y[:100, 1] = np.nan
    found = VelocityFilter(2, DT, 1e-5).handle(y)
    assert np.isnan(found.qd[:100, 1]).all()
    assert np.isfinite(found.qd[100:, 1]).all()
    assert np.isfinite(found.qd[:, 0]).all()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: VelocityFilter(2, 0.0, 1e-5), "sampling period"),
        (lambda: VelocityFilter(2, DT, [1e-5, -1.0]), "one positive number or 2"),
        (lambda: VelocityFilter(2, DT, 1e-5).handle(np.zeros((3, 5))), "for a velocity filter of 2 joints"),
        (lambda: VelocityFilter(2, DT, 1e-5).handle([[0.0, 0.0], [0.0, np.inf]]), "joint 2 is infinite at sample 1"),
    ],
)
def test_what_does_not_fit_is_refused(make: Any, message: str) -> None:
    with pytest.raises(DataError, match=message):
        make()
