"""Mistakes of wiring and naming: signals with the wrong sign, or of the wrong drive."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from configs import ConfigError, RobotConfig
from identify.catalogue.effect import Effect, Place
from identify.catalogue.motion import Motion
from identify.experiment import Experiment

Array = NDArray[np.float64]

SIGNALS = ("position", "torque")
"""Parameters of the stanzas of this file: which signal is meant, by a value of 1."""


def _none(motion: Motion, place: Place) -> Array:
    return np.zeros((motion.samples, 0))


EFFECTS = (
    Effect(
        name="sign_error",
        title="a signal with the wrong sign",
        says="position or torque of a drive is read with the wrong sign: a swapped polarity, a wrong gear sign",
        reference="CiA 402-2, object 607Eh (polarity)",
        linear=(),
        columns=_none,
        needs="motion against gravity or friction",
        scope="motor",
        rewires=True,
    ),
    Effect(
        name="joint_order",
        title="two drives exchanged",
        says="the signals of two drives stand in each other's place: swapped node numbers or plugs",
        reference="CiA 301, node-ID; CiA 305",
        linear=(),
        columns=_none,
        needs="different motion of the joints",
        scope="pair",
        rewires=True,
    ),
)
NAMES = tuple(effect.name for effect in EFFECTS)


def rewired(experiments: Sequence[Experiment], robot: RobotConfig) -> list[Experiment]:
    """The experiments as they would be without the wiring mistakes that a robot's effects name.

    Raises
    ------
    ConfigError
        If a stanza does not say which signal, or which other joint.
    """
    position, torque = permutations(robot)
    if np.array_equal(position, np.eye(robot.n)) and np.array_equal(torque, np.eye(robot.n)):
        return list(experiments)
    ratios = robot.transmission_matrix
    # Signals belong to the motors: exchanged there, and brought back to the joints.
    of_position = np.linalg.solve(ratios, position @ ratios)
    of_torque = np.linalg.inv(ratios) @ torque.T @ ratios
    return [
        replace(
            e,
            q=np.ascontiguousarray(e.q @ of_position.T),
            tau=np.ascontiguousarray(e.tau @ of_torque),
            q_ref=None if e.q_ref is None else np.ascontiguousarray(e.q_ref @ of_position.T),
        )
        for e in experiments
    ]


def permutations(robot: RobotConfig) -> tuple[Array, Array]:
    """Signed permutations (n, n) of the motors' positions and torques that undo the mistakes a robot's effects name."""
    names = [joint.name for joint in robot.joints]
    found = {signal: np.eye(robot.n) for signal in SIGNALS}
    for k, stanza in enumerate(robot.effects):
        if stanza.effect not in NAMES:
            continue
        meant = [signal for signal in SIGNALS if stanza.parameters.get(signal)]
        if not meant:
            raise ConfigError(f"effects[{k}]: {stanza.effect} of {stanza.joint} needs position: 1, torque: 1 or both")
        first = names.index(stanza.joint)
        for signal in meant:
            change = np.eye(robot.n)
            if stanza.effect == "sign_error":
                change[first, first] = -1.0
            else:
                if stanza.other is None:
                    raise ConfigError(f"effects[{k}]: joint_order of {stanza.joint} needs the other joint")
                second = names.index(stanza.other)
                change[[first, second]] = change[[second, first]]
            found[signal] = change @ found[signal]
    return found["position"], found["torque"]
