"""Entry of the catalogue: `Effect`, its linear parameters (`Linear`) and nonlinear ones (`Shape`)."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from armident.configs import RobotConfig
from armident.identify.robot.motion import Motion

Array = NDArray[np.float64]

Scope = Literal["joint", "motor", "pair", "other", "arm"]
"""Location of an effect: one joint, one motor, a pair of joints, a joint with a variable of another one, or the arm.

A coupled transmission makes the effect of a motor act on several joints. The entry of an effect of the whole arm names
the first joint in the configuration, that of a payload the last one.
"""

SIGN_TOLERANCE = 2.0
"""Standard deviations by which a parameter must violate its sign or bounds to be rejected."""


@dataclass(frozen=True)
class Linear:
    """Linear parameter of an effect: the torque is proportional to it.

    Parameters
    ----------
    name
        Name in the robot configuration; results append the number of the joint.
    unit
        Units at a revolute and at a prismatic joint.
    sign
        +1 or -1 where physics determines the sign, 0 otherwise.
    bounds
        Lowest and highest plausible value.
    through
        Nonlinear parameter that this one requires: it is absent where that one is zero. The diagnosis adds the effect
        without it.
    replaces
        Rigid parameter of the joint that this one absorbs; ``without`` in the configuration keeps that parameter.
    """

    name: str
    unit: tuple[str, str]
    sign: int = 0
    bounds: tuple[float, float] = (-math.inf, math.inf)
    through: str | None = None
    replaces: str = ""


@dataclass(frozen=True)
class Shape:
    """Nonlinear parameter of an effect: found by a grid search, then refined.

    Parameters
    ----------
    name, unit
        Name in the robot configuration; units at a revolute and at a prismatic joint.
    grid
        ``(motion, joint)`` to the increasing values to try, in the unit of the parameter.
    continuous
        For a revolute and for a prismatic joint: True if values between those of the grid are meaningful. A harmonic of
        a turn is an integer; the pitch of a prismatic axis is unknown.
    default
        Value where the configuration gives none; ``None``: the configuration must give one.
    movable
        True if its standard deviation is estimated although its value is one of the grid.
    """

    name: str
    unit: tuple[str, str]
    grid: Callable[[Motion, int], Sequence[float]]
    continuous: tuple[bool, bool] = (True, True)
    default: float | None = None
    movable: bool = False


@dataclass(frozen=True)
class Recorded:
    """Recorded torque of a motor.

    Parameters
    ----------
    dt
        Sampling period, s.
    limit
        Largest torque, N m or N.
    """

    dt: float
    limit: float


def motor_limit(robot: RobotConfig, motor: int) -> float:
    """Return the largest torque of a motor at its shaft, N m or N.

    Parameters
    ----------
    robot
        Configuration with the limits of the joints and the transmission.
    motor
        Index of the motor, from 0.
    """
    return float(robot.joints[motor].limits.torque / np.abs(robot.transmission_matrix[motor]).max())


@dataclass(frozen=True)
class Effect:
    """Effect of the catalogue; its torque in the reported torques is ``columns(motion, place, **shapes) @ linear``.

    Parameters
    ----------
    name
        Name in ``diagnosis.json`` and in the ``effects`` of a robot configuration.
    title, says
        Short name and description for a plant engineer.
    reference
        Source of the functional form.
    linear
        Linear parameters, one per column.
    columns
        ``(motion, place, **shapes)`` to the torques per unit of the linear parameters, N m or N: an array (N, k) for
        joint ``place.joint``, or (N, n, k) for all joints.
    needs
        Motion or data that make the effect visible, in words.
    shapes
        Nonlinear parameters.
    scope
        See `Scope`.
    visible
        ``(motion, place)`` to the reason for which the motion cannot show the effect at any size, or ``None``. The
        motion is the simulated one.
    numbers
        Jacobian (b, k) of the base parameters with respect to the linear ones, for an effect that only changes
        parameters of the same model. It is visible against a baseline only; ``columns`` follow from the Jacobian.
    together
        True if several instances at one joint make one finding (harmonics of a periodic torque).
    excitation
        Keywords of the motion that excites the effect, see `armident.identify.excitation.design`.
    rewires
        True if the effect permutes signals or changes their signs instead of adding a torque.
        `armident.identify.effects.wiring` corrects the recording, and there are no columns.
    predicts
        True if the columns depend on the predicted torque, and so on the model's parameters. They are then computed at
        the simulated motion, because measured signals that are differentiated twice add more noise than torque.
    share
        True if its linear parameter scales the predicted torque. The fit is then iterated until parameter and torque
        agree.
    undo
        ``(recorded, at, value)`` to the true torque (N,) of a motor, for the one linear parameter. The columns are its
        first-order expansion, whose noise at measured signals exceeds the effect; the corrected recording has no added
        noise.
    sudden
        True if the arm's motion has jumps at instants that a simulation does not reproduce to the sample. The columns
        at measured signals are then their own instruments.
    physical
        ``(values, shapes, largest)`` to True if linear parameters (k,) are physically possible at given nonlinear ones,
        beyond signs and bounds; ``largest`` has the largest values of the nonlinear ones in the grid of the motion.
    negligible
        ``(values, dt)`` to True if linear parameters (k,) are within the sampling convention at the sampling period
        ``dt``, s; ``None``: never.
    law
        Formula of the same dependence that differs from the first one in the catalogue; empty for the first one.
        ``table`` is a free shape.
    order_of
        ``motor`` if its nonlinear parameter is an order of the motor angle, found by order analysis of the residual.
    """

    name: str
    title: str
    says: str
    reference: str
    linear: tuple[Linear, ...]
    columns: Callable[..., Array]
    needs: str
    shapes: tuple[Shape, ...] = ()
    scope: Scope = "joint"
    visible: Callable[[Motion, "Place"], str | None] | None = None
    numbers: Callable[[Motion, "Place"], Array] | None = None
    together: bool = False
    excitation: tuple[str, ...] = field(default=("reversals", "speeds"))
    rewires: bool = False
    predicts: bool = False
    share: bool = False
    undo: Callable[[Array, Recorded, float], Array] | None = None
    sudden: bool = False
    physical: Callable[[Array, Mapping[str, float], Mapping[str, float]], bool] | None = None
    negligible: Callable[[Array, float], bool] | None = None
    law: str = ""
    order_of: str = ""

    @property
    def key(self) -> str:
        """Name in the catalogue: that of the effect, with the law behind a slash unless it is the first one."""
        return f"{self.name}/{self.law}" if self.law else self.name

    @property
    def free(self) -> bool:
        """True if the law is a free shape, whose parameters are torques at knots."""
        return self.law == "table" or self.name == "unnamed"

    def allows(
        self, values: Array, std: Array, shapes: Mapping[str, float], largest: Mapping[str, float] | None = None
    ) -> bool:
        """Return True if linear parameters (k,) with standard deviations (k,) are physically possible.

        Signs and bounds may be violated by `SIGN_TOLERANCE` standard deviations: single parameters may be zero.

        Parameters
        ----------
        values, std
            Linear parameters and their standard deviations, (k,) each.
        shapes
            Nonlinear parameters by name.
        largest
            Largest value of each nonlinear parameter in the grid of the motion; ``None``: as ``shapes``.
        """
        if self.physical is not None and not self.physical(values, shapes, largest or shapes):
            return False
        return all(
            p.sign * value >= -SIGN_TOLERANCE * deviation
            and p.bounds[0] - SIGN_TOLERANCE * deviation <= value <= p.bounds[1] + SIGN_TOLERANCE * deviation
            for p, value, deviation in zip(self.linear, values, std, strict=True)
        )

    @property
    def essence(self) -> "Effect":
        """Effect without its optional linear parameters."""
        kept = [k for k, linear in enumerate(self.linear) if linear.through is None]
        if len(kept) == len(self.linear):
            return self
        return replace(self, linear=tuple(self.linear[k] for k in kept), columns=partial(_some, self.columns, kept))

    def refinable(self, robot: RobotConfig, place: "Place") -> tuple[bool, ...]:
        """Return, for each nonlinear parameter, True if it may lie between the values of its grid at a place.

        Parameters
        ----------
        robot
            Configuration of the robot.
        place
            Location of the effect.
        """
        prismatic = robot.joints[place.joint].type == "prismatic"
        return tuple(shape.continuous[prismatic] for shape in self.shapes)

    def movable(self, robot: RobotConfig, place: "Place", shapes: Mapping[str, float]) -> list[str]:
        """Return the names of the nonlinear parameters to refine; those at zero stay, as refinement is by factors.

        Parameters
        ----------
        robot
            Configuration of the robot.
        place
            Location of the effect.
        shapes
            Nonlinear parameters by name.
        """
        between = zip(self.shapes, self.refinable(robot, place), strict=True)
        return [s.name for s, may in between if (may or s.movable) and shapes[s.name] != 0.0]

    def torque(self, motion: Motion, place: "Place", shapes: Mapping[str, float]) -> Array:
        """Return the columns of all joints, shape (N, n, k).

        Parameters
        ----------
        motion
            The motion, N samples.
        place
            Location of the effect.
        shapes
            Nonlinear parameters by name.
        """
        columns = self.columns(motion, place, **shapes)
        if columns.ndim == 3:
            return columns
        whole = np.zeros((motion.samples, motion.n, columns.shape[1]))
        whole[:, place.joint] = columns
        return whole


def _some(columns: Callable[..., Array], kept: Sequence[int], motion: Motion, place: "Place", **shapes: float) -> Array:
    """Return those columns of an effect whose indices are ``kept``."""
    return columns(motion, place, **shapes)[..., kept]


@dataclass(frozen=True)
class Place:
    """Location of an effect in an arm.

    Parameters
    ----------
    joint
        Index of the joint, from 0.
    other
        Index of the second joint of a pair, or ``None``.
    """

    joint: int
    other: int | None = None
