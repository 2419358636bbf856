"""Derivatives: where they sit, and how much better than the bandpass they are."""

import numpy as np
import pytest
from numpy.typing import NDArray

from configs import DataError
from identify.signals.differentiate import NVR_BY_HAND, Method, differentiate

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


def noisy_motion() -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    q, qd, qdd = motion()
    return q + 1e-6 * np.random.default_rng(0).standard_normal(q.size), qd, qdd


def test_irwsm_1_with_the_manual_ratio_beats_a_bandpass_of_a_wrong_bandwidth_fivefold() -> None:
    noisy, qd, qdd = noisy_motion()
    ours = differentiate(noisy[:, None], DT, "irwsm", nvr=NVR_BY_HAND)
    for wrong in (2.0, 60.0):
        bandpass = differentiate(noisy[:, None], DT, "bandpass", bandwidth_hz=wrong)
        assert error(ours.qd, qd) < 0.2 * error(bandpass.qd, qd)
        assert error(ours.qdd, qdd) < 0.2 * error(bandpass.qdd, qdd)


def test_likelihood_of_irwsm_1_follows_more_of_the_noise_than_is_good() -> None:
    # Thesis section 5.3.1: what the random walk does not model counts as dynamics; the decimation compensates.
    noisy, _, qdd = noisy_motion()
    chosen = differentiate(noisy[:, None], DT, "irwsm")
    by_hand = differentiate(noisy[:, None], DT, "irwsm", nvr=NVR_BY_HAND)
    assert chosen.nvr is not None
    assert chosen.nvr.min() > 100 * NVR_BY_HAND
    assert error(chosen.qdd, qdd) > 10 * error(by_hand.qdd, qdd)


def test_irwsm_2_with_the_likeliest_ratio_needs_no_bandwidth() -> None:
    noisy, qd, qdd = noisy_motion()
    ours = differentiate(noisy[:, None], DT, "irwsm2")
    too_wide = differentiate(noisy[:, None], DT, "bandpass", bandwidth_hz=60.0)
    assert error(ours.qd, qd) < 0.5 * error(too_wide.qd, qd)
    assert error(ours.qdd, qdd) < 0.5 * error(too_wide.qdd, qdd)


def test_joints_do_not_influence_each_other() -> None:
    q, _, _ = motion(4000)
    both = differentiate(np.stack([q, q**2], axis=1), DT)
    alone = differentiate(q[:, None], DT)
    np.testing.assert_array_equal(both.qdd[:, :1], alone.qdd)


def test_bandpass_without_bandwidth_says_what_to_do() -> None:
    with pytest.raises(DataError, match="bandwidth_hz"):
        differentiate(np.zeros((100, 1)), DT, "bandpass")
