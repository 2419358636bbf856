"""Smoothing of the sign by the speeds of each joint."""

from collections.abc import Callable
from functools import cache, partial

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError

from armident.configs import RobotConfig, load_robot
from armident.identify.effects.terms import arm_model
from armident.identify.estimators.methods import Method
from armident.identify.identification.options import Options
from armident.identify.identification.pipeline import identify_experiment
from armident.identify.identification.sign_smoothing import Speeds, recorded_speeds, with_sign_smoothing
from armident.identify.robot.controller import DiscreteController
from armident.identify.robot.simulation import simulate
from armident.identify.signals.experiments import Experiment

DT = 1e-3
MASS, VISCOUS, COULOMB = 40.0, 60.0, 15.0
BANDWIDTH = 10.0


def lift(sign_smoothing: float | list[float] | None = None) -> RobotConfig:
    return RobotConfig.model_validate(
        {
            "schema": "armident/robot/1",
            "name": "lift",
            "gravity": [0.0, -9.81, 0.0],
            "joints": [
                {
                    "name": "lift",
                    "type": "prismatic",
                    "mdh": {"alpha": 0.0, "d": 0.0, "theta": 0.0, "r": 0.0},
                    "limits": {"position": [-0.5, 0.5], "velocity": 1.0, "acceleration": 5.0, "torque": 2000.0},
                    "drive": {"signal": "torque"},
                    "rotor_inertia": False,
                }
            ],
            "transmission": [[1.0]],
            "friction": {"sign_smoothing": sign_smoothing},
        }
    )


@cache
def recorded() -> Experiment:
    """Moves at 5 to 15 cm/s that reverse with 1 m/s^2, under a friction that switches within 10 um/s."""
    plant = arm_model(lift(1e5))
    speeds = np.repeat([0.05, -0.15, 0.1, -0.08, 0.12, -0.05, 0.15, -0.1] * 2, 1000)
    ramp = round(0.2 / 1.0 / DT)
    velocity = np.convolve(speeds, np.full(ramp, 1 / ramp), mode="same")
    q_ref = DT * np.cumsum(velocity)[:, None]
    gain, damping = 8000.0 * 80.0, 8000.0
    loop = DiscreteController(
        np.array([[gain]]), np.array([[-damping / DT, damping / DT]]), np.zeros((1, 0)), np.array([np.inf]), DT
    )
    run = simulate(plant, np.array([MASS, VISCOUS, COULOMB, 0.0]), loop, q_ref, DT)
    rng = np.random.default_rng(1)
    return Experiment(run.q, run.tau + 0.2 * rng.normal(size=run.tau.shape), q_ref, DT)


def speeds(experiment: Experiment) -> Speeds:
    return recorded_speeds([experiment], BANDWIDTH)


@pytest.mark.parametrize("method", ["idim-ls", "idim-iv"])
def test_friction_of_a_slow_prismatic_joint_is_not_biased_by_the_smoothing(method: Method) -> None:
    found = identify_experiment(recorded(), lift(), Options(method=method))
    friction = dict(zip(found.names, found.theta, strict=True))
    assert friction["fv1"] == pytest.approx(VISCOUS, rel=0.02)
    assert friction["fc1"] == pytest.approx(COULOMB, rel=0.01)
    # Friction switches within 10 um/s; the search ends at a ten-thousandth of the top speed.
    assert found.transitions["lift"].velocity < 2e-5
    assert not any("smoothed sign" in reason.message for reason in found.verdict.reasons)


def with_friction(law: Callable[[NDArray[np.float64]], NDArray[np.float64]], seed: int) -> Experiment:
    """A smooth motion of up to 0.15 m/s under the force of a friction law, with 0.2 N of noise; held for a sample."""
    t, seconds = np.arange(0, 16, DT)[:, None], np.array([5.0, 3.1, 1.7])

    def derivative(order: int) -> NDArray[np.float64]:
        rate = 2 * np.pi / seconds
        return np.asarray(
            np.sum(0.06 * rate ** (order - 1) * np.cos(rate * (t + DT / 2 * (order > 0)) + 0.5 * np.pi * order), axis=1)
        )[:, None]

    speed = derivative(1)
    force = MASS * (derivative(2) + 9.81) + VISCOUS * speed + COULOMB * law(speed)
    return Experiment(derivative(0), force + 0.2 * np.random.default_rng(seed).normal(size=force.shape), None, DT)


