"""The effects a rigid model with symmetric friction can lack: one entry each, with regressor and explanation."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from configs import ConfigError, RobotConfig

Array = NDArray[np.float64]


@dataclass(frozen=True)
class JointSignals:
    """What the effects of one joint can depend on; every array has shape (N,).

    ``q``, ``qd`` rad or m (and per s) of the joint, ``motor`` rad at the motor shaft, ``sign`` the smoothed
    sign of ``qd`` (thesis section B.2), ``top_speed`` the fastest the joint may move.
    """

    q: Array
    qd: Array
    motor: Array
    sign: Array
    top_speed: float


@dataclass(frozen=True)
class CatalogueEffect:
    """One effect: torque of its joint = ``columns(signals, **shape) @ linear parameters``.

    Parameters
    ----------
    name
        As in ``diagnosis.json`` and in the ``effects`` of a robot configuration.
    says
        What a plant engineer is told, in plain language.
    linear
        Names of the linear parameters, one per column; the number of the joint is appended.
    units
        Unit of each linear parameter of a revolute joint.
    shapes
        Values to try for each shape parameter; ``relative_speed`` shapes are shares of the top speed.
    needs
        What a recording must contain for the effect to be visible.
    """

    name: str
    says: str
    linear: tuple[str, ...]
    units: tuple[str, ...]
    columns: Callable[..., Array]
    needs: str
    shapes: dict[str, tuple[float, ...]] = field(default_factory=dict)

    def grid(self) -> list[dict[str, float]]:
        """All combinations of shape parameters to try."""
        combinations: list[dict[str, float]] = [{}]
        for name, values in self.shapes.items():
            combinations = [{**c, name: value} for c in combinations for value in values]
        return combinations


def _asymmetric_viscous(s: JointSignals) -> Array:
    return (s.qd * s.sign)[:, None]


def _asymmetric_coulomb(s: JointSignals) -> Array:
    return (s.sign**2)[:, None]


def _nonlinear_viscous(s: JointSignals, *, exponent: float) -> Array:
    return (np.abs(s.qd) ** exponent * s.sign)[:, None]


def _stribeck(s: JointSignals, *, relative_speed: float) -> Array:
    return (np.exp(-((s.qd / (relative_speed * s.top_speed)) ** 2)) * s.sign)[:, None]


def _spring(s: JointSignals) -> Array:
    return s.q[:, None]


def _cogging(s: JointSignals, *, harmonic: float) -> Array:
    return np.stack([np.cos(harmonic * s.motor), np.sin(harmonic * s.motor)], axis=1)


CATALOGUE: dict[str, CatalogueEffect] = {
    effect.name: effect
    for effect in (
        CatalogueEffect(
            name="asymmetric_viscous_friction",
            says="friction grows with speed more in one direction than in the other: a worn or one-sidedly loaded gear",
            linear=("fva",),
            units=("N m s/rad",),
            columns=_asymmetric_viscous,
            needs="both directions of motion at several speeds",
        ),
        CatalogueEffect(
            name="asymmetric_coulomb_friction",
            says="dry friction differs between the two directions of motion, beyond a constant offset",
            linear=("fca",),
            units=("N m",),
            columns=_asymmetric_coulomb,
            needs="both directions of motion, and standstill: while moving it looks like a constant offset",
        ),
        CatalogueEffect(
            name="nonlinear_viscous_friction",
            says="friction does not grow in proportion to speed: the lubricant thins or churns",
            linear=("fvn",),
            units=("N m (s/rad)^exponent",),
            columns=_nonlinear_viscous,
            needs="slow and fast motion",
            shapes={"exponent": (0.5, 1.5, 2.0, 3.0)},
        ),
        CatalogueEffect(
            name="stribeck_friction",
            says="extra friction at low speed that fades as the joint speeds up: poor lubrication",
            linear=("fst",),
            units=("N m",),
            columns=_stribeck,
            needs="slow motion in both directions",
            shapes={"relative_speed": (0.01, 0.02, 0.04, 0.08, 0.15)},
        ),
        CatalogueEffect(
            name="joint_spring",
            says="a torque in proportion to the joint angle: a spring, a gravity compensator, or a stiff cable harness",
            linear=("ks",),
            units=("N m/rad",),
            columns=_spring,
            needs="a wide range of joint angles",
        ),
        CatalogueEffect(
            name="cogging_torque",
            says="a torque ripple that repeats with the motor angle: magnets of the motor, or an eccentric gear",
            linear=("cgc", "cgs"),
            units=("N m", "N m"),
            columns=_cogging,
            needs="slow motion over several motor turns",
            shapes={"harmonic": (1.0, 2.0, 4.0, 6.0, 8.0, 12.0)},
        ),
    )
}


def joint_signals(
    robot: RobotConfig, joint: int, q: Array, qd: Array, sign: Literal["smooth", "sharp"]
) -> JointSignals:
    """What the effects of joint number ``joint`` (from 0) depend on; ``q`` and ``qd`` have shape (N, n)."""
    speed = qd[:, joint]
    smooth = np.sign(speed) if sign == "sharp" else 2 / np.pi * np.arctan(robot.friction.sign_smoothing * speed)
    return JointSignals(
        q=q[:, joint],
        qd=speed,
        motor=q @ robot.transmission_matrix[joint],
        sign=smooth,
        top_speed=robot.joints[joint].limits.velocity,
    )


def effect_names(robot: RobotConfig) -> list[str]:
    """Names of the linear parameters of a robot's effects, in the order of ``effect_regressor``.

    Raises
    ------
    ConfigError
        If an effect is not in the catalogue.
    """
    return [name for name, _, _ in _terms(robot)]


def effect_units(robot: RobotConfig) -> list[str]:
    """Units of the linear parameters of a robot's effects."""
    return [unit for _, unit, _ in _terms(robot)]


