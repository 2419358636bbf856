"""What a trajectory is to show: an effect of the catalogue, or the difference between two."""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from armident.configs import ConfigError, RobotConfig
from armident.identify.diagnosis.candidates import Shapes, grid, places
from armident.identify.effects.effect import Effect, Place
from armident.identify.effects.registry import known
from armident.identify.robot.motion import Motion
from armident.identify.signals.decimate import Decimation

Array = NDArray[np.float64]

TYPICAL = (0.25, 0.5, 0.75)
"""Where between the ends of its grid a nonlinear parameter is taken to be, when nobody knows."""

CONTAINED = 1e-8
"""Information, over that of the columns alone, under which a parameter is not seen at all."""


@dataclass(frozen=True)
class EffectLocation:
    """An effect at a place, at the values of its nonlinear parameters that are to be thought of."""

    effect: Effect
    place: Place
    shapes: tuple[Shapes, ...]

    def columns(self, motion: Motion, shapes: Shapes, decimation: Decimation, sigma: Array) -> Array:
        """Filtered columns over the noise of each joint, (M n, k)."""
        columns = decimation(self.effect.torque(motion, self.place, dict(shapes))) / sigma[:, None]
        return columns.reshape(-1, columns.shape[2])


@dataclass(frozen=True)
class EffectObjective:
    """Effects to be estimated, each with the rival that it is to be told from, or without one."""

    pairs: tuple[tuple[EffectLocation, EffectLocation | None], ...]

    @property
    def predicts(self) -> bool:
        """Whether the effects depend on the arm's own torques."""
        return any(seat is not None and seat.effect.predicts for pair in self.pairs for seat in pair)

    def cost(self, motion: Motion, x: Array, decimation: Decimation, sigma: Array) -> float:
        """Mean logarithm of the standard deviations of all linear parameters (D-optimality), lower being better.

        Parameters
        ----------
        motion
            At the rate that the decimation filters.
        x
            Weighted base regressor at the instants that the decimation keeps, (M n, b).
        sigma
            Standard deviation of the torque noise of each joint, (n,).
        """
        values = []
        for seat, rival in self.pairs:
            for shapes in seat.shapes:
                power, information = _information(seat, shapes, rival, motion, x, decimation, sigma)
                eigenvalues = np.maximum(np.linalg.eigvalsh(information), CONTAINED)
                values.append(-0.5 * float(np.mean(np.log(np.maximum(power, CONTAINED)) + np.log(eigenvalues))))
        return float(np.mean(values))

    def std(self, motion: Motion, x: Array, decimation: Decimation, sigma: Array) -> dict[str, float]:
        """Predicted standard deviations of the linear parameters by name and place, at the middle shapes; see `cost`.

        Parameters that the motion does not show, or not apart from each other, are infinite.
        """
        found: dict[str, float] = {}
        for seat, rival in self.pairs:
            shapes = seat.shapes[len(seat.shapes) // 2]
            power, information = _information(seat, shapes, rival, motion, x, decimation, sigma)
            eigenvalues, axes = np.linalg.eigh(information)
            with np.errstate(divide="ignore"):
                variance = axes**2 @ (1.0 / np.where(eigenvalues > CONTAINED, eigenvalues, 0.0)) / power
            for linear, value in zip(seat.effect.linear, variance, strict=True):
                found[f"{linear.name}{_number(seat)}"] = float(np.sqrt(value))
        return found


def effect_objective(
    robot: RobotConfig, wanted: str, joint: str | None, against: str | None, motion: Motion
) -> EffectObjective:
    """Aim at an effect, at one joint or wherever it can sit.

    Parameters
    ----------
    wanted, against
        Names of effects; ``against`` is the one that the wanted one is to be told from.
    joint
        Name of the joint; ``None``: all.
    motion
        A usual one of the robot, by whose speeds and loads nonlinear parameters are chosen.

    Raises
    ------
    ConfigError
        If there is no such effect or joint, or no motion in particular shows the effect.
    """
    effect, rival = _designable(wanted, "--for"), None if against is None else _designable(against, "--against")
    if rival is not None and rival.name == effect.name:
        raise ConfigError(f"--against {against}: expected another effect than --for")
    joints = [j.name for j in robot.joints]
    if joint is not None and joint not in joints:
        raise ConfigError(f"--joint {joint}: {robot.name} has {', '.join(joints)}")
    at = None if joint is None else joints.index(joint)
    if motion.theta is None and any(e is not None and e.predicts for e in (effect, rival)):
        name = effect.name if effect.predicts else against
        raise ConfigError(f"{name} depends on the torques of the arm: give an identification of it with --known")
    here = _seats(effect, robot, at, motion)
    if not here:
        raise ConfigError(f"--for {wanted}: {robot.name} has no place for it")
    if rival is None:
        return EffectObjective(tuple((seat, None) for seat in here))
    there = _seats(rival, robot, at, motion)
    met = [(one, two) for one, two in product(here, there) if _meet(one, two)]
    if not met:
        raise ConfigError(f"--against {against}: never at the same joint as {wanted}")
    # Both must be estimated well for either to be told from the other.
    return EffectObjective(tuple(pair for one, two in met for pair in ((one, two), (two, one))))


def weighted(x: Array, sigma: ArrayLike) -> Array:
    """Regressor (M, n, b) over the noise of each joint, as rows (M n, b)."""
    rows: Array = (x / np.asarray(sigma, dtype=np.float64)[:, None]).reshape(-1, x.shape[2])
    return rows


def _designable(name: str, option: str) -> Effect:
    effect = known(name)
    if effect.rewires:
        raise ConfigError(f"{option} {name}: shows in any motion, no trajectory shows it better")
    return effect


def _seats(effect: Effect, robot: RobotConfig, joint: int | None, motion: Motion) -> list[EffectLocation]:
    found = []
    for place in places(effect, robot.n):
        elsewhere = joint is not None and effect.scope != "arm" and joint not in (place.joint, place.other)
        if elsewhere or (effect.visible is not None and effect.visible(motion, place) is not None):
            continue
        every = grid(effect, motion, place)
        chosen = sorted({round(share * (len(every) - 1)) for share in TYPICAL})
        found.append(EffectLocation(effect, place, tuple(every[k] for k in chosen)))
    return found


def _meet(one: EffectLocation, two: EffectLocation) -> bool:
    if "arm" in (one.effect.scope, two.effect.scope):
        return True
    return bool({one.place.joint, one.place.other} & {two.place.joint, two.place.other} - {None})


def _number(seat: EffectLocation) -> str:
    if seat.effect.scope == "arm":
        return ""
    return f"{seat.place.joint + 1}" if seat.place.other is None else f"{seat.place.joint + 1}{seat.place.other + 1}"


def _information(
    seat: EffectLocation,
    shapes: Shapes,
    rival: EffectLocation | None,
    motion: Motion,
    x: Array,
    decimation: Decimation,
    sigma: Array,
) -> tuple[Array, Array]:
    """Information in the columns of an effect alone (k,), and over it what is left beside model and rival (k, k).

    An effect that is nothing but other numbers is judged against a baseline, so the model does not hide it.
    """
    own = seat.columns(motion, shapes, decimation, sigma)
    power = np.einsum("rk,rk->k", own, own)
    own = own / np.sqrt(np.where(power > 0.0, power, 1.0))
    beside = [] if seat.effect.numbers is not None else [x]
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
