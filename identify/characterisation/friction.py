"""Friction over speed: torques at constant speeds, less those of position and acceleration.

Torques forth and back at one speed differ by twice the friction, whatever depends on the position alone
(Armstrong-Helouvry 1991, Control of Machines with Friction; Bona, Indri 2005, CDC, Friction compensation in robotics).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from armident.arrays import Array
from armident.configs import RobotConfig
from armident.identify.characterisation.estimates import RATE_HZ, SEEN, Fitted, averaged, fitted, solved
from armident.identify.characterisation.motion import SLOWEST, Alone, Plateau
from armident.identify.effects.effect import Place
from armident.identify.effects.friction import AsymmetricViscousFriction, StribeckBell
from armident.identify.effects.terms import arm_model
from armident.identify.robot.motion import Motion

SPEEDS = 2
"""Least number of different speeds in each direction: four torques for four parameters."""
CURVED = 6
"""Least number of speeds for Stribeck friction: as many as the curve then has parameters."""
LAST = 0.35
"""Largest Stribeck velocity over the top speed, as that of a diagnosis."""
TRIALS = 20
"""Stribeck velocities of the first search, evenly spaced in their logarithm."""
STEP = 0.01
"""Relative change of the Stribeck velocity for the derivative of the curve."""
DRAWN = 200
"""Points of the drawn curve."""


@dataclass(frozen=True, eq=False)
class Levels:
    """Torques at constant speeds: one level (P,) for each plateau, gravity, and further columns.

    ``columns``, ``torques``, ``positions``: block means of each plateau, (M, k), (M,) and (M,).
    """

    plateaus: Sequence[Plateau]
    columns: list[Array]
    torques: list[Array]
    positions: list[Array]
    fit: Fitted

    def beside(self, further: Sequence[Array]) -> "Levels":
        """Return the levels beside further columns (M, c) of each plateau."""
        columns = [np.hstack(pair) for pair in zip(self.columns, further, strict=True)]
        return Levels(self.plateaus, columns, self.torques, self.positions, fitted(columns, self.torques))


def measured_levels(plateaus: Sequence[Plateau]) -> Levels:
    """Return the torques at constant speeds."""
    motions = [*dict.fromkeys(p.motion for p in plateaus)]
    top = max(float(np.abs(m.speed).max()) for m in motions)
    inertia, friction = _moving(motions, top)
    columns, torques, positions = [], [], []
    for k, p in enumerate(plateaus):
        rigid, shape, tau, q = _means(p.motion, p.rows, top)
        own = np.zeros((rigid.shape[0], len(plateaus)))
        own[:, k] = 1.0
        columns.append(np.hstack([own, rigid[:, 2:]]))
        torques.append(tau - inertia * rigid[:, 0] - (shape - shape.mean(axis=0)) @ friction)
        positions.append(q)
    if columns[0].shape[1] > len(plateaus):
        # Levels are those at the middle of all positions.
        mean = np.concatenate(columns)[:, len(plateaus) :].mean(axis=0)
        for c in columns:
            c[:, len(plateaus) :] -= mean
    return Levels(plateaus, columns, torques, positions, fitted(columns, torques))


def _means(motion: Alone, rows: NDArray[np.intp], top: float) -> tuple[Array, Array, Array, Array]:
    """Return block means of rigid columns, functions of the speed, torque and position."""
    block = motion.block(RATE_HZ)
    shape = np.column_stack([motion.qd, motion.friction(top) * np.sign(motion.qd)[:, None]])
    rigid, shape, tau, q = (averaged(each[rows], block) for each in (motion.rigid(), shape, motion.tau, motion.q))
    return rigid, shape, tau, q


def _moving(motions: Sequence[Alone], top: float) -> tuple[float, Array]:
    """Return the inertia of the joint, kg m^2 or kg, and its friction at `KNOTS`, by the rows in which it moves."""
    parts = [_means(m, np.flatnonzero(m.alone & (np.abs(m.speed) > SLOWEST * top)), top) for m in motions]
    columns = np.concatenate([np.hstack([rigid, shape]) for rigid, shape, _, _ in parts])
    rigid = parts[0][0].shape[1]
    theta = solved(columns, np.concatenate([tau for _, _, tau, _ in parts]))
    return float(theta[0]), theta[rigid:]


@dataclass(frozen=True, eq=False)
class Curve:
    """Coulomb, viscous and Stribeck friction through the levels: parameters (k,) by ``names``, with their covariance.

    ``offset`` (P,): weights of the levels in the offset. ``misfit``: root of chi square over its degrees of freedom, at
    least one; the covariance contains it. ``at``: torques (M,) of the curve without the offset at speeds (M,).
    """

    names: tuple[str, ...]
    theta: Array
    covariance: Array
    offset: Array
    misfit: float
    at: Callable[[Array], Array]


def friction_curve(found: Levels, robot: RobotConfig, joint: int) -> Curve | None:
    """Return the curve, with Stribeck friction where it is seen; ``None`` for too few speeds, or one direction only."""
    speeds = np.array([p.speed for p in found.plateaus])
    different = min(np.unique(np.round(np.log(np.abs(speeds[speeds * side > 0.0])), 1)).size for side in (1.0, -1.0))
    if different < SPEEDS or speeds.size <= 2 * SPEEDS:
        return None
    levels = found.fit.theta[: speeds.size]
    root = np.linalg.inv(np.linalg.cholesky(found.fit.covariance[: speeds.size, : speeds.size]))
    model, place, bell = arm_model(robot), Place(joint), StribeckBell()

    def columns(v: Array, sharp: bool, velocity: float | None) -> Array:
        qd = np.zeros((v.size, model.n))
        qd[:, joint] = v
        motion = Motion(model, np.zeros_like(qd), qd, np.zeros_like(qd), 1.0, sharp=sharp)
        one_sided = AsymmetricViscousFriction().columns(motion, place, {})[:, 0]
        parts = [motion.sign[:, joint], v, one_sided, np.ones(v.size)]
        if velocity is not None:
            parts.append(bell.columns(motion, place, {"velocity": velocity, "displacement": 0.0})[:, 0])
        return np.stack(parts, axis=1)

    def tried(sharp: bool, velocity: float | None) -> tuple[float, Array]:
        a, y = root @ columns(speeds, sharp, velocity), root @ levels
        theta = solved(a, y)
        return float(np.sum((y - a @ theta) ** 2)), theta

    slowest, top = np.abs(speeds).min(), np.abs(speeds).max()
    trials = np.geomspace(slowest, LAST * top, TRIALS)
    bare, sharp = min((tried(sharp, None)[0], sharp) for sharp in (True, False))
    error, curved, k = min((tried(one, v)[0], one, k) for one in (True, False) for k, v in enumerate(trials))
    velocity: float | None = None
    if (
        different >= CURVED
        and bare - error > SEEN * max(error / max(speeds.size - 6, 1), 1.0)
        and tried(curved, trials[k])[1][-1] > 0.0
    ):
        around = np.log(trials[[max(k - 1, 0), min(k + 1, TRIALS - 1)]])
        best = minimize_scalar(lambda x: tried(curved, float(np.exp(x)))[0], bounds=tuple(around), method="bounded")
        velocity, sharp = float(np.exp(best.x)), curved
    error, theta = tried(sharp, velocity)
    names = ["fc", "fv", "fva", "offset"]
    a = columns(speeds, sharp, velocity)
    if velocity is not None:
        low, high = (columns(speeds, sharp, velocity * f) @ theta for f in (1.0 - STEP, 1.0 + STEP))
        a = np.column_stack([a, (high - low) / (2.0 * STEP * velocity)])
        names, theta = [*names, "fst", "velocity"], np.append(theta, velocity)
    misfit = float(np.sqrt(max(error / (speeds.size - len(names)), 1.0)))
    covariance: Array = np.asarray(np.linalg.inv((root @ a).T @ (root @ a)), dtype=np.float64)
    weights = (covariance @ (root @ a).T @ root)[3]

    def at(v: Array) -> Array:
        shown = columns(v, sharp, velocity)
        shown[:, 3] = 0.0
        return np.asarray(shown @ theta[: shown.shape[1]])

    return Curve(tuple(names), theta, misfit**2 * covariance, weights, misfit, at)
