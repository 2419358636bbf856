"""The controller as impulse responses by correlation analysis, "CRC" (thesis section 5.2.3)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from configs import DataError
from identify.estimators.noise import ArModel, fit_ar
from identify.model.controller import DiscreteController

LENGTHS = (1, 2, 3, 5, 8, 12, 20)
"""Impulse-response lengths tried; the thesis settles between 3 and 20 (table 5.12)."""

PREWHITENING_ORDER = 10
"""AR order of the prewhitening, the thesis's usual choice (table 5.12)."""

HELD_OUT = 0.3
"""Share of the data that only judges."""

GAIN_WORTH_A_TAP = 0.002
"""Relative gain in held-out error below which the shorter response is taken."""


NO_FILTER = ArModel(np.empty(0), 1.0, 0.0)


@dataclass(frozen=True)
class JointResponse:
    """Impulse response of one motor's controller.

    Parameters
    ----------
    error_taps
        From the tracking error (rad or m at the motor) to motor torque, one per sampling period.
    position_taps
        From the measured motor position to motor torque; their sum is zero (a velocity loop feels changes
        only). Empty where the tracking error alone explains the torque.
    prewhitening_order
        Order of the AR filter applied to both sides; 0 for none.
    fit_pct
        Share of the held-out torque's variance that is explained, percent.
    """

    error_taps: NDArray[np.float64]
    position_taps: NDArray[np.float64]
    prewhitening_order: int
    fit_pct: float


@dataclass(frozen=True)
class IdentifiedController:
    """The controllers of all motors and how well each explains its torque."""

    controller: DiscreteController
    responses: tuple[JointResponse, ...]


def identify_crc(
    q_motor: Sequence[NDArray[np.float64]],
    reference_motor: Sequence[NDArray[np.float64]],
    torque_motor: Sequence[NDArray[np.float64]],
    dt: float,
    *,
    length: int | Sequence[int] | None = None,
    velocity_loop: bool | None = None,
    saturation: NDArray[np.float64] | None = None,
) -> IdentifiedController:
    """Impulse response of each motor's controller from tracking error to torque.

    Correlation analysis solves ``R_nu,eps(tau) = sum_k h(k) R_eps,eps(tau - k)`` (5.31, 5.32), once as it stands and
    once with both signals prewhitened by an AR model of the error; what predicts the held-out torque best is kept.
    A cascade also feeds back the measured velocity, which the tracking error does not contain; so a second
    response, from position changes, is tried, and kept where the held-out data want it.

    Parameters
    ----------
    q_motor, reference_motor, torque_motor
        Measured position, reference and torque at the motor shafts, one (N, n) array per experiment.
    dt
        Sampling period, s.
    length
        Taps for all motors or for each; ``None``: chosen by the data.
    velocity_loop
        Whether to allow the response from position changes; ``None``: chosen by the data.
    saturation
        Largest motor torque (n,); ``None``: none.

    Raises
    ------
    DataError
        If a motor never deviates from its reference.
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
        nu = [t[:, j] for t in torque_motor]
        motion = [np.diff(q[:, j], prepend=q[0, j]) for q in q_motor]
        responses.append(_identify_joint(error, motion, nu, lengths[j], structures))
    return IdentifiedController(_assemble(responses, dt, saturation), tuple(responses))


def _identify_joint(
    error: list[NDArray[np.float64]],
    motion: list[NDArray[np.float64]],
    nu: list[NDArray[np.float64]],
    lengths: Sequence[int],
    structures: Sequence[bool],
) -> JointResponse:
    longest = max(lengths)
    best: tuple[float, JointResponse] | None = None
    for velocity in structures:
        inputs = [error, motion] if velocity else [error]
        plain = [_lagged(NO_FILTER, [u[k] for u in inputs], nu[k], longest) for k in range(len(nu))]
        judge = _split(plain)[1]
        power = sum(float(np.sum((b - b.mean()) ** 2)) for _, b in judge)
        for ar in (NO_FILTER, fit_ar(error, PREWHITENING_ORDER)):
            pieces = plain
            if ar.order:
                pieces = [_lagged(ar, [u[k] for u in inputs], nu[k], longest) for k in range(len(nu))]
            part, whole = _correlations(_split(pieces)[0]), _correlations(pieces)
            for m in lengths:
                chosen = np.concatenate([np.arange(m) + i * longest for i in range(len(inputs))])
                taps = _solve(part, chosen)
                miss = sum(float(np.sum((b - a[:, chosen] @ taps) ** 2)) for a, b in judge)
                if best is None or miss < best[0] * (1 - GAIN_WORTH_A_TAP):
                    taps = _solve(whole, chosen)
                    response = JointResponse(
                        error_taps=taps[:m],
                        position_taps=np.diff(taps[m:], prepend=0.0, append=0.0) if velocity else np.empty(0),
                        prewhitening_order=ar.order,
                        fit_pct=100 * (1 - miss / power) if power > 0 else 0.0,
                    )
                    best = (miss, response)
    assert best is not None
    return best[1]


def _lagged(
    ar: ArModel, inputs: list[NDArray[np.float64]], output: NDArray[np.float64], length: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Prewhitened inputs at lags 0..length-1, shape (N', inputs * length), and output (N',)."""
    columns = []
    for u in inputs:
        white = ar.whiten(u)
        columns += [white[length - 1 - lag : white.size - lag] for lag in range(length)]
    return np.stack(columns, axis=1), ar.whiten(output)[length - 1 :]


_Pieces = list[tuple[NDArray[np.float64], NDArray[np.float64]]]


def _split(pieces: _Pieces) -> tuple[_Pieces, _Pieces]:
    """The first part of every experiment and its last, held-out part."""
    cut = [int(b.size * (1 - HELD_OUT)) for _, b in pieces]
    return (
        [(a[:c], b[:c]) for (a, b), c in zip(pieces, cut, strict=True)],
        [(a[c:], b[c:]) for (a, b), c in zip(pieces, cut, strict=True)],
    )


def _correlations(pieces: _Pieces) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """``R_eps,eps`` and ``R_nu,eps`` of 5.31 and 5.32 over all experiments."""
    columns = pieces[0][0].shape[1]
    auto, cross = np.zeros((columns, columns)), np.zeros(columns)
    for a, b in pieces:
        auto += a.T @ a
        cross += a.T @ b
    return auto, cross


def _solve(
    correlations: tuple[NDArray[np.float64], NDArray[np.float64]], chosen: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Solve the correlation equations; directions that the input does not contain get no response."""
    gram, right = correlations[0][np.ix_(chosen, chosen)], correlations[1][chosen]
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    values, vectors = linalg.eigh(gram / np.outer(scale, scale))
    used = values > 1e-11 * values[-1]
    taps: NDArray[np.float64] = vectors[:, used] @ ((vectors[:, used].T @ (right / scale)) / values[used]) / scale
    return taps


def _assemble(
    responses: Sequence[JointResponse], dt: float, saturation: NDArray[np.float64] | None
) -> DiscreteController:
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
