"""Every effect of the catalogue hidden in every shipped robot: change of the signals, and control of the arm.

    python -m tests.statistics.twin_effects                     # all robots and effects; a table of changes, percent
    python -m tests.statistics.twin_effects --robots ur5e,panda

Each twin plays the first second of a motion within its limits, without noise, healthy and with the effect. The change
is the largest difference of a position or torque signal over the range of the healthy one.
"""

import argparse
import sys
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from armident.configs import Scenario
from armident.configs.loading import HERE
from armident.configs.schema.robot import Limits
from armident.configs.schema.scenario import HiddenEffect
from armident.configs.units import counts_per_si
from armident.virtual_robot.arm import Arm
from armident.virtual_robot.effects import EFFECTS
from armident.virtual_robot.plausible_motion import plausible_trajectory
from armident.virtual_robot.twin import Twin, load_twin

SYNC = 1e-3
"""Period of the bus, s."""
DURATION = 1.0
"""Recorded motion, s."""
EVERY = 5
"""SYNCs between set points."""
VISIBLE = 2e-3
"""Least change of a signal, as a share of the healthy signal's range, that counts as visible: two steps of 10 bits."""
RUN_AWAY = 20.0
"""Multiple of the largest healthy signal beyond which the loops do not hold the arm."""

ROBOTS = tuple(sorted(file.stem for file in (HERE / "robots").glob("*.yaml")))
"""Shipped robots."""

Signals = tuple[NDArray[np.float64], NDArray[np.float64]]


def span(limits: Limits) -> float:
    """Return the range of positions of a joint, rad or m."""
    return limits.position[1] - limits.position[0]


SIZES: dict[str, Callable[[Limits], dict[str, float]]] = {
    "asymmetric_viscous_friction": lambda j: {"fva": 0.005 * j.torque / j.velocity},
    "asymmetric_coulomb_friction": lambda j: {"fca": 0.005 * j.torque},
    "stribeck_friction": lambda j: {"extra": 0.05 * j.torque},
    "nonlinear_viscous_friction": lambda j: {"thinning": 0.4},
    "load_dependent_friction": lambda j: {"fcl": 0.2},
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


@cache
def twin(config: Path) -> Twin:
    """Return the virtual arm of a configuration."""
    return load_twin(config)


def signals(config: Path, scenario: Scenario | None) -> Signals:
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


@cache
def healthy_signals(config: Path) -> Signals:
    """Signals of the healthy arm."""
    return signals(config, None)


def change(config: Path, effect: str, joint: int, other: int) -> tuple[float, float]:
    """Return the largest change of a signal by an effect, and the largest signal, over those of the healthy arm.

    ``joint``, ``other``: joint of the effect, from 0, and the other joint of an effect between two.
    """
    joints, spec = twin(config).robot.joints, EFFECTS[effect]
    place = joints[0 if spec.first_joint else joint]
    hidden = HiddenEffect(
        effect=effect,
        joint=place.name,
        other=joints[other].name if spec.other == "required" else None,
        parameters=SIZES[effect](place.limits),
    )
    scenario = Scenario(schema="armident/scenario/1", effects=(hidden,))
    changes, peaks = [], []
    for healthy, changed in zip(healthy_signals(config), signals(config, scenario), strict=True):
        changes.append(float((np.abs(changed - healthy).max(axis=0) / np.ptp(healthy, axis=0)).max()))
        peaks.append(float(np.abs(changed).max() / np.abs(healthy).max()))
    return max(changes), max(peaks)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table; 0 if every effect shows in every robot that can have it, and every arm is held."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", default=",".join(ROBOTS), help="shipped robots: A,B,...")
    parser.add_argument("--effects", default=",".join(sorted(EFFECTS)), help="effects: A,B,...")
    options = parser.parse_args(arguments)
    effects, failed = options.effects.split(","), 0
    print("| robot | effects | visible | held | least change, % | by |\n| --- | --- | --- | --- | --- | --- |")
    for name in options.robots.split(","):
        n = twin(Path(name)).robot.n
        able = [effect for effect in effects if n > 1 or not needs_two_joints(effect)]
        found = {effect: change(Path(name), effect, min(1, n - 1), min(2, n - 1)) for effect in able}
        visible = sum(size > VISIBLE for size, _ in found.values())
        held = sum(peak < RUN_AWAY for _, peak in found.values())
        failed += 2 * len(able) - visible - held
        least = min(found, key=lambda effect: found[effect][0])
        print(f"| `{name}` | {len(able)} | {visible} | {held} | {100 * found[least][0]:.2g} | `{least}` |", flush=True)
    return 1 if failed else 0


def needs_two_joints(effect: str) -> bool:
    """Return ``True`` for an effect between two joints."""
    return EFFECTS[effect].other == "required"


if __name__ == "__main__":
    sys.exit(main())
