"""The robot model against Python loops over Pinocchio."""

import time
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from armident.configs import load_robot, load_trajectory
from armident.identify.effects.terms import arm_model
from armident.identify.robot.arm import ArmModel
from armident.identify.robot.controller import DiscreteController
from armident.identify.robot.simulation import simulate
from tests.benchmarks.harness import Row, best_of
from tests.pinocchio_oracle import TO_OURS, pinocchio_model, random_parameters

Floats = NDArray[np.float64]

DT = 2e-4
SECONDS = 10.0
SAMPLES = 50_000
INNER_STEPS = 3
"""Steps of the Python loop per sample: what its explicit method needs to be stable on the wrist."""


def run() -> list[Row]:
    """Closed loop of ten seconds, and the regressor of 50 000 samples."""
    robot = load_robot("tx40")
    model = arm_model(robot)
    theta = _parameters(model)
    return [_closed_loop(model, theta), _regressor(model, theta)]


def _parameters(model: ArmModel) -> Floats:
    """A physical arm with the friction of the TX40 (thesis table B.4)."""
    theta = random_parameters(model, np.random.default_rng(7))
    values = {"ia": (0.3, 0.3, 0.09, 0.03, 0.04, 0.03), "fv": (8.0, 5.5, 1.93, 1.09, 1.79, 0.65)}
    values["fc"] = (7.34, 8.24, 6.48, 2.57, 3.07, 0.3)
    for kind, numbers in values.items():
        for k, number in enumerate(numbers, start=1):
            theta[model.names.index(f"{kind}{k}")] = number
    # The smallest links: their random boxes weigh kilograms.
    for k, share in ((4, 0.3), (5, 0.1), (6, 0.02)):
        theta[model.columns.inertial[k - 1]] *= share
    theta[model.names.index("fvm6")] = 0.61
    theta[model.names.index("fcm6")] = 1.9
    return theta


def _closed_loop(model: ArmModel, theta: Floats) -> Row:
    moves = load_trajectory("trajectories/tx40_excitation.yaml").sample(DT)
    reference = np.concatenate([moves, moves[::-1]])[: round(SECONDS / DT)]
    ratio = np.abs(np.diag(model.robot.transmission_matrix))
    inertia = np.median(np.diagonal(model.mass_matrix(theta, moves[::100]), axis1=1, axis2=2), axis=0)
    controller = DiscreteController.cascade(np.full(6, 60.0), 250.0 * inertia / ratio**2, np.ones(6), DT)
    simulate(model, theta, controller, reference[:10], DT)
    ours = best_of(lambda: simulate(model, theta, controller, reference, DT))
    motion = simulate(model, theta, controller, reference, DT)
    start = time.perf_counter()
    q, tau = _python_loop(model, theta, controller, reference)
    theirs = time.perf_counter() - start
    apart = np.abs(motion.q - q).max()
    torque = np.abs(motion.tau - tau).max() / np.abs(tau).max()
    note = f"same trajectory: {apart:.1e} rad, {100 * torque:.2g} % of the torque at most apart"
    return Row("closed loop of 10 s at 5 kHz vs Python loop over pinocchio.aba", ours, theirs, theirs / ours, "s", note)


def _python_loop(
    model: ArmModel, theta: Floats, controller: DiscreteController, reference: Floats
) -> tuple[Floats, Floats]:
    """The same loop with `pinocchio.aba` and ode3 (Bogacki-Shampine), the method of the thesis."""
    values = model.values(theta)
    oracle = pinocchio_model(model.robot, values.inertial, values.ia)
    data = oracle.createData()
    r = model.robot.transmission_matrix
    g, (i, j), (_, viscous, coulomb) = model.smoothing, values.coupling_joints[0], values.coupling[0]
    h = DT / INNER_STEPS

    def acceleration(q: Floats, qd: Floats, tau: Floats) -> Any:
        friction = values.fv * qd + values.fc * (2 / np.pi) * np.arctan(g * qd)
        common = coulomb * (2 / np.pi) * np.arctan(min(g[i], g[j]) * (qd[i] + qd[j]))
        friction[i] += viscous * qd[j] + common
        friction[j] += viscous * qd[i] + common
        return pin.aba(oracle, data, q, qd, tau - friction).copy()

    q, qd = reference[0].copy(), (reference[1] - reference[0]) / DT
    before = q - DT * qd
    positions, torques = np.empty_like(reference), np.empty_like(reference)
    for k in range(reference.shape[0]):
        nu = controller.error_taps[:, 0] * (r @ (reference[k] - q))
        nu += controller.position_taps[:, 0] * (r @ q) + controller.position_taps[:, 1] * (r @ before)
        tau = r.T @ nu
        positions[k], torques[k] = q, tau
        before = q.copy()
        for _ in range(INNER_STEPS):
            a1 = acceleration(q, qd, tau)
            v2 = qd + h / 2 * a1
            a2 = acceleration(q + h / 2 * qd, v2, tau)
            v3 = qd + 0.75 * h * a2
            a3 = acceleration(q + 0.75 * h * v2, v3, tau)
            q = q + h / 9 * (2 * qd + 3 * v2 + 4 * v3)
            qd = qd + h / 9 * (2 * a1 + 3 * a2 + 4 * a3)
    return positions, torques


def _regressor(model: ArmModel, theta: Floats) -> Row:
    rng = np.random.default_rng(0)
    q, qd, qdd = rng.uniform(-2.0, 2.0, (3, SAMPLES, model.n))
    values = model.values(theta)
    oracle = pinocchio_model(model.robot, values.inertial, values.ia)
    data = oracle.createData()
    model.regressor(q[:10], qd[:10], qdd[:10])
    # Both write into memory that they have written to before.
    ours_out = model.regressor(q, qd, qdd)
    ours = best_of(lambda: model.regressor(q, qd, qdd, out=ours_out))
    theirs_out = np.empty((SAMPLES, model.n, 10 * model.n))

    def loop() -> None:
        for k in range(SAMPLES):
            theirs_out[k] = pin.computeJointTorqueRegressor(oracle, data, q[k], qd[k], qdd[k])

    theirs = best_of(loop, repeat=2)
    inertial = model.columns.inertial[:, TO_OURS].reshape(-1)
    apart = np.abs(model.regressor(q, qd, qdd)[:, :, inertial] - theirs_out).max()
    note = f"largest difference {apart:.1e}; ours includes friction, rotor and coupling columns"
    name = "regressor of 50 000 samples, TX40, vs loop over pinocchio.computeJointTorqueRegressor"
    return Row(name, ours, theirs, theirs / ours, "s", note)
