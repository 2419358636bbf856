"""What of a joint's inertia the gear does not hand on: the rotor, where a rigid motion cannot tell it from the link."""

from collections.abc import Sequence

import numpy as np

from armident.identify.effects.effect import Shape
from armident.identify.robot.motion import Motion

SHARES = (0.0, 0.25, 0.5, 0.75)
"""Of the least inertia that a joint has along a motion."""

APART = 0.05
"""Share of the load's size that must not go with the acceleration for the rotor to make a difference but of scale."""


def rotors(motion: Motion, joint: int) -> Sequence[float]:
    """Rotor inertias beyond the model's own: none where it is identified, else shares of what passes for the link's.

    In the base parameters of joints with a constant axis, and of models without rotors, the rotor is part of the link;
    load and elastic or loose gears feel the difference, unless all the load there is goes with the acceleration.
    """
    if f"ia{joint + 1}" in motion.model.base.names:
        return (0.0,)
    load, qdd = motion.transmitted[:, joint], motion.qdd[:, joint]
    rest = load - qdd * (float(load @ qdd) / max(float(qdd @ qdd), 1e-300))
    if float(np.linalg.norm(rest)) <= APART * float(np.linalg.norm(load)):
        return (0.0,)
    least = max(float(motion.slopes(joint, links=True)[2][:, joint].min()), 0.0)
    return tuple(share * least for share in SHARES) if least > 0.0 else (0.0,)


ROTOR = Shape("rotor", ("kg m^2", "kg"), rotors, continuous=(False, False), default=0.0, movable=True)
"""Shape of effects that depend on what the gear hands on."""
