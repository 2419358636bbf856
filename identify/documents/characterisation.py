"""The document ``characterisation.json``: friction, ripple and reversals of one joint."""

from typing import Literal

from pydantic import Field

from armident.identify.documents.base import Document, RecordingReference, SignedDocument

NORMAL_95 = 1.959964
"""Half width of a 95 % interval, standard deviations of a normal distribution."""


class Estimate(Document):
    """A value with its 95 % interval.

    Parameters
    ----------
    value
        Estimate.
    low, high
        Ends of the interval.
    unit
        Unit of all three.
    """

    value: float
    low: float
    high: float
    unit: str

    @property
    def std(self) -> float:
        """Standard deviation of a symmetric interval."""
        return (self.high - self.low) / (2.0 * NORMAL_95)


class FrictionPoint(Document):
    """Friction at one constant speed.

    Parameters
    ----------
    speed
        Speed, rad/s or m/s.
    friction
        Half the difference of the torques forth and back over the same positions; null without a pair.
    forward, backward
        Friction against the motion in each direction; null where it is not known.
    """

    speed: float
    friction: Estimate | None = None
    forward: Estimate | None = None
    backward: Estimate | None = None


class Friction(Document):
    """Friction over speed.

    Parameters
    ----------
    points
        Measured speeds, the slowest first.
    curve
        Parameters of the fitted curve by name: ``fc``, ``fv``, ``fva``, ``offset``, and ``fst`` with ``velocity`` where
        Stribeck friction is seen; empty for too few speeds.
    speeds, forward, backward
        The fitted curve: speeds, rad/s or m/s, and friction in each direction, N m or N.
    """

    points: list[FrictionPoint]
    curve: dict[str, Estimate] = Field(default_factory=dict)
    speeds: list[float] = Field(default_factory=list)
    forward: list[float] = Field(default_factory=list)
    backward: list[float] = Field(default_factory=list)


class RippleOrder(Document):
    """A torque ripple.

    Parameters
    ----------
    order
        Cycles per revolution of the joint, or per metre.
    motor_order
        Cycles per revolution of the motor, or per its metre.
    amplitude
        Amplitude of the ripple.
    """

    order: float
    motor_order: float
    amplitude: Estimate


class Ripple(Document):
    """Torque ripple over position at constant speeds.

    Parameters
    ----------
    peaks
        Ripples above the noise floor, the largest first.
    orders
        Orders of the spectrum, cycles per revolution of the joint, or per metre.
    amplitudes
        Amplitude at each of them, N m or N.
    floor
        Amplitude that one recording in a hundred without ripple exceeds at any order, N m or N.
    """

    peaks: list[RippleOrder]
    orders: list[float]
    amplitudes: list[float]
    floor: list[float]


class Presliding(Document):
    """Friction about reversals.

    Parameters
    ----------
    stiffness
        Stiffness of resting friction; null if no reversal shows it.
    friction
        Dry friction at the slowest speed, N m or N.
    travel, measured, model
        Travel since a reversal, rad or m, and friction against it, measured and of the model, N m or N.
    """

    stiffness: Estimate | None = None
    friction: float
    travel: list[float]
    measured: list[float]
    model: list[float]


class CharacterisationDocument(SignedDocument):
    """``characterisation.json``: friction, ripple and reversals of one joint.

    Parameters
    ----------
    joint
        Name of the joint.
    torque_unit, position_unit
        Units of its torque and of its position.
    recordings
        Recordings that were used.
    friction, ripple, presliding
        Results; null where they cannot be determined.
    statements
        Each result in one line, or why it cannot be determined, with the next step.
    """

    schema_: Literal["armident/characterisation/1"] = Field("armident/characterisation/1", alias="schema")
    robot: str
    joint: str
    torque_unit: str
    position_unit: str
    recordings: list[RecordingReference]
    friction: Friction | None = None
    ripple: Ripple | None = None
    presliding: Presliding | None = None
    statements: dict[str, str]
    versions: dict[str, str]
