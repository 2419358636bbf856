"""Joint positions and torques of an experiment on an even time grid."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Experiment:
    """Signals of a recording as the estimators use them: SI units, joint side, no gaps.

    Parameters
    ----------
    q
        Measured joint positions, shape (N, n), rad or m.
    tau
        Joint torques from the drives' signals, shape (N, n), N m or N. Sample k is the torque held
        over ``[k, k + 1)`` sampling periods, as a digital drive applies it.
    q_ref
        Reference positions, shape (N, n), or ``None`` where none was recorded.
    dt
        Sampling period, s.
    start
        Time of the first sample since the recordings began, s, for friction that depends on temperature.
    torque_shift
        Samples by which all torques are late against this convention; negative: early. The equations of motion are
        aligned with it, and everything else takes the torque as recorded.
    """

    q: NDArray[np.float64]
    tau: NDArray[np.float64]
    q_ref: NDArray[np.float64] | None
    dt: float
    start: float = 0.0
    torque_shift: float = 0.0
