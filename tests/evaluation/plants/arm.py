"""Random serial arms: geometry, bodies, rotors, friction and encoders."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armident.virtual_robot.drawn_parameters import log_uniform, random_body
from tests.evaluation.plants.bodies import evaluate
from tests.evaluation.plants.halves import Ranges
from tests.evaluation.plants.slots import COULOMB, LAWS, OFFSET, SMOOTHING, VISCOUS

Floats = NDArray[np.float64]
Generator = np.random.Generator

POSTURES = 40
"""Random postures over which inertia and gravity of a joint are averaged."""
REACH = 1.2
"""Range of the joints in those postures, rad."""
PRISMATIC_SCALE = 0.25
"""Metres of a prismatic joint that correspond to a radian."""


@dataclass(frozen=True, eq=False)
class Arm:
    """A serial arm; SI, joint side.

    Parameters
    ----------
    mdh
        alpha, d, theta, r by joint, shape (n, 4).
    prismatic
        1 for a prismatic joint, shape (n,).
    mass, com, inertia
        Masses, kg, (n,); centres of mass in the link frames, m, (n, 3); inertias about them, kg m^2, (n, 3, 3).
    gravity
        Acceleration of gravity in frame 0, m/s^2, shape (3,).
    ratio
        Motor angle, rad, per rad or m of the joint, shape (n,).
    rotor
        Rotor inertias, joint side, shape (n,).
    laws
        Table of `LAWS` of the healthy arm, shape (n, .).
    resolution
        Encoder steps, joint side, rad or m, shape (n,).
    diagonal
        Typical inertia seen by each motor, rotor included, joint side, shape (n,).
    scale
        Typical torque of inertia and gravity by joint, N m or N, shape (n,).
    speed
        Largest speed of the motions by joint, rad/s or m/s, shape (n,).
    """

    mdh: Floats
    prismatic: NDArray[np.int64]
    mass: Floats
    com: Floats
    inertia: Floats
    gravity: Floats
    ratio: Floats
    rotor: Floats
    laws: Floats
    resolution: Floats
    diagonal: Floats
    scale: Floats
    speed: Floats

    @property
    def n(self) -> int:
        """Number of joints."""
        return int(self.mass.size)

    @property
    def bodies(self) -> tuple[Any, ...]:
        """Geometry and bodies in the order of the compiled functions."""
        return self.mdh, self.prismatic, self.mass, self.com, self.inertia


def random_arm(rng: Generator, ranges: Ranges) -> Arm:
    """Draw an arm. ``ranges``: ranges of the half."""
    n = int(rng.integers(ranges.joints[0], ranges.joints[1] + 1))
    prismatic = (rng.random(n) < ranges.prismatic).astype(np.int64)
    mdh = _geometry(rng, ranges, n)
    mass, com, inertia = _bodies(rng, ranges, n)
    gravity = np.array([0.0, 0.0, -9.81])
    links, weight = _averages(rng, prismatic, (mdh, prismatic, mass, com, inertia), gravity)
    rotor = links * log_uniform(rng, ranges.rotor, n)
    diagonal = links + rotor
    metre = np.where(prismatic > 0, PRISMATIC_SCALE, 1.0)
    speed = log_uniform(rng, ranges.speed, n) * metre
    # A speed of v is reached in about a third of a second.
    scale = np.sqrt((3.0 * diagonal * speed) ** 2 + weight**2)
    laws = np.zeros((n, len(LAWS)))
    laws[:, VISCOUS] = log_uniform(rng, ranges.viscous, n) * scale / speed
    laws[:, COULOMB] = log_uniform(rng, ranges.dry, n) * scale
    sharp = rng.random() < ranges.sharp
    laws[:, SMOOTHING] = 0.0 if sharp else log_uniform(rng, ranges.smoothing, n) * speed
    laws[:, OFFSET] = 0.03 * scale * rng.normal(size=n)
    ratio = np.round(log_uniform(rng, ranges.ratio, n))
    screw = 2.0 * np.pi / np.round(log_uniform(rng, ranges.pitch, n), 4)
    resolution = log_uniform(rng, ranges.resolution, n) * np.where(prismatic > 0, 0.1, 1.0)
    return Arm(
        mdh, prismatic, mass, com, inertia, gravity, np.where(prismatic > 0, screw, ratio), rotor, laws, resolution,
        diagonal, scale, speed,
    )  # fmt: skip


def _geometry(rng: Generator, ranges: Ranges, n: int) -> Floats:
    mdh = np.zeros((n, 4))
    for j in range(1, n):
        right = rng.random() < ranges.right_angles
        mdh[j, 0] = rng.choice([0.0, 0.5 * np.pi, -0.5 * np.pi], p=[0.3, 0.35, 0.35])
        if not right:
            mdh[j, 0] += rng.uniform(-0.7, 0.7)
        shrink = 0.8**j
        if rng.random() < 0.55 or mdh[j, 0] == 0.0:
            mdh[j, 1] = rng.uniform(*ranges.length) * shrink
        if rng.random() < 0.55:
            mdh[j, 3] = rng.uniform(*ranges.length) * shrink
        mdh[j, 2] = rng.choice([0.0, 0.5 * np.pi, -0.5 * np.pi, rng.uniform(-1.0, 1.0)], p=[0.6, 0.15, 0.15, 0.1])
    return mdh


def _bodies(rng: Generator, ranges: Ranges, n: int) -> tuple[Floats, Floats, Floats]:
    """Masses, centres of mass, inertias about them: of positive second moments, so that every body exists."""
    mass = log_uniform(rng, ranges.mass) * np.cumprod(np.concatenate([[1.0], rng.uniform(*ranges.decay, n - 1)]))
    com, inertia = np.zeros((n, 3)), np.zeros((n, 3, 3))
    for j in range(n):
        size = rng.uniform(*ranges.length) * 0.85**j
        com[j], second = random_body(rng, size, mass[j])
        inertia[j] = np.trace(second) * np.eye(3) - second
    return mass, com, inertia


def _averages(
    rng: Generator, prismatic: NDArray[np.int64], bodies: tuple[Any, ...], gravity: Floats
) -> tuple[Floats, Floats]:
    """Mean inertia of the links at each joint and rms torque of gravity over random postures."""
    n = prismatic.size
    diagonal, weight = np.zeros(n), np.zeros(n)
    for _ in range(POSTURES):
        q = rng.uniform(-REACH, REACH, n) * np.where(prismatic > 0, PRISMATIC_SCALE, 1.0)
        M, bias = evaluate(q, np.zeros(n), gravity, *bodies)
        diagonal += np.diag(M) / POSTURES
        weight += bias**2 / POSTURES
    return diagonal, np.sqrt(weight)
