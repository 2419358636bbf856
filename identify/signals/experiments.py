"""Joint positions and torques of experiments on an even time grid."""

from collections.abc import Sequence
from dataclasses import dataclass
from shlex import quote

from armident.arrays import Array
from armident.configs import DataError


@dataclass(frozen=True)
class Experiment:
    """Signals (N, n) of a recording as the estimators use them: SI units, joint side, no gaps.

    ``tau``: sample k is held over ``[k, k + 1)``, as a digital drive applies it. ``start``: time since the recordings
    began, s, for friction that depends on temperature. ``torque_shift``: samples by which all torques are late
    (negative: early); only the equations of motion are aligned with it. ``source``: path, or empty.
    """

    q: Array
    tau: Array
    q_ref: Array | None
    dt: float
    start: float = 0.0
    torque_shift: float = 0.0
    source: str = ""


RATE_TOLERANCE = 1e-6
"""Relative difference of sampling rates that are the same: rounding of time stamps makes so much."""


def check_one_rate(experiments: Sequence[Experiment]) -> None:
    """Raise DataError, with the commands that resample, if experiments have different sampling rates."""
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
