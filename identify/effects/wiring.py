"""Mistakes of recorded signals: wrong sign, wrong drive or column, wrong scale."""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from armident.arrays import Array
from armident.configs import ConfigError, RobotConfig
from armident.configs.schema.robot import Effect as Entry
from armident.identify.effects.effect import POSITION, UNITLESS, Effect, Place, Scope, Shape, Shapes
from armident.identify.robot.motion import Motion
from armident.identify.signals.experiments import Experiment
from armident.identify.signals.streamed import mapped

SIGNALS = ("position", "torque")
"""Parameters of these effects: a value of 1 selects the signal; of `signal_scale` it is the factor."""

JOINT_SIDE = "joint_side"
"""Parameter with the value 1 where columns in SI units on the joint side are concerned, not raw numbers of drives."""


class SignalMistake(Effect):
    """Mistake of recorded signals, which adds no torque."""

    linear = ()

    def columns(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> Array:
        """Return no columns."""
        return np.zeros((motion.samples, 0))

    def corrects(self, entry: Entry) -> bool:
        """Return True."""
        return True

    def may_be_added(self, motion: Motion, place: Place, present: Sequence[Shapes]) -> bool:
        """Return False: it is no term of a model."""
        return False


class Wiring(SignalMistake):
    """Effect that exchanges signals or changes their signs or scales."""

    scope: Scope = "motor"

    @abstractmethod
    def _exchange(self, n: int, first: int, second: int, value: float) -> Array:
        """Return the matrix (n, n) that corrects a signal; ``second`` is ``first`` without another joint."""

    def on_joint_side(self, entry: Entry) -> bool:
        """Return True if an entry concerns columns in SI units on the joint side, False for raw numbers of drives."""
        return bool(entry.parameters.get(JOINT_SIDE))


class SignError(Wiring):
    """Wrong sign of a signal."""

    name = "sign_error"
    title = "a signal with the wrong sign"
    description = "position or torque of a drive is read with the wrong sign: a swapped polarity, a wrong gear sign"
    reference = "CiA 402-2, object 607Eh (polarity)"
    required_motion = "motion against gravity or friction"
    settings = (
        Shape("position", UNITLESS, "1: the position signal has the wrong sign."),
        Shape("torque", UNITLESS, "1: the torque signal has the wrong sign."),
        Shape(JOINT_SIDE, UNITLESS, "1: the signals of the joint, in SI units, not those of the drive."),
    )

    def _exchange(self, n: int, first: int, second: int, value: float) -> Array:
        """Return a change of sign."""
        change = np.eye(n)
        change[first, first] = -1.0
        return change


class JointOrder(Wiring):
    """Exchange of the signals of two drives."""

    name = "joint_order"
    title = "two drives exchanged"
    description = "the signals of two drives are exchanged: swapped node numbers or plugs"
    reference = "CiA 301, node-ID; CiA 305"
    required_motion = "different motion of the joints"
    scope = "pair"
    settings = (
        Shape("position", UNITLESS, "1: the position signals are exchanged."),
        Shape("torque", UNITLESS, "1: the torque signals are exchanged."),
        Shape(JOINT_SIDE, UNITLESS, "1: columns of the joints, in SI units, not raw numbers of the drives."),
    )

    def _exchange(self, n: int, first: int, second: int, value: float) -> Array:
        """Return a permutation."""
        change = np.eye(n)
        change[[first, second]] = change[[second, first]]
        return change


class SignalScale(Wiring):
    """Wrong scale of a signal."""

    name = "signal_scale"
    title = "a signal with the wrong scale"
    description = (
        "position or torque of a joint is recorded in another unit, on the other side of the gear, or with "
        "another gear ratio; the value is true over recorded"
    )
    reference = "Brunot 2017, equation 2.14"
    required_motion = "motion of the neighbouring joints"
    settings = (
        Shape("position", UNITLESS, "True over recorded position; with another joint, the share of it to add."),
        Shape("torque", UNITLESS, "True over recorded torque; with another joint, the share of it to add."),
    )

    def _exchange(self, n: int, first: int, second: int, value: float) -> Array:
        """Return the factor of the joint, or of the other joint's signal that is added."""
        change = np.eye(n)
        change[first, second] = value
        return change

    def on_joint_side(self, entry: Entry) -> bool:
        """Return True."""
        return True


class PositionOffset(SignalMistake):
    """Another zero of the encoder than that of the model."""

    name = "position_offset"
    title = "a position with another zero"
    description = "the encoder's zero is not the model's: a joint homed at another mark, an encoder mounted again"
    reference = "CiA 402-2, object 607Ch (home offset)"
    required_motion = "motion of the joints beyond it, with the joint at several positions"
    settings = (Shape("offset", POSITION, "True less recorded position of the joint, on the joint side."),)


BY_NAME = {wiring.name: wiring() for wiring in Wiring.__subclasses__()}


def with_zeros(experiments: Sequence[Experiment], robot: RobotConfig) -> Sequence[Experiment]:
    """Return the experiments with the zeros of the configured position offsets."""
    names = [joint.name for joint in robot.joints]
    offsets = np.zeros(robot.n)
    for entry in robot.effects:
        if entry.effect == PositionOffset.name:
            offsets[names.index(entry.joint)] += entry.parameters.get("offset", 0.0)
    if not offsets.any():
        return experiments
    return mapped(
        lambda e: replace(e, q=e.q + offsets, q_ref=None if e.q_ref is None else e.q_ref + offsets), experiments
    )


def rewired(experiments: Sequence[Experiment], robot: RobotConfig) -> Sequence[Experiment]:
    """Return the experiments corrected for wiring errors; ConfigError if an entry lacks signal or other joint."""
    position, torque = exchanges(robot)
    if np.array_equal(position, np.eye(robot.n)) and np.array_equal(torque, np.eye(robot.n)):
        return experiments
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

    Raw values are exchanged, while the scaling belongs to the drive: signed permutations, scaled where drives differ.
    ``joint_side: 1`` and `signal_scale` concern SI columns on the joint side, as after an import. `signal_scale` with
    an ``other`` joint adds a multiple of its signal. Entries act one after the other, which expresses any permutation.
    """
    names = [joint.name for joint in robot.joints]
    worth = {"position": _per_count(robot), "torque": _per_share(robot)}
    ratios = robot.transmission_matrix
    to_motor = {"position": ratios, "torque": np.linalg.inv(ratios).T}
    found = {signal: np.eye(robot.n) for signal in SIGNALS}
    for k, entry in enumerate(robot.effects):
        effect = BY_NAME.get(entry.effect)
        if effect is None:
            continue
        where = f"effects[{k}]: {entry.effect} of {entry.joint}"
        meant = [signal for signal in SIGNALS if entry.parameters.get(signal)]
        if not meant:
            raise ConfigError(f"{where} needs position: 1, torque: 1 or both")
        if effect.two_joints and entry.other is None:
            raise ConfigError(f"{where} needs the other joint")
        first, second = names.index(entry.joint), names.index(entry.other or entry.joint)
        for signal in meant:
            change = effect._exchange(robot.n, first, second, entry.parameters[signal])
            if effect.on_joint_side(entry):
                change = to_motor[signal] @ change @ np.linalg.inv(to_motor[signal])
            else:
                change = change * worth[signal][:, None] / worth[signal]
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
