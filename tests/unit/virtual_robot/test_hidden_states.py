"""Hidden effects with states (bristles, gears, swinging masses) against accurately integrated equations."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from armident.configs import ConfigError, RobotConfig
from armident.configs.schema.scenario import HiddenEffect, Scenario
from armident.virtual_robot.arm_parameters import arm_parameters
from armident.virtual_robot.plant import Plant
from tests.plant_torques import resistance

PERIOD = 200e-6
HOLD = 5
"""Number of periods of constant force; the reference integration restarts at each change."""
MASS, FV, FC, OFF, SMOOTHING = 95.1089, 203.5034, 20.3935, -3.1648, 5000.0
"""The virtual EMPS: kg, N s/m, N, N, s/m."""
Vector = NDArray[np.float64]
Law = Callable[[Vector, float], list[float]]


def entry(effect: str, joint: str = "joint_1", **parameters: float) -> HiddenEffect:
    return HiddenEffect(effect=effect, joint=joint, parameters=parameters)


def hide(*effects: HiddenEffect) -> Scenario:
    return Scenario(schema="armident/scenario/1", effects=effects)


def slide(speed: float) -> float:
    """Friction of the healthy EMPS."""
    return FV * speed + FC * 2 / math.pi * math.atan(SMOOTHING * speed) + OFF


def run(plant: Plant, forces: Vector) -> Vector:
    """Coordinates after every hold, shape (N, coordinates)."""
    out = []
    for force in forces:
        for _ in range(HOLD):
            plant.advance(np.array([force]), PERIOD)
        out.append(plant.coordinates.copy())
    return np.array(out)


def solve(
    law: Law, start: list[float], forces: Vector, method: Literal["RK45", "Radau"] = "RK45", largest: float = math.inf
) -> Vector:
    """States (N, states) after every hold, by ``law(state, force)``."""
    state, out = np.array(start), []
    for force in forces:

        def rhs(_: float, y: Vector, force: float = force) -> list[float]:
            return law(y, force)

        solution = solve_ivp(rhs, (0.0, HOLD * PERIOD), state, method, rtol=1e-9, atol=1e-13, max_step=largest)
        state = solution.y[:, -1]
        out.append(state)
    return np.array(out)


def sweep(seconds: float, amplitude: float = 150.0) -> Vector:
    """Forces that move the axis back and forth with increasing frequency."""
    t = np.arange(round(seconds / (HOLD * PERIOD))) * HOLD * PERIOD
    return amplitude * np.sin(2 * np.pi * (2.0 * t + 8.0 * t**2)) + OFF


def test_an_elastic_joint_is_two_masses_with_a_spring(emps: RobotConfig) -> None:
    stiffness, motor = 4e5, 25.0
    link = MASS - motor
    damping = 0.1 * 2 * math.sqrt(stiffness * motor * link / MASS)

    def law(y: Vector, force: float) -> list[float]:
        gear = stiffness * (y[0] - y[1]) + damping * (y[2] - y[3])
        return [y[2], y[3], (force - slide(y[2]) - gear) / motor, gear / link]

    forces = sweep(0.4)
    effect = entry("joint_elasticity", stiffness=stiffness, damping=0.1, motor_inertia=motor)
    plant = Plant(emps, [0.01], hide(effect))
    moved, truth = run(plant, forces), solve(law, [0.01, 0.01, 0.0, 0.0], forces)
    twist = truth[:, 0] - truth[:, 1]
    assert np.ptp(truth[:, 0]) > 1e-3
    assert np.ptp(twist) > 1e-4
    # One part in ten thousand of the twist, the quantity of interest.
    assert np.abs(moved - truth[:, :2]).max() < 1e-4 * np.ptp(twist)


def test_the_resonance_of_an_elastic_joint_rings_at_its_frequency_and_dies_with_its_damping(emps: RobotConfig) -> None:
    stiffness, ratio = 4e5, 0.02
    plant = Plant(emps, [0.0], hide(entry("joint_elasticity", stiffness=stiffness, damping=ratio)))
    plant.brake[:] = 1e9
    link = 0.7 * MASS
    plant.coordinates[1] += 1e-4
    twist = run(plant, np.full(1000, OFF))[:, 1]
    peaks = 1 + np.flatnonzero((twist[1:-1] > twist[:-2]) & (twist[1:-1] >= twist[2:]))
    own = math.sqrt(stiffness / link)
    # The motor is held, so the damping set for the free pair is another share of critical.
    held = ratio * math.sqrt(0.3)
    period = 2 * math.pi / (own * math.sqrt(1 - held**2))
    assert np.diff(peaks).mean() * HOLD * PERIOD == pytest.approx(period, rel=2e-3)
    decay = np.log(twist[peaks[0]] / twist[peaks[5]]) / 5
    assert decay == pytest.approx(2 * math.pi * held / math.sqrt(1 - held**2), rel=2e-2)


def test_backlash_leaves_the_link_at_rest_while_the_motor_crosses_the_gap(emps: RobotConfig) -> None:
    gap, motor = 1e-3, 30.0
    plant = Plant(emps, [0.0], hide(entry("backlash", gap=gap, motor_inertia=motor)))
    force = 60.0
    moved = run(plant, np.full(500, force))
    inside = moved[:, 0] < 0.45 * gap
    assert inside.sum() > 10
    # The link has no friction of its own: it comes to rest by the gap alone.
    assert np.abs(moved[inside, 1]).max() < 1e-15
    alone = solve(lambda y, f: [y[1], (f - slide(y[1])) / motor], [0.0, 0.0], np.full(int(inside.sum()), force))
    assert np.abs(moved[inside, 0] - alone[:, 0]).max() < 1e-4 * gap
    twist = moved[:, 0] - moved[:, 1]
    # The contact closes over 2 % of the gap to either side of its edge.
    assert (0.48 * gap < twist[-50:]).all()
    assert 0.5 * gap < twist.max() < 0.6 * gap


@pytest.mark.slow
def test_backlash_agrees_with_a_contact_that_has_a_sharp_corner(emps: RobotConfig) -> None:
    gap, motor, stiffness, ratio = 1e-3, 30.0, 2e6, 0.2
    link = MASS - motor
    damping = ratio * 2 * math.sqrt(stiffness * motor * link / MASS)

    def law(y: Vector, force: float) -> list[float]:
        twist, rate, gear = y[0] - y[1], y[2] - y[3], 0.0
        if abs(twist) > 0.5 * gap:
            gear = stiffness * (twist - math.copysign(0.5 * gap, twist)) + damping * rate
        return [y[2], y[3], (force - slide(y[2]) - gear) / motor, gear / link]

    forces = sweep(0.6, 120.0)
    effect = entry("backlash", gap=gap, stiffness=stiffness, damping=ratio, motor_inertia=motor)
    moved, truth = run(Plant(emps, [0.0], hide(effect)), forces), solve(law, [0.0] * 4, forces, largest=2e-4)
    twist = moved[:, 0] - moved[:, 1]
    assert (np.diff((twist > 0).astype(int)) != 0).sum() >= 4, "the gap must be crossed several times"
    assert np.abs(moved - truth[:, :2]).max() < 0.05 * gap


def test_a_gear_that_gives_carries_the_weight_of_its_link_from_the_start(tx40: RobotConfig) -> None:
    q = np.array([0.0, 1.0, 0.5, 0.0, 0.0, 0.0])
    for effect in (entry("joint_elasticity", "joint_2", stiffness=4e3), entry("backlash", "joint_2", gap=2e-3)):
        plant = Plant(tx40, q, hide(effect))
        plant.brake[:] = 1e9
        start = plant.coordinates.copy()
        for _ in range(1000):
            plant.advance(np.zeros(6), PERIOD)
        assert abs(start[6] - start[1]) > 1e-3
        assert np.abs(plant.coordinates - start).max() < 1e-6


def test_a_stiff_gear_is_no_gear(tx40: RobotConfig) -> None:
    q = np.array([0.0, 0.3, 1.2, 0.0, 0.4, 0.0])
    soft, rigid = Plant(tx40, q, hide(entry("joint_elasticity", "joint_3", stiffness=3e6, damping=1.0))), Plant(tx40, q)
    np.testing.assert_allclose(soft.mass_matrix(), rigid.mass_matrix(), atol=1e-3)
    t = np.arange(1000) * PERIOD
    for x in np.sin(2 * np.pi * 4 * t):
        for plant in (soft, rigid):
            plant.advance(x * np.array([20.0, 30.0, 15.0, 5.0, 5.0, 3.0]), PERIOD)
    assert np.abs(rigid.q - q).max() > 0.02
    # 30 N m over 3e6 N m/rad are 1e-5 rad.
    assert np.abs(soft.q - rigid.q).max() < 5e-5


def lugre(extra: float, velocity: float, exponent: float, deflection: float, damping: float) -> Law:
    """Equation (1) to (5) of Canudas de Wit et al. (1995) on the EMPS; the state is x, v, z."""
    stiffness = FC / deflection
    own = damping * 2 * math.sqrt(stiffness * MASS)

    def law(y: Vector, force: float) -> list[float]:
        level = FC + extra * math.exp(-(abs(y[1] / velocity) ** exponent))
        rate = y[1] - stiffness * abs(y[1]) / level * y[2]
        return [y[1], (force - FV * y[1] - OFF - stiffness * y[2] - own * rate) / MASS, rate]

    return law


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effect", "law"),
    [
        (
            entry("stribeck_friction", extra=15.0, velocity=0.02, exponent=1.5, deflection=2e-6, damping=0.1),
            lugre(15.0, 0.02, 1.5, 2e-6, 0.1),
        ),
        (entry("presliding_friction", deflection=5e-4), lugre(0.0, 1.0, 2.0, 5e-4, 0.0)),
        (entry("presliding_friction", deflection=5e-5, damping=0.3), lugre(0.0, 1.0, 2.0, 5e-5, 0.3)),
    ],
)
def test_bristles_follow_the_lugre_equations(emps: RobotConfig, effect: HiddenEffect, law: Law) -> None:
    forces = sweep(0.4, 60.0)
    moved = run(Plant(emps, [0.0], hide(effect)), forces)[:, 0]
    truth = solve(law, [0.0, 0.0, 0.0], forces, "Radau")[:, 0]
    assert np.ptp(truth) > 1e-3
    assert np.abs(moved - truth).max() < 2e-4 * np.ptp(truth)


def test_presliding_is_elastic_and_keeps_part_of_the_way_when_the_force_is_gone(emps: RobotConfig) -> None:
    deflection, share = 1e-4, 0.6
    plant = Plant(emps, [0.0], hide(entry("presliding_friction", deflection=deflection)))
    ramp = share * (0.5 - 0.5 * np.cos(2 * np.pi * np.arange(1, 4001) / 4000)) * FC + OFF
    way = run(plant, ramp)[:, 0]
    # Dahl: dF/dx = stiffness (1 - F/Fc) on loading, stiffness (1 + F/Fc) on unloading.
    loaded = -deflection * math.log(1 - share)
    left = loaded - deflection * math.log(1 + share)
    # The viscous friction takes 0.05 N of the 20 N, and the mass rings on its bristle a little.
    assert way[1999] == pytest.approx(loaded, abs=0.03 * deflection)
    assert way[-1] == pytest.approx(left, abs=0.03 * deflection)


def test_steady_sliding_has_the_stribeck_curve(emps: RobotConfig) -> None:
    plant = Plant(emps, [0.0], hide(entry("stribeck_friction", extra=10.0, velocity=0.02)))
    for speed in (0.01, 0.05, 0.3):
        curve = FV * speed + OFF + FC + 10.0 * math.exp(-((speed / 0.02) ** 2))
        assert resistance(plant, np.zeros(1), np.array([speed]))[0] == pytest.approx(curve)
    # An axis that slides at 0.05 m/s keeps its speed under that force.
    curve = FV * 0.05 + OFF + FC + 10.0 * math.exp(-6.25)
    plant.velocities[0] = 0.05
    plant.bristles[0] = (FC + 10.0 * math.exp(-6.25)) / (FC / (4e-6 * 0.5))
    run(plant, np.full(100, curve))
    assert plant.qd[0] == pytest.approx(0.05, rel=1e-4)


@pytest.mark.slow
def test_stribeck_and_presliding_of_one_joint_share_a_bristle(emps: RobotConfig) -> None:
    both = hide(entry("stribeck_friction", extra=10.0, velocity=0.02), entry("presliding_friction", deflection=2e-4))
    forces = sweep(0.3, 60.0)
    moved = run(Plant(emps, [0.0], both), forces)[:, 0]
    truth = solve(lugre(10.0, 0.02, 2.0, 2e-4, 0.02), [0.0, 0.0, 0.0], forces, "Radau")[:, 0]
    assert np.abs(moved - truth).max() < 2e-4 * np.ptp(truth)


def test_a_bristle_needs_coulomb_friction_to_stand_for(emps: RobotConfig) -> None:
    own = arm_parameters(emps)
    smooth = replace(own, standard={**own.standard, "fc1": 0.0})
    with pytest.raises(ConfigError, match=r"effects\[0\]: joint_1 has no Coulomb friction"):
        Plant(emps, [0.0], hide(entry("presliding_friction", deflection=1e-4)), smooth)


def test_a_sloshing_payload_is_a_pendulum_on_a_cart(emps: RobotConfig) -> None:
    mass, length, gravity = 8.0, 0.2, 9.81
    inertia = mass * length**2 * 1.01
    damping = 0.1 * 2 * mass * length**2 * math.sqrt(gravity / length)

    def law(y: Vector, force: float) -> list[float]:
        x, angle, speed, rate = y
        del x
        couple = mass * length * math.cos(angle)
        matrix = np.array([[MASS + mass, couple], [couple, inertia]])
        right = [
            force - slide(speed) + mass * length * rate**2 * math.sin(angle),
            -mass * gravity * length * math.sin(angle) - damping * rate,
        ]
        return [speed, rate, *np.linalg.solve(matrix, right)]

    forces = sweep(0.5)
    plant = Plant(emps, [0.0], hide(entry("slosh_payload", mass=mass, length=length, damping=0.1)))
    hanging = plant.coordinates[1]
    moved, truth = run(plant, forces), solve(law, [0.0] * 4, forces)
    swing = moved[:, 1] - hanging
    assert np.ptp(truth[:, 1]) > 0.02
    # The same angle, counted the same way or the other.
    swing *= np.sign(swing @ truth[:, 1])
    assert np.abs(swing - truth[:, 1]).max() < 1e-3 * np.ptp(truth[:, 1])
    assert np.abs(moved[:, 0] - truth[:, 0]).max() < 1e-4 * np.ptp(truth[:, 0])


def test_a_sloshing_payload_at_rest_weighs_what_it_hangs_with(tx40: RobotConfig) -> None:
    """With closed brakes the arm does not move, and the mass keeps its rest angle."""
    q = np.array([0.2, 0.5, 1.0, 0.3, -0.4, 0.2])
    plant = Plant(tx40, q, hide(entry("slosh_payload", "joint_6", mass=1.0)))
    plant.brake[:] = 1e9
    start = plant.coordinates[6]
    for _ in range(500):
        plant.advance(np.zeros(6), PERIOD)
    assert plant.coordinates[6] == pytest.approx(start, abs=1e-6)


def test_energy_never_comes_from_a_passive_arm(tx40: RobotConfig) -> None:
    """Without motor torque an arm with gap, spring, bristles and a swinging mass comes to rest."""
    effects = (
        entry("backlash", "joint_1", gap=5e-3),
        entry("joint_elasticity", "joint_3", stiffness=2e3),
        entry("stribeck_friction", "joint_4", extra=1.0),
        entry("presliding_friction", "joint_5", deflection=1e-3),
        entry("presliding_friction", "joint_1", deflection=1e-4),
    )
    level = tx40.model_copy(update={"gravity": (0.0, 0.0, 0.0)})
    plant = Plant(level, [0.0, 0.0, 1.5, 0.0, 0.3, 0.0], hide(*effects))
    plant.velocities[:6] = [1.0, -1.0, 1.0, 2.0, -1.0, 2.0]
    plant.velocities[6:] = plant.velocities[[0, 2]]
    energy = []
    for _ in range(3000):
        plant.advance(np.zeros(6), PERIOD)
        v = plant.velocities
        energy.append(0.5 * v @ plant._inertia(plant.coordinates) @ v)
    assert energy[0] > 0.5
    assert max(energy) <= energy[0] * 1.001
    assert energy[-1] < 1e-3 * energy[0]
