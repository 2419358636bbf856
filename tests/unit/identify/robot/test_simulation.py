"""Closed-loop simulation: accuracy against fine integration, stiffness, divergence."""

import numpy as np
import pytest
from numpy.typing import NDArray

from armident.configs import load_robot, load_trajectory
from armident.identify.effects.terms import arm_model
from armident.identify.robot.arm import ArmModel
from armident.identify.robot.controller import DiscreteController
from armident.identify.robot.physical import damp_to_physical
from armident.identify.robot.simulation import simulate

Floats = NDArray[np.float64]

DT = 2e-4

DIVISIONS = 20
"""Steps of the reference integration per sample: 0.2 of the time constant of the stiffest friction."""

ESSENTIAL = {
    "zz1r": 1.24, "fv1": 8.0, "fc1": 7.34, "xx2r": -0.48, "xz2r": -0.16, "zz2r": 1.09, "mx2r": 2.21, "fc2": 8.24,
    "fv2": 5.5, "xx3r": 0.13, "zz3r": 0.11, "my3r": -0.6, "ia3": 0.09, "fc3": 6.48, "fv3": 1.93, "mx4": -0.02,
    "ia4": 0.03, "fc4": 2.57, "fv4": 1.09, "my5r": -0.03, "ia5": 0.04, "fc5": 3.07, "fv5": 1.79, "ia6": 0.01,
    "fc6": 0.3, "fv6": 0.65, "fcm6": 1.9, "fvm6": 0.61,
}  # fmt: skip
"""Table B.4; its joint 6 makes the friction stiff: 2/pi 150 (fc6 + fcm6) / ia6 = 21000 1/s."""


@pytest.fixture(scope="module")
def tx40() -> ArmModel:
    return arm_model(load_robot("tx40"))


@pytest.fixture(scope="module")
def theta(tx40: ArmModel) -> Floats:
    return np.array([ESSENTIAL.get(name, 0.0) for name in tx40.base.names])


def position_controller(model: ArmModel, dt: float = DT) -> DiscreteController:
    """A cascade of about 10 Hz around typical inertias of the TX40."""
    ratio = np.abs(np.diag(model.robot.transmission_matrix))
    inertia = np.array([1.5, 1.5, 0.25, 0.04, 0.05, 0.012])
    return DiscreteController.cascade(np.full(6, 60.0), 250.0 * inertia / ratio**2, np.ones(6), dt)


def constant_torque(model: ArmModel, dt: float) -> DiscreteController:
    """No feedback: goes on with the torque that keeps the first velocity at the first posture."""
    none = np.zeros((model.n, 0))
    return DiscreteController(none, none, np.ones((model.n, 1)), np.full(model.n, np.inf), dt)


def finely(model: ArmModel, theta: Floats, tau: Floats, q: Floats, qd: Floats, dt: float) -> tuple[Floats, Floats]:
    """State one sample later under the held torque ``tau`` (n,), by the classical method of order four."""
    n, h = model.n, dt / DIVISIONS
    y = np.concatenate([q, qd])

    def slope(state: Floats) -> Floats:
        qdd = model.forward_dynamics(theta, state[None, :n], state[None, n:], tau[None])[0]
        return np.concatenate([state[n:], qdd])

    for _ in range(DIVISIONS):
        k1 = slope(y)
        k2 = slope(y + h / 2 * k1)
        k3 = slope(y + h / 2 * k2)
        k4 = slope(y + h * k3)
        y = y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return y[:n], y[n:]


def test_one_sample_ahead_agrees_with_fine_integration_everywhere(tx40: ArmModel, theta: Floats) -> None:
    reference = load_trajectory("trajectories/tx40_excitation.yaml").sample(DT)
    motion = simulate(tx40, theta, position_controller(tx40), reference, DT)
    assert motion.diverged_at is None
    for k in range(100, reference.shape[0] - 1, 307):
        q, qd = finely(tx40, theta, motion.tau[k], motion.q[k], motion.qd[k], DT)
        # One count of the finest encoder (thesis table 5.1) is 1e-6 rad.
        assert np.abs(motion.q[k + 1] - q).max() < 5e-8
        assert np.abs(motion.qd[k + 1] - qd).max() < 1e-4


