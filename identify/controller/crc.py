"""The controller as impulse responses by correlation analysis, "CRC" (thesis section 5.2.3)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from armident.arrays import Array
from armident.configs import DataError
from armident.identify.regression.ar_noise import WHITE, ArModel, fit_ar
from armident.identify.robot.controller import DiscreteController

LENGTHS = (1, 2, 3, 5, 8, 12, 20)
"""Impulse-response lengths tried; the thesis settles between 3 and 20 (table 5.12)."""

PREWHITENING_ORDER = 10
"""AR order of the prewhitening, the thesis's usual choice (table 5.12)."""

HELD_OUT = 0.3
"""Share of the data that is held out of the fit and used to compare the candidates: 20 taps need few of the rest."""

GAIN_WORTH_A_TAP = 0.002
"""Relative decrease of the held-out error below which the shorter response is taken: the shape of the controller then
changes the simulated torques by less than their noise does, and a tap without effect adds only variance."""

PIECE = 16384
"""Samples of a signal whose products at all lags are formed while they are in the cache: 128 kB."""


@dataclass(frozen=True)
class JointResponse:
    """Impulse response of one motor's controller.

    ``error_taps``: from tracking error (rad or m at the motor) to motor torque. ``position_taps``: from measured motor
    position; their sum is zero, as a velocity loop responds only to changes; empty where the error alone explains the
    torque. ``prewhitening_order``: of the AR filter. ``fit_pct``: explained share of the held-out torque's variance.
    """

    error_taps: Array
    position_taps: Array
    prewhitening_order: int
    fit_pct: float


@dataclass(frozen=True)
class IdentifiedController:
    """Identified controller of all n motors."""

    controller: DiscreteController
    responses: tuple[JointResponse, ...]


def identify_crc(
    q_motor: Sequence[Array],
    reference_motor: Sequence[Array],
    torque_motor: Sequence[Array],
    dt: float,
    *,
    length: int | Sequence[int] | None = None,
    velocity_loop: bool | None = None,
    saturation: Array | None = None,
) -> IdentifiedController:
    """Impulse response of each motor's controller from tracking error to torque.

    Correlation analysis solves ``R_nu,eps(tau) = sum_k h(k) R_eps,eps(tau - k)`` (5.31, 5.32), with the signals as
    recorded, and prewhitened by an AR model of the error; the better prediction of the held-out torque is returned. A
    cascade also feeds back the measured velocity: a second response, from position changes, is kept if the held-out
    error falls.

    Inputs: position, reference (rad or m) and torque (N m or N) at the motors, one (N, n) array per experiment.
    ``length``: taps, of all motors or of each; ``None``: the best of `LENGTHS`. ``velocity_loop``: response from
    position changes; ``None``: compare both. ``saturation``: largest torque (n,).
    """
    n = q_motor[0].shape[1]
    lengths: list[tuple[int, ...]]
    if length is None:
        lengths = [LENGTHS] * n
    else:
        lengths = [(int(m),) for m in np.broadcast_to(np.asarray(length), (n,))]
    structures = (False, True) if velocity_loop is None else (velocity_loop,)
    responses = []
    for j in range(n):
        error = [r[:, j] - q[:, j] for r, q in zip(reference_motor, q_motor, strict=True)]
        if not any(np.ptp(e) > 0 for e in error):
            raise DataError(f"controller of motor {j + 1}: position and reference never differ")
        nu = [np.ascontiguousarray(t[:, j]) for t in torque_motor]
        motion = [np.diff(q[:, j], prepend=q[0, j]) for q in q_motor]
        responses.append(_identify_joint(error, motion, nu, lengths[j], structures))
    return IdentifiedController(_assemble(responses, dt, saturation), tuple(responses))


def _identify_joint(
    error: list[Array], motion: list[Array], nu: list[Array], lengths: Sequence[int], structures: Sequence[bool]
) -> JointResponse:
    longest = max(lengths)
    best: tuple[float, JointResponse] | None = None
    # The correlations of the error alone are a part of those of both inputs.
    inputs = [error, motion] if any(structures) else [error]
    filters = (WHITE, fit_ar(error, PREWHITENING_ORDER))
    correlations = [_correlations(ar, inputs, nu, longest) for ar in filters]
    plain = correlations[0][1]
    power = sum(float(np.sum((b - b.mean()) ** 2)) for b in _held_out(nu, longest))
    for velocity in structures:
        for ar, (fitted, judge) in zip(filters, correlations, strict=True):
            for m in lengths:
                chosen = np.concatenate([np.arange(m) + i * longest for i in range(1 + velocity)])
                taps = _solve(fitted, chosen)
                miss = plain.miss(taps, chosen)
                if best is None or miss < best[0] * (1 - GAIN_WORTH_A_TAP):
                    taps = _solve(fitted + judge, chosen)
                    response = JointResponse(
                        error_taps=taps[:m],
                        position_taps=np.diff(taps[m:], prepend=0.0, append=0.0) if velocity else np.empty(0),
                        prewhitening_order=ar.order,
                        fit_pct=100 * (1 - miss / power) if power > 0 else 0.0,
                    )
                    best = (miss, response)
    assert best is not None
    return best[1]


