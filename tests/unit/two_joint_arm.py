"""A small arm in closed loop, quick enough to run every estimator on: two joints, coupled motors, gravity, friction."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from armident.configs import RobotConfig
from armident.identify.effects.terms import arm_model
from armident.identify.estimators.auxiliary_model import AuxiliaryModel
from armident.identify.identification.equations import aligned_torque
from armident.identify.regression.equations import ExperimentEquations, filtered_regressor
from armident.identify.robot.arm import ArmModel
from armident.identify.robot.controller import DiscreteController
from armident.identify.robot.simulation import simulate
from armident.identify.signals.decimate import design
from armident.identify.signals.differentiate import Derivatives

Floats = NDArray[np.float64]

DT = 1e-3
CUTOFF_HZ = 40.0
"""The loops have 8 Hz."""
STANDARD = {
    "zz1": 0.9, "ia1": 0.4, "m2": 2.0, "mx2": 0.5, "my2": 0.1, "zz2": 0.25, "ia2": 0.15,
    "fv1": 3.0, "fc1": 1.5, "fv2": 1.2, "fc2": 0.7, "mx1": 0.8, "my1": 0.1, "off1": 0.2,
}  # fmt: skip


@dataclass(frozen=True)
class Recorded:
    """A recording of the arm: equations at measured signals, positions after the same filter, and the loop."""

    blocks: list[ExperimentEquations]
    positions: list[Floats]
    loop: AuxiliaryModel
    truth: Floats


@cache
def model() -> ArmModel:
    joint = {"limits": {"position": [-6.0, 6.0], "velocity": 20.0, "acceleration": 500.0, "torque": 200.0}}
    drive = {"signal": "torque", "gain": 1.0, "rated": 10.0}
    robot = RobotConfig.model_validate(
        {
            "schema": "armident/robot/1",
            "name": "two_joint",
            "gravity": [0.0, -9.81, 0.0],
            "joints": [
                joint | {"name": "j1", "drive": drive, "mdh": {"alpha": 0.0, "d": 0.0, "theta": 0.0, "r": 0.0}},
                joint | {"name": "j2", "drive": drive, "mdh": {"alpha": 0.0, "d": 0.5, "theta": 0.0, "r": 0.0}},
            ],
            "transmission": [[20.0, 0.0], [15.0, 15.0]],
        }
    )
    return arm_model(robot)


def start() -> Floats:
    """Zero but for rotor inertias of 1 kg m^2."""
    standard = np.zeros(len(model().names))
    standard[[model().names.index("ia1"), model().names.index("ia2")]] = 1.0
    base: Floats = model().base.regroup @ standard
    return base


def recorded(
    seconds: float = 6.0,
    seed: int = 0,
    torque_noise: float = 0.0,
    position_noise: float = 0.0,
    cutoff_hz: float | None = CUTOFF_HZ,
) -> Recorded:
    """Simulate the arm and derive its equations from true velocities and accelerations.

    ``torque_noise`` (N m, white) is measured only; ``position_noise`` (motor rad, white) is measured torque of the
    controller's making.
    """
    arm, rng = model(), np.random.default_rng(seed)
    truth = arm.base.regroup @ np.array([STANDARD.get(name, 0.0) for name in arm.names])
    controller = DiscreteController.cascade(np.array([25.0, 30.0]), np.array([0.35, 0.18]), np.ones(2), DT)
    t = np.arange(round(seconds / DT)) * DT
    q_ref = np.stack(
        [
            1.0 * np.sin(2.1 * t) + 0.35 * np.sin(9.3 * t + 0.4) + 0.1 * np.sin(23.0 * t),
            1.2 * np.sin(3.3 * t + 1.0) - 0.3 * np.sin(12.1 * t) + 0.1 * np.sin(31.0 * t),
        ],
        axis=1,
    )
    run = simulate(arm, truth, controller, q_ref, DT)
    assert run.diverged_at is None
    tau = run.tau + torque_noise * rng.standard_normal(run.tau.shape)
    if position_noise:
        noise = position_noise * rng.standard_normal(run.q.shape)
        taps = (controller.error_taps[:, 0], controller.position_taps)
        motor = taps[0] * noise - taps[1][:, 0] * noise - taps[1][:, 1] * np.roll(noise, 1, axis=0)
        tau = tau - motor @ arm.robot.transmission_matrix
    decimation = design(DT, CUTOFF_HZ if cutoff_hz is None else cutoff_hz, 1 if cutoff_hz is None else None)
    y = decimation(aligned_torque(tau))
    x = filtered_regressor(arm, Derivatives(run.q, run.qd, run.qdd, None), decimation)
    instants = np.asarray(decimation.instants(t.size) * DT, dtype=np.float64)
    blocks = [ExperimentEquations(y, x, np.ones(y.shape, dtype=np.bool_), instants)]
    loop = AuxiliaryModel(
        arm, controller, [q_ref], [(run.q[0], run.qd[0])], DT, decimation, 3 * np.abs(run.qd).max(axis=0)
    )
    return Recorded(blocks, [decimation(run.q)], loop, truth)


def masked(data: Recorded) -> Recorded:
    """The same recording with every third equation of the first joint left out."""
    block = data.blocks[0]
    keep = block.keep.copy()
    keep[::3, 0] = False
    return replace(data, blocks=[replace(block, keep=keep)])