@pytest.mark.slow
def test_closed_loop_through_a_reversal_agrees_with_fine_integration(tx40: ArmModel, theta: Floats) -> None:
    t = np.arange(600) * DT
    reference = 0.3 * np.sin(2 * np.pi * 4 * t + 0.5)[:, None] * np.array([1.0, -1.0, 1.0, 1.0, -1.0, 1.0])
    controller = position_controller(tx40)
    motion = simulate(tx40, theta, controller, reference, DT)
    assert (motion.qd[100] * motion.qd[-1] < 0).all()
    r = tx40.robot.transmission_matrix
    q, qd = motion.q[0], motion.qd[0]
    before = q - DT * qd
    for k in range(reference.shape[0]):
        # One count of the coarsest encoder of table 5.1 is 3e-6 rad.
        assert np.abs(motion.q[k] - q).max() < 2e-6
        nu = controller.error_taps[:, 0] * (r @ (reference[k] - q))
        nu += (controller.position_taps * np.stack([r @ q, r @ before], axis=1)).sum(axis=1)
        before = q
        q, qd = finely(tx40, theta, r.T @ nu, q, qd, DT)


def test_the_loop_for_any_number_of_joints_agrees_with_the_unrolled(
    tx40: ArmModel, theta: Floats, monkeypatch: pytest.MonkeyPatch
) -> None:
    reference = load_trajectory("trajectories/tx40_excitation.yaml").sample(DT)[:2000]
    unrolled = simulate(tx40, theta, position_controller(tx40), reference, DT)
    monkeypatch.setattr("armident.identify.robot.simulation.UNROLLED", ())
    rolled = simulate(tx40, theta, position_controller(tx40), reference, DT)
    assert unrolled.diverged_at is None
    assert np.abs(rolled.q - unrolled.q).max() < 1e-10
    assert np.abs(rolled.tau - unrolled.tau).max() < 1e-6


def test_integration_is_of_second_order(tx40: ArmModel, theta: Floats) -> None:
    duration, q0 = 0.1, np.array([0.1, 0.3, 1.2, -0.4, 0.8, 0.2])
    qd0 = np.array([1.0, -0.8, 1.2, 2.0, -1.5, 3.0])
    errors = []
    fine = simulate(tx40, theta, constant_torque(tx40, 1e-6), np.tile(q0, (100001, 1)), 1e-6, q0=q0, qd0=qd0)
    for dt in (1e-3, 5e-4, 2.5e-4):
        samples = round(duration / dt) + 1
        motion = simulate(tx40, theta, constant_torque(tx40, dt), np.tile(q0, (samples, 1)), dt, q0=q0, qd0=qd0)
        errors.append(np.abs(motion.q[-1] - fine.q[-1]).max())
    assert errors[0] / errors[1] > 3.0
    assert errors[1] / errors[2] > 3.0


def test_stiff_friction_at_rest_stays_at_rest(tx40: ArmModel, theta: Floats) -> None:
    posture = np.array([0.0, 0.4, 1.0, 0.2, 0.5, -0.3])
    reference = np.tile(posture, (5000, 1))
    # A start without the static tracking error: the loop settles against gravity, and then only creeps.
    motion = simulate(tx40, theta, position_controller(tx40), reference, DT)
    assert np.abs(motion.qd[-500:]).max() < 1e-3
    assert np.abs(np.diff(motion.qd[-500:], axis=0)).max() < 1e-6


def test_rigid_identity_holds_along_the_simulation(tx40: ArmModel, theta: Floats) -> None:
    reference = load_trajectory("trajectories/tx40_excitation.yaml").sample(DT)[:5000]
    motion = simulate(tx40, theta, position_controller(tx40), reference, DT)
    tau = tx40.inverse_dynamics(theta, motion.q, motion.qd, motion.qdd)
    held = 0.5 * (motion.tau[1:] + motion.tau[:-1])
    assert np.abs(tau[1:] - held).max() < 1e-9


