"""Mistakes of recorded signals: wrong sign, wrong drive or column, wrong scale."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from armident.configs import ConfigError, RobotConfig
from armident.identify.effects.effect import Effect, Place
from armident.identify.experiment import Experiment
from armident.identify.robot.motion import Motion

Array = NDArray[np.float64]

SIGNALS = ("position", "torque")
"""Parameters of these effects: a value of 1 selects the signal; of `signal_scale` it is the factor."""

JOINT_SIDE = "joint_side"
"""Parameter with the value 1 where columns in SI units on the joint side are concerned, not raw numbers of drives."""


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
        says="the signals of two drives are exchanged: swapped node numbers or plugs",
        reference="CiA 301, node-ID; CiA 305",
        linear=(),
        columns=_none,
        needs="different motion of the joints",
        scope="pair",
        rewires=True,
    ),
    Effect(
        name="signal_scale",
        title="a signal with the wrong scale",
        says="position or torque of a joint is recorded in another unit, on the other side of the gear, or with "
        "another gear ratio; the value is true over recorded",
        reference="Brunot 2017, equation 2.14",
        linear=(),
        columns=_none,
        needs="motion of the neighbouring joints",
        scope="motor",
        rewires=True,
    ),
)
NAMES = tuple(effect.name for effect in EFFECTS)


def rewired(experiments: Sequence[Experiment], robot: RobotConfig) -> list[Experiment]:
    """Return the experiments corrected for the wiring errors of a robot's configuration.

    Parameters
    ----------
    experiments
        As recorded.
    robot
        Configuration with the effect entries.

    Raises
    ------
    ConfigError
        If an entry does not name the signal or the other joint.
    """
    position, torque = exchanges(robot)
    if np.array_equal(position, np.eye(robot.n)) and np.array_equal(torque, np.eye(robot.n)):
        return list(experiments)
    ratios = robot.transmission_matrix
    # Signals are those of the motors: exchanged there, then converted back to the joints.
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


def exchanges(robot: RobotConfig) -> tuple[Array, Array]:
    """Return the matrices (n, n) that correct the motors' positions and torques for the configured wiring errors.

    Raw values (counts, shares of the rated signal) are exchanged, while the scaling belongs to the drive. So these are
    signed permutations, scaled where two drives differ in resolution, gain or rating. With ``joint_side: 1`` columns in
    SI units on the joint side are concerned, as they are after an import; `signal_scale` always acts on these, and
    with an ``other`` joint adds a multiple of its signal. Several entries act one after the other: exchanges express
    any permutation.

    Raises
    ------
    ConfigError
        If an entry does not name the signal or the other joint.
    """
    names = [joint.name for joint in robot.joints]
    worth = {"position": _per_count(robot), "torque": _per_share(robot)}
    ratios = robot.transmission_matrix
    to_motor = {"position": ratios, "torque": np.linalg.inv(ratios).T}
    found = {signal: np.eye(robot.n) for signal in SIGNALS}
    for k, entry in enumerate(robot.effects):
        if entry.effect not in NAMES:
            continue
        meant = [signal for signal in SIGNALS if entry.parameters.get(signal)]
        if not meant:
            raise ConfigError(f"effects[{k}]: {entry.effect} of {entry.joint} needs position: 1, torque: 1 or both")
        first = names.index(entry.joint)
        joint_side = bool(entry.parameters.get(JOINT_SIDE)) or entry.effect == "signal_scale"
        for signal in meant:
            change = np.eye(robot.n)
            if entry.effect == "sign_error":
                change[first, first] = -1.0
            elif entry.effect == "signal_scale":
                second = first if entry.other is None else names.index(entry.other)
                change[first, second] = entry.parameters[signal]
            else:
                if entry.other is None:
                    raise ConfigError(f"effects[{k}]: joint_order of {entry.joint} needs the other joint")
                second = names.index(entry.other)
                change[[first, second]] = change[[second, first]]
                if not joint_side:
                    change = change * worth[signal][:, None] / worth[signal]
            if joint_side:
                change = to_motor[signal] @ change @ np.linalg.inv(to_motor[signal])
            found[signal] = change @ found[signal]
    return found["position"], found["torque"]


def raw_scales(robot: RobotConfig) -> tuple[Array, Array]:
    """Return the motor position per count, rad or m, and the motor torque at the rated signal, N m or N, (n,) each."""
    return _per_count(robot), _per_share(robot)


def _per_count(robot: RobotConfig) -> Array:
    """Return the position of each motor per count (n,), rad or m; ones where positions come in SI."""
    if any(joint.drive.counts_per_unit is None for joint in robot.joints):
        return np.ones(robot.n)
    turn = np.array([2 * np.pi if joint.type == "revolute" else 1.0 for joint in robot.joints])
    counts: Array = np.array([joint.drive.counts_per_unit for joint in robot.joints], dtype=np.float64)
    return turn / counts


def _per_share(robot: RobotConfig) -> Array:
    """Return the torque of each motor at its rated signal (n,), N m or N."""
    drives = [joint.drive for joint in robot.joints]
    return np.array([d.rated * (d.gain if d.signal != "torque" and d.gain else 1.0) for d in drives])
