"""Mistakes of wiring, units and configuration: the arm is healthy, and its recording says something else."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from armident.virtual_robot.drawn_parameters import log_uniform
from tests.evaluation.plants.arm import Arm, Generator
from tests.evaluation.plants.effects import rotated
from tests.evaluation.plants.plant import Plant, Run

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class SetUp:
    """Changes by a set-up mistake: the plant's readings, the recording, and the joints concerned.

    ``joints``: numbers of the joints; empty for the whole arm. ``plant``: changes the plant of the healthy arm and its
    largest torques (n,). ``detail``: description with figures.
    """

    joints: tuple[int, ...]
    plant: Callable[[Plant, Floats], Plant] = lambda plant, peak: plant
    recorded: Callable[[Run], Run] = lambda run: run
    detail: str = ""


Draw = Callable[[Generator, Arm], SetUp | None]
"""Draws a mistake; ``None`` if the arm has no place for it."""


def scaled(run: Run, position: Floats | float = 1.0, torque: Floats | float = 1.0, time: float = 1.0) -> Run:
    """Recording in other units.

    ``position``, ``torque``, ``time``: factors of positions (n,), torques (n,) and times.
    """
    return Run(
        run.t * time, run.q * position, run.qd * position / time, run.qdd * position / time**2, run.reading * position,
        run.torque * torque, run.reference * position,
    )  # fmt: skip


def _some(rng: Generator, n: int, most: int) -> NDArray[np.int64]:
    return np.sort(rng.permutation(n)[: rng.integers(1, min(most, n) + 1)])


def _factors(n: int, joints: NDArray[np.int64], value: Floats | float) -> Floats:
    out = np.ones(n)
    out[joints] = value
    return out


def _signs(position: bool, torque: bool) -> Draw:
    def draw(rng: Generator, arm: Arm) -> SetUp:
        joints = _some(rng, arm.n, 2)
        flip = _factors(arm.n, joints, -1.0)
        return SetUp(
            tuple(joints.tolist()), recorded=lambda run: scaled(run, flip if position else 1.0, flip if torque else 1.0)
        )

    return draw


def _all_signs(rng: Generator, arm: Arm) -> SetUp:
    return SetUp(tuple(range(arm.n)), recorded=lambda run: scaled(run, 1.0, -1.0))


def _permutation(rng: Generator, n: int) -> NDArray[np.int64]:
    """Exchange of two joints, or a permutation of all of them."""
    order = np.arange(n)
    if n == 2 or rng.random() < 0.6:
        i, j = rng.permutation(n)[:2]
        order[[i, j]] = j, i
        return order
    while np.array_equal(order, np.arange(n)):
        order = rng.permutation(n)
    return order


def _order(torque_alone: bool) -> Draw:
    def draw(rng: Generator, arm: Arm) -> SetUp | None:
        if not torque_alone and np.ptp(arm.prismatic):
            return None
        order = _permutation(rng, arm.n)

        def recorded(run: Run) -> Run:
            if torque_alone:
                return replace(run, torque=run.torque[:, order])
            return Run(
                run.t, run.q[:, order], run.qd[:, order], run.qdd[:, order], run.reading[:, order],
                run.torque[:, order], run.reference[:, order],
            )  # fmt: skip

        joints = tuple(np.flatnonzero(order != np.arange(arm.n)).tolist())
        return SetUp(joints, recorded=recorded, detail="order " + " ".join(str(k + 1) for k in order))

    return draw


def _degrees(rng: Generator, arm: Arm) -> SetUp | None:
    joints = np.flatnonzero(arm.prismatic == 0)
    if not joints.size:
        return None
    factor = _factors(arm.n, joints, 180.0 / np.pi)
    return SetUp(tuple(joints.tolist()), recorded=lambda run: scaled(run, factor))


def _torque_unit(rng: Generator, arm: Arm) -> SetUp:
    factor, word = [(1e3, "mN m"), (1e-3, "kN m")][rng.integers(2)]
    return SetUp(tuple(range(arm.n)), recorded=lambda run: scaled(run, 1.0, factor), detail=word)


def _milliamperes(rng: Generator, arm: Arm) -> SetUp:
    """Motor currents in mA, although the configuration says torque of the joint."""
    constant = log_uniform(rng, (0.03, 0.5), arm.n)
    factor = 1e3 / (constant * arm.ratio)
    return SetUp(tuple(range(arm.n)), recorded=lambda run: scaled(run, 1.0, factor), detail="mA of the motor")


def _per_mille(rng: Generator, arm: Arm) -> SetUp:
    factor = 1e3 / (arm.scale * rng.uniform(1.5, 4.0, arm.n))
    return SetUp(tuple(range(arm.n)), recorded=lambda run: scaled(run, 1.0, factor), detail="per mille of rated torque")


def _milliseconds(rng: Generator, arm: Arm) -> SetUp:
    return SetUp((), recorded=lambda run: scaled(run, time=1e3))


def _side(position: bool, torque: bool) -> Draw:
    def draw(rng: Generator, arm: Arm) -> SetUp:
        joints = np.arange(arm.n) if rng.random() < 0.7 else _some(rng, arm.n, 2)
        factor = _factors(arm.n, joints, arm.ratio[joints])
        return SetUp(
            tuple(joints.tolist()),
            recorded=lambda run: scaled(run, factor if position else 1.0, 1.0 / factor if torque else 1.0),
        )

    return draw


def _gear_ratio(rng: Generator, arm: Arm) -> SetUp:
    """Wrong ratio of a joint: its position is too large by a factor, and its torque too small by the same."""
    joints = _some(rng, arm.n, 1)
    wrong = float(rng.choice([0.5, 2.0, rng.uniform(0.4, 0.8), rng.uniform(1.25, 2.5)]))
    factor = _factors(arm.n, joints, wrong)
    return SetUp(tuple(joints.tolist()), recorded=lambda run: scaled(run, factor, 1.0 / factor), detail=f"{wrong:.3g}")


def _all_late(rng: Generator, arm: Arm) -> SetUp:
    delay = log_uniform(rng, (4e-3, 3e-2))
    return SetUp(
        (), plant=lambda plant, peak: replace(plant, delay=plant.delay + delay), detail=f"{1e3 * delay:.1f} ms"
    )


def _gravity_missing(rng: Generator, arm: Arm) -> SetUp:
    return SetUp((), plant=lambda plant, peak: replace(plant, without_gravity=True))


def _clipped(rng: Generator, arm: Arm) -> SetUp:
    joints = _some(rng, arm.n, 2)
    share = rng.uniform(0.45, 0.8)

    def change(plant: Plant, peak: Floats) -> Plant:
        clip = plant.clip.copy()
        clip[joints] = share * peak[joints]
        return replace(plant, clip=clip)

    return SetUp(tuple(joints.tolist()), plant=change, detail=f"{100 * share:.0f} % of the peak")


def _another_gravity(rng: Generator, arm: Arm) -> SetUp:
    """Wall, ceiling, or any other mounting; the configuration says floor."""
    if rng.random() < 0.7:
        direction = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]], np.float64)[rng.integers(5)]
        gravity = 9.81 * direction
    else:
        heading = rng.uniform(0.0, 2.0 * np.pi)
        axis = np.array([np.cos(heading), np.sin(heading), 0.0])
        gravity = rotated(arm.gravity, axis, rng.uniform(0.5, 2.6))
    detail = "gravity " + " ".join(f"{g:.2f}" for g in gravity)
    return SetUp((), plant=lambda plant, peak: replace(plant, arm=replace(plant.arm, gravity=gravity)), detail=detail)


MISTAKES: dict[str, Draw] = {
    "another_gravity": _another_gravity,
    "position_sign": _signs(True, False),
    "torque_sign": _signs(False, True),
    "both_signs": _signs(True, True),
    "all_torque_signs": _all_signs,
    "joint_order": _order(False),
    "torque_order": _order(True),
    "degrees": _degrees,
    "torque_unit": _torque_unit,
    "milliamperes": _milliamperes,
    "per_mille": _per_mille,
    "milliseconds": _milliseconds,
    "motor_side_position": _side(True, False),
    "motor_side_torque": _side(False, True),
    "gear_ratio": _gear_ratio,
    "all_late": _all_late,
    "gravity_missing": _gravity_missing,
    "clipped": _clipped,
}
"""Set-up mistakes by kind."""
