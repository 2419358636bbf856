"""Plausible parameters of a robot whose masses or friction are not known, drawn from a seed.

A body lies between its joint and the next one, lighter towards the tip; torques take a share of the limits.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio

from armident.arrays import Array
from armident.configs import ConfigError, RobotConfig
from armident.configs.urdf_inertials import INERTIAL
from armident.virtual_robot.model import build_model

pin: Any = pinocchio

TORQUE_SHARE = 0.3
"""Share of the torque limit that gravity and acceleration take at the joint that has the least reserve."""
RISE_PER_S = 8.0
"""Largest acceleration over the velocity limit for this share, 1/s; a limit of acceleration may be far above use."""
SHORTEST = 0.06
"""Shortest body, m: a servo of 45 mm with its bracket (SO-101). Of the eleven shipped arms only that one and the single
axis depend on it."""
POSTURES = 40
"""Random postures over which inertia and gravity of a joint are averaged."""
OFFSET_SHARE = 0.03
"""Standard deviation of the torque offsets over the torque scale."""
MASS, DECAY = (2.0, 20.0), (0.5, 0.8)
"""Range of the mass of the first link before scaling, kg, and of that of a link over that of the link before."""
ROTOR = (0.15, 1.5)
"""Range of the rotor inertia, joint side, over the inertia of the links at the joint."""
DRY, VISCOUS = (0.05, 0.6), (0.05, 0.8)
"""Ranges of dry friction, and of viscous friction at full speed, over the torque scale of the joint."""


@dataclass(frozen=True, eq=False)
class TorqueScale:
    """Typical loads (n,) over postures, joint side, SI: mean ``inertia`` with rotors, ``gravity`` (rms), ``torque``."""

    inertia: Array
    gravity: Array
    torque: Array


def log_uniform(rng: np.random.Generator, limits: tuple[float, float], size: int | None = None) -> Any:
    """Draw numbers, or one, between two limits; their logarithm is uniform."""
    return np.exp(rng.uniform(np.log(limits[0]), np.log(limits[1]), size))


def random_body(rng: np.random.Generator, size: float, mass: float) -> tuple[Array, Array]:
    """Draw a body, m, kg, that exists: centre of mass, m, (3,), and second moments about it, kg m^2, (3, 3)."""
    com = rng.normal(size=3) * size * np.array([0.4, 0.15, 0.3])
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return com, mass * axes @ np.diag((size * rng.uniform(0.08, 0.4, 3)) ** 2) @ axes.T


def draw_bodies(robot: RobotConfig, seed: int) -> dict[str, float]:
    """Draw the inertial parameters of all links, by name (``xx1`` ... ``m6``), SI, for the limits of a robot."""
    rng, n = np.random.default_rng([seed, 1]), robot.n
    mass = log_uniform(rng, MASS) * np.cumprod(np.concatenate([[1.0], rng.uniform(*DECAY, n - 1)]))
    ends = [_next_origin(robot, j) for j in range(n)]
    lengths = [float(np.linalg.norm(end)) for end in ends]
    typical = float(np.mean([length for length in lengths if length > 0.0] or [2.0 * SHORTEST]))
    standard: dict[str, float] = {}
    for j, end in enumerate(ends):
        size = max(lengths[j], 0.5 * typical, SHORTEST)
        com, second = random_body(rng, size, float(mass[j]))
        standard |= _standard(j + 1, float(mass[j]), 0.5 * end + 0.5 * com, second)
    limits = np.array([joint.limits.torque for joint in robot.joints])
    share = float((needed_torque(robot, standard) / limits).max())
    factor = TORQUE_SHARE / share if share > 0.0 else 1.0
    return {name: value * factor for name, value in standard.items()}


def needed_torque(robot: RobotConfig, standard: Mapping[str, float]) -> Array:
    """Torque (n,) for gravity and a large acceleration, N m or N; of ``standard`` only the links count."""
    load = torque_scale(robot, {name: value for name, value in standard.items() if not name.startswith("ia")})
    rise = np.array([min(j.limits.acceleration, RISE_PER_S * j.limits.velocity) for j in robot.joints])
    # Rotors add to the inertia about as much as the links do.
    return np.asarray(2.0 * load.inertia * rise + load.gravity)


def _next_origin(robot: RobotConfig, j: int) -> Array:
    """Origin of frame j + 1 in frame j at zero, m; zero for the last link."""
    if j + 1 == robot.n:
        return np.zeros(3)
    mdh = robot.joints[j + 1].mdh
    return np.array([mdh.d, -np.sin(mdh.alpha) * mdh.r, np.cos(mdh.alpha) * mdh.r])


def _standard(link: int, mass: float, com: Array, second: Array) -> dict[str, float]:
    """Inertial parameters of a body about the origin of its frame, of its second moments (3, 3) about ``com``."""
    moments = second + mass * np.outer(com, com)
    inertia = np.trace(moments) * np.eye(3) - moments
    values = (*inertia[np.triu_indices(3)], *(mass * com), mass)
    return {f"{name}{link}": float(value) for name, value in zip(INERTIAL, values, strict=True)}


def torque_scale(robot: RobotConfig, standard: Mapping[str, float]) -> TorqueScale:
    """Typical loads of the joints over postures within their limits; raises ConfigError if a joint moves no inertia."""
    n = robot.n
    model = build_model(robot, standard)
    data = model.createData()
    low, high = np.array([joint.limits.position for joint in robot.joints]).T
    rotor = np.array([standard.get(f"ia{j + 1}", 0.0) for j in range(n)])
    inertia, gravity = np.zeros(n), np.zeros(n)
    for q in np.random.default_rng(0).uniform(low, high, (POSTURES, n)):
        mass = np.array(pin.crba(model, data, q)) + np.diag(rotor)
        smallest = np.linalg.eigvalsh(mass, UPLO="U")[0]
        if not smallest > 0.0:
            raise ConfigError(
                f"robot {robot.name!r}: the masses leave a joint without inertia; correct them, or draw others "
                "(armident robot --draw-masses)"
            )
        inertia += np.diag(mass) / POSTURES
        gravity += np.array(pin.computeGeneralizedGravity(model, data, q)) ** 2 / POSTURES
    speed = np.array([joint.limits.velocity for joint in robot.joints])
    weight = np.sqrt(gravity)
    # A speed is reached in about a third of a second.
    return TorqueScale(inertia, weight, np.sqrt((3.0 * inertia * speed) ** 2 + weight**2))


def draw_rotors(robot: RobotConfig, standard: Mapping[str, float], seed: int) -> dict[str, float]:
    """Draw the rotor inertias, joint side; zero at joints without ``rotor_inertia``."""
    factors = log_uniform(np.random.default_rng([seed, 2]), ROTOR, robot.n)
    links = torque_scale(robot, standard).inertia
    return {
        f"ia{j + 1}": float(factors[j] * links[j]) if joint.rotor_inertia else 0.0
        for j, joint in enumerate(robot.joints)
    }


def draw_friction(robot: RobotConfig, scale: TorqueScale, seed: int) -> dict[str, float]:
    """Draw viscous and Coulomb friction and offset of each joint, and the parameters of couplings."""
    rng, n = np.random.default_rng([seed, 3]), robot.n
    speed = np.array([joint.limits.velocity for joint in robot.joints])
    viscous = log_uniform(rng, VISCOUS, n) * scale.torque / speed
    coulomb = log_uniform(rng, DRY, n) * scale.torque
    offset = OFFSET_SHARE * scale.torque * rng.normal(size=n)
    out: dict[str, float] = {}
    for j in range(n):
        out |= {f"fv{j + 1}": float(viscous[j]), f"fc{j + 1}": float(coulomb[j]), f"off{j + 1}": float(offset[j])}
    names = [joint.name for joint in robot.joints]
    for coupling in robot.couplings:
        one, two = (names.index(joint) for joint in coupling.joints)
        lighter = one if scale.inertia[one] < scale.inertia[two] else two
        # As on the TX40: a tenth of the lighter joint's inertia, and half of its friction.
        out |= {
            f"ia{coupling.name}": 0.1 * float(scale.inertia[lighter]),
            f"fv{coupling.name}": 0.5 * float(viscous[lighter]),
            f"fc{coupling.name}": 0.5 * float(coulomb[lighter]),
        }
    return out
