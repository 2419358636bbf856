"""Limits of a trajectory beyond those of motion: torques by known masses, and distances between bodies."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from armident.configs import RobotConfig
from armident.configs.loading import load_inertials, load_shapes
from armident.identify.effects.terms import arm_model
from armident.identify.excitation.collision import CollisionModel
from armident.identify.excitation.design import PERIOD, Design
from armident.identify.excitation.link_geometry import capsules_of
from armident.identify.excitation.previous_estimate import PreviousEstimate
from armident.identify.robot.chain import Floats

NO_GEOMETRY = "give collision.radius or collision.capsules in the robot configuration, or a URDF with shapes"
NO_BOXES = "list what stands around it in collision.boxes of the robot configuration"


@dataclass(frozen=True, eq=False)
class SafetyModel:
    """Masses and bodies of an arm.

    Parameters
    ----------
    collision
        Bodies of arm and cell.
    theta
        Base (b,) or standard (p,) parameters that predict torques; ``None`` if no masses are known.
    torque_source
        Origin of the parameters, for messages.
    remarks
        Properties that cannot be checked.
    """

    collision: CollisionModel
    theta: Floats | None
    torque_source: str
    remarks: tuple[str, ...]


@dataclass(frozen=True)
class SafetyChecks:
    """Results of the checks of a trajectory, one sentence each.

    Parameters
    ----------
    checked, unchecked
        Properties that were checked, with the result, and those that were not, with the reason.
    """

    checked: tuple[str, ...]
    unchecked: tuple[str, ...]


def safety_model(
    robot: RobotConfig, source: str | Path | None, prior: PreviousEstimate | None, prior_name: str = "--known"
) -> SafetyModel:
    """Collect masses and bodies of an arm: of an earlier estimate, of its configuration, of its URDF.

    Parameters
    ----------
    robot
        Configuration.
    source
        Path or shipped name from which it was loaded: its URDF is read; ``None``: there is none.
    prior, prior_name
        Earlier estimate, and its name in messages.

    Raises
    ------
    ConfigError
        If masses, shapes or boxes are wrong.
    """
    shapes = None if source is None else load_shapes(source)
    capsules, unread = ([], []) if shapes is None else capsules_of(shapes.shapes)
    collision = CollisionModel(robot, capsules)
    remarks = (
        [f"shapes of meshes that cannot be read: {_listed([*shapes.missing, *unread])}"]
        if (shapes is not None and (shapes.missing or unread))
        else []
    )
    if prior is not None:
        return SafetyModel(collision, prior.theta, prior_name, tuple(remarks))
    theta = None if source is None else _theta_of_urdf(robot, source)
    if theta is not None:
        remarks.append("torques of rotor inertias, and of friction that the URDF does not give")
    return SafetyModel(collision, theta, "the masses of the URDF", tuple(remarks))


def _theta_of_urdf(robot: RobotConfig, source: str | Path) -> Floats | None:
    """Standard parameters (p,) of the masses and friction of a URDF; ``None`` if it has no masses."""
    found = load_inertials(source)
    if found is None or not any(value > 0.0 for name, value in found.standard.items() if name.startswith("m")):
        return None
    values = found.standard | found.friction
    return np.array([values.get(name, 0.0) for name in arm_model(robot).names])


def check_safety(robot: RobotConfig, design: Design, safety: SafetyModel) -> SafetyChecks:
    """Return what was checked of a trajectory, with the results, and what was not.

    Parameters
    ----------
    robot
        Configuration with the limits.
    design
        The trajectory.
    safety
        Masses and bodies by which it was designed or checked.
    """
    done = ["position, velocity and acceleration keep their limits"]
    left = list(safety.remarks)
    if design.torque is None:
        left.append("torques: no --known identification, and no masses in a URDF")
    else:
        used = np.abs(design.torque).max(axis=0) / [joint.limits.torque for joint in robot.joints]
        worst = int(np.argmax(used))
        share = f"at most {100 * used[worst]:.0f} % of the limit ({robot.joints[worst].name})"
        done.append(f"torque by {safety.torque_source}: {share}")
    bodies, collision = design.closest, safety.collision
    if bodies is not None:
        time = bodies.sample * PERIOD
        done.append(
            f"{collision.pairs} pairs of bodies, clearance {collision.clearance:g} m: closest {bodies} at {time:.2f} s"
        )
    if collision.without_geometry:
        names = "any link" if len(collision.without_geometry) > robot.n else _listed(collision.without_geometry)
        left.append(f"collisions of {names}: no geometry; {NO_GEOMETRY}")
    if collision.touching:
        left.append(f"pairs that touch by construction: {'; '.join(collision.touching)}")
    if not collision.settings.boxes:
        left.append(f"obstacles: {NO_BOXES}")
    left.append("cables, and a tool that neither the URDF nor collision.capsules contains")
    return SafetyChecks(tuple(done), tuple(left))


def _listed(names: Iterable[str], most: int = 6) -> str:
    every = list(names)
    more = f" and {len(every) - most} more" if len(every) > most else ""
    return ", ".join(every[:most]) + more
