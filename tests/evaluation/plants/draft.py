"""Healthy arm of a case with its controller, motions and noise, and its robot configuration."""

from dataclasses import dataclass, replace
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from armident.configs import RobotConfig
from armident.virtual_robot.drawn_parameters import log_uniform
from tests.evaluation.plants.arm import Arm, Generator, random_arm
from tests.evaluation.plants.controllers import KINDS, finest_needed, random_controller
from tests.evaluation.plants.halves import Ranges
from tests.evaluation.plants.motions import Motion, MotionKind, random_motion
from tests.evaluation.plants.plant import Plant, Run, healthy_plant, simulate

Floats = NDArray[np.float64]

CONTROL_HZ = 4000.0
"""Lowest rate of control and integration, Hz."""
REFERENCE = 0.75
"""Probability that the reference positions are recorded."""
SHARE_COLOURED = 0.5
"""Probability that the torque noise of a joint is coloured."""
LIMIT_FACTOR = 12.0
"""Torque limit of the configuration over the torque scale of the joint."""


@dataclass(frozen=True, eq=False)
class Draft:
    """A healthy arm with its motions, noise and first recording.

    Parameters
    ----------
    motions
        References of the recordings to learn from and to judge by.
    healthy
        Recording of the first motion, without torque noise.
    noise
        Standard deviation of the torque noise by joint, N m or N, shape (n,).
    poles
        Pole of the noise of first order by joint; 0 for white noise, shape (n,).
    controller, motion
        Family of the controller and of the motions.
    with_reference
        ``True`` if the reference positions are recorded.
    """

    seed: tuple[int, ...]
    plant: Plant
    motions: tuple[Motion, Motion]
    healthy: Run
    noise: Floats
    poles: Floats
    controller: str
    motion: MotionKind
    with_reference: bool

    @property
    def peak(self) -> Floats:
        """Largest torque of the healthy arm by joint, N m or N, shape (n,)."""
        return np.asarray(np.abs(self.healthy.torque).max(axis=0))

    @property
    def rate(self) -> float:
        """Sampling rate, Hz."""
        return round(1.0 / (self.plant.step * self.plant.every), 6)


def draw_draft(rng: Generator, ranges: Ranges, seed: tuple[int, ...]) -> Draft:
    """Draw a healthy arm with everything but a hidden effect.

    ``ranges``: ranges of the half. Raises Diverged if the drawn loop is not stable.
    """
    arm = random_arm(rng, ranges)
    rate = float(rng.choice(ranges.rates))
    every = max(int(np.ceil(CONTROL_HZ / rate)), 1)
    step = 1.0 / (rate * every)
    controller = KINDS[rng.integers(len(KINDS))]
    control = random_controller(rng, arm, controller, ranges, step)
    arm = replace(arm, resolution=np.minimum(arm.resolution, finest_needed(arm, control)))
    motion: MotionKind = get_args(MotionKind)[rng.integers(2)]
    duration = rng.uniform(*ranges.duration)
    first, second = (random_motion(rng, arm, motion, duration, step) for _ in range(2))
    plant = healthy_plant(arm, control, step, every)
    healthy = simulate(plant, first, (*seed, 10))
    noise = log_uniform(rng, ranges.noise, arm.n) * healthy.torque.std(axis=0)
    times = log_uniform(rng, ranges.noise_time, arm.n)
    poles = np.where(rng.random(arm.n) < SHARE_COLOURED, np.exp(-1.0 / (rate * times)), 0.0)
    reference = bool(rng.random() < REFERENCE)
    return Draft(seed, plant, (first, second), healthy, noise, poles, controller, motion, reference)


def noisy(draft: Draft, part: int, run: Run) -> Run:
    """Recording with the torque noise of the case.

    ``part``: 0 for the recording to learn from, 1 for the one to judge by.
    """
    rng = np.random.default_rng([*draft.seed, 3, part])
    noise = np.empty_like(run.torque)
    for j, pole in enumerate(draft.poles):
        drive = rng.normal(size=len(noise) + 400)
        noise[:, j] = draft.noise[j] * np.sqrt(1.0 - pole**2) * lfilter([1.0], [1.0, -pole], drive)[400:]
    return replace(run, torque=run.torque + noise)


def simulated(draft: Draft, plant: Plant, part: int) -> Run:
    """Simulate a motion of the case with another plant, and add the torque noise of the case.

    ``part``: 0 for the recording to learn from, 1 for the one to judge by.
    """
    return noisy(draft, part, simulate(plant, draft.motions[part], (*draft.seed, 10 + part)))


def configuration(arm: Arm, name: str) -> RobotConfig:
    """Robot configuration of a healthy arm."""
    joints: list[dict[str, Any]] = []
    for j in range(arm.n):
        alpha, d, theta, r = (float(x) for x in arm.mdh[j])
        limits = {
            "position": [-0.8, 0.8] if arm.prismatic[j] else [-3.1, 3.1],
            "velocity": 2.0 * float(arm.speed[j]),
            "acceleration": 100.0,
            "torque": LIMIT_FACTOR * float(arm.scale[j]),
        }
        joints.append(
            {
                "name": f"axis_{j + 1}",
                "type": "prismatic" if arm.prismatic[j] else "revolute",
                "mdh": {"alpha": alpha, "d": d, "theta": theta, "r": r},
                "limits": limits,
                "drive": {"signal": "torque"},
            }
        )
    return RobotConfig.model_validate(
        {
            "schema": "armident/robot/1",
            "name": f"arm_{name}",
            "gravity": [0.0, 0.0, -9.81],
            "joints": joints,
            "transmission": np.diag(arm.ratio).tolist(),
        }
    )
