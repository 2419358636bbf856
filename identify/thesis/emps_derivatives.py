"""Table 5.2: how well positions of the simulated EMPS are differentiated (thesis section 5.1.4).

What the thesis states is used as printed: model 5.28, controller 5.29 with their parameters, 100 dB of signal to noise,
Butterworth of order 4 at 40 Hz, relative errors in per cent averaged over 100 simulations. It states neither the motion
nor the sampling rate. The motion here is rest to rest along polynomials of degree five over the axis's quarter of a
metre. The sampling rate is that of the TX40: the position of the bandpass, whose error is the noise that 40 Hz let
through and nothing else, says that it was several kilohertz.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from armident.configs import DataError
from armident.identify.signals.bandpass import butterworth
from armident.identify.signals.differentiate import NVR_BY_HAND, Derivatives, differentiate

MASS = 96.0
"""kg."""
VISCOUS = 205.0
"""N s/m."""
COULOMB = 20.0
"""N."""
KP = 160.2
"""1/s."""
KV = 242.5
"""V s/m."""
GAIN = 35.2
"""N/V."""
SIGN_SMOOTHING = 150.0
"""``sign(x)`` is ``(2/pi) atan(150 x)`` in the thesis's simulations (after 2.7)."""
SNR_DB = 100.0
CUTOFF_HZ = 40.0
MODE_HZ = 8.0
"""The bandwidth for which ``differentiate`` chooses the thesis's 40 Hz."""

STROKE = 0.25
"""m."""
DURATIONS = (1.0, 1.5, 2.0)
"""Of the moves, each there and back, s: all keep the axis's 0.5 m/s."""
STEP = 1e-5
"""Longest integration step, s; the loop has 19 Hz, so RK4 is exact to 1e-9 of the position."""

Array = NDArray[np.float64]
Errors = tuple[float, float, float]
"""Relative errors of position, velocity and acceleration, per cent."""

THESIS: dict[str, Errors] = {
    "bandpass": (6.38e-5, 5.49e-1, 1.15),
    "IRWSM 1": (5.78e-5, 1.20e-3, 1.34e-1),
    "IRWSM 2": (5.10e-5, 3.20e-3, 2.64e-1),
}


@dataclass(frozen=True)
class Row:
    """One method: relative errors in per cent of position, velocity and acceleration.

    Parameters
    ----------
    label
        The method; the thesis's name where the table has it.
    thesis
        The table's figures, ``None`` where it has no such method.
    ours
        Means over the simulations.
    """

    label: str
    thesis: Errors | None
    ours: Errors


@dataclass(frozen=True)
class EmpsRun:
    """Noise-free simulation of the axis: reference and motion, shape (N,) each, m, m/s, m/s^2."""

    q_ref: Array
    q: Array
    qd: Array
    qdd: Array
    dt: float


def table_5_2(simulations: int = 100, sampling_hz: float = 5000.0, seed: int = 0) -> list[Row]:
    """Mean relative errors of the estimated signals, the table's three methods first.

    IRWSM 1 and 2 choose their noise-variance ratio as the product does by default; the rows that follow show the
    thesis's other choices, and the bandpass with plain forward differences that are not moved back to their samples.

    Parameters
    ----------
    simulations
        Number of noise realisations.
    sampling_hz
        Sampling rate of the simulated position, Hz.
    seed
        Of the noise.

    Raises
    ------
    DataError
        If there is no simulation, or the sampling rate is too low for the Butterworth filter.
    """
    if simulations < 1:
        raise DataError(f"table 5.2 needs at least one simulation, got {simulations}")
    if sampling_hz <= 2 * CUTOFF_HZ:
        raise DataError(f"table 5.2: {sampling_hz:g} Hz is not above twice the cut-off of {CUTOFF_HZ:g} Hz")
    run = simulate_emps(1.0 / sampling_hz)
    random = np.random.default_rng(seed)
    deviation = float(np.std(run.q)) * 10 ** (-SNR_DB / 20)
    errors: dict[str, list[Errors]] = {}
    for _ in range(simulations):
        measured = run.q + deviation * random.standard_normal(run.q.size)
        for label, found in _methods(run, measured, deviation).items():
            errors.setdefault(label, []).append(relative_errors(run, found))
    return [Row(label, THESIS.get(label), mean(values)) for label, values in errors.items()]


def mean(errors: Sequence[Errors]) -> Errors:
    """Means over the simulations."""
    q, qd, qdd = np.mean(errors, axis=0)
    return float(q), float(qd), float(qdd)


def simulate_emps(dt: float) -> EmpsRun:
    """Closed loop of equations 5.28 and 5.29 along the moves, sampled every ``dt`` seconds."""
    return follow(polynomial_moves(DURATIONS, dt), dt)


