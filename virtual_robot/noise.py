"""Noise with measured variances: white noise on the measured signal, and a slow disturbance torque on the arm."""

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from armident.arrays import Array
from armident.configs import RobotConfig


@dataclass(frozen=True)
class NoiseSize:
    """Variances of the joint torque's noise, (N m)^2 or N^2; ``decimated``: of the part below 20 Hz."""

    sampled: tuple[float, ...]
    decimated: tuple[float, ...]


RESIDUAL_VARIANCE = (34.35, 21.01, 4.198, 0.4400, 1.425, 0.5057)
"""Variance of the joint torque residual as sampled, (N m)^2 (thesis table 6.3, without decimation)."""
DECIMATED_VARIANCE = (1.537, 1.793, 0.9120, 0.2199, 0.6207, 0.2523)
"""Variance of the joint torque residual below the cut-off of the decimation, (N m)^2 (thesis table 6.3)."""
SIZES = {
    "tx40": NoiseSize(RESIDUAL_VARIANCE, DECIMATED_VARIANCE),
    "emps": NoiseSize((0.346,), (0.0708,)),
}
"""Noise by virtual arm. EMPS: the measured arm repeats a reference of 6.24 s three times. The noise is the part of the
published model's residual that differs between repetitions, 0.588 N in all and 0.266 N below 20 Hz. The repeated part,
2.4 and 1.9 N, is model error and not part of the noise."""
DECIMATION_HZ = 20.0
"""Cut-off of the decimation of table 6.3, Hz."""
DISTURBANCE_HZ = 20.0
"""Corner of the first-order spectrum of the disturbance, Hz: nearly white after decimation, as the thesis found."""
BLOCK = 1024
"""Number of control periods whose noise is drawn at once."""


class Noise:
    """Reproducible noise of one arm, by control period.

    A white and a slow part together have the sampled variance, their parts below the cut-off the decimated one.
    ``level``: factor on amplitudes. The mean of a signal over ``averaged`` periods has the sampled variance.
    """

    def __init__(
        self,
        robot: RobotConfig,
        period: float,
        seed: int,
        level: float = 1.0,
        size: NoiseSize | None = None,
        averaged: int = 1,
    ) -> None:
        n = robot.n
        white, slow = amplitudes(robot, period, size, averaged)
        gain = np.array([joint.drive.gain for joint in robot.joints])
        self._current = level * white / np.abs(gain)
        self._disturbance = level * slow
        self._keep = float(np.exp(-2 * np.pi * DISTURBANCE_HZ * period))
        self._random = np.random.default_rng(seed)
        self._last = self._disturbance * self._random.standard_normal(n)
        self._row = BLOCK
        self.current: Array = np.zeros((BLOCK, n))
        self.disturbance: Array = np.zeros((BLOCK, n))

    def next(self) -> tuple[Array, Array]:
        """Noise on the measured signals (A or V) and disturbance torques (N m, joint side), shape (n,) each."""
        if self._row == BLOCK:
            self._refill()
        self._row += 1
        return self.current[self._row - 1], self.disturbance[self._row - 1]

    def _refill(self) -> None:
        n = self._last.size
        self.current[:] = self._random.standard_normal((BLOCK, n)) * self._current
        fresh = self._random.standard_normal((BLOCK, n)) * (self._disturbance * np.sqrt(1 - self._keep**2))
        self.disturbance[:], state = lfilter([1.0], [1.0, -self._keep], fresh, axis=0, zi=self._keep * self._last[None])
        self._last = state[0] / self._keep
        self._row = 0


def amplitudes(
    robot: RobotConfig, period: float, size: NoiseSize | None = None, averaged: int = 1
) -> tuple[Array, Array]:
    """Standard deviations (n,) of both parts of the noise, N m or N.

    White: torque of a motor, motor side, mean of ``averaged`` periods. Slow: torque of a joint, corner
    `DISTURBANCE_HZ`.
    """
    size = SIZES[robot.name] if size is None else size
    total, low = np.array(size.sampled), np.array(size.decimated)
    white_low = DECIMATION_HZ * 2 * period * averaged
    slow_low = 2 / np.pi * np.arctan(DECIMATION_HZ / DISTURBANCE_HZ)
    slow = np.clip((low - white_low * total) / (slow_low - white_low), 0.0, None)
    motor = np.linalg.solve(robot.transmission_matrix.T**2, np.maximum(total - slow, 0.0))
    return np.sqrt(averaged * np.maximum(motor, 0.0)), np.sqrt(slow)
