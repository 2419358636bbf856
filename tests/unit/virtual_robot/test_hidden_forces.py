"""Hidden torques of the virtual arm against closed-form physics."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from armident.configs import RobotConfig
from armident.configs.schema.scenario import Scenario
from armident.virtual_robot.inertias import rest_posture
from armident.virtual_robot.plant import Plant
from tests.plant_torques import acceleration, resistance
from tests.unit.hidden import hide

PERIOD = 200e-6
FV2, FC2 = 5.50, 8.24
"""Friction of joint 2, table B.4."""


class Joint2:
    """Torque that an effect adds to the resistance of joint 2 of the TX40, moving alone."""

    def __init__(self, robot: RobotConfig, effect: str, other: str | None = None, **parameters: float) -> None:
        self.healthy = Plant(robot, np.zeros(6))
        self.plant = Plant(robot, np.zeros(6), hide(effect, "joint_2", other, **parameters))

    def all(self, q: float, qd: float, t: float = 0.0, beside: float = 0.0) -> NDArray[np.float64]:
        where, speed = np.zeros(6), np.zeros(6)
        where[1], speed[1], speed[2] = q, qd, beside
        return resistance(self.plant, where, speed, t) - resistance(self.healthy, where, speed, t)

    def __call__(self, q: float, qd: float, t: float = 0.0, beside: float = 0.0) -> float:
        return float(self.all(q, qd, t, beside)[1])


def test_asymmetric_viscous_friction_is_a_fifth_up_forwards_and_a_fifth_down_backwards(tx40: RobotConfig) -> None:
    extra = Joint2(tx40, "asymmetric_viscous_friction", fva=0.2 * FV2)
    assert extra(0.0, 1.5) == pytest.approx(0.2 * FV2 * 1.5)
    assert extra(0.0, -1.5) == pytest.approx(0.2 * FV2 * 1.5)


def test_asymmetric_coulomb_friction_is_an_offset_in_motion_and_gone_at_rest(tx40: RobotConfig) -> None:
    extra = Joint2(tx40, "asymmetric_coulomb_friction", fca=0.2 * FC2, velocity=0.05)
    for side in (1.0, -1.0):
        assert extra(0.0, side * 1.0) == pytest.approx(0.2 * FC2, rel=1e-6)
        assert extra(0.0, side * 0.05) == pytest.approx(0.75 * 0.2 * FC2)
    assert extra(0.0, 0.0) == 0.0


def test_a_lubricant_that_thins_loses_its_share_at_the_speed_given(tx40: RobotConfig) -> None:
    extra = Joint2(tx40, "nonlinear_viscous_friction", thinning=0.3, velocity=2.0)
    for side in (1.0, -1.0):
        assert extra(0.0, side * 2.0) == pytest.approx(-0.3 * FV2 * side * 2.0)
        assert abs(extra(0.0, side * 0.02)) < 0.01 * FV2 * 0.02
    # Half of the joint's limit of 5 rad/s unless given.
    assert Joint2(tx40, "nonlinear_viscous_friction", thinning=0.3)(0.0, 2.5) == pytest.approx(-0.3 * FV2 * 2.5)


def test_friction_along_the_joint_is_a_wave_or_a_tight_spot_and_always_resists(tx40: RobotConfig) -> None:
    sign = 2 / math.pi * math.atan(150.0)
    wave = Joint2(tx40, "position_dependent_friction", ratio=0.3, per_turn=2.0, phase=0.5)
    spot = Joint2(tx40, "position_dependent_friction", ratio=0.8, width=0.1, position=0.4)
    for q in np.linspace(-2.0, 2.0, 9):
        for side in (1.0, -1.0):
            assert wave(q, side) == pytest.approx(side * sign * 0.3 * FC2 * math.cos(2 * q + 0.5))
    assert spot(0.4, -1.0) == pytest.approx(-sign * 0.8 * FC2)
    assert spot(0.5, 1.0) == pytest.approx(sign * 0.8 * FC2 * math.exp(-0.5))
    assert abs(spot(1.2, 1.0)) < 1e-9


def test_friction_drifts_to_its_end_or_for_ever(tx40: RobotConfig) -> None:
    whole = 1.5 * FV2 + FC2 * 2 / math.pi * math.atan(150 * 1.5)
    warm = Joint2(tx40, "friction_drift", change=-0.3, time_constant=20.0)
    assert warm(0.0, 1.5, 0.0) == 0.0
    assert warm(0.0, 1.5, 20.0) == pytest.approx(-0.3 * (1 - math.exp(-1)) * whole)
    assert warm(0.0, 1.5, 1e4) == pytest.approx(-0.3 * whole)
    line = Joint2(tx40, "friction_drift", change=0.1, time_constant=20.0, linear=1.0)
    assert line(0.0, 1.5, 50.0) == pytest.approx(0.25 * whole)


def test_a_shared_shaft_takes_power_whatever_its_joints_do(tx40: RobotConfig) -> None:
    extra = Joint2(tx40, "coupling_friction", other="joint_3", coulomb=2.0, viscous=0.5)
    for one, two in np.random.default_rng(0).uniform(-3, 3, (50, 2)):
        torque = extra.all(0.0, one, beside=two)
        shaft = 0.5 * (one + two) + 2.0 * 2 / math.pi * math.atan(150.0 * (one + two))
        assert torque[1] == pytest.approx(shaft)
        assert torque[2] == pytest.approx(shaft)
        assert torque @ np.array([0, one, two, 0, 0, 0]) > 0
    default = Joint2(tx40, "coupling_friction", other="joint_3", coulomb=2.0)
    assert default(0.0, 1.0) == pytest.approx(0.6 + 2.0 * 2 / math.pi * math.atan(150.0))


def test_torques_of_position_are_what_their_parameters_say(tx40: RobotConfig) -> None:
    assert Joint2(tx40, "joint_spring", stiffness=4.0, rest=0.2)(0.7, 1.0) == pytest.approx(2.0)
    assert Joint2(tx40, "torque_offset", torque=-1.5)(0.7, -1.0) == pytest.approx(-1.5)
    bump = Joint2(tx40, "torque_bump", torque=3.0, position=0.5, width=0.1)
    assert bump(0.5, 1.0) == pytest.approx(3.0)
    assert bump(0.7, -1.0) == pytest.approx(3.0 * math.exp(-2.0))
    cog = Joint2(tx40, "cogging_torque", amplitude=0.5, harmonic=2.0, phase=0.3)
    assert cog(0.01, 1.0) == pytest.approx(0.5 * math.sin(2 * 32 * 0.01 + 0.3))
    half = Joint2(tx40, "friction_scale", factor=1.5)
    assert half(0.0, 1.0) == pytest.approx(0.5 * (FV2 + FC2 * 2 / math.pi * math.atan(150.0)))
    hose = Joint2(tx40, "quadratic_coupling", other="joint_3", coefficient=0.4)
    assert hose(0.0, 0.0, beside=-3.0) == pytest.approx(0.4 * 9.0)
    assert hose(0.0, 2.0) == pytest.approx(0.0)


def test_the_motor_of_a_prismatic_joint_cogs_once_per_pitch(emps: RobotConfig) -> None:
    plant = Plant(emps, [0.0], hide("cogging_torque", "joint_1", amplitude=2.0, harmonic=3.0, pitch=0.01))
    healthy = Plant(emps, [0.0])
    for q in (0.0, 0.0008, 0.01 + 0.0008):
        extra = resistance(plant, np.array([q]), np.zeros(1)) - resistance(healthy, np.array([q]), np.zeros(1))
        assert extra[0] == pytest.approx(2.0 * math.sin(3 * 2 * math.pi * q / 0.01), abs=1e-12)


def test_dirt_sticks_once_in_every_interval_at_times_that_the_seed_gives(tx40: RobotConfig) -> None:
    t = np.arange(0.0, 40.0, 0.005)
    series = []
    for seed in (0.0, 0.0, 1.0):
        extra = Joint2(tx40, "stick_events", torque=2.0, every=2.0, duration=0.2, seed=seed)
        series.append(np.array([extra(0.0, 1.0, x) for x in t]))
    np.testing.assert_array_equal(series[0], series[1])
    starts = [np.flatnonzero(np.diff((s > 0).astype(int)) == 1) for s in series]
    # Rest lies between two events, unless one ends with its interval and the next begins at once.
    assert 19 <= len(starts[0]) <= 20
    assert np.abs(starts[0] - starts[2]).max() * 0.005 > 0.2
    offsets = t[starts[0]] % 2.0
    assert offsets.std() > 0.3, "uniform over 1.8 s has a standard deviation of 0.52 s"
    assert (series[0] > 0).mean() == pytest.approx(0.1, abs=0.005)
    assert series[0].max() == pytest.approx(2.0 * 2 / math.pi * math.atan(150.0), rel=1e-3)


def test_friction_that_grows_with_the_load_takes_its_share_of_every_acceleration(emps: RobotConfig) -> None:
    plant = Plant(emps, [0.0], hide("load_dependent_friction", "joint_1", fcl=0.2))
    mass, fv, fc, off, smoothing = 95.1089, 203.5034, 20.3935, -3.1648, 5000.0
    force = 120.0

    def rhs(_: float, y: NDArray[np.float64]) -> list[float]:
        side = 2 / math.pi * math.atan(smoothing * y[1])
        # The carriage passes on mass times acceleration, positive throughout.
        return [y[1], (force - fv * y[1] - fc * side - off) / (mass * (1 + 0.2 * side))]

    for _ in range(2000):
        plant.advance(np.array([force]), PERIOD)
    truth = solve_ivp(rhs, (0.0, 2000 * PERIOD), [0.0, 0.0], rtol=1e-10, atol=1e-13).y[:, -1]
    # The load is the one of the inner step before, 33 us ago.
    assert plant.q[0] == pytest.approx(truth[0], rel=2e-4)
    assert plant.qd[0] == pytest.approx(truth[1], rel=2e-4)
    free = Plant(emps, [0.0])
    for _ in range(2000):
        free.advance(np.array([force]), PERIOD)
    assert free.qd[0] > 1.1 * plant.qd[0]


def test_a_joint_that_holds_a_weight_has_more_friction_than_one_that_does_not(tx40: RobotConfig) -> None:
    """Joint 2 falls from horizontal and from upright: load-dependent friction slows only the first motion."""
    fallen = {}
    for name, effect in (("healthy", None), ("loaded", hide("load_dependent_friction", "joint_2", fcl=0.3))):
        plant = Plant(tx40, [0.0, 1.2, 0.5, 0.0, 0.0, 0.0], effect)
        plant.brake[[0, 2, 3, 4, 5]] = 1e9
        for _ in range(250):
            plant.advance(np.zeros(6), PERIOD)
        fallen[name] = plant.qd[1]
    posture = np.array([0.0, 1.2, 0.5, 0.0, 0.0, 0.0])
    weight = acceleration(Plant(tx40, posture), posture, np.zeros(6), np.zeros(6))[1]
    assert np.sign(fallen["healthy"]) == np.sign(weight)
    assert 0.5 < fallen["loaded"] / fallen["healthy"] < 0.98


NO_STRENGTH = {
    "asymmetric_viscous_friction": {"fva": 0.0},
    "asymmetric_coulomb_friction": {"fca": 0.0},
    "position_dependent_friction": {"ratio": 0.0},
    "friction_drift": {"change": 0.0},
    "coupling_friction": {"coulomb": 0.0},
    "cogging_torque": {"amplitude": 0.0},
    "joint_spring": {"stiffness": 0.0},
    "rotor_inertia": {"inertia": 0.0},
    "torque_offset": {"torque": 0.0},
    "torque_bump": {"torque": 0.0},
    "quadratic_coupling": {"coefficient": 0.0},
    "friction_scale": {"factor": 1.0},
}


def moved(robot: RobotConfig, effect: Scenario | None) -> NDArray[np.float64]:
    """Final position and velocity of the TX40 under torques that shake every joint."""
    plant = Plant(robot, rest_posture(robot), effect)
    rng = np.random.default_rng(0)
    for _ in range(500):
        plant.advance(rng.standard_normal(6) * np.array([20.0, 30.0, 15.0, 5.0, 5.0, 3.0]), PERIOD)
    return np.concatenate([plant.q, plant.qd])


@pytest.mark.parametrize("effect", sorted(NO_STRENGTH))
def test_an_effect_of_no_strength_changes_no_bit_of_the_motion(tx40: RobotConfig, effect: str) -> None:
    other = "joint_3" if effect in ("coupling_friction", "quadratic_coupling") else None
    np.testing.assert_array_equal(moved(tx40, hide(effect, "joint_2", other, **NO_STRENGTH[effect])), moved(tx40, None))
