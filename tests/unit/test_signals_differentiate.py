"""Derivatives: where they sit, and how much better than the bandpass they are."""

import numpy as np
import pytest
from numpy.typing import NDArray

from configs import DataError
from identify.signals.differentiate import Method, differentiate

DT = 2e-4


def motion(samples: int = 20000) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    t = np.arange(samples) * DT
    q, qd, qdd = np.zeros(samples), np.zeros(samples), np.zeros(samples)
    for amplitude, frequency in ((0.1, 0.5), (0.02, 2.0), (0.004, 5.0)):
        w = 2 * np.pi * frequency
        q += amplitude * np.sin(w * t)
        qd += amplitude * w * np.cos(w * t)
        qdd -= amplitude * w * w * np.sin(w * t)
    return q, qd, qdd


def error(found: NDArray[np.float64], truth: NDArray[np.float64]) -> float:
    inner = slice(1000, -1000)
    return float(np.linalg.norm(found[inner, 0] - truth[inner]) / np.linalg.norm(truth[inner]))


@pytest.mark.parametrize("method", ["irwsm", "irwsm2"])
def test_velocity_and_acceleration_sit_at_the_sample(method: Method) -> None:
    q, qd, qdd = motion()
    found = differentiate(q[:, None], DT, method, nvr=1.0)
    # Half a sample at 5 Hz would be an error of w dt / 2 = 1.6 %, the central difference's own is (w dt)^2 / 6.
    assert error(found.qd, qd) < 2e-4
    assert error(found.qdd, qdd) < 5e-4


@pytest.mark.parametrize("method", ["irwsm", "irwsm2"])
def test_irwsm_needs_no_bandwidth_to_beat_a_bandpass_that_was_given_a_wrong_one(method: Method) -> None:
    q, qd, qdd = motion()
    noisy = q + 1e-6 * np.random.default_rng(0).standard_normal(q.size)
    ours = differentiate(noisy[:, None], DT, method)
    for wrong in (2.0, 60.0):
        bandpass = differentiate(noisy[:, None], DT, "bandpass", bandwidth_hz=wrong)
        assert error(ours.qd, qd) < 0.5 * error(bandpass.qd, qd)
        assert error(ours.qdd, qdd) < 0.5 * error(bandpass.qdd, qdd)


def test_joints_do_not_influence_each_other() -> None:
    q, _, _ = motion(4000)
    both = differentiate(np.stack([q, q**2], axis=1), DT)
    alone = differentiate(q[:, None], DT)
    np.testing.assert_array_equal(both.qdd[:, :1], alone.qdd)


def test_bandpass_without_bandwidth_says_what_to_do() -> None:
    with pytest.raises(DataError, match="bandwidth_hz"):
        differentiate(np.zeros((100, 1)), DT, "bandpass")
