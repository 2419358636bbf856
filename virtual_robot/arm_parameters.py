"""Parameters of a virtual arm that a robot configuration does not hold: masses, friction, noise and bandwidth."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from armident.configs import ConfigError, RobotConfig, Scenario
from armident.configs.urdf_inertials import UrdfInertials
from armident.virtual_robot import servo
from armident.virtual_robot.drawn_parameters import draw_bodies, draw_friction, draw_rotors, torque_scale
from armident.virtual_robot.identified import read_identified
from armident.virtual_robot.inertias import has_stored_parameters, plant_parameters, rest_posture
from armident.virtual_robot.noise import SIZES, NoiseSize

NOISE_SHARE = 0.02
"""Standard deviation of the torque noise over the torque scale of a joint: within the range of the random arms."""
SLOW_SHARE = 0.005
"""The same of its part below 20 Hz, a quarter of it as on the TX40 (thesis table 6.3)."""
EDGE = 0.1
"""Share of a joint's range at either end of which the arm is not at power-on."""


@dataclass(frozen=True)
class ArmParameters:
    """Parameters of a virtual arm by standard name in the frames of the configuration; SI, joint side.

    ``rest``: posture at power-on, n. ``bandwidth_hz``: of the position loops, n. ``sources``: sentences.
    ``sign_smoothing``: ``g``, s/rad or s/m, of an identification.
    """

    standard: Mapping[str, float]
    rest: tuple[float, ...]
    noise: NoiseSize
    bandwidth_hz: tuple[float, ...]
    sources: tuple[str, ...] = ()
    sign_smoothing: tuple[float, ...] | None = None


def arm_parameters(
    robot: RobotConfig,
    *,
    model: Path | None = None,
    inertials: UrdfInertials | None = None,
    seed: int = 0,
) -> ArmParameters:
    """Parameters of the virtual arm of a robot with limits of position, velocity and acceleration."""
    if model is not None:
        identified = read_identified(model, robot)
        found = _completed(robot, identified.standard, identified.sources, seed)
        return replace(found, sign_smoothing=identified.sign_smoothing)
    if inertials is not None and len(inertials.massless) < robot.n:
        standard, sources = _of_urdf(robot, inertials, seed)
        return _completed(robot, standard, sources, seed)
    if inertials is None and has_stored_parameters(robot):
        bandwidth = tuple(servo.BANDWIDTH_HZ[j] for j in range(robot.n))
        source = f"parameters: those of the virtual {robot.name}"
        return ArmParameters(plant_parameters(robot), rest_posture(robot), SIZES[robot.name], bandwidth, (source,))
    reason = "" if inertials is None else ", the URDF has none"
    source = f"masses and inertias: drawn from seed {seed}{reason}"
    return _completed(robot, draw_bodies(robot, seed), (source,), seed)


def _of_urdf(robot: RobotConfig, read: UrdfInertials, seed: int) -> tuple[dict[str, float], tuple[str, ...]]:
    sources = ["masses and inertias: of the URDF"]
    standard = read.standard | read.friction
    if read.friction:
        sources.append(f"friction {', '.join(read.friction)}: of the URDF")
    if read.held:
        sources.append(f"{', '.join(read.held)} behind the tip: held at zero, their links are a load")
    if read.impossible:
        sources.append(f"no body has the moments of inertia of link {', '.join(read.impossible)}: used as they are")
    if read.massless:
        drawn = draw_bodies(robot, seed)
        standard |= {name: drawn[name] for name in drawn if int(name.lstrip("mxyz")) in read.massless}
        joints = ", ".join(robot.joints[k - 1].name for k in read.massless)
        sources.append(f"masses behind {joints}: drawn from seed {seed}, the URDF has none there")
    return standard, tuple(sources)


def _completed(robot: RobotConfig, standard: Mapping[str, float], sources: tuple[str, ...], seed: int) -> ArmParameters:
    """Draw what ``standard`` lacks of rotors, friction and couplings, and choose noise, bandwidth and posture."""
    rotors = {f"ia{j + 1}" for j in range(robot.n)} - standard.keys()
    if rotors:
        standard = {**standard, **{name: v for name, v in draw_rotors(robot, standard, seed).items() if name in rotors}}
    scale = torque_scale(robot, standard)
    lacking = {name: v for name, v in draw_friction(robot, scale, seed).items() if name not in standard}
    if lacking:
        sources = (*sources, f"{', '.join(_kinds(lacking))}: drawn from seed {seed}")
    noise = NoiseSize(tuple((NOISE_SHARE * scale.torque) ** 2), tuple((SLOW_SHARE * scale.torque) ** 2))
    lowest = [servo.BANDWIDTH_HZ[min(j, len(servo.BANDWIDTH_HZ) - 1)] for j in range(robot.n)]
    bandwidth = tuple(max(robot.bandwidth_hz or 0.0, each) for each in lowest)
    return ArmParameters({**standard, **lacking}, _rest(robot), noise, bandwidth, sources)


def _kinds(lacking: Mapping[str, float]) -> list[str]:
    words = {"fv": "viscous friction", "fc": "Coulomb friction", "off": "torque offsets", "ia": "coupling inertia"}
    return [word for start, word in words.items() if any(name.startswith(start) for name in lacking)]


def _rest(robot: RobotConfig) -> tuple[float, ...]:
    """Posture with every joint at zero, or in the middle of its range where zero is near an end or outside."""
    rest = []
    for joint in robot.joints:
        low, high = joint.limits.position
        near = EDGE * (high - low)
        rest.append(0.0 if low + near <= 0.0 <= high - near else 0.5 * (low + high))
    return tuple(rest)


def with_scenario(parameters: ArmParameters, robot: RobotConfig, scenario: Scenario | None) -> ArmParameters:
    """Parameters with the friction, noise and bandwidth of a scenario; raises ConfigError if it does not fit."""
    if scenario is None:
        return parameters
    names = [joint.name for joint in robot.joints]
    for key, given in (("friction", scenario.friction), ("noise", scenario.noise)):
        if unknown := [name for name in given if name not in names]:
            raise ConfigError(f"scenario: {key}: {unknown[0]!r} is not a joint of {robot.name} ({', '.join(names)})")
    standard = dict(parameters.standard)
    for name, friction in scenario.friction.items():
        number = names.index(name) + 1
        values = {"fv": friction.viscous, "fc": friction.coulomb, "off": friction.offset}
        standard |= {f"{key}{number}": value for key, value in values.items() if value is not None}
    sampled, decimated = np.array(parameters.noise.sampled), np.array(parameters.noise.decimated)
    for name, noise in scenario.noise.items():
        sampled[names.index(name)], decimated[names.index(name)] = noise.std**2, noise.std_below_20_hz**2
    bandwidth = parameters.bandwidth_hz
    if scenario.controller is not None and scenario.controller.bandwidth_hz is not None:
        wanted = scenario.controller.bandwidth_hz
        bandwidth = wanted if isinstance(wanted, tuple) else (wanted,) * robot.n
        if len(bandwidth) != robot.n:
            raise ConfigError(f"scenario: controller.bandwidth_hz: expected one number or {robot.n}")
    return replace(
        parameters, standard=standard, noise=NoiseSize(tuple(sampled), tuple(decimated)), bandwidth_hz=bandwidth
    )
