"""Maintenance hints: probable causes of a residual dependence and checks at the machine."""

from armident.identify.diagnosis.free_functions import Kind

HINTS: dict[Kind, str] = {
    "velocity": (
        "friction of {joint} does not follow the model: look at its lubricant, seals and bearings, and run it"
        " at several constant speeds"
    ),
    "position": (
        "the torque of {joint} has an error that depends on its position, most at {at}: look for a cable or "
        "hose under tension, an end stop, a spring, a tight spot of the gear, or a wrong mass"
    ),
    "position and direction": (
        "friction of {joint} depends on the position, with the largest error at {at}: look for a "
        "tight spot, a bent shaft or a worn section of the guide"
    ),
    "motor angle": (
        "a torque ripple repeats with the motor of {other}: look at the motor, its encoder and the first gear stage"
    ),
    "load": (
        "the torque error of {joint} is proportional to its load: check masses, the current scaling "
        "of its drive, and the stiffness of gear and link"
    ),
    "load and direction": "friction of {joint} changes with the load on its gear: check its preload and lubrication",
    "torque": (
        "the drive of {joint} does not give the torque that it reports, with the largest error at {at}: check torque "
        "constant, current limit and saturation"
    ),
    "acceleration": (
        "the inertia of {joint} does not follow the model: look for a loose coupling, an elastic gear, a flexibly"
        " mounted mass, or a slow current loop"
    ),
    "time": (
        "the torque of {joint} changed during the recording, independently of the motion: look for a drifting "
        "current sensor, a leaking weight balance or a dragging brake"
    ),
    "time and direction": (
        "friction of {joint} changed during the recording: let the arm warm up, and check that the "
        "lubricant suits the temperature"
    ),
    "position of another joint": (
        "the torque of {joint} follows the position of {other}: look for a cable, a hose or a spring between the "
        "joints, and for a wrongly placed mass in the model"
    ),
    "velocity of another joint": (
        "the torque of {joint} follows the velocity of {other}: look for a shared gear, belt or hose, and for"
        " a wrongly placed mass in the model"
    ),
    "torque of another joint": (
        "the torque of {joint} follows that of {other}: look for electrical coupling between the drives, "
        "a voltage drop of a shared supply, or an elastic structure"
    ),
    "frequency": (
        "the torque of {joint} has a spectral line at {at} that is independent of the motion: look for ripple of "
        "the mains or of the supply, a fan, a pump, a neighbouring machine, or a badly tuned control loop"
    ),
    "motion": (
        "the torque error of {joint} at the frequencies of the motion exceeds the noise, most at {at}, and no "
        "candidate explains it: record the same motion twice to see how much of it is repeatable, and look for "
        "effects that are not in the model"
    ),
    "transients": (
        "the torque of {joint} has transient disturbances, the largest at {at}, at times that are independent of the "
        "motion: look for dirt or a chip in gear and guide, a cable that catches, a dragging brake, contact, or "
        "a loose plug"
    ),
}
"""Hint for each kind of dependence; ``joint``, ``other`` and ``at`` (value of the largest error) are filled in.

``transients`` is of documents of former versions."""


def hint_of(kind: Kind, joint: str, other: str | None, at: str) -> str:
    """Hint as a sentence.

    ``kind``: kind of dependence; ``joint``, ``other``: names of the joint, and of the joint or motor to which the
    variable belongs; ``at``: value of the variable at the largest error, with its unit.
    """
    text = HINTS[kind].format(joint=joint, other=other, at=at)
    return f"{text[0].upper()}{text[1:]}."


def unit_of(kind: Kind, joint: str) -> str:
    """Unit of a variable. ``kind``: kind of dependence; ``joint``: type of the joint, ``revolute`` or ``prismatic``."""
    length = "rad" if joint == "revolute" else "m"
    match kind:
        case "velocity" | "velocity of another joint":
            return f"{length}/s"
        case "position" | "position and direction" | "motor angle" | "position of another joint":
            return length
        case "acceleration":
            return f"{length}/s^2"
        case "time" | "time and direction" | "transients":
            return "s"
        case "frequency" | "motion":
            return "Hz"
        case _:
            return "N m" if joint == "revolute" else "N"