def follow(q_ref_dd: Array, dt: float) -> EmpsRun:
    """Closed loop of equations 5.28 and 5.29 from rest along a reference given by its acceleration, (N,) m/s^2."""
    signals = np.empty((4, q_ref_dd.size))
    parameters = np.array([MASS, VISCOUS, COULOMB, SIGN_SMOOTHING, GAIN * KV, KP])
    _integrate(q_ref_dd, dt, int(np.ceil(dt / STEP - 1e-9)), parameters, signals)
    q_ref, q, qd, qdd = signals
    return EmpsRun(q_ref, q, qd, qdd, dt)


def polynomial_moves(durations: Sequence[float], dt: float) -> Array:
    """Accelerations (N,) m/s^2, constant over each sample, of moves there and back along polynomials of degree five."""
    moves = []
    for duration in durations:
        samples = round(duration / dt)
        x = (np.arange(samples) + 0.5) / samples
        acceleration = STROKE * (60 * x - 180 * x**2 + 120 * x**3) / (samples * dt) ** 2
        moves += [acceleration, -acceleration]
    return np.concatenate(moves)


def _methods(run: EmpsRun, measured: Array, deviation: float) -> dict[str, Derivatives]:
    y, dt = measured[:, None], run.dt
    # Equations 5.26 and 5.27 want the resolution; a uniform error of that size has the variance of the noise.
    known = {"q_ref": run.q_ref[:, None], "resolution": deviation * np.sqrt(12.0)}
    return {
        "bandpass": differentiate(y, dt, "bandpass", bandwidth_hz=MODE_HZ),
        "IRWSM 1": differentiate(y, dt, "irwsm"),
        "IRWSM 2": differentiate(y, dt, "irwsm2"),
        "bandpass, forward differences": forward(butterworth(y, dt, CUTOFF_HZ), dt),
        "IRWSM 1, likelihood": differentiate(y, dt, "irwsm", "likelihood"),
        "IRWSM 2, likelihood": differentiate(y, dt, "irwsm2", "likelihood"),
        "IRWSM 1, tracking error": differentiate(y, dt, "irwsm", "tracking-error", **known),
        "IRWSM 2, tracking error": differentiate(y, dt, "irwsm2", "tracking-error", **known),
        "IRWSM 1, NVR 1e-5": differentiate(y, dt, "irwsm", NVR_BY_HAND),
        "IRWSM 2, NVR 1e-5": differentiate(y, dt, "irwsm2", NVR_BY_HAND),
    }


def forward(smooth: Array, dt: float) -> Derivatives:
    """Forward differences as they come: half a sample late for the velocity, a whole one for the acceleration."""
    qd = np.diff(smooth, axis=0, append=smooth[-1:]) / dt
    return Derivatives(smooth, qd, np.diff(qd, axis=0, append=qd[-1:]) / dt, None)


def relative_errors(run: EmpsRun, found: Derivatives, border: int = 0) -> Errors:
    """Relative errors without ``border`` samples at either end."""
    inner = slice(border, run.q.size - border)

    def relative(estimate: Array, truth: Array) -> float:
        return 100 * float(np.linalg.norm((estimate[:, 0] - truth)[inner]) / np.linalg.norm(truth[inner]))

    return relative(found.q, run.q), relative(found.qd, run.qd), relative(found.qdd, run.qdd)


@numba.njit(cache=True)
def _acceleration(q, qd, q_ref, parameters):  # type: ignore[no-untyped-def]
    mass, viscous, coulomb, smoothing, loop, kp = parameters
    force = loop * (kp * (q_ref - q) - qd)
    return (force - viscous * qd - coulomb * 2.0 / np.pi * np.arctan(smoothing * qd)) / mass


@numba.njit(cache=True)
def _integrate(q_ref_dd, dt, steps, parameters, out):  # type: ignore[no-untyped-def]
    """Classical Runge-Kutta; fills reference, position, velocity and acceleration at the samples, (4, N)."""
    h = dt / steps
    q = qd = ref = ref_d = 0.0
    for k in range(q_ref_dd.size):
        bend = q_ref_dd[k]
        out[0, k], out[1, k], out[2, k] = ref, q, qd
        out[3, k] = _acceleration(q, qd, ref, parameters)
        for s in range(steps):
            t0, t1, t2 = s * h, (s + 0.5) * h, (s + 1) * h
            r0 = ref + t0 * (ref_d + 0.5 * bend * t0)
            r1 = ref + t1 * (ref_d + 0.5 * bend * t1)
            r2 = ref + t2 * (ref_d + 0.5 * bend * t2)
            a1 = _acceleration(q, qd, r0, parameters)
            v2 = qd + 0.5 * h * a1
            a2 = _acceleration(q + 0.5 * h * qd, v2, r1, parameters)
            v3 = qd + 0.5 * h * a2
            a3 = _acceleration(q + 0.5 * h * v2, v3, r1, parameters)
            v4 = qd + h * a3
            a4 = _acceleration(q + h * v3, v4, r2, parameters)
            q += h / 6.0 * (qd + 2.0 * v2 + 2.0 * v3 + v4)
            qd += h / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)
        ref += dt * (ref_d + 0.5 * bend * dt)
        ref_d += bend * dt
