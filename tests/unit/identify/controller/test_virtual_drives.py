"""Parametric controllers of the virtual TX40: gains, the closed loop they give, and IDIM-IV with them."""

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from armident.configs import RobotConfig, load_robot
from armident.identify.controller.crc import IdentifiedController, identify_crc
from armident.identify.controller.nominal import saturation
from armident.identify.controller.parametric import ControlLaw, identify_parametric
from armident.identify.effects.terms import arm_model
from armident.identify.estimators.auxiliary_model import AuxiliaryModel
from armident.identify.estimators.idim_iv import idim_iv
from armident.identify.identification.equations import equations
from armident.identify.identification.from_recording import experiments_from_recording
from armident.identify.robot.simulation import Simulation, simulate
from armident.identify.signals.decimate import design
from armident.identify.signals.differentiate import Derivatives, differentiate
from armident.identify.signals.experiments import Experiment
from armident.virtual_robot.inertias import plant_parameters
from armident.virtual_robot.plant import Plant
from armident.virtual_robot.servo import CONTROL_PERIOD, VELOCITY_FILTER_HZ, cascade_gains
from tests.fixtures.arms import recording

pytestmark = pytest.mark.slow

Floats = NDArray[np.float64]

TABLE_5_12 = (10, 20, 3, 13, 10, 20)
"""Lengths of the impulse responses in the thesis."""


def value(law: ControlLaw, name: str) -> float:
    return law.gains[name].value


@cache
def robot() -> RobotConfig:
    return load_robot("tx40")


@cache
def recorded(noise: float) -> Experiment:
    """The excitation, of which half is enough without noise."""
    ((whole,), _) = experiments_from_recording(recording("tx40", "tx40_excitation", 1, noise=noise), robot())
    assert whole.q_ref is not None
    taken = slice(whole.q.shape[0] // (2 if noise == 0.0 else 1))
    return Experiment(whole.q[taken], whole.tau[taken], whole.q_ref[taken], whole.dt)


def motor_side(experiment: Experiment) -> tuple[list[Floats], list[Floats], list[Floats]]:
    ratios = robot().transmission_matrix
    assert experiment.q_ref is not None
    torque = experiment.tau @ np.linalg.inv(ratios)
    return [experiment.q @ ratios.T], [experiment.q_ref @ ratios.T], [torque]


@cache
def identified_tx40(noise: float) -> IdentifiedController:
    experiment = recorded(noise)
    drive = np.array([joint.drive.gain for joint in robot().joints])
    return identify_parametric(*motor_side(experiment), experiment.dt, saturation=saturation(robot()), gain=drive)


@pytest.mark.parametrize(("noise", "tolerance"), [(0.0, 1e-3), (1.0, 0.01)])
def test_gains_of_the_virtual_drives_come_out(noise: float, tolerance: float) -> None:
    experiment = recorded(noise)
    kp, kv = cascade_gains(robot(), Plant(robot(), experiment.q[0]).mass_matrix())
    laws = [law for law in identified_tx40(noise).responses if isinstance(law, ControlLaw)]
    np.testing.assert_allclose([value(law, "kp") for law in laws], kp, rtol=tolerance)
    np.testing.assert_allclose([value(law, "kv") for law in laws], kv, rtol=tolerance)
    assert all(law.structure.velocity == "error" and law.structure.delay == 0 for law in laws)
    corners = [law.gains["corner"] for law in laws if "corner" in law.gains]
    assert len(corners) >= (6 if noise == 0.0 else 4)
    # A pole of exp(-2 pi f dt) is a first-order corner of f.
    assert pytest.approx(experiment.dt) == CONTROL_PERIOD
    assert all(abs(c.value - VELOCITY_FILTER_HZ) < max(3 * c.std, 1.0) for c in corners)


@cache
def true_parameters() -> Floats:
    model = arm_model(robot())
    plant = plant_parameters(robot())
    base: Floats = model.base.regroup @ np.array([plant[name] for name in model.names])
    return base


def follow(found: IdentifiedController, experiment: Experiment) -> tuple[Simulation, Derivatives]:
    signals = differentiate(experiment.q, experiment.dt, "irwsm", None, 10.0)
    assert experiment.q_ref is not None
    start = {"q0": signals.q[0], "qd0": signals.qd[0]}
    model = arm_model(robot())
    motion = simulate(model, true_parameters(), found.controller, experiment.q_ref, experiment.dt, **start)
    return motion, signals


def test_closed_loop_with_the_identified_controller_moves_like_the_virtual_arm() -> None:
    motion, signals = follow(identified_tx40(0.0), recorded(0.0))
    assert motion.diverged_at is None
    # One count of the coarsest encoder, 3e-6 rad on the joint side (thesis table 5.1).
    assert np.abs(motion.q - recorded(0.0).q).max() < 5e-6
    assert np.linalg.norm(motion.qd - signals.qd) < 1e-4 * np.linalg.norm(signals.qd)
    noisy, signals = follow(identified_tx40(1.0), recorded(1.0))
    assert np.linalg.norm(noisy.qd - signals.qd) < 0.05 * np.linalg.norm(signals.qd)


def test_sizes_of_table_5_12_explain_as_much_as_those_the_data_choose() -> None:
    experiment = recorded(1.0)
    given = identify_crc(
        *motor_side(experiment), experiment.dt, length=TABLE_5_12, velocity_loop=False, saturation=saturation(robot())
    )
    assert tuple(r.error_taps.size for r in given.responses) == TABLE_5_12
    chosen = identify_crc(*motor_side(experiment), experiment.dt, saturation=saturation(robot()))
    laws = identified_tx40(1.0).responses
    for one, two, law in zip(given.responses, chosen.responses, laws, strict=True):
        assert one.fit_pct == pytest.approx(two.fit_pct, abs=0.02)
        assert one.fit_pct == pytest.approx(law.fit_pct, abs=0.02)


def test_idim_iv_gives_the_same_with_parametric_and_correlated_controllers() -> None:
    # Tables 5.13 and 5.14: "C" and "CRC", here with the sizes of table 5.12, are equally good auxiliary models.
    experiment = recorded(1.0)
    assert experiment.q_ref is not None
    model = arm_model(robot())
    signals = differentiate(experiment.q, experiment.dt, "irwsm", None, 10.0)
    decimation = design(experiment.dt, 20.0)
    blocks = equations(model, [experiment], [signals], decimation)
    crc = identify_crc(
        *motor_side(experiment),
        experiment.dt,
        length=TABLE_5_12,
        velocity_loop=False,
        saturation=saturation(robot()),
    )
    estimates = []
    for found in (identified_tx40(1.0), crc):
        auxiliary = AuxiliaryModel(
            model,
            found.controller,
            [experiment.q_ref],
            [(signals.q[0], signals.qd[0])],
            experiment.dt,
            decimation,
            3.0 * np.abs(signals.qd).max(axis=0),
        )
        estimates.append(idim_iv(blocks, auxiliary, true_parameters()))
    parametric, correlated = estimates
    assert parametric.converged
    assert correlated.converged
    assert (np.abs(parametric.theta - correlated.theta) < 0.1 * parametric.std).all()
