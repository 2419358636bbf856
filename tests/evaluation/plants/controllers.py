"""Controllers of random arms: cascade, PID, with velocity feed-forward, with filtered velocity."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from armident.virtual_robot.drawn_parameters import log_uniform
from tests.evaluation.plants import slots
from tests.evaluation.plants.arm import Arm, Generator
from tests.evaluation.plants.halves import Ranges

Floats = NDArray[np.float64]
ControllerKind = Literal["cascade", "pid", "feed_forward", "filtered"]
KINDS: tuple[ControllerKind, ...] = ("cascade", "pid", "feed_forward", "filtered")

WINDOW_S = 1e-3
"""Time over which the encoder is differenced for the velocity, s."""
FILTER_HZ = 120.0
"""Cut-off of the filtered velocity, Hz."""
LIMIT_FACTOR = 12.0
"""Torque limit over the torque scale of the joint."""
CHATTER = 0.03
"""Torque noise from one encoder step through the velocity loop, over the torque scale of the joint."""


def random_controller(rng: Generator, arm: Arm, kind: ControllerKind, ranges: Ranges, step: float) -> Floats:
    """Draw the gains of one controller for each joint.

    ``kind``: family of the controller; ``ranges``: ranges of the half. Returns the table of `CONTROLLERS`, shape
    (n, .).
    """
    n = arm.n
    table = np.zeros((n, len(slots.CONTROLLERS)))
    natural = 2.0 * np.pi * log_uniform(rng, ranges.bandwidth, n)
    damping = rng.uniform(0.7, 1.1, n)
    proportional, rate = arm.diagonal * natural**2, 2.0 * damping * natural * arm.diagonal
    table[:, slots.WINDOW] = max(round(WINDOW_S / step), 1)
    table[:, slots.FILTER] = 1.0
    table[:, slots.LIMIT] = LIMIT_FACTOR * arm.scale
    if kind == "pid":
        table[:, slots.KP], table[:, slots.KV], table[:, slots.ONE_LOOP] = proportional, rate, 1.0
        table[:, slots.KI] = proportional * rng.uniform(0.3, 1.5)
        return table
    table[:, slots.KV] = rate
    table[:, slots.KP] = proportional / rate
    if rng.random() < 0.5:
        table[:, slots.KI] = rate * rng.uniform(0.5, 3.0)
    if kind == "feed_forward":
        table[:, slots.FEEDFORWARD] = rng.uniform(0.7, 1.0)
    if kind == "filtered":
        table[:, slots.FILTER] = 1.0 - np.exp(-2.0 * np.pi * FILTER_HZ * rng.uniform(0.7, 1.5) * step)
    return table


def finest_needed(arm: Arm, control: Floats) -> Floats:
    """Coarsest encoder step of each joint with which the velocity loop does not chatter, rad or m, shape (n,).

    ``control``: table of the controller.
    """
    return np.asarray(CHATTER * arm.scale * WINDOW_S / (control[:, slots.KV] * control[:, slots.FILTER]))
