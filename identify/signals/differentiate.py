"""Velocity and acceleration from measured positions, aligned to the samples."""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from armident.arrays import Array
from armident.configs import DataError, RobotConfig
from armident.identify.signals.bandpass import butterworth, central_difference
from armident.identify.signals.choices import NVR_RULES, DerivativesName, NvrRule
from armident.identify.signals.irwsm import automatic_nvr, cross_validated_nvr, irwsm, optimal_nvr


@dataclass(frozen=True, eq=False)
class Derivatives:
    """Positions and their derivatives (N, n) at the sampling instants; rad or m, s.

    ``nvr``: noise-variance ratios (n, 2) for ``irwsm`` (first and second pass), (n, 1) for ``irwsm2``, else ``None``.
    ``start``: time since the first recording began, s; like ``dt``, for model terms.
    """

    q: Array
    qd: Array
    qdd: Array
    nvr: Array | None
    dt: float | None = None
    start: float = 0.0


def differentiate(
    q: Array,
    dt: float,
    derivatives: DerivativesName = "irwsm",
    nvr: float | Sequence[float] | Array | NvrRule | None = None,
    bandwidth_hz: float | None = None,
    *,
    q_ref: Array | None = None,
    resolution: float | Sequence[float] | Array | None = None,
) -> Derivatives:
    """Differentiate measured positions (N, n) twice.

    ``irwsm``: level-slope smoother applied twice; ``irwsm2``: three states at once; ``bandpass``: zero-phase
    Butterworth of order 4 at five times ``bandwidth_hz``, then central differences. ``nvr``: ratios, or their rule:
    ``automatic`` (as ``None``), ``cross-validation``, ``likelihood`` (thesis 5.21) or ``tracking-error`` (5.26, 5.27),
    which needs ``q_ref`` and ``resolution`` (:func:`encoder_resolution`).

    The slope is the forward difference of the level, half a sample later. IRWSM 1 therefore yields velocities midway
    between samples: their smoothed difference is the acceleration at the sample, the mean of two the velocity. Noise is
    not white after the first pass: the second uses its ratio. Only ``likelihood`` estimates both, as the thesis.
    """
    if derivatives == "bandpass":
        if bandwidth_hz is None:
            raise DataError("derivatives bandpass: the closed-loop bandwidth is unknown; set bandwidth_hz or use irwsm")
        smooth = butterworth(q, dt, min(5 * bandwidth_hz, 0.45 / dt))
        qd = central_difference(smooth, dt)
        return Derivatives(smooth, qd, central_difference(qd, dt), None, dt)
    rule, given = _ratios(q, derivatives, nvr, q_ref, resolution)
    smoother = _irwsm1 if derivatives == "irwsm" else _irwsm2
    level, qd, qdd = np.empty(q.shape), np.empty(q.shape), np.empty(q.shape)

    def derive(j: int) -> list[float]:
        level[:, j], qd[:, j], qdd[:, j], used = smoother(q[:, j], dt, rule, given[j])
        return used

    # Threads on all processors: the kernels release the interpreter lock.
    with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        ratios = list(pool.map(derive, range(q.shape[1])))
    return Derivatives(q=level, qd=qd, qdd=qdd, nvr=np.array(ratios), dt=dt)


def tracking_error_nvr(error: Array, order: int, resolution: float | Sequence[float] | Array) -> Array:
    """Noise-variance ratios (n,) approximated from the tracking error ``q_ref - q`` (N, n) (thesis 5.25 to 5.27).

    Order 2: variance of its difference (5.26, IRWSM 1); 3: of its second difference (5.27, IRWSM 2). ``resolution``:
    joint displacement per count. Raises DataError if a joint has no tracking error.
    """
    step = np.broadcast_to(np.asarray(resolution, dtype=np.float64), (error.shape[1],))
    if not (step > 0).all():
        raise DataError(
            f"nvr by tracking error: the resolution of joint {int(np.argmin(step > 0)) + 1} is not positive"
        )
    ratios: Array = (np.std(np.diff(error, n=order - 1, axis=0), axis=0) / step) ** 2
    if not (ratios > 0).all():
        raise DataError(
            f"nvr by tracking error: the tracking error of joint {int(np.argmin(ratios > 0)) + 1} does not vary"
        )
    return ratios


