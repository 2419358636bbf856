"""Base classes of the catalogue: `Effect`, its linear parameters (`Linear`) and nonlinear ones (`Shape`)."""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, permutations, product
from typing import Literal

import numpy as np

from armident.arrays import Array
from armident.configs import RobotConfig
from armident.configs.schema.robot import Effect as Entry
from armident.identify.documents.rounding import plus_minus
from armident.identify.robot.motion import Motion

Shapes = tuple[tuple[str, float], ...]
"""Nonlinear parameters as pairs of name and value."""

Scope = Literal["joint", "motor", "pair", "other", "arm"]
"""Location of an effect: one joint, one motor, a pair of joints, a joint with a variable of another one, or the arm.

A coupled transmission makes the effect of a motor act on several joints. The entry of an effect of the whole arm names
the first joint in the configuration, that of a payload the last one.
"""

Signals = Literal["measured", "simulated"]
Trials = tuple[Sequence[float] | Array, ...]
"""Values to try of each nonlinear parameter."""

SIGN_TOLERANCE = 2.0
"""Standard deviations by which a parameter must violate its sign or bounds to be rejected."""

# Units at a revolute and at a prismatic joint.
POSITION = ("rad", "m")
VELOCITY = ("rad/s", "m/s")
TORQUE = ("N m", "N")
VISCOUS = ("N m s/rad", "N s/m")
UNITLESS = ("", "")


@dataclass(frozen=True)
class Linear:
    """Linear parameter of an effect: the torque is proportional to it.

    Parameters
    ----------
    name
        Name in the robot configuration; results append the number of the joint.
    unit
        Units at a revolute and at a prismatic joint.
    meaning
        Meaning, a sentence; empty: the description of the effect explains it.
    sign
        +1 or -1 where physics determines the sign, 0 otherwise.
    bounds
        Lowest and highest plausible value.
    requires
        Nonlinear parameter without which this one is absent: where that one is zero.
    absorbs
        Rigid parameter of the joint that this one absorbs; ``without`` in the configuration keeps that parameter.
    """

    name: str
    unit: tuple[str, str]
    meaning: str = ""
    sign: int = 0
    bounds: tuple[float, float] = (-math.inf, math.inf)
    requires: str | None = None
    absorbs: str = ""


