"""Fv and Fc on a simulated axis whose friction near standstill is not what the model says."""

import numpy as np
import pytest
from numpy.typing import NDArray

from armident.configs import DataError, load_robot
from armident.identify.effects.terms import arm_model
from armident.identify.estimators.idim_ls import idim_ls
from armident.identify.identification.equations import aligned_torque
from armident.identify.regression.equations import Estimate, ExperimentEquations, filtered_regressor
from armident.identify.signals.decimate import Decimation, design
from armident.identify.signals.differentiate import Derivatives, differentiate
from armident.identify.signals.standstill import SLOW_SHARE, moving, velocity_threshold
from armident.identify.thesis.emps_derivatives import simulate_emps

DT = 1e-3
FORCE_NOISE = 5.0
"""N, about what the measured axis leaves unexplained."""


def derivatives(qd: NDArray[np.float64]) -> Derivatives:
    return Derivatives(np.zeros_like(qd), qd, np.zeros_like(qd), None)


def test_threshold_is_a_share_of_the_rms_speed_of_each_joint_over_all_experiments() -> None:
    one, other = np.full((300, 2), [3.0, 0.0]), np.full((100, 2), [1.0, 4.0])
    expected = 0.02 * np.sqrt([(300 * 9 + 100) / 400, 100 * 16 / 400])
    np.testing.assert_allclose(velocity_threshold([derivatives(one), derivatives(other)]), expected)


def test_a_joint_that_stands_still_keeps_its_equations() -> None:
    threshold = velocity_threshold([derivatives(np.zeros((100, 1)))])
    assert moving(np.zeros((100, 1)), threshold, Decimation(1, np.ones(1))).all()


def test_an_equation_goes_if_any_sample_nearby_is_slow() -> None:
    qd = np.ones((100, 2))
    qd[50, 1] = 0.05
    low_pass = Decimation(5, np.ones(11) / 11)
    kept = low_pass.instants(100)
    found = moving(qd, np.array([0.1, 0.1]), low_pass)
    assert found.shape == (kept.size, 2)
    assert found[:, 0].all()
    np.testing.assert_array_equal(found[:, 1], np.abs(kept - 50) > 2)


def fitted(share: float, sharp_sign: bool) -> Estimate:
    """IDIM-LS of the axis of table 5.2, whose true sign is the thesis's, ``(2/pi) atan(150 qd)``."""
    run = simulate_emps(DT)
    force = 96.0 * run.qdd + 205.0 * run.qd + 20.0 * 2 / np.pi * np.arctan(150.0 * run.qd)
    force += FORCE_NOISE * np.random.default_rng(0).standard_normal(force.size)
    # Recorded as a drive holds it: the mean of two neighbours belongs to the sample between them.
    tau = np.append((force[1:] + force[:-1]) / 2, force[-1])[:, None]
    model, low_pass = arm_model(load_robot("emps")), design(DT, 40.0)
    s = differentiate(run.q[:, None], DT)
    kept = low_pass.instants(run.q.size)
    keep = moving(s.qd, velocity_threshold([s], share), low_pass)
    x = filtered_regressor(model, s, low_pass, sharp_sign=sharp_sign)
    return idim_ls(
        [ExperimentEquations(low_pass(aligned_torque(tau)), x, keep, np.asarray(kept * DT, dtype=np.float64))],
        model.base.names,
    )


def test_two_shapes_of_the_sign_agree_once_slow_equations_are_left_out() -> None:
    def disagreement(share: float) -> NDArray[np.float64]:
        smooth, sharp = fitted(share, False), fitted(share, True)
        return np.abs(smooth.theta - sharp.theta)[1:3] / smooth.std[1:3]

    with_all, without_slow = disagreement(0.0), disagreement(SLOW_SHARE)
    assert (without_slow < 1.0).all()
    assert (without_slow < 0.5 * with_all).all()


def test_leaving_them_out_costs_less_than_a_tenth_of_the_precision() -> None:
    assert (fitted(SLOW_SHARE, True).std < 1.1 * fitted(0.0, True).std).all()


@pytest.mark.parametrize("share", [-0.1, 1.0])
def test_a_share_that_is_none_is_refused(share: float) -> None:
    with pytest.raises(DataError, match="share of the rms velocity"):
        velocity_threshold([derivatives(np.ones((10, 1)))], share)


def test_no_signals_are_refused() -> None:
    with pytest.raises(DataError, match="no signals"):
        velocity_threshold([])
