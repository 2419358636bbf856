"""Hidden effects of the virtual arm: validation of scenarios, and basic physics of each effect."""

import math
from pathlib import Path

import numpy as np
import pytest
import typer
from numpy.typing import NDArray
from typer.testing import CliRunner

from armident.compiled import PLAIN, compiled
from armident.configs import ConfigError, RobotConfig, load_robot
from armident.configs.loading import HERE, load_scenario
from armident.configs.schema.scenario import HiddenEffect, Scenario
from armident.virtual_robot.arm import Arm
from armident.virtual_robot.cli import robot as robot_command
from armident.virtual_robot.effects import CATALOGUE, EFFECTS, OUTSIDE, describe_effects, hidden_effects
from armident.virtual_robot.effects.forces import CODES, effect_torque, force_table
from armident.virtual_robot.inertias import rest_posture
from armident.virtual_robot.plant import Plant
from tests.plant_torques import resistance
from tests.statistics.twin_effects import SIZES

cli = typer.Typer()
cli.command()(robot_command)


@pytest.fixture(scope="module")
def tx40() -> RobotConfig:
    return load_robot("tx40.yaml")


@pytest.fixture(scope="module")
def emps() -> RobotConfig:
    return load_robot("emps.yaml")


LIMITS = {joint.name: joint.limits for joint in load_robot("tx40.yaml").joints}

HEALTHY = (
    0.04804163140280711, 0.14355670318505015, 1.8563242080086155,
    0.06016075942464121, 0.0006689536512731999, 0.01959493721133968,
)  # fmt: skip


def scenario(*effects: tuple[str, str, str | None, dict[str, float]]) -> Scenario:
    hidden = tuple(HiddenEffect(effect=e, joint=j, other=o, parameters=p) for e, j, o, p in effects)
    return Scenario(schema="armident/scenario/1", effects=hidden)


def with_effect(
    robot: RobotConfig, effect: str, joint: str, parameters: dict[str, float], other: str | None = None
) -> Plant:
    return Plant(robot, np.zeros(robot.n), scenario((effect, joint, other, parameters)))


def test_the_command_lists_the_effects() -> None:
    result = CliRunner().invoke(cli, ["--list-effects"])
    assert result.exit_code == 0
    assert result.stdout == describe_effects() + "\n"


@pytest.mark.parametrize("path", sorted((HERE / "scenarios").glob("*.yaml")), ids=lambda path: path.stem)
def test_the_shipped_scenarios_can_be_hidden_in_their_arm(path: Path) -> None:
    robot = load_robot(path.stem.split("_")[0] + ".yaml")
    hidden = load_scenario(path)
    arm = Arm(robot, rest_posture(robot), noise=0.0, scenario=hidden)
    for _ in range(20):
        arm.advance()
    assert np.isfinite(arm.plant.coordinates).all()
    assert len(hidden.effects) == len(hidden_effects(hidden, robot))


def test_without_hidden_effects_the_arm_moves_as_it_always_did(tx40: RobotConfig) -> None:
    """Reference values of the plant from its first version with six effects."""
    plant = Plant(tx40, rest_posture(tx40))
    t = np.arange(1000) * 200e-6
    for x in np.sin(2 * np.pi * 4 * t):
        plant.advance(x * np.array([20.0, 30.0, 15.0, 5.0, 5.0, 3.0]), 200e-6)
    np.testing.assert_allclose(plant.q, HEALTHY, rtol=1e-10)


def test_every_effect_of_the_catalogue_can_be_hidden_and_at_least_five_outside_it() -> None:
    assert set(SIZES) == set(EFFECTS)
    assert not set(CATALOGUE) & set(OUTSIDE)
    assert len(OUTSIDE) >= 5
    assert {e for e in EFFECTS if EFFECTS[e].target == "force"} == {*CODES, "coupling_friction"}


def test_a_scenario_needs_one_number_per_effect_at_most() -> None:
    for name, effect in EFFECTS.items():
        required = {key for key, parameter in effect.parameters.items() if parameter.default is None}
        assert required <= set(SIZES[name](LIMITS["joint_1"]))
        assert len(required) <= 1


def test_the_list_of_effects_names_every_parameter_with_its_unit() -> None:
    text = describe_effects()
    for name, effect in EFFECTS.items():
        assert f"  {name}" in text
        for key, parameter in effect.parameters.items():
            assert f"      {key} ({parameter.unit}): " in text


@pytest.mark.parametrize("effect", sorted(set(CODES) - {"quadratic_coupling", "load_dependent_friction"}))
@pytest.mark.parametrize("joint", ["joint_1", "joint_6"])
def test_a_hidden_torque_acts_on_its_joint_alone(tx40: RobotConfig, effect: str, joint: str) -> None:
    plant, healthy = with_effect(tx40, effect, joint, SIZES[effect](LIMITS[joint])), Plant(tx40, np.zeros(6))
    q, qd = np.full(6, 0.05), np.full(6, 0.1)
    extra = [resistance(plant, q, qd, t) - resistance(healthy, q, qd, t) for t in np.arange(0.5, 2.0, 0.01)]
    largest = np.abs(extra).max(axis=0)
    assert np.flatnonzero(largest > 1e-4).tolist() == [int(joint[-1]) - 1]
    assert np.delete(largest, int(joint[-1]) - 1).max() < 1e-12


