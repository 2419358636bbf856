"""Joint positions and torques of experiments on an even time grid."""

from collections.abc import Sequence
from dataclasses import dataclass
from shlex import quote

import numpy as np
from numpy.typing import NDArray

from armident.configs import DataError


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
    start
        Time of the first sample since the recordings began, s, for friction that depends on temperature.
    torque_shift
        Samples by which all torques are late against this convention; negative: early. The equations of motion are
        aligned with it, and everything else takes the torque as recorded.
    source
        Path of the recording; empty where there is no file.
    """

    q: NDArray[np.float64]
    tau: NDArray[np.float64]
    q_ref: NDArray[np.float64] | None
    dt: float
    start: float = 0.0
    torque_shift: float = 0.0
    source: str = ""


RATE_TOLERANCE = 1e-6
"""Relative difference of sampling rates that are the same: rounding of time stamps makes so much."""


def check_one_rate(experiments: Sequence[Experiment]) -> None:
    """Refuse experiments of different sampling rates, with the commands that resample their recordings.

    ``experiments``: experiments to use together. Raises DataError if the sampling rates differ.
    """
    lowest = max(e.dt for e in experiments)
    if all(lowest - e.dt <= RATE_TOLERANCE * lowest for e in experiments):
        return
    rates = {e.source or f"experiment {k}": e.dt for k, e in enumerate(experiments, start=1)}
    found = ", ".join(f"{name} {_hz(dt)} Hz" for name, dt in rates.items())
    # Resampling to a higher rate adds no information.
    target = _hz(lowest)
    faster = dict.fromkeys(e.source for e in experiments if e.source and lowest - e.dt > RATE_TOLERANCE * lowest)
    commands = []
    for path in faster:
        out = f"{path.removesuffix('.mcap')}_{target}Hz.mcap"
        commands.append(f"armident import {quote(path)} --rate {target} --out {quote(out)}")
    remedy = "resample to the lowest: " + "; ".join(commands) if commands else f"resample them to {target} Hz"
    raise DataError(f"the recordings have different sampling rates ({found}): {remedy}")


def _hz(dt: float) -> str:
    """Sampling rate as text, without a rounding error of the period."""
    return f"{1.0 / dt:.10g}"
