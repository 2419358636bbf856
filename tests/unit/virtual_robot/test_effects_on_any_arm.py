"""Every hidden effect on arms without stored parameters: the arm moves on, and its signals change."""

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from armident.configs import Scenario
from armident.configs.schema.robot import Limits
from armident.configs.schema.scenario import HiddenEffect
from armident.configs.units import counts_per_si
from armident.virtual_robot.arm import Arm
from armident.virtual_robot.effects import EFFECTS
from armident.virtual_robot.plausible_motion import plausible_trajectory
from armident.virtual_robot.twin import Twin, load_twin
from tests.fixtures.other_arms import write_scara

pytestmark = pytest.mark.slow

SYNC = 1e-3
DURATION = 1.0
"""Recorded motion, s."""
EVERY = 5
"""SYNCs between set points."""
VISIBLE = 2e-3
"""Least change of a signal, as a share of the healthy signal's range, that counts as visible: two steps of 10 bits."""

PLACES = {"panda": (3, 1), "kuka_lwr4": (1, 3), "scara": (2, 1)}
"""Joint of the effect, from 0, and the other joint of an effect between two; the lift of the SCARA is prismatic."""


def span(limits: Limits) -> float:
    return limits.position[1] - limits.position[0]


SIZES: dict[str, Callable[[Limits], dict[str, float]]] = {
    "asymmetric_viscous_friction": lambda j: {"ratio": 0.5},
    "asymmetric_coulomb_friction": lambda j: {"ratio": 0.3},
    "stribeck_friction": lambda j: {"extra": 0.05 * j.torque},
    "nonlinear_viscous_friction": lambda j: {"thinning": 0.4},
    "load_dependent_friction": lambda j: {"coefficient": 0.2},
    "presliding_friction": lambda j: {"deflection": 1e-3 * j.velocity},
    "position_dependent_friction": lambda j: {"ratio": 0.5},
    "friction_drift": lambda j: {"change": 0.5, "time_constant": 2.0},
    "coupling_friction": lambda j: {"coulomb": 0.03 * j.torque},
    "cogging_torque": lambda j: {"amplitude": 0.03 * j.torque, "harmonic": 2.0},
    "joint_spring": lambda j: {"stiffness": 0.3 * j.torque / span(j)},
    "joint_elasticity": lambda j: {"stiffness": 100.0 * j.torque / span(j)},
    "backlash": lambda j: {"gap": 5e-3 * span(j)},
    "payload": lambda j: {"mass": 0.5},
    "rotor_inertia": lambda j: {"inertia": 0.02 * j.torque / j.acceleration},
    "gravity_direction": lambda j: {"tilt": 0.2},
    "drive_gain_error": lambda j: {"error": 0.2},
    "drive_gain_saturation": lambda j: {"drop": 0.3},
    "sign_error": lambda j: {},
    "joint_order": lambda j: {},
    "time_delay": lambda j: {"delay": 0.02},
    "encoder_eccentricity": lambda j: {"amplitude": 2e-3 * span(j)},
    "actuator_bandwidth": lambda j: {"time_constant": 2e-3},
    "torque_offset": lambda j: {"torque": 0.03 * j.torque},
    "torque_bump": lambda j: {"torque": 0.05 * j.torque, "position": 0.5 * sum(j.position), "width": 0.3 * span(j)},
    "mains_ripple": lambda j: {"amplitude": 0.02 * j.torque},
    "slosh_payload": lambda j: {"mass": 0.5},
    "current_crosstalk": lambda j: {"share": 0.1},
    "stick_events": lambda j: {"torque": 0.1 * j.torque, "every": 0.4, "duration": 0.2},
    "quadratic_coupling": lambda j: {"coefficient": 0.1 * j.torque},
    "base_vibration": lambda j: {"amplitude": 0.5},
    "friction_scale": lambda j: {"factor": 1.5},
}
"""Values of each effect by the limits of its joint."""


@pytest.fixture(scope="module")
def scara(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scara(tmp_path_factory.mktemp("scara"))


@cache
def twin(config: Path) -> Twin:
    return load_twin(config)


@cache
def signals(config: Path, scenario: Scenario | None) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Positions and torque signals (K, n) on the bus along the first second of a motion, without noise."""
    arm_of = twin(config)
    robot = arm_of.robot
    motion = plausible_trajectory(robot)
    arm = Arm(robot, motion.start, SYNC, noise=0.0, scenario=scenario, parameters=arm_of.parameters)
    for joint in range(robot.n):
        arm.enable(joint, True)
        arm.interpolation_time(joint, EVERY * SYNC)
    rows = np.rint(motion.sample(EVERY * SYNC) @ robot.transmission_matrix.T * counts_per_si(robot)).astype(np.int32)
    position, current = [], []
    for k in range(round(DURATION / SYNC)):
        position.append(arm.position.copy())
        current.append(arm.current.copy())
        if k % EVERY == 0:
            arm.set_targets(rows[k // EVERY], np.ones(robot.n, np.bool_))
        arm.advance()
    assert np.isfinite(arm.plant.coordinates).all()
    return np.array(position, dtype=np.float64), np.array(current, dtype=np.float64)


@pytest.mark.parametrize("arm", sorted(PLACES))
@pytest.mark.parametrize("effect", sorted(EFFECTS))
def test_an_effect_changes_the_signals_of_any_arm(effect: str, arm: str, scara: Path) -> None:
    config = scara if arm == "scara" else Path(arm)
    joint, other = (twin(config).robot.joints[k] for k in PLACES[arm])
    spec = EFFECTS[effect]
    if spec.first_joint:
        joint = twin(config).robot.joints[0]
    hidden = HiddenEffect(
        effect=effect,
        joint=joint.name,
        other=other.name if spec.other == "required" else None,
        parameters=SIZES[effect](joint.limits),
    )
    scenario = Scenario(schema="armident/scenario/1", effects=(hidden,))
    changes = []
    for healthy, changed in zip(signals(config, None), signals.__wrapped__(config, scenario), strict=True):
        scale = np.ptp(healthy, axis=0)
        changes.append(float((np.abs(changed - healthy).max(axis=0) / scale).max()))
        # the loops hold the arm: nothing runs away
        assert np.abs(changed).max() < 20.0 * np.abs(healthy).max()
    assert max(changes) > VISIBLE, changes


def test_every_effect_has_a_size() -> None:
    assert set(SIZES) == set(EFFECTS)