def smoothed_sign(width: float, speed: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(2 / np.pi * np.arctan(speed / width))


@pytest.mark.slow
def test_intervals_hold_the_width_of_the_transition() -> None:
    inside = []
    for seed in range(6):
        width = 4e-4 * 1.15**seed
        simulated = with_friction(partial(smoothed_sign, width), seed)
        found = identify_experiment(simulated, lift(), Options(method="idim-ls")).transitions["lift"]
        assert found.velocity == pytest.approx(width, rel=0.3)
        inside.append(found.low <= width <= found.high)
    # Three misses of six at 95 % have a probability of 0.2 %.
    assert sum(inside) >= 4


def test_standard_deviations_contain_the_unknown_law_of_the_transition() -> None:
    found = identify_experiment(with_friction(lambda v: np.tanh(v / 2e-3), 0), lift(), Options(method="idim-ls"))
    known = identify_experiment(with_friction(lambda v: np.tanh(v / 2e-3), 0), lift(700.0), Options(method="idim-ls"))
    assert found.transitions["lift"].saturating == pytest.approx(2e-3, rel=0.3)
    assert any(line.startswith("The law by which dry friction of lift reverses") for line in found.warnings)
    for name, true in (("fv1", VISCOUS), ("fc1", COULOMB)):
        k = found.names.index(name)
        assert abs(found.theta[k] - true) < 3 * found.std[k]
        assert found.std[k] > known.std[k]


def test_a_smoothing_wider_than_the_motion_is_reported_with_the_joint() -> None:
    found = identify_experiment(recorded(), lift(150.0), Options(method="idim-ls"))
    (reason,) = (r for r in found.verdict.reasons if r.message.startswith("lift: the smoothed sign"))
    assert reason.level == "doubtful"
    assert "Coulomb and viscous friction are biased" in reason.message
    assert found.theta[1] < 0.8 * VISCOUS


def test_configured_smoothing_is_kept() -> None:
    for given in (150.0, [150.0]):
        robot = lift(given)
        assert with_sign_smoothing(robot, speeds(recorded())) is robot


def test_width_does_not_depend_on_the_unit_of_length() -> None:
    metres = with_sign_smoothing(lift(), speeds(recorded())).sign_smoothing
    e = recorded()
    millimetres = with_sign_smoothing(lift(), speeds(Experiment(1e3 * e.q, e.tau, None, DT))).sign_smoothing
    assert millimetres == pytest.approx(metres / 1e3, rel=1e-3)


def test_width_is_not_below_the_noise_of_the_velocity() -> None:
    e = recorded()
    noisy = Experiment(e.q + 1e-3 * np.random.default_rng(0).normal(size=e.q.shape), e.tau, None, DT)
    width = 1 / with_sign_smoothing(lift(), speeds(noisy)).sign_smoothing[0]
    # White noise through a low-pass: std = sigma pi f sqrt(8 f dt / 3).
    assert width == pytest.approx(1e-3 * np.pi * BANDWIDTH * np.sqrt(8 / 3 * BANDWIDTH * DT), rel=0.05)


def test_a_joint_at_rest_has_the_nominal_smoothing() -> None:
    still = Experiment(np.zeros((2000, 1)), np.zeros((2000, 1)), None, DT)
    assert with_sign_smoothing(lift(), speeds(still)).sign_smoothing.tolist() == [5000.0]


def test_number_of_values_must_be_that_of_the_joints() -> None:
    with pytest.raises(ValidationError, match="expected one number or 1"):
        lift([1.0, 2.0])


def test_each_joint_has_its_own_smoothing_and_a_coupling_the_smaller_one() -> None:
    robot = load_robot("tx40")
    values = (100.0, 200.0, 300.0, 400.0, 50.0, 600.0)
    model = arm_model(
        robot.model_copy(update={"friction": robot.friction.model_copy(update={"sign_smoothing": values})})
    )
    qd = np.full((1, 6), 0.01)
    x = model.regressor(np.zeros((1, 6)), qd, np.zeros((1, 6)))[0]
    for j, g in enumerate(values):
        assert x[j, model.names.index(f"fc{j + 1}")] == pytest.approx(2 / np.pi * np.arctan(g * 0.01))
    assert x[5, model.names.index("fcm6")] == pytest.approx(2 / np.pi * np.arctan(50.0 * 0.02))
    theta = np.zeros(len(model.names))
    theta[[model.names.index(name) for name in ("fc1", "fc6", "fcm6")]] = 1.0
    np.testing.assert_allclose(model.inverse_dynamics(theta, np.zeros((1, 6)), qd, np.zeros((1, 6)))[0], x @ theta)