@dataclass(frozen=True)
class Shape:
    """Nonlinear parameter of an effect: found by a grid search, then refined.

    Parameters
    ----------
    name, unit, meaning
        As of `Linear`.
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
    meaning: str = ""
    continuous: tuple[bool, bool] = (True, True)
    default: float | None = None
    movable: bool = False


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

    @property
    def second(self) -> int:
        """Index of the second joint of a pair."""
        assert self.other is not None
        return self.other


class Effect(ABC):
    """Effect of the catalogue; its torque in the reported torques is ``columns(motion, place, shapes) @ linear``.

    Each effect is a subclass, and so is each further law of it. Its attributes and `columns` are required; the other
    methods have usual answers.

    Attributes
    ----------
    name
        Name in ``diagnosis.json`` and in the ``effects`` of a robot configuration.
    law
        Formula of the same dependence that differs from the first one in the catalogue; empty for the first one.
        ``table`` is a free shape.
    title, description
        Short name and description for a plant engineer.
    reference
        Source of the functional form.
    required_motion
        Motion or data that make the effect visible, in words.
    direct_evidence
        Signal or load beyond the usual recording that shows the effect directly, in words; empty: none.
    excitation
        Keywords of the motion that excites the effect, see `armident.identify.diagnosis.next_experiment`.
    scope
        See `Scope`.
    linear
        Linear parameters, one per column.
    shapes
        Nonlinear parameters.
    settings
        Further parameters of an entry of an effect that adds no torque.
    at_reversals
        True if the torque acts about reversals, where no model of dry friction is right: evidence for others is not.
    depends_on_torque
        True if the columns depend on the torque that the model predicts, and so on its parameters.
    scales_torque
        True if the linear parameter scales the predicted torque. The fit is then iterated until both agree.
    regressor_signals, instrument_signals
        Signals at which the columns of the regressor and its instruments are computed.
    change_title
        Words for a change against a baseline, if they differ from the title.
    compared
        True if a difference from a baseline may be this effect, of which base parameters absorb a part. It has no
        nonlinear parameters, and its columns do not depend on the past.
    rigid_part
        Part of an exported arm that holds the effect, by its first law: ``springs``, ``gravity``, ...; empty: none.
    """

    name: str
    law: str = ""
    title: str
    description: str
    reference: str
    required_motion: str
    direct_evidence: str = ""
    excitation: tuple[str, ...] = ("reversals", "speeds")
    scope: Scope = "joint"
    linear: tuple[Linear, ...]
    shapes: tuple[Shape, ...] = ()
    settings: tuple[Shape, ...] = ()
    at_reversals: bool = False
    depends_on_torque: bool = False
    scales_torque: bool = False
    regressor_signals: Signals = "measured"
    instrument_signals: Signals = "simulated"
    change_title: str = ""
    compared: bool = False
    rigid_part: str = ""

    @abstractmethod
    def columns(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> Array:
        """Return the torques per unit of the linear parameters, N m or N.

        Parameters
        ----------
        motion, place, shapes
            Motion, N samples, location of the effect, and all nonlinear parameters by name.

        Returns
        -------
        ndarray
            Torques of the joint ``place.joint``, (N, k), or of all joints, (N, n, k).
        """

    def trial_values(self, motion: Motion, place: Place) -> Trials:
        """Return the values of each nonlinear parameter to try, increasing, in its unit.

        Parameters
        ----------
        motion, place
            Motion that determines the ranges, and location of the effect.
        """
        return ()

    def invisible(self, motion: Motion, place: Place) -> str | None:
        """Return the reason for which a motion cannot show the effect at any size, or ``None``.

        Parameters
        ----------
        motion, place
            The motion, and location of the effect.
        """
        return None

    def may_be_added(self, motion: Motion, place: Place, present: Sequence[Shapes]) -> bool:
        """Return True if a diagnosis may add the effect to a model.

        Parameters
        ----------
        motion, place, present
            Motion of the model, location, and nonlinear parameters of the instances that the model has there.
        """
        return not present and self.invisible(motion, place) is None

    def possible(self, values: Array, shapes: Mapping[str, float]) -> bool:
        """Return True if linear parameters are physically possible, beyond their signs and bounds.

        Parameters
        ----------
        values, shapes
            Linear parameters, (k,), and nonlinear ones by name.
        """
        return True

    def least(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> float:
        """Return the least size of every linear parameter that this arm allows; 0 without a limit.

        Parameters
        ----------
        motion, place, shapes
            Motion with the parameters of the model, location, and nonlinear parameters by name.
        """
        return 0.0

    def is_convention(self, values: Array, uncertain: float) -> bool:
        """Return True if the effect is a part of every model at these values, and no finding.

        Parameters
        ----------
        values
            Linear parameters, (k,).
        uncertain
            Time by which the common instant of all torques is uncertain, s.
        """
        return False

    def corrects(self, entry: Entry) -> bool:
        """Return True if an entry of the configuration corrects the recordings instead of being a term of the model.

        Parameters
        ----------
        entry
            Entry of this effect.
        """
        return False

    def change_in_words(self, joint: str, values: Mapping[str, float], std: Mapping[str, float]) -> str:
        """Return the description of a change against a baseline.

        Parameters
        ----------
        joint, values, std
            Name of the joint, estimable linear parameters by name, and their standard deviations.
        """
        each = ", ".join(f"{name} {plus_minus(value, std[name])}" for name, value in values.items())
        words = f"{self.change_title or self.title} at {joint}"
        return f"{words}: {each}" if each else words

    @property
    def minimal(self) -> "Effect":
        """The effect as a diagnosis adds it, without optional linear parameters."""
        return self

    @property
    def key(self) -> str:
        """Name in the catalogue: that of the effect, with the law behind a slash unless it is the first one."""
        return f"{self.name}/{self.law}" if self.law else self.name

    @property
    def sign(self) -> int:
        """Sign of the one linear parameter; 0 if physics determines none, or there are several."""
        return self.linear[0].sign if len(self.linear) == 1 else 0

    @property
    def two_joints(self) -> bool:
        """True if a location has two joints."""
        return self.scope in ("pair", "other")

    @property
    def parameters_of_entry(self) -> "tuple[Linear | Shape, ...]":
        """All parameters of an entry of the configuration, the linear ones first."""
        return (*self.linear, *self.shapes, *self.settings)

    @property
    def units(self) -> dict[str, tuple[str, str]]:
        """Units at a revolute and at a prismatic joint of linear and nonlinear parameters, by name."""
        return {p.name: p.unit for p in self.linear} | {s.name: s.unit for s in self.shapes}

    @property
    def defaults(self) -> dict[str, float]:
        """Nonlinear parameters that the configuration may leave out, with their values."""
        return {shape.name: shape.default for shape in self.shapes if shape.default is not None}

    def places(self, n: int) -> list[Place]:
        """Return the possible locations in an arm.

        Parameters
        ----------
        n
            Number of joints.
        """
        if self.two_joints:
            chosen = combinations(range(n), 2) if self.scope == "pair" else permutations(range(n), 2)
            return [Place(*joints) for joints in chosen]
        return [Place(j) for j in range(1 if self.scope == "arm" else n)]

    def grid(self, motion: Motion, place: Place) -> tuple[Shapes, ...]:
        """Return all combinations of the nonlinear parameters to try.

        Parameters
        ----------
        motion, place
            Motion that determines the ranges, and location of the effect.
        """
        values = zip(self.shapes, self.trial_values(motion, place), strict=True)
        return tuple(product(*([(shape.name, float(v)) for v in of_shape] for shape, of_shape in values)))

    def present(self, shapes: Mapping[str, float]) -> tuple[int, ...]:
        """Return the indices of the linear parameters that the effect has at given nonlinear ones.

        Parameters
        ----------
        shapes
            Nonlinear parameters by name.
        """
        return tuple(k for k, p in enumerate(self.linear) if p.requires is None or shapes[p.requires] != 0.0)

    def allows(self, values: Array, std: Array, shapes: Mapping[str, float]) -> bool:
        """Return True if linear parameters (k,) with standard deviations (k,) are physically possible.

        Signs and bounds may be violated by `SIGN_TOLERANCE` standard deviations: single parameters may be zero.

        Parameters
        ----------
        values, std, shapes
            Linear parameters and their standard deviations, (k,) each, and nonlinear parameters by name.
        """
        return self.possible(values, shapes) and all(
            p.sign * value >= -SIGN_TOLERANCE * deviation
            and p.bounds[0] - SIGN_TOLERANCE * deviation <= value <= p.bounds[1] + SIGN_TOLERANCE * deviation
            for p, value, deviation in zip(self.linear, values, std, strict=True)
        )

    def positive_friction(self, shapes: Mapping[str, float]) -> tuple[str, Array]:
        """Return a friction parameter of the joint and factors (k,) of the linear ones: their sum is not negative.

        An empty name for most effects. Viscous friction never falls with the speed, and Coulomb friction is positive.

        Parameters
        ----------
        shapes
            Nonlinear parameters by name.
        """
        return "", np.zeros(len(self.linear))

    def refinable(self, robot: RobotConfig, place: Place) -> tuple[bool, ...]:
        """Return, for each nonlinear parameter, True if it may lie between the values of its grid at a place.

        Parameters
        ----------
        robot, place
            Configuration of the robot, and location of the effect.
        """
        prismatic = robot.joints[place.joint].type == "prismatic"
        return tuple(shape.continuous[prismatic] for shape in self.shapes)

    def movable(self, robot: RobotConfig, place: Place, shapes: Mapping[str, float]) -> list[str]:
        """Return the names of the nonlinear parameters to refine; those at zero stay, as refinement is by factors.

        Parameters
        ----------
        robot, place, shapes
            Configuration of the robot, location of the effect, and nonlinear parameters by name.
        """
        between = zip(self.shapes, self.refinable(robot, place), strict=True)
        return [s.name for s, may in between if (may or s.movable) and shapes[s.name] != 0.0]

    def torque(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> Array:
        """Return the columns of all joints, shape (N, n, k).

        Parameters
        ----------
        motion, place, shapes
            Motion, N samples, location, and nonlinear parameters by name; `defaults` may be left out.
        """
        columns = self.columns(motion, place, {**self.defaults, **shapes})
        if columns.ndim == 3:
            return columns
        whole = np.zeros((motion.samples, motion.n, columns.shape[1]))
        whole[:, place.joint] = columns
        return whole

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and vars(self) == vars(other)

    def __hash__(self) -> int:
        return hash((type(self), self.key))


class TorqueDependent(Effect):
    """Effect whose columns depend on the torque that the model predicts.

    They are computed at the simulated motion, because measured signals that are differentiated twice add more noise
    than torque.
    """

    depends_on_torque = True
    regressor_signals: Signals = "simulated"


class Periodic(Effect):
    """Effect of which a joint may have several at different periods; together they are one torque."""

    def may_be_added(self, motion: Motion, place: Place, present: Sequence[Shapes]) -> bool:
        """Return True: at another period."""
        return self.invisible(motion, place) is None
