"""Limits of a trajectory beyond those of motion: torques by known masses, and distances between bodies."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from armident.arrays import Array
from armident.configs import ConfigError, RobotConfig
from armident.configs.loading import load_inertials, load_shapes
from armident.configs.urdf_inertials import UrdfInertials
from armident.identify.documents.files import read_json
from armident.identify.effects.terms import arm_model
from armident.identify.excitation.collision import CollisionModel
from armident.identify.excitation.design import ASSUMED_NOISE, PERIOD, Design, excesses, predict_precision
from armident.identify.excitation.link_geometry import capsules_of
from armident.identify.excitation.previous_estimate import PreviousEstimate

NO_GEOMETRY = "give collision.radius or collision.capsules in the robot configuration, or a URDF with shapes"
NO_BOXES = "list what stands around it in collision.boxes of the robot configuration"


@dataclass(frozen=True, eq=False)
class SafetyModel:
    """Masses (parameters (b,) or (p,), ``None`` if unknown) and bodies of an arm; ``remarks``: not checkable."""

    collision: CollisionModel
    theta: Array | None
    torque_source: str
    remarks: tuple[str, ...]


@dataclass(frozen=True)
class SafetyChecks:
    """Properties of a trajectory that were checked, with results, and those that were not, with reasons."""

    checked: tuple[str, ...]
    unchecked: tuple[str, ...]


def safety_model(
    robot: RobotConfig,
    source: str | Path | None,
    prior: PreviousEstimate | None,
    prior_name: str = "--known",
    masses: Path | None = None,
) -> SafetyModel:
    """Collect masses and bodies of an arm: of an earlier estimate, of a file, of its configuration, of its URDF."""
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
    if masses is not None:
        given, lacking = _theta_of_file(robot, masses)
        remarks += [f"torques of parameters that {masses} lacks: {_listed(lacking)}"] if lacking else []
        return SafetyModel(collision, given, f"the parameters of {masses}", tuple(remarks))
    found = None if source is None else load_inertials(source)
    theta = None if found is None else _theta_of_urdf(robot, found)
    if found is not None and theta is not None:
        if found.massless:
            remarks.append(
                f"masses moved by {_listed(robot.joints[k - 1].name for k in found.massless)}: not in the URDF"
            )
        remarks.append("torques of rotor inertias, and of friction that the URDF does not give")
    return SafetyModel(collision, theta, "the masses of the URDF", tuple(remarks))


def _theta_of_urdf(robot: RobotConfig, found: UrdfInertials) -> Array | None:
    """Standard parameters (p,) of the masses and friction of a URDF; ``None`` if it has no masses."""
    if len(found.massless) == robot.n:
        return None
    values = found.standard | found.friction
    return np.array([values.get(name, 0.0) for name in arm_model(robot).names])


def _theta_of_file(robot: RobotConfig, file: Path) -> tuple[Array, list[str]]:
    """Return the standard parameters (p,) of a JSON file, and the names of those that it lacks, which are zero."""
    values = read_json(file)
    names = arm_model(robot).names
    given = {name: values[name] for name in names if name in values}
    wrong = next((n for n, v in given.items() if isinstance(v, bool) or not isinstance(v, int | float)), None)
    if wrong is not None or not np.isfinite([float(v) for v in given.values()]).all():
        raise ConfigError(f"{file}: {wrong or 'a parameter'}: expected a finite number, SI")
    if not any(name in given for name in _not_negative(names, "m")):
        raise ConfigError(
            f"{file}: has no masses of links (m1 to m{robot.n}); expected standard parameters in SI by name, as "
            "`armident robot --truth FILE` writes them"
        )
    negative = next((n for n in _not_negative(names, "m", "ia", "fv", "fc") if given.get(n, 0.0) < 0.0), None)
    if negative is not None:
        raise ConfigError(f"{file}: {negative}: {given[negative]:g} is negative, which no arm has")
    important = _not_negative(names, "m", "ia", "fv", "fc")
    lacking = sorted((name for name in names if name not in given), key=lambda name: name not in important)
    return np.array([float(given.get(name, 0.0)) for name in names]), lacking


def _not_negative(names: Sequence[str], *kinds: str) -> list[str]:
    """Return the names of parameters of some kinds: kind and number of a link, joint or coupling."""
    return [name for name in names if re.fullmatch(rf"({'|'.join(kinds)})m?\d+", name)]


def check_safety(robot: RobotConfig, design: Design, safety: SafetyModel) -> SafetyChecks:
    """Return what was checked of a trajectory, with the results, and what was not."""
    done = ["position, velocity and acceleration keep their limits"]
    left = list(safety.remarks)
    if design.torque is None:
        left.append("torques: no --known identification, no --masses, and no masses in a URDF")
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


@dataclass(frozen=True, eq=False)
class CheckedTrajectory:
    """Result of ``armident trajectory``; ``excess``: limits exceeded; ``std``: of the base parameters (b,), SI."""

    robot: RobotConfig
    path: Path | None
    design: Design
    std: Array
    prior: PreviousEstimate | None
    safety: SafetyModel
    checks: SafetyChecks
    excess: tuple[str, ...]

    def refuse_excess(self) -> None:
        """Raise ConfigError if limits of torque or distance are exceeded, with each excess and the next step."""
        if self.excess:
            next_step = "Next: design another one with --out FILE, or correct limits.torque and collision of the robot"
            raise ConfigError(f"{self.path}: needs {'; '.join(self.excess)}. {next_step}")


def checked_trajectory(
    robot: RobotConfig, design: Design, safety: SafetyModel, prior: PreviousEstimate | None, path: Path | None = None
) -> CheckedTrajectory:
    """Return a trajectory with all checks."""
    std, checks = expected_std(robot, design, prior), check_safety(robot, design, safety)
    return CheckedTrajectory(
        robot, path, design, std, prior, safety, checks, tuple(excesses(robot, design, safety.collision))
    )


def expected_std(robot: RobotConfig, design: Design, prior: PreviousEstimate | None) -> Array:
    """Return predicted standard deviations of the base parameters (b,); of an assumed noise without ``prior``."""
    std = design.std
    if prior is None or std is None:
        std = predict_precision(arm_model(robot), design.trajectory, assumed_noise(robot)).std
        assert std is not None
    return std


def assumed_noise(robot: RobotConfig) -> Array:
    """Return the torque noise (n,) that is assumed where none is known, N m or N."""
    return ASSUMED_NOISE * np.array([joint.limits.torque for joint in robot.joints])


def _listed(names: Iterable[str], most: int = 6) -> str:
    every = list(names)
    more = f" and {len(every) - most} more" if len(every) > most else ""
    return ", ".join(every[:most]) + more
