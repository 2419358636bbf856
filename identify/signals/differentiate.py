"""Velocity and acceleration from measured positions, aligned to the samples."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from configs import DataError
from identify.signals.bandpass import butterworth, central_difference
from identify.signals.irwsm import irwsm, optimal_nvr

Method = Literal["irwsm", "irwsm2", "bandpass"]

NVR_BY_HAND = 1e-5
"""The thesis's manual choice (section 5.3.1)."""


@dataclass(frozen=True)
class Derivatives:
    """Positions and their derivatives at the sampling instants, shape (N, n) each.

    ``nvr`` has shape (n, 2) for ``irwsm`` (first and second pass), (n, 1) for ``irwsm2``, ``None`` for ``bandpass``.
    """

    q: NDArray[np.float64]
    qd: NDArray[np.float64]
    qdd: NDArray[np.float64]
    nvr: NDArray[np.float64] | None


def differentiate(
    q: NDArray[np.float64],
    dt: float,
    derivatives: Method = "irwsm",
    nvr: float | Sequence[float] | None = None,
    bandwidth_hz: float | None = None,
) -> Derivatives:
    """Differentiate measured positions twice.

    Parameters
    ----------
    q
        Measured positions, shape (N, n), rad or m.
    dt
        Sampling period, s.
    derivatives
        ``irwsm``: IRWSM 1, the level-slope smoother applied twice; ``irwsm2``: IRWSM 2, three states at once;
        ``bandpass``: zero-phase Butterworth of order 4 at five times ``bandwidth_hz``, then central differences.
    nvr
        Noise-variance ratio, one for all joints or one per joint; ``None``: by likelihood.
    bandwidth_hz
        Closed-loop bandwidth, Hz; needed by ``bandpass``.

    Notes
    -----
    The slope state is the forward difference of the level and belongs half a sample later. IRWSM 1 therefore
    yields velocity midway between samples, whose smoothed difference is an acceleration at the sample; the
    velocity at the sample is the mean of its two neighbours.

    Raises
    ------
    DataError
        If a series is too short or not finite, or ``bandpass`` lacks the bandwidth.
    """
    if derivatives == "bandpass":
        if bandwidth_hz is None:
            raise DataError("derivatives bandpass: the closed-loop bandwidth is unknown; set bandwidth_hz or use irwsm")
        smooth = butterworth(q, dt, min(5 * bandwidth_hz, 0.45 / dt))
        qd = central_difference(smooth, dt)
        return Derivatives(smooth, qd, central_difference(qd, dt), None)
    n = q.shape[1]
    given: list[float | None]
    if nvr is None:
        given = [None] * n
    else:
        given = [float(v) for v in np.broadcast_to(np.asarray(nvr, dtype=np.float64), (n,))]
    one = _irwsm1 if derivatives == "irwsm" else _irwsm2
    columns = [one(q[:, j], dt, given[j]) for j in range(n)]
    return Derivatives(
        q=np.stack([c[0] for c in columns], axis=1),
        qd=np.stack([c[1] for c in columns], axis=1),
        qdd=np.stack([c[2] for c in columns], axis=1),
        nvr=np.array([c[3] for c in columns]),
    )


_Column = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], list[float]]


def _irwsm1(y: NDArray[np.float64], dt: float, nvr: float | None) -> _Column:
    first = irwsm(y, 2, nvr if nvr is not None else optimal_nvr(y, 2))
    second = irwsm(first.slope, 2, nvr if nvr is not None else optimal_nvr(first.slope, 2))
    qd = _to_samples(first.slope) / dt
    qdd = _extended(second.slope) / dt**2
    return first.level, qd, qdd, [first.nvr, second.nvr]


def _irwsm2(y: NDArray[np.float64], dt: float, nvr: float | None) -> _Column:
    smooth = irwsm(y, 3, nvr if nvr is not None else optimal_nvr(y, 3))
    return smooth.level, _to_samples(smooth.slope) / dt, _extended(np.diff(smooth.slope)) / dt**2, [smooth.nvr]


def _to_samples(slope: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values midway between samples (N - 1,) to values at the samples (N,)."""
    inner = (slope[1:] + slope[:-1]) / 2
    return np.concatenate([slope[:1], inner, slope[-1:]])


def _extended(inner: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values at the samples 1..N-2 to all N: the two ends repeat their neighbour."""
    return np.concatenate([inner[:1], inner, inner[-1:]])
