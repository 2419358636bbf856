"""Instruments from the smoothed motion, for recordings whose arm cannot be simulated."""

import numpy as np
import pytest

from armident.configs import load_robot
from armident.identify.effects.terms import arm_model
from armident.identify.estimators.idim_iv import idim_iv
from armident.identify.estimators.idim_ls import idim_ls
from armident.identify.estimators.measured_instruments import MotionInstruments
from armident.identify.identification.equations import equations
from armident.identify.robot.arm import ArmModel
from armident.identify.signals.bandpass import butterworth, central_difference
from armident.identify.signals.decimate import design
from armident.identify.signals.differentiate import Derivatives
from armident.identify.signals.experiments import Experiment

DT = 1e-3
THETA = np.array([95.0, 200.0, 20.0, -3.0])
"""Of EMPS: mass, viscous and Coulomb friction, offset."""


def axis(seed: int) -> tuple[ArmModel, Experiment]:
    """A minute of one linear axis, positions with a noise of 60 um, forces with 1 N."""
    model = arm_model(load_robot("emps"))
    t = np.arange(0.0, 60.0, DT)[:, None]
    waves = [(0.06, 0.4), (0.015, 1.3), (0.004, 2.9)]
    q = np.sum([a * np.sin(2 * np.pi * f * t + f) for a, f in waves], axis=0)
    qd = np.sum([a * 2 * np.pi * f * np.cos(2 * np.pi * f * t + f) for a, f in waves], axis=0)
    qdd = np.sum([-a * (2 * np.pi * f) ** 2 * np.sin(2 * np.pi * f * t + f) for a, f in waves], axis=0)
    rng = np.random.default_rng(seed)
    tau = model.inverse_dynamics(THETA, q, qd, qdd) + rng.normal(0.0, 1.0, q.shape)
    return model, Experiment(q + rng.normal(0.0, 6e-5, q.shape), tau, None, DT)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_idim_iv_takes_the_bias_from_a_mass_that_noisy_derivatives_make_too_small(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "armident.identify.identification.equations.aligned_torque", lambda tau, late=0.0: tau
    )  # force sampled, not held
    model, experiment = axis(seed)
    decimation = design(DT, 40.0)
    qd = central_difference(experiment.q, DT)
    noisy = Derivatives(experiment.q, qd, central_difference(qd, DT), None)
    blocks = equations(model, [experiment], [noisy], decimation)
    ls = idim_ls(blocks, model.base.names)
    motion = [butterworth(experiment.q, DT, 8.0)]
    iv = idim_iv(blocks, MotionInstruments.of(model, motion, DT, decimation), ls.theta)
    assert ls.theta[0] < 0.95 * THETA[0]
    assert iv.converged
    assert iv.theta[0] == pytest.approx(THETA[0], rel=0.01)


def test_torques_are_what_the_motion_needs_and_a_theta_that_is_not_finite_has_none() -> None:
    model, experiment = axis(0)
    motion = butterworth(experiment.q, DT, 8.0)
    followed = MotionInstruments.of(model, [motion], DT, design(DT, 40.0))
    runs = followed.simulate(THETA)
    assert runs is not None
    np.testing.assert_array_equal(runs[0].q, motion)
    np.testing.assert_array_equal(runs[0].tau, model.inverse_dynamics(THETA, runs[0].q, runs[0].qd, runs[0].qdd))
    assert followed.simulate(np.full(4, np.nan)) is None
