"""A plant of the suite: arm, hidden laws, controller, motion and readings, and its simulation."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armident.configs import ArmidentError
from tests.evaluation.plants.arm import Arm, Generator
from tests.evaluation.plants.bodies import evaluate
from tests.evaluation.plants.motions import Motion
from tests.evaluation.plants.simulate import run
from tests.evaluation.plants.slots import (
    ECCENTRICITY,
    ECCENTRICITY_ORDER,
    ECCENTRICITY_PHASE,
    GEARS,
    LAWS,
    PAIRS,
)

Floats = NDArray[np.float64]
External = Callable[[Generator, Floats], Floats]
"""Torque on a link by time, of a source of random numbers and the times."""


class Diverged(ArmidentError):
    """The closed loop of a drawn arm is not stable."""


@dataclass(frozen=True, eq=False)
class Plant:
    """Everything that a recording is simulated from; SI, joint side.

    Parameters
    ----------
    arm
        The arm; gravity as it acts.
    laws
        Table of `LAWS`, shape (n, .).
    control
        Table of `CONTROLLERS`, shape (n, .).
    step
        Step of integration and control, s.
    every
        Steps per sample of the recording.
    gears, pairs
        Tables of `GEARS` and `PAIRS`.
    external
        Torques on the links from outside, by joint.
    saturation
        Torque at which the reading of a joint saturates softly, N m or N, shape (n,); infinite without.
    gain
        Reading over torque, shape (n,).
    delay
        Delay of the torque readings, s, shape (n,).
    clip
        Largest torque reading, N m or N, shape (n,); infinite without.
    without_gravity
        ``True`` if the readings are without the torque of gravity.
    """

    arm: Arm
    laws: Floats
    control: Floats
    step: float
    every: int
    gears: Floats
    pairs: Floats
    saturation: Floats
    gain: Floats
    delay: Floats
    clip: Floats
    external: dict[int, External] = field(default_factory=dict)
    without_gravity: bool = False


@dataclass(frozen=True, eq=False)
class Run:
    """One simulated recording at its sampling instants; SI, joint side.

    ``t``: times, s, shape (M,); ``q``, ``qd``, ``qdd``: True motion as the encoders see it, without their steps, shape
    (M, n); ``reading``: encoder readings, shape (M, n); ``torque``: torque readings without noise, shape (M, n);
    ``reference``: reference positions, shape (M, n).
    """

    t: Floats
    q: Floats
    qd: Floats
    qdd: Floats
    reading: Floats
    torque: Floats
    reference: Floats


def healthy_plant(arm: Arm, control: Floats, step: float, every: int) -> Plant:
    """Plant of a healthy arm.

    ``control``: table of the controller; ``step``: step of integration and control, s; ``every``: steps per sample.
    """
    n = arm.n
    never = np.full(n, np.inf)
    return Plant(
        arm, arm.laws.copy(), control, step, every, np.zeros((0, len(GEARS))), np.zeros((0, len(PAIRS))), never,
        np.ones(n), np.zeros(n), never,
    )  # fmt: skip


def simulate(plant: Plant, motion: Motion, seed: tuple[int, ...]) -> Run:
    """Simulate a recording.

    ``motion``: reference at every step; ``seed``: seed of the torques from outside. Raises Diverged if the loop is not
    stable.
    """
    arm, K, n = plant.arm, motion.position.shape[0], plant.arm.n
    t = np.arange(K, dtype=np.float64) * plant.step
    outside = np.zeros((K, n))
    for j, push in plant.external.items():
        outside[:, j] = push(np.random.default_rng([*seed, j]), t)
    position, velocity, acceleration, reading, torque = (np.zeros((K, n)) for _ in range(5))
    arguments = (
        plant.step, arm.gravity, *arm.bodies, arm.rotor, plant.laws, plant.gears, plant.pairs, outside, arm.resolution,
        plant.control, motion.position, motion.velocity, position, velocity, acceleration, reading, torque,
    )  # fmt: skip
    done = run(*arguments)
    if done < K or np.abs(motion.position - position).max() > 0.5:
        raise Diverged("random arm: the closed loop is not stable")
    rows = slice(0, K, plant.every)
    late = _late(t, torque, plant.delay, rows)
    if plant.without_gravity:
        still = np.zeros(n)
        late -= np.array([evaluate(q, still, arm.gravity, *arm.bodies)[1] for q in position[rows]])
    q, qd, qdd = _seen(plant.laws, position[rows], velocity[rows], acceleration[rows])
    return Run(t[rows], q, qd, qdd, reading[rows], _read(plant, late), motion.position[rows])


def _late(t: Floats, torque: Floats, delay: Floats, rows: slice) -> Floats:
    out = torque[rows].copy()
    for j in np.flatnonzero(delay):
        out[:, j] = np.interp(t[rows] - delay[j], t, torque[:, j])
    return out


def _read(plant: Plant, torque: Floats) -> Floats:
    out = torque.copy()
    for j in np.flatnonzero(np.isfinite(plant.saturation)):
        out[:, j] = plant.saturation[j] * np.tanh(out[:, j] / plant.saturation[j])
    return np.clip(out * plant.gain, -plant.clip, plant.clip)


def _seen(laws: Floats, q: Floats, qd: Floats, qdd: Floats) -> tuple[Floats, Floats, Floats]:
    """Motion as eccentric encoders see it, without their steps."""
    q, qd, qdd = q.copy(), qd.copy(), qdd.copy()
    for j in np.flatnonzero(laws[:, ECCENTRICITY]):
        e, order, phase = laws[j, [ECCENTRICITY, ECCENTRICITY_ORDER, ECCENTRICITY_PHASE]]
        angle = order * q[:, j] + phase
        q[:, j] += e * np.sin(angle)
        slope = 1.0 + e * order * np.cos(angle)
        qdd[:, j] = qdd[:, j] * slope - qd[:, j] ** 2 * e * order**2 * np.sin(angle)
        qd[:, j] *= slope
    return q, qd, qdd


def with_law(plant: Plant, joint: int, **values: float) -> Plant:
    """Plant with other values in the law table. ``**values``: values by name of the column."""
    laws = plant.laws.copy()
    for name, value in values.items():
        laws[joint, LAWS.index(name)] = value
    return replace(plant, laws=laws)


def with_entry(plant: Plant, name: str, joint: int, value: float) -> Plant:
    """Plant with another value of one joint in one of its arrays (n,). ``name``: name of the array."""
    array = np.array(getattr(plant, name), np.float64)
    array[joint] = value
    changes: dict[str, Any] = {name: array}
    return replace(plant, **changes)