def effect_values(robot: RobotConfig) -> Array:
    """Values of the linear parameters of a robot's effects, shape (e,); zero where the configuration gives none."""
    return np.array([value for _, _, value in _terms(robot)], dtype=np.float64)


def effect_regressor(robot: RobotConfig, q: Array, qd: Array, *, sharp_sign: bool = False) -> Array:
    """Columns that a robot's effects add to the regressor, shape (N, n, e), N m per unit of the parameter.

    Parameters
    ----------
    q, qd
        Joint positions and velocities, shape (N, n).
    """
    blocks = []
    names = [joint.name for joint in robot.joints]
    for stanza in robot.effects:
        effect = known(stanza.effect)
        j = names.index(stanza.joint)
        signals = joint_signals(robot, j, q, qd, "sharp" if sharp_sign else "smooth")
        shape = {name: stanza.parameters[name] for name in effect.shapes}
        columns = effect.columns(signals, **shape)
        block = np.zeros((q.shape[0], robot.n, columns.shape[1]))
        block[:, j, :] = columns
        blocks.append(block)
    return np.concatenate(blocks, axis=2) if blocks else np.zeros((q.shape[0], robot.n, 0))


def known(name: str) -> CatalogueEffect:
    """Look an effect up.

    Raises
    ------
    ConfigError
        Naming the effects there are.
    """
    if name not in CATALOGUE:
        raise ConfigError(f"effects: {name!r} is not in the catalogue ({', '.join(CATALOGUE)})")
    return CATALOGUE[name]


def _terms(robot: RobotConfig) -> list[tuple[str, str, float]]:
    names = [joint.name for joint in robot.joints]
    terms = []
    for stanza in robot.effects:
        effect = known(stanza.effect)
        missing = [shape for shape in effect.shapes if shape not in stanza.parameters]
        if missing:
            raise ConfigError(f"effects: {stanza.effect} of {stanza.joint} needs {', '.join(missing)}")
        number = names.index(stanza.joint) + 1
        terms += [
            (f"{symbol}{number}", unit, stanza.parameters.get(symbol, 0.0))
            for symbol, unit in zip(effect.linear, effect.units, strict=True)
        ]
    return terms