@compiled(kept=True, **PLAIN)
def torque_and_slope(code: int, row: NDArray[np.float64], qd: float) -> tuple[float, float]:
    """A kernel around the function of kernels."""
    found: tuple[float, float] = effect_torque(code, row, 0.4, qd, 0.3, 0.7, 3.0, 1.13, 150.0)
    return found


@pytest.mark.slow
@pytest.mark.parametrize("effect", CODES)
def test_the_slope_of_a_hidden_torque_is_its_derivative(tx40: RobotConfig, effect: str) -> None:
    other = "joint_2" if effect == "quadratic_coupling" else None
    hidden = hidden_effects(scenario((effect, "joint_1", other, SIZES[effect](LIMITS["joint_1"]))), tx40)
    row = force_table(hidden, tx40, np.array([[5.0, 8.0, 0.0]] * 6))[0]
    step = 1e-6

    def torque(qd: float) -> tuple[float, float]:
        return torque_and_slope(int(row[0]), row[3:], qd)

    # None of them exactly at standstill, where asymmetric friction has a kink.
    for qd in (-1.3, -0.05, -0.004, 0.003, 0.08, 1.1):
        here, slope = torque(qd)
        assert math.isfinite(here)
        assert slope == pytest.approx((torque(qd + step)[0] - torque(qd - step)[0]) / (2 * step), rel=1e-4, abs=1e-5)


@pytest.mark.parametrize(
    ("effect", "joint", "other", "parameters", "message"),
    [
        ("worn_gear", "joint_1", None, {}, r"effects\[0\]\.effect: 'worn_gear'"),
        ("joint_spring", "joint_9", None, {"stiffness": 1.0}, r"effects\[0\]\.joint: 'joint_9'"),
        ("joint_spring", "joint_1", None, {}, "needs stiffness"),
        ("joint_spring", "joint_1", None, {"stiffness": 1.0, "damping": 1.0}, "parameters.damping: unknown"),
        ("asymmetric_viscous_friction", "joint_1", None, {"ratio": 0.2}, r"takes fva \(N m s/rad\)"),
        ("asymmetric_viscous_friction", "joint_1", None, {"fva": 9.0}, "at most the friction 8, found 9"),
        ("stribeck_friction", "joint_1", None, {"extra": 1.0, "velocity": 0.0}, "velocity: expected a number above 0"),
        ("payload", "joint_6", None, {"mass": -1.0}, "mass: expected a number above 0"),
        ("friction_drift", "joint_1", None, {"change": -2.0}, "change: expected a number from -1 up to 10"),
        ("coupling_friction", "joint_1", None, {"coulomb": 1.0}, r"other: coupling_friction is between two joints"),
        ("coupling_friction", "joint_1", "joint_1", {"coulomb": 1.0}, r"other: expected another joint than joint_1"),
        ("coupling_friction", "joint_1", "joint_9", {"coulomb": 1.0}, r"other: 'joint_9' is not a joint of tx40"),
        ("torque_offset", "joint_1", "joint_2", {"torque": 1.0}, r"other: torque_offset is of one joint"),
        ("gravity_direction", "joint_2", None, {"tilt": 0.1}, "is of the base, expected joint_1, found joint_2"),
        ("cogging_torque", "joint_1", None, {"amplitude": 1.0, "pitch": 0.1}, "for a prismatic joint, joint_1 is rev"),
        ("stick_events", "joint_1", None, {"torque": 1.0, "every": 0.05}, "duration: expected less than every"),
        ("rotor_inertia", "joint_1", None, {"inertia": -50.0}, "inertia: -50 leaves a joint without inertia"),
        ("joint_elasticity", "joint_1", None, {"stiffness": 1e3, "motor_inertia": 99.0}, "motor_inertia: expected les"),
    ],
)
def test_a_mistake_in_a_scenario_is_named(
    tx40: RobotConfig, effect: str, joint: str, other: str | None, parameters: dict[str, float], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        with_effect(tx40, effect, joint, parameters, other)


def test_the_same_effect_twice_on_a_joint_is_refused_but_harmonics_are_not(tx40: RobotConfig) -> None:
    spring = ("joint_spring", "joint_1", None, {"stiffness": 1.0})
    with pytest.raises(ConfigError, match=r"effects\[1\]: joint_1 has joint_spring already"):
        Plant(tx40, np.zeros(6), scenario(spring, spring))
    waves = [("cogging_torque", "joint_1", None, {"amplitude": 1.0, "harmonic": k}) for k in (1.0, 6.0)]
    plant = Plant(tx40, np.zeros(6), scenario(*waves))
    q = np.array([0.01, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert resistance(plant, q, np.zeros(6))[0] == pytest.approx(math.sin(0.32) + math.sin(6 * 0.32))