@dataclass(frozen=True)
class _Correlations:
    """``R_eps,eps`` (m, m) and ``R_nu,eps`` (m,) of 5.31 and 5.32, and the power of the output; all are sums."""

    auto: Array
    cross: Array
    power: float

    def __add__(self, other: "_Correlations") -> "_Correlations":
        return _Correlations(self.auto + other.auto, self.cross + other.cross, self.power + other.power)

    def miss(self, taps: Array, chosen: NDArray[np.int64]) -> float:
        """Sum of the squared errors of the impulse response ``taps`` (k,), whose tap numbers are ``chosen`` (k,)."""
        explained = 2 * taps @ self.cross[chosen] - taps @ self.auto[np.ix_(chosen, chosen)] @ taps
        return max(self.power - float(explained), 0.0)


def _held_out(output: Sequence[Array], length: int) -> list[Array]:
    """Return the last part of every experiment, which is not used in the fit."""
    return [b[length - 1 + _cut(b.size - length + 1) :] for b in output]


def _cut(rows: int) -> int:
    return int(rows * (1 - HELD_OUT))


def _correlations(
    ar: ArModel, inputs: Sequence[Sequence[Array]], output: Sequence[Array], length: int
) -> tuple[_Correlations, _Correlations]:
    """Correlations of the prewhitened inputs at lags 0..length-1, of the fitted and of the held-out part."""
    parts: tuple[list[_Correlations], list[_Correlations]] = [], []
    for k, raw in enumerate(output):
        white = [ar.whiten(u[k]) for u in inputs]
        b = ar.whiten(raw)
        cut = length - 1 + _cut(b.size - length + 1)
        for into, first, last in ((parts[0], length - 1, cut), (parts[1], cut, b.size)):
            into.append(_sums(white, b, length, first, last))
    return sum(parts[0][1:], parts[0][0]), sum(parts[1][1:], parts[1][0])


def _sums(inputs: Sequence[Array], b: Array, length: int, first: int, last: int) -> _Correlations:
    """Correlations over the samples ``first .. last - 1``, without a matrix of lagged inputs."""
    auto = np.empty((len(inputs) * length, len(inputs) * length))
    for i, u in enumerate(inputs):
        for j, v in enumerate(inputs[: i + 1]):
            rows, columns = slice(i * length, (i + 1) * length), slice(j * length, (j + 1) * length)
            auto[rows, columns] = _lag_products(u, v, length, first, last)
            auto[columns, rows] = auto[rows, columns].T
    cross = np.concatenate([_products(b, u, length, first, last) for u in inputs])
    return _Correlations(auto, cross, float(b[first:last] @ b[first:last]))


def _lag_products(u: Array, v: Array, length: int, first: int, last: int) -> Array:
    """``sum_k u(k - i) v(k - j)`` for lags i, j, shape (length, length), by recursion along the diagonals."""
    out = np.empty((length, length))
    out[0], out[:, 0] = _products(u, v, length, first, last), _products(v, u, length, first, last)
    for i in range(1, length):
        begins = u[first - i] * v[first - length + 1 : first][::-1]
        ends = u[last - i] * v[last - length + 1 : last][::-1]
        out[i, 1:] = out[i - 1, :-1] + begins - ends
    return out


def _products(u: Array, v: Array, length: int, first: int, last: int) -> Array:
    """``sum_k u(k) v(k - lag)`` for every lag, shape (length,); summed piece by piece for the cache."""
    out = np.zeros(length)
    for begin in range(first, last, PIECE):
        end = min(begin + PIECE, last)
        out += [u[begin:end] @ v[begin - lag : end - lag] for lag in range(length)]
    return out


def _solve(correlations: _Correlations, chosen: NDArray[np.int64]) -> Array:
    """Solve the correlation equations; the response is zero along directions that the input does not excite."""
    gram, right = correlations.auto[np.ix_(chosen, chosen)], correlations.cross[chosen]
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    values, vectors = linalg.eigh(gram / np.outer(scale, scale))
    used = values > 1e-11 * values[-1]
    taps: Array = vectors[:, used] @ ((vectors[:, used].T @ (right / scale)) / values[used]) / scale
    return taps


def _assemble(responses: Sequence[JointResponse], dt: float, saturation: Array | None) -> DiscreteController:
    n = len(responses)
    error = np.zeros((n, max(r.error_taps.size for r in responses)))
    position = np.zeros((n, max(1, *(r.position_taps.size for r in responses))))
    for j, response in enumerate(responses):
        error[j, : response.error_taps.size] = response.error_taps
        position[j, : response.position_taps.size] = response.position_taps
    return DiscreteController(
        error_taps=error,
        position_taps=position,
        output_taps=np.zeros((n, 0)),
        saturation=np.full(n, np.inf) if saturation is None else saturation,
        dt=dt,
    )
