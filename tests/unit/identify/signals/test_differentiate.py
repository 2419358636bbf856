"""Derivatives: where they sit, and how much better than the bandpass they are."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import signal

from armident.configs import DataError, load_robot
from armident.identify.signals.choices import DerivativesName
from armident.identify.signals.differentiate import differentiate, encoder_resolution, tracking_error_nvr
from tests.reproduction.emps_derivatives import NVR_BY_HAND

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
def test_velocity_and_acceleration_sit_at_the_sample(method: DerivativesName) -> None:
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
    chosen = differentiate(noisy[:, None], DT, "irwsm", "likelihood")
    by_hand = differentiate(noisy[:, None], DT, "irwsm", nvr=NVR_BY_HAND)
    assert chosen.nvr is not None
    assert chosen.nvr.min() > 100 * NVR_BY_HAND
    assert error(chosen.qdd, qdd) > 10 * error(by_hand.qdd, qdd)


def best_by_hand(y: NDArray[np.float64], qd: NDArray[np.float64], qdd: NDArray[np.float64]) -> tuple[float, float]:
    """Least errors that any ratio on a grid of decades can reach, by somebody who knows the truth."""
    tried = [differentiate(y[:, None], DT, "irwsm", nvr=10.0**g) for g in range(-8, 3)]
    return min(error(d.qd, qd) for d in tried), min(error(d.qdd, qdd) for d in tried)


@pytest.mark.parametrize("step", [1e-6, 1e-5, 1e-4])
def test_quantised_positions_are_differentiated_nearly_as_well_as_by_somebody_who_knows_the_truth(step: float) -> None:
    q, qd, qdd = motion()
    y = np.round(q / step) * step
    automatic = differentiate(y[:, None], DT)
    velocity, acceleration = best_by_hand(y, qd, qdd)
    # Positions are validated, not derivatives, whose best ratio is up to a decade lower: 10^(1/4) in bandwidth.
    assert error(automatic.qd, qd) < 2 * velocity
    assert error(automatic.qdd, qdd) < 10 * acceleration
    likeliest = differentiate(y[:, None], DT, nvr="likelihood")
    assert error(automatic.qd, qd) < 0.2 * error(likeliest.qd, qd)


@pytest.mark.parametrize("correlation", [0.3, 0.6])
def test_coloured_noise_misleads_either_criterion_alone_more_than_the_smoother_of_both(correlation: float) -> None:
    q, qd, _ = motion()
    white = np.random.default_rng(1).standard_normal(q.size)
    noise = signal.lfilter([np.sqrt(1 - correlation**2)], [1.0, -correlation], white)
    y = q + 1e-6 * noise
    automatic = error(differentiate(y[:, None], DT).qd, qd)
    assert automatic < 0.3 * error(differentiate(y[:, None], DT, nvr="cross-validation").qd, qd)
    assert automatic < 0.3 * error(differentiate(y[:, None], DT, nvr="likelihood").qd, qd)


def test_encoder_so_coarse_that_its_noise_is_not_white_leaves_velocities_usable() -> None:
    q, qd, _ = motion()
    # A hundred samples per count at the mean speed: cross-validation alone follows every step.
    y = np.round(q / 1e-3) * 1e-3
    assert error(differentiate(y[:, None], DT, nvr="cross-validation").qd, qd) > 1.0
    assert error(differentiate(y[:, None], DT).qd, qd) < 0.02


def test_irwsm_2_needs_no_bandwidth() -> None:
    noisy, qd, qdd = noisy_motion()
    too_wide = differentiate(noisy[:, None], DT, "bandpass", bandwidth_hz=60.0)
    for rule in ("automatic", "likelihood"):
        ours = differentiate(noisy[:, None], DT, "irwsm2", rule)
        assert error(ours.qd, qd) < 0.5 * error(too_wide.qd, qd)
        assert error(ours.qdd, qdd) < 0.5 * error(too_wide.qdd, qdd)


def test_tracking_error_gives_the_ratio_of_its_increments_to_a_count() -> None:
    # Equations 5.26 and 5.27 on increments of known variance.
    rng = np.random.default_rng(2)
    increments = 3e-6 * rng.standard_normal((20000, 2))
    error_walk = np.cumsum(increments, axis=0)
    found = tracking_error_nvr(error_walk, 2, [1e-6, 3e-6])
    # The variance of 20000 increments is known to 1 %, three of that.
    np.testing.assert_allclose(found, [9.0, 1.0], rtol=0.03)
    np.testing.assert_allclose(
        tracking_error_nvr(np.cumsum(error_walk, axis=0), 3, [1e-6, 3e-6]), [9.0, 1.0], rtol=0.03
    )


def test_tracking_error_rule_uses_that_ratio_in_both_passes() -> None:
    noisy, _, _ = noisy_motion()
    q_ref = noisy + np.cumsum(2e-7 * np.random.default_rng(4).standard_normal(noisy.size))
    chosen = differentiate(noisy[:, None], DT, nvr="tracking-error", q_ref=q_ref[:, None], resolution=1e-6)
    assert chosen.nvr is not None
    np.testing.assert_allclose(chosen.nvr, 0.04, rtol=0.05)


def test_encoder_resolution_is_that_of_the_joint_side() -> None:
    degrees = np.rad2deg(encoder_resolution(load_robot("tx40")))
    # Table 5.1, in 10^-3 deg, for the joints that one motor moves; joint 6 is moved by two.
    np.testing.assert_allclose(degrees[:5] * 1e3, [0.057, 0.057, 0.122, 0.114, 0.122], atol=6e-4)
    assert degrees[5] == pytest.approx(np.hypot(360 / 65536 / 32, 360 / 65536 / 45))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"nvr": "tracking-error"}, "reference trajectory is unknown"),
        ({"nvr": "tracking-error", "q_ref": np.zeros((500, 1))}, "encoder resolution is unknown"),
        ({"nvr": "tracking-error", "q_ref": np.zeros((50, 1)), "resolution": 1.0}, "shape"),
        ({"nvr": "tracking-error", "q_ref": np.ones((500, 1)), "resolution": 0.0}, "not positive"),
        ({"nvr": "tracking-error", "q_ref": np.zeros((500, 1)), "resolution": 1.0}, "does not vary"),
        ({"nvr": "guess"}, "neither a number nor one of"),
        ({"nvr": [1.0, 2.0]}, "one positive number or 1"),
        ({"nvr": 0.0}, "one positive number"),
    ],
)
def test_a_ratio_that_cannot_be_had_is_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(DataError, match=message):
        differentiate(np.zeros((500, 1)), DT, **arguments)


def test_joints_do_not_influence_each_other() -> None:
    q, _, _ = motion(4000)
    both = differentiate(np.stack([q, q**2], axis=1), DT)
    alone = differentiate(q[:, None], DT)
    np.testing.assert_array_equal(both.qdd[:, :1], alone.qdd)


def test_bandpass_without_bandwidth_says_what_to_do() -> None:
    with pytest.raises(DataError, match="bandwidth_hz"):
        differentiate(np.zeros((100, 1)), DT, "bandpass")
