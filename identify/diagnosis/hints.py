"""What a dependence of the residual tells whoever stands at the machine."""

from armident.identify.diagnosis.maps import Kind

HINTS: dict[Kind, str] = {
    "velocity": (
        "friction of {joint} does not follow the model: look at its lubricant, seals and bearings, and run it"
        " at several constant speeds"
    ),
    "position": (
        "something pushes or pulls {joint} depending on where it stands, most at {at}: look for a cable or "
        "hose under tension, an end stop, a spring, a tight spot of the gear, or a wrong mass in the model"
    ),
    "position and direction": (
        "friction of {joint} is higher at some positions than at others, most unlike the model at {at}: look for a "
        "tight spot, a bent shaft or a worn stretch of the guide"
    ),
    "motor angle": (
        "a torque ripple repeats with the motor of {other}: look at the motor, its encoder and the first gear stage"
    ),
    "load": (
        "the torque of {joint} is wrong in proportion to what it carries: check masses, the current scaling "
        "of its drive, and whether gear or link give way"
    ),
    "load and direction": "friction of {joint} changes with the load on its gear: check its preload and lubrication",
    "torque": (
        "the drive of {joint} does not give the torque that it reports, most at {at}: check torque constant, "
        "current limit and saturation"
    ),
    "acceleration": (
        "the inertia of {joint} does not follow the model: look for a loose coupling, an elastic gear, a mass"
        " that swings along, or a current loop that lags"
    ),
    "time": (
        "the torque of {joint} changed while it was recorded, whatever the motion: look for a drifting "
        "current sensor, a leaking weight balance or a brake that drags"
    ),
    "time and direction": (
        "friction of {joint} changed while it was recorded: let the arm warm up, and check whether the "
        "lubricant suits the temperature"
    ),
    "velocity of another joint": (
        "the torque of {joint} follows the velocity of {other}: look for a shared gear, belt or hose, and for"
        " a mass that the model has at the wrong place"
    ),
    "torque of another joint": (
        "the torque of {joint} follows that of {other}: look for a current that couples from drive to drive, "
        "a shared supply that sags, or a structure that gives way"
    ),
    "frequency": (
        "the torque of {joint} has a line at {at} that does not move with the motion: look for ripple of the "
        "mains or of the supply, a fan, a pump, a neighbouring machine, or a badly tuned loop"
    ),
    "motion": (
        "the torque of {joint} misses more at the frequencies of the motion, most at {at}, than noise can, and nothing "
        "tried explains it: record the same motion twice to see how much of it repeats, and look for what is not in "
        "the model"
    ),
    "time, in bursts": (
        "the torque of {joint} is off for moments at a time, most at {at}, and nothing in the motion tells when: look "
        "for dirt or a chip in gear and guide, a cable that catches, a brake that drags, contact, or a loose plug"
    ),
}
"""For each kind; the names of the joint and of another one, and where the shape is largest, are filled in."""


def hint_of(kind: Kind, joint: str, other: str | None, at: str) -> str:
    """The hint as a sentence; ``at`` is the value of the variable where the shape is largest, with its unit."""
    text = HINTS[kind].format(joint=joint, other=other, at=at)
    return f"{text[0].upper()}{text[1:]}."


def unit_of(kind: Kind, joint: str) -> str:
    """Unit of the variable of a map at a revolute or prismatic joint."""
    length = "rad" if joint == "revolute" else "m"
    match kind:
        case "velocity" | "velocity of another joint":
            return f"{length}/s"
        case "position" | "position and direction" | "motor angle":
            return length
        case "acceleration":
            return f"{length}/s^2"
        case "time" | "time and direction" | "time, in bursts":
            return "s"
        case "frequency" | "motion":
            return "Hz"
        case _:
            return "N m" if joint == "revolute" else "N"