def encoder_resolution(robot: RobotConfig) -> Array:
    """Joint displacement per count of the motor encoders (n,); several motors of a joint add as root sum of squares."""
    steps = []
    for joint in robot.joints:
        if joint.drive.counts_per_unit is None:
            raise DataError(
                f"robot {robot.name!r}: {joint.name}.drive.counts_per_unit: the encoder resolution is unknown"
            )
        steps.append((2 * np.pi if joint.type == "revolute" else 1.0) / joint.drive.counts_per_unit)
    inverse = np.linalg.inv(robot.transmission_matrix)
    resolution: Array = np.sqrt(inverse**2 @ np.square(steps))
    return resolution


def _ratios(
    q: Array,
    derivatives: DerivativesName,
    nvr: float | Sequence[float] | Array | NvrRule | None,
    q_ref: Array | None,
    resolution: float | Sequence[float] | Array | None,
) -> tuple[NvrRule, list[float | None]]:
    """Return the rule, and the ratio of each joint if it is already known, otherwise ``None``."""
    n = q.shape[1]
    if nvr is None:
        return "automatic", [None] * n
    if isinstance(nvr, str):
        if nvr not in NVR_RULES:
            raise DataError(f"nvr: {nvr!r} is neither a number nor one of {', '.join(NVR_RULES)}")
        if nvr != "tracking-error":
            return nvr, [None] * n
        if q_ref is None or resolution is None:
            missing = "reference trajectory" if q_ref is None else "encoder resolution"
            raise DataError(f"nvr by tracking error: the {missing} is unknown; use automatic")
        if q_ref.shape != q.shape:
            raise DataError(f"nvr by tracking error: the reference has shape {q_ref.shape}, the positions {q.shape}")
        order = 2 if derivatives == "irwsm" else 3
        return "tracking-error", list(tracking_error_nvr(q_ref - q, order, resolution))
    ratios = np.asarray(nvr, dtype=np.float64)
    if ratios.ndim > 1 or ratios.size not in (1, n) or not (ratios > 0).all():
        raise DataError(f"nvr: expected one positive number or {n}, got {nvr}")
    return "automatic", [float(v) for v in np.broadcast_to(ratios, (n,))]


_Column = tuple[Array, Array, Array, list[float]]


def _irwsm1(y: Array, dt: float, rule: NvrRule, nvr: float | None) -> _Column:
    first = irwsm(y, 2, _found(y, 2, rule) if nvr is None else nvr)
    again = nvr is None and rule == "likelihood"
    second = irwsm(first.slope, 2, optimal_nvr(first.slope, 2) if again else first.nvr)
    qd = _to_samples(first.slope) / dt
    qdd = _extended(second.slope) / dt**2
    return first.level, qd, qdd, [first.nvr, second.nvr]


def _irwsm2(y: Array, dt: float, rule: NvrRule, nvr: float | None) -> _Column:
    smooth = irwsm(y, 3, _found(y, 3, rule) if nvr is None else nvr)
    return smooth.level, _to_samples(smooth.slope) / dt, _extended(np.diff(smooth.slope)) / dt**2, [smooth.nvr]


def _found(y: Array, order: int, rule: NvrRule) -> float:
    if rule == "likelihood":
        return optimal_nvr(y, order)
    return cross_validated_nvr(y, order) if rule == "cross-validation" else automatic_nvr(y, order)


def _to_samples(slope: Array) -> Array:
    """Interpolate values midway between samples (N - 1,) to the samples (N,)."""
    inner = (slope[1:] + slope[:-1]) / 2
    return np.concatenate([slope[:1], inner, slope[-1:]])


def _extended(inner: Array) -> Array:
    """Extend values at the samples 1..N-2 to all N samples; each end repeats its neighbour."""
    return np.concatenate([inner[:1], inner, inner[-1:]])
