"""D-optimality objective of a trajectory for an effect of the catalogue, or for the separation of two."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike

from armident.arrays import Array
from armident.configs import ConfigError, RobotConfig
from armident.identify.diagnosis.candidates import Shapes
from armident.identify.effects.effect import Effect, Place
from armident.identify.effects.parameter_change import ParameterChange
from armident.identify.effects.registry import known
from armident.identify.effects.wiring import SignalMistake
from armident.identify.robot.motion import Motion
from armident.identify.signals.decimate import Decimation

TYPICAL = (0.25, 0.5, 0.75)
"""Assumed values of an unknown nonlinear parameter, as positions in its grid."""

CONTAINED = 1e-8
"""Information relative to that of the columns alone, below which a parameter is not identifiable."""


@dataclass(frozen=True)
class EffectLocation:
    """Effect at a location, with the values of its nonlinear parameters to consider."""

    effect: Effect
    place: Place
    shapes: tuple[Shapes, ...]

    def columns(self, motion: Motion, shapes: Shapes, decimation: Decimation, sigma: Array) -> Array:
        """Return the filtered columns over the noise of each joint, (M n, k), per unit of the linear parameters."""
        columns = decimation(self.effect.torque(motion, self.place, dict(shapes))) / sigma[:, None]
        return columns.reshape(-1, columns.shape[2])


@dataclass(frozen=True)
class EffectObjective:
    """Effects to estimate, each with the effect to separate it from, or ``None``."""

    pairs: tuple[tuple[EffectLocation, EffectLocation | None], ...]

    def cost(self, motion: Motion, x: Array, decimation: Decimation, sigma: Array) -> float:
        """Return the mean log standard deviation of all linear parameters, by the weighted base regressor (M n, b)."""
        values = []
        for location, rival in self.pairs:
            for shapes in location.shapes:
                power, information = _information(location, shapes, rival, motion, x, decimation, sigma)
                eigenvalues = np.maximum(np.linalg.eigvalsh(information), CONTAINED)
                values.append(-0.5 * float(np.mean(np.log(np.maximum(power, CONTAINED)) + np.log(eigenvalues))))
        return float(np.mean(values))

    def std(self, motion: Motion, x: Array, decimation: Decimation, sigma: Array) -> dict[str, float]:
        """Return standard deviations by name, nonlinear parameters at mid-grid; inf: not identifiable; see `cost`."""
        found: dict[str, float] = {}
        for location, rival in self.pairs:
            shapes = location.shapes[len(location.shapes) // 2]
            power, information = _information(location, shapes, rival, motion, x, decimation, sigma)
            eigenvalues, axes = np.linalg.eigh(information)
            with np.errstate(divide="ignore"):
                variance = axes**2 @ (1.0 / np.where(eigenvalues > CONTAINED, eigenvalues, 0.0)) / power
            for linear, value in zip(location.effect.linear, variance, strict=True):
                found[f"{linear.name}{_number(location)}"] = float(np.sqrt(value))
        return found


def effect_objective(
    robot: RobotConfig, wanted: str, joint: str | None, against: str | None, motion: Motion
) -> EffectObjective:
    """Return the objective for an effect at one joint or at all joints."""
    effect, rival = _designable(wanted, "--for"), None if against is None else _designable(against, "--against")
    if rival is not None and rival.name == effect.name:
        raise ConfigError(f"--against {against}: expected another effect than --for")
    joints = [j.name for j in robot.joints]
    if joint is not None and joint not in joints:
        raise ConfigError(f"--joint {joint}: {robot.name} has {', '.join(joints)}")
    at = None if joint is None else joints.index(joint)
    if motion.theta is None and any(e is not None and e.depends_on_torque for e in (effect, rival)):
        name = effect.name if effect.depends_on_torque else against
        raise ConfigError(f"{name} depends on the torques of the arm: add --known identification.json")
    here = _locations(effect, robot, at, motion)
    if not here:
        raise ConfigError(f"--for {wanted}: {robot.name} has no location for it")
    if rival is None:
        return EffectObjective(tuple((location, None) for location in here))
    there = _locations(rival, robot, at, motion)
    met = [(one, two) for one, two in product(here, there) if _meet(one, two)]
    if not met:
        raise ConfigError(f"--against {against}: never at the same joint as {wanted}")
    # Both must be estimated precisely to separate them.
    return EffectObjective(tuple(pair for one, two in met for pair in ((one, two), (two, one))))


def weighted_rows(x: Array, sigma: ArrayLike) -> Array:
    """Return a regressor (M, n, b) over the noise of each joint (n,) as rows (M n, b)."""
    rows: Array = (x / np.asarray(sigma, dtype=np.float64)[:, None]).reshape(-1, x.shape[2])
    return rows


def _designable(name: str, option: str) -> Effect:
    effect = known(name)
    if isinstance(effect, SignalMistake):
        raise ConfigError(f"{option} {name}: visible in any motion, needs no special trajectory")
    return effect


def _locations(effect: Effect, robot: RobotConfig, joint: int | None, motion: Motion) -> list[EffectLocation]:
    found = []
    for place in effect.places(robot.n):
        elsewhere = joint is not None and effect.scope != "arm" and joint not in (place.joint, place.other)
        if elsewhere or effect.invisible(motion, place) is not None:
            continue
        found.append(EffectLocation(effect, place, _typical(effect.grid(motion, place))))
    return found


def _typical(every: Sequence[Shapes]) -> tuple[Shapes, ...]:
    """Return the grid's nonlinear parameters at the positions `TYPICAL` of each one's values."""
    values = [[(name, value) for value in dict.fromkeys(dict(one)[name] for one in every)] for name, _ in every[0]]
    chosen = (tuple(own[round(share * (len(own) - 1))] for own in values) for share in TYPICAL)
    return tuple(dict.fromkeys(chosen))


def _meet(one: EffectLocation, two: EffectLocation) -> bool:
    if "arm" in (one.effect.scope, two.effect.scope):
        return True
    return bool({one.place.joint, one.place.other} & {two.place.joint, two.place.other} - {None})


def _number(location: EffectLocation) -> str:
    if location.effect.scope == "arm":
        return ""
    return (
        f"{location.place.joint + 1}"
        if location.place.other is None
        else f"{location.place.joint + 1}{location.place.other + 1}"
    )


def _information(
    location: EffectLocation,
    shapes: Shapes,
    rival: EffectLocation | None,
    motion: Motion,
    x: Array,
    decimation: Decimation,
    sigma: Array,
) -> tuple[Array, Array]:
    """Return the information on the linear parameters in the effect's columns alone (k,), and a relative one (k, k).

    The second is that beside model and rival effect, over the first. An effect that only changes parameters is tested
    against a baseline, so the model does not absorb it.
    """
    own = location.columns(motion, shapes, decimation, sigma)
    power = np.einsum("rk,rk->k", own, own)
    own = own / np.sqrt(np.where(power > 0.0, power, 1.0))
    beside = [] if isinstance(location.effect, ParameterChange) else [x]
    if rival is not None:
        beside += [rival.columns(motion, s, decimation, sigma) for s in rival.shapes]
    information = own.T @ own
    if beside:
        others = np.concatenate(beside, axis=1)
        norm = np.linalg.norm(others, axis=0)
        others = others / np.where(norm > 0.0, norm, 1.0)
        values, axes = np.linalg.eigh(others.T @ others)
        kept = values > 1e-10 * values[-1]
        shared = (axes[:, kept] / np.sqrt(values[kept])).T @ (others.T @ own)
        information = information - shared.T @ shared
    return power, information