def test_finite_impulse_response_controller_matches_the_cascade_it_equals() -> None:
    model = arm_model(load_robot("emps"))
    theta = np.array([95.1, 203.5, 20.4, -3.2])
    t = np.arange(2000) * 1e-3
    reference = (0.1 * np.sin(2 * np.pi * t))[:, None]
    cascade = DiscreteController.cascade(160.18, 243.45, 35.15, 1e-3)
    loop = 35.15 * 243.45
    # On the tracking error alone: kp eps + d eps/dt, which differs from the cascade by the reference's velocity.
    fir = DiscreteController.fir([[loop * (160.18 + 1e3), -loop * 1e3]], 1e-3)
    one, other = (simulate(model, theta, c, reference, 1e-3) for c in (cascade, fir))
    assert np.abs(one.q - reference).max() > 10 * np.abs(other.q - reference).max()
    again = DiscreteController(cascade.error_taps, cascade.position_taps, np.zeros((1, 3)), np.array([np.inf]), 1e-3)
    assert np.abs(simulate(model, theta, again, reference, 1e-3).q - one.q).max() < 1e-13


def test_saturation_limits_the_motor_torque() -> None:
    model = arm_model(load_robot("emps"))
    controller = DiscreteController.cascade(160.18, 243.45, 35.15, 1e-3, saturation=351.5)
    reference = np.concatenate([np.zeros(10), np.full(490, 0.2)])[:, None]
    motion = simulate(model, np.array([95.1, 203.5, 20.4, -3.2]), controller, reference, 1e-3)
    assert np.abs(motion.tau).max() == pytest.approx(351.5)
    assert motion.diverged_at is None


def test_an_unstable_loop_is_reported_and_not_raised(tx40: ArmModel, theta: Floats) -> None:
    stable = position_controller(tx40)
    unstable = DiscreteController(
        -stable.error_taps, stable.position_taps, stable.output_taps, stable.saturation, stable.dt
    )
    reference = load_trajectory("trajectories/tx40_excitation.yaml").sample(DT)
    motion = simulate(tx40, theta, unstable, reference, DT)
    assert motion.diverged_at is not None
    assert np.isfinite(motion.q[: motion.diverged_at]).all()
    assert np.isnan(motion.q[motion.diverged_at :]).all()


def test_a_mass_matrix_that_is_not_positive_definite_ends_the_simulation(tx40: ArmModel, theta: Floats) -> None:
    wrong = theta.copy()
    wrong[tx40.base.names.index("ia6")] = -0.05
    motion = simulate(tx40, wrong, position_controller(tx40), np.zeros((100, 6)), DT)
    assert motion.diverged_at == 0


def test_damping_ends_at_physical_parameters_on_the_way(tx40: ArmModel, theta: Floats) -> None:
    postures = np.random.default_rng(0).uniform(-2.0, 2.0, (100, 6))
    wanted = theta.copy()
    inertia, coulomb = tx40.base.names.index("ia6"), tx40.base.names.index("fc6")
    wanted[inertia], wanted[coulomb] = -0.02, -0.1
    damped = damp_to_physical(tx40, wanted, theta, postures)
    assert np.linalg.eigvalsh(tx40.mass_matrix(damped.theta, postures)).min() > 0.0
    assert damped.theta[coulomb] >= 0.0
    assert damped.step == 0.25
    assert damped.theta[inertia] == pytest.approx(0.75 * 0.01 + 0.25 * -0.02)
    assert "fc6" in damped.reason
    assert "step reduced to 25 %" in damped.reason
    unchanged = damp_to_physical(tx40, theta, theta, postures)
    assert unchanged.step == 1.0
    assert unchanged.reason == ""
    assert np.array_equal(damp_to_physical(tx40, np.full(61, np.nan), theta, postures).theta, theta)
