"""Rotor inertia as a nonlinear parameter, for joints where a rigid motion cannot separate it from the link."""

from collections.abc import Sequence

import numpy as np

from armident.identify.effects.effect import Shape
from armident.identify.robot.motion import Motion

ROTOR = Shape(
    "rotor",
    ("kg m^2", "kg"),
    "Rotor inertia that the gear does not transmit, on the joint side; 0 where the model has it as `ia`.",
    continuous=(False, False),
    default=0.0,
    movable=True,
)
"""Nonlinear parameter of effects that depend on the torque that the gear transmits."""

SHARES = (0.0, 0.25, 0.5, 0.75)
"""Rotor inertias to try, over the least inertia of the joint along the motion."""

APART = 0.05
"""Least share of the load that is not proportional to the acceleration; below it the rotor only scales the effect."""


def rotors(motion: Motion, joint: int) -> Sequence[float]:
    """Return the rotor inertias to try, kg m^2 or kg: zero where the model has one, else shares of the link's."""
    if f"ia{joint + 1}" in motion.model.base.names:
        return (0.0,)
    load, qdd = motion.transmitted[:, joint], motion.qdd[:, joint]
    rest = load - qdd * (float(load @ qdd) / max(float(qdd @ qdd), 1e-300))
    if float(np.linalg.norm(rest)) <= APART * float(np.linalg.norm(load)):
        return (0.0,)
    least = max(float(motion.slopes(joint, links=True)[2][:, joint].min()), 0.0)
    return tuple(share * least for share in SHARES) if least > 0.0 else (0.0,)
