"""Delay between torque and position on a simulated axis with known delay."""

import numpy as np
import pytest
from numpy.typing import NDArray

from armident.configs import load_robot
from armident.identify.effects.terms import arm_model
from armident.identify.identification.torque_delay import HELD, TorqueDelay, torque_delay
from armident.identify.robot.arm import ArmModel
from armident.identify.robot.controller import DiscreteController
from armident.identify.robot.simulation import Simulation, simulate
from armident.identify.signals.decimate import Decimation, design
from armident.identify.signals.differentiate import Derivatives, differentiate
from armident.identify.signals.experiments import Experiment
from tests.reproduction.emps_derivatives import DURATIONS, polynomial_moves

DT = 1e-3
THETA = np.array([96.0, 205.0, 20.0, -3.0])
QUANTUM = 1e-8
"""Encoder resolution, m."""


@pytest.fixture(scope="module")
def axis() -> ArmModel:
    return arm_model(load_robot("emps"))


def run(axis: ArmModel, disturbance: NDArray[np.float64] | None = None) -> tuple[Simulation, NDArray[np.float64]]:
    reference = DT**2 * np.cumsum(np.cumsum(polynomial_moves(DURATIONS, DT)))[:, None]
    controller = DiscreteController.cascade(160.2, 242.5, 35.2, DT)
    return simulate(axis, THETA, controller, reference, DT, disturbance=disturbance), reference


def recorded(simulated: Simulation, reference: NDArray[np.float64], tau: NDArray[np.float64], shift: int) -> Experiment:
    """Recording whose torques lead by ``shift`` samples."""
    q = np.round(simulated.q / QUANTUM) * QUANTUM
    rows = slice(10, -10)
    return Experiment(q=q[rows], tau=np.roll(tau, -shift, axis=0)[rows], q_ref=reference[rows], dt=DT)


def low_pass() -> Decimation:
    return design(DT, 40.0)


def estimated(axis: ArmModel, experiment: Experiment, instruments: list[Derivatives] | None = None) -> TorqueDelay:
    return torque_delay(axis, [experiment], [differentiate(experiment.q, DT)], low_pass(), instruments)


@pytest.mark.parametrize("shift", [-2, 0, 1])
def test_a_held_torque_is_half_a_sample_early_and_what_comes_on_top_is_seen(axis: ArmModel, shift: int) -> None:
    simulated, reference = run(axis)
    rng = np.random.default_rng(0)
    noisy = simulated.tau + 0.5 * rng.standard_normal(simulated.tau.shape)
    found = estimated(axis, recorded(simulated, reference, noisy, shift))
    assert found.instrumented
    assert abs(found.samples[0] - (HELD + shift)) < 4 * found.std[0]
    assert found.std[0] < 0.1
    assert found.contradicts()[0] == (shift != 0)


@pytest.mark.slow
def test_standard_deviation_is_that_of_the_estimates_over_20_noises(axis: ArmModel) -> None:
    simulated, reference = run(axis)
    rng = np.random.default_rng(1)
    z = []
    for _ in range(20):
        noisy = simulated.tau + 2.0 * rng.standard_normal(simulated.tau.shape)
        found = estimated(axis, recorded(simulated, reference, noisy, 0))
        z.append((found.samples[0] - HELD) / found.std[0])
    # The standard deviation of 20 values is accurate to 16 %; three times that.
    assert 0.5 < np.std(z) < 1.5
    assert abs(np.mean(z)) < 1.0


def test_disturbances_bias_least_squares_and_not_the_instruments(axis: ArmModel) -> None:
    rng = np.random.default_rng(2)
    samples = run(axis)[0].q.shape[0]
    slow = np.convolve(rng.standard_normal(samples + 49), np.ones(50) / 50, mode="valid")[:, None]
    disturbance = 20.0 * slow / slow.std()
    disturbed, reference = run(axis, disturbance)
    experiment = recorded(disturbed, reference, disturbed.tau - disturbance, 0)
    undisturbed, _ = run(axis)
    motion = Derivatives(undisturbed.q[10:-10], undisturbed.qd[10:-10], undisturbed.qdd[10:-10], None)
    with_simulation = estimated(axis, experiment, [motion])
    assert with_simulation.instrumented
    assert abs(with_simulation.samples[0] - HELD) < 3 * with_simulation.std[0]
    blind = estimated(axis, Experiment(experiment.q, experiment.tau, None, DT))
    assert not blind.instrumented
    assert blind.samples[0] - HELD > 5 * blind.std[0]
