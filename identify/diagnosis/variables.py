"""Variables that the residual of a joint may depend on: meaning, unit, and probable causes for maintenance."""

from dataclasses import dataclass
from typing import Literal

from armident.identify.effects.effect import POSITION, TORQUE, VELOCITY

Kind = Literal[
    "velocity", "position", "position and direction", "motor angle", "load", "load and direction", "torque",
    "acceleration", "time", "time and direction", "position of another joint", "velocity of another joint",
    "torque of another joint", "frequency", "motion", "unrecorded signal", "bursts", "recording",
]  # fmt: skip
"""Variables; those with a direction have the opposite sign in the negative direction. The last five have no free
functions of their own: all functions of the motion together, and what no recorded motion explains."""


@dataclass(frozen=True)
class ResidualVariable:
    """Variable of a residual; ``units``: at a revolute and at a prismatic joint; ``signal``: attribute of the motion.

    ``hint``: causes and checks; ``joint``, ``other`` and ``at`` (value of the largest error) are filled in.
    """

    meaning: str
    units: tuple[str, str]
    hint: str
    signal: str = ""


SECONDS, HERTZ = ("s", "s"), ("Hz", "Hz")

VARIABLES: dict[Kind, ResidualVariable] = {
    "velocity": ResidualVariable(
        "Velocity of the joint: friction.",
        VELOCITY,
        "friction of {joint} does not follow the model: look at its lubricant, seals and bearings, and run it"
        " at several constant speeds",
        "qd",
    ),
    "position": ResidualVariable(
        "Position of the joint: gravity, springs, cables.",
        POSITION,
        "the torque of {joint} has an error that depends on its position, most at {at}: look for a cable or "
        "hose under tension, an end stop, a spring, a tight spot of the gear, or a wrong mass",
        "q",
    ),
    "position and direction": ResidualVariable(
        "Position, with the sign of the velocity: friction that varies with the position.",
        POSITION,
        "friction of {joint} depends on the position, with the largest error at {at}: look for a "
        "tight spot, a bent shaft or a worn section of the guide",
        "q",
    ),
    "motor angle": ResidualVariable(
        "Angle of a motor: cogging, first gear stage, motor encoder.",
        POSITION,
        "a torque ripple repeats with the motor of {other}: look at the motor, its encoder and the first gear stage",
        "motor",
    ),
    "load": ResidualVariable(
        "Torque that the gear transmits.",
        TORQUE,
        "the torque error of {joint} is proportional to its load: check masses, the current scaling "
        "of its drive, and the stiffness of gear and link",
        "transmitted",
    ),
    "load and direction": ResidualVariable(
        "Transmitted torque, with the sign of the velocity: load-dependent friction.",
        TORQUE,
        "friction of {joint} changes with the load on its gear: check its preload and lubrication",
        "transmitted",
    ),
    "torque": ResidualVariable(
        "Torque of the motor: torque constant, saturation.",
        TORQUE,
        "the drive of {joint} does not give the torque that it reports, with the largest error at {at}: check torque "
        "constant, current limit and saturation",
        "torque",
    ),
    "acceleration": ResidualVariable(
        "Acceleration of the joint: inertia, elasticity, delay.",
        ("rad/s^2", "m/s^2"),
        "the inertia of {joint} does not follow the model: look for a loose coupling, an elastic gear, a flexibly"
        " mounted mass, or a slow current loop",
        "qdd",
    ),
    "time": ResidualVariable(
        "Time since the beginning of the recordings: drift.",
        SECONDS,
        "the torque of {joint} changed during the recording, independently of the motion: look for a drifting "
        "current sensor, a leaking weight balance or a dragging brake",
        "t",
    ),
    "time and direction": ResidualVariable(
        "Time, with the sign of the velocity: drift of friction.",
        SECONDS,
        "friction of {joint} changed during the recording: let the arm warm up, and check that the "
        "lubricant suits the temperature",
        "t",
    ),
    "position of another joint": ResidualVariable(
        "Position of another joint: cables and hoses that it pulls, wrong geometry.",
        POSITION,
        "the torque of {joint} follows the position of {other}: look for a cable, a hose or a spring between the "
        "joints, and for a wrongly placed mass in the model",
        "q",
    ),
    "velocity of another joint": ResidualVariable(
        "Velocity of another joint: shared gears, cables, wrong geometry.",
        VELOCITY,
        "the torque of {joint} follows the velocity of {other}: look for a shared gear, belt or hose, and for"
        " a wrongly placed mass in the model",
        "qd",
    ),
    "torque of another joint": ResidualVariable(
        "Torque of another joint: electrical coupling, elastic structure.",
        TORQUE,
        "the torque of {joint} follows that of {other}: look for electrical coupling between the drives, "
        "a voltage drop of a shared supply, or an elastic structure",
        "torque",
    ),
    "frequency": ResidualVariable(
        "A spectral line that is independent of the motion.",
        HERTZ,
        "the torque of {joint} has a spectral line at {at} that is independent of the motion: look for ripple of "
        "the mains or of the supply, a fan, a pump, a neighbouring machine, or a badly tuned control loop",
    ),
    "motion": ResidualVariable(
        "The frequencies of the motion, more than noise has there, with no single variable.",
        HERTZ,
        "the torque error of {joint} at the frequencies of the motion exceeds the noise, most at {at}, and no "
        "candidate explains it: record the same motion twice to see how much of it is repeatable, and look for "
        "effects that are not in the model",
    ),
    "unrecorded signal": ResidualVariable(
        "Frequencies at which the torque has more power than noise, and which no recorded motion explains.",
        HERTZ,
        "the torque of {joint} contains a signal, strongest at {at}, that no recorded motion explains: look for a "
        "process force, a load or an axis that is not recorded, and record it with the arm",
    ),
    "bursts": ResidualVariable(
        "Moments with far more torque error than the others.",
        SECONDS,
        "the torque of {joint} has bursts, the strongest at {at}, that the motion does not explain: look for contact "
        "with the surroundings, a collision, a slipping brake or a loose part",
    ),
    "recording": ResidualVariable(
        "Data: the report part has far more torque error than the training data.",
        ("times", "times"),
        "the torque error of {joint} in the report part is {at} as large as in the training data: the arm or its load "
        "changed between them, or the training motion does not show what the other needs; diagnose the recording of "
        "the report part alone",
    ),
}
"""All variables by their names in ``varies_with``."""


def hint_of(kind: Kind, joint: str, other: str | None, at: str) -> str:
    """Return the hint of a variable as a sentence; ``at`` is its value at the largest error, with the unit."""
    text = VARIABLES[kind].hint.format(joint=joint, other=other, at=at)
    return f"{text[0].upper()}{text[1:]}."


def unit_of_variable(kind: Kind, joint_type: str) -> str:
    """Return the unit of a variable at a ``revolute`` or ``prismatic`` joint."""
    return VARIABLES[kind].units[joint_type == "prismatic"]
