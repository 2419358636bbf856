"""What an entry of the catalogue is."""

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

Scope = Literal["joint", "motor", "pair", "arm"]
"""Where an effect sits: in one joint, in one motor (which a coupled transmission joins to several joints), between two
joints, or in the arm as a whole (its stanza then names the first joint, a payload the last one)."""

DOUBT = 2.0
"""Standard deviations by which a parameter must have the wrong sign to be against physics."""


@dataclass(frozen=True)
class Linear:
    """A parameter that the torque is proportional to.

    Parameters
    ----------
    name
        In the robot configuration; in results the number of the joint is appended.
    unit
        Of a revolute joint; and of a prismatic one.
    sign
        +1 or -1 where physics knows it, 0 where both are possible.
    bounds
        Values beyond which the effect would be something else.
    through
        The nonlinear parameter without which (where it is zero) there is no such parameter, if there is one. A search
        tries the effect without it.
    replaces
        The rigid parameter of the joint whose part it takes over then: the search gives it to an effect where it takes
        over all of that, and data kept back are nearer with it.
    """

    name: str
    unit: tuple[str, str]
    sign: int = 0
    bounds: tuple[float, float] = (-math.inf, math.inf)
    through: str | None = None
    replaces: str = ""


@dataclass(frozen=True)
class Shape:
    """A parameter that the torque depends on in another way: found by search, then refined.

    Parameters
    ----------
    name, unit
        In the robot configuration; the unit of a revolute and of a prismatic joint.
    grid
        Values worth trying on a motion of a joint, increasing, in the unit of the parameter.
    continuous
        Whether values between those of the grid make sense, for a revolute and for a prismatic joint; a harmonic of a
        turn is a whole number, and nobody has said where on its travel a screw turns round.
    default
        What a robot configuration means that does not give it; ``None``: it must.
    closer
        Values to try beside those of the grid once the simulated loop has the effect in it: what a rigid arm's motion
        does not excite says nothing there.
    movable
        Whether it is moved with the others once the effect is found, although the search takes it from its grid.
    """

    name: str
    unit: tuple[str, str]
    grid: Callable[[Motion, int], Sequence[float]]
    continuous: tuple[bool, bool] = (True, True)
    default: float | None = None
    closer: tuple[float, ...] = ()
    movable: bool = False


@dataclass(frozen=True)
class Recorded:
    """What is known of a motor whose torque was recorded: the sampling period, s, and its largest torque, N m or N."""

    dt: float
    limit: float


def motor_limit(robot: RobotConfig, motor: int) -> float:
    """Largest torque of a motor at its shaft, N m or N."""
    return float(robot.joints[motor].limits.torque / np.abs(robot.transmission_matrix[motor]).max())


@dataclass(frozen=True)
class Effect:
    """One effect: the torque it adds to what the drives report is ``columns(motion, joint, **shapes) @ linear``.

    Parameters
    ----------
    name
        In ``diagnosis.json`` and in the ``effects`` of a robot configuration.
    title, says
        A name and an explanation in plain language, for a plant engineer.
    reference
        Where the form comes from.
    linear
        Linear parameters, one per column.
    columns
        ``(motion, place, **shapes)`` to an array (N, k) of the torques (N m or N) of joint ``place.joint``, or
        (N, n, k) of all joints, per unit of the linear parameters.
    needs
        What a recording must contain for the effect to be visible, in words.
    shapes
        Nonlinear parameters.
    scope
        See `Scope`.
    visible
        Why the effect cannot show in a motion whatever its size, or ``None``; the motion is the model's own.
    numbers
        Change of the base parameters (b, k) per unit of the linear ones, where the effect is nothing but other numbers
        in the same model: it shows against a baseline only, and ``columns`` follow from it.
    together
        Whether several of one effect on one joint are one finding (the harmonics of a periodic torque).
    excitation
        What a trajectory that is to show the effect must have plenty of; see `armident.identify.excitation.design`.
    rewires
        Whether the effect is an exchange of signals instead of a torque:
        `armident.identify.effects.wiring` undoes it in the recording, and there are no columns.
    predicts
        Whether the columns depend on the torques that the model predicts, and so on its parameters.
    share
        Whether its linear parameter is a share of these torques: fits are repeated until it is one of those that the
        model with the effect predicts.
    undo
        ``(recorded, at, value)`` to the torque (N,) that a motor really had where the recording says otherwise, for the
        one linear parameter. The columns are what the first order of it makes of the model's torques, which at measured
        signals hold more noise than effect; a recording put right holds none that it did not have.
    sudden
        Whether it makes the arm leap, at instants that no simulation meets to the sample: columns at measured signals
        are their own instruments then, and have to explain more than feedback lets a term without merit explain.
    physical
        Whether physics allows linear parameters (k,) at given nonlinear ones, where signs and bounds do not say it all.
    negligible
        Whether linear parameters (k,) are a convention of sampling instead of a fault, at the sampling period of the
        recording in s; ``None``: never.
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
    physical: Callable[[Array, Mapping[str, float]], bool] | None = None
    negligible: Callable[[Array, float], bool] | None = None

    def allows(self, values: Array, std: Array, shapes: Mapping[str, float]) -> bool:
        """Whether linear parameters (k,) at given nonlinear ones have signs and sizes that physics allows.

        Signs and sizes are wrong if they are wrong beyond doubt: of several parameters some may be nothing but noise.
        """
        if self.physical is not None and not self.physical(values, shapes):
            return False
        return all(
            p.sign * value >= -DOUBT * doubt and p.bounds[0] - DOUBT * doubt <= value <= p.bounds[1] + DOUBT * doubt
            for p, value, doubt in zip(self.linear, values, std, strict=True)
        )

    @property
    def essence(self) -> "Effect":
        """The effect without the parameters that it may be without."""
        kept = [k for k, linear in enumerate(self.linear) if linear.through is None]
        if len(kept) == len(self.linear):
            return self
        return replace(self, linear=tuple(self.linear[k] for k in kept), columns=partial(_some, self.columns, kept))

    def refinable(self, robot: RobotConfig, place: "Place") -> tuple[bool, ...]:
        """Which of the nonlinear parameters may lie between the values of their grids at a place."""
        prismatic = robot.joints[place.joint].type == "prismatic"
        return tuple(shape.continuous[prismatic] for shape in self.shapes)

    def movable(self, robot: RobotConfig, place: "Place", shapes: Mapping[str, float]) -> list[str]:
        """Names of the nonlinear parameters to be moved once it is found: none at zero, which no factor moves."""
        between = zip(self.shapes, self.refinable(robot, place), strict=True)
        return [s.name for s, may in between if (may or s.movable) and shapes[s.name] != 0.0]

    def torque(self, motion: Motion, place: "Place", shapes: Mapping[str, float]) -> Array:
        """Columns of all joints, shape (N, n, k)."""
        columns = self.columns(motion, place, **shapes)
        if columns.ndim == 3:
            return columns
        whole = np.zeros((motion.samples, motion.n, columns.shape[1]))
        whole[:, place.joint] = columns
        return whole


def _some(columns: Callable[..., Array], kept: Sequence[int], motion: Motion, place: "Place", **shapes: float) -> Array:
    """Some of the columns of an effect."""
    return columns(motion, place, **shapes)[..., kept]


@dataclass(frozen=True)
class Place:
    """Where in an arm an effect sits; joints count from 0, ``other`` is the second one of a pair."""

    joint: int
    other: int | None = None
