"""Table 5.2: errors of derivatives of positions of the simulated EMPS (thesis section 5.1.4).

As stated by the thesis: model 5.28 and controller 5.29 with their parameters, a signal-to-noise ratio of 100 dB, and a
Butterworth filter of order 4 at 40 Hz. Errors are relative, in percent, and averaged over 100 simulations. Motion and
sampling rate are not stated. The motion here is rest to rest along polynomials of degree five over 0.25 m. The sampling
rate is that of the TX40: the position error of the bandpass, noise below 40 Hz only, implies several kilohertz.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armident.compiled import compiled
from armident.configs import DataError
from armident.identify.signals.bandpass import butterworth
from armident.identify.signals.differentiate import Derivatives, differentiate

MASS = 96.0
"""Mass, kg."""
VISCOUS = 205.0
"""Viscous friction, N s/m."""
COULOMB = 20.0
"""Coulomb friction, N."""
KP = 160.2
"""Position gain, 1/s."""
KV = 242.5
"""Velocity gain, V s/m."""
GAIN = 35.2
"""Drive gain, N/V."""
SIGN_SMOOTHING = 150.0
"""``sign(x)`` is ``(2/pi) atan(150 x)`` in the simulations of the thesis (after equation 2.7)."""
NVR_BY_HAND = 1e-5
"""Noise-variance ratio chosen manually in the thesis (section 5.3.1)."""
SNR_DB = 100.0
CUTOFF_HZ = 40.0
MODE_HZ = 8.0
"""Bandwidth for which ``differentiate`` selects the 40 Hz of the thesis."""

STROKE = 0.25
"""Length of a move, m."""
DURATIONS = (1.0, 1.5, 2.0)
"""Durations of the moves, each there and back, s: all stay below 0.5 m/s."""
STEP = 1e-5
"""Longest integration step, s: with a loop of 19 Hz the relative position error of RK4 is 1e-9."""

Array = NDArray[np.float64]
Errors = tuple[float, float, float]
"""Relative errors of position, velocity and acceleration, percent."""

THESIS: dict[str, Errors] = {
    "bandpass": (6.38e-5, 5.49e-1, 1.15),
    "IRWSM 1": (5.78e-5, 1.20e-3, 1.34e-1),
    "IRWSM 2": (5.10e-5, 3.20e-3, 2.64e-1),
}


@dataclass(frozen=True)
class Row:
    """Relative errors of position, velocity and acceleration of one method, percent.

    ``label``: name of the method, as in the thesis if it is there. ``thesis``: published figures; ``None`` if the table
    has no such method. ``ours``: means over the simulations.
    """

    label: str
    thesis: Errors | None
    ours: Errors


@dataclass(frozen=True)
class EmpsRun:
    """Noise-free simulation of the axis.

    ``q_ref``, ``q``: reference and position, m, shape (N,); ``qd``, ``qdd``: velocity, m/s, and acceleration, m/s^2,
    shape (N,).
    """

    q_ref: Array
    q: Array
    qd: Array
    qdd: Array
    dt: float


def table_5_2(simulations: int = 100, sampling_hz: float = 5000.0, seed: int = 0) -> list[Row]:
    """Return mean relative errors of the estimated signals; the three methods of the table come first.

    IRWSM 1 and 2 use the default rule for the noise-variance ratio. Further rows show the other rules of the thesis,
    and the bandpass with forward differences without compensation of their delay.

    ``simulations``: number of noise realisations; ``sampling_hz``: sampling rate of the simulated position, Hz. Raises
    DataError if there is no simulation, or the sampling rate is too low for the Butterworth filter.
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
    """Return the means over the simulations."""
    q, qd, qdd = np.mean(errors, axis=0)
    return float(q), float(qd), float(qdd)


def simulate_emps(dt: float) -> EmpsRun:
    """Simulate the closed loop of equations 5.28 and 5.29 along the moves, sampled every ``dt`` seconds."""
    return follow(polynomial_moves(DURATIONS, dt), dt)


def follow(q_ref_dd: Array, dt: float) -> EmpsRun:
    """Simulate the closed loop of equations 5.28 and 5.29 from rest along a reference.

    ``q_ref_dd``: acceleration of the reference, constant over each sample, m/s^2, shape (N,).
    """
    signals = np.empty((4, q_ref_dd.size))
    parameters = np.array([MASS, VISCOUS, COULOMB, SIGN_SMOOTHING, GAIN * KV, KP])
    _integrate(q_ref_dd, dt, int(np.ceil(dt / STEP - 1e-9)), parameters, signals)
    q_ref, q, qd, qdd = signals
    return EmpsRun(q_ref, q, qd, qdd, dt)


def polynomial_moves(durations: Sequence[float], dt: float) -> Array:
    """Return the accelerations (N,), m/s^2, of moves of degree five over `STROKE`, there and back.

    They are constant over each sample.

    ``durations``: duration of each move in one direction, s.
    """
    moves = []
    for duration in durations:
        samples = round(duration / dt)
        x = (np.arange(samples) + 0.5) / samples
        acceleration = STROKE * (60 * x - 180 * x**2 + 120 * x**3) / (samples * dt) ** 2
        moves += [acceleration, -acceleration]
    return np.concatenate(moves)


def _methods(run: EmpsRun, measured: Array, deviation: float) -> dict[str, Derivatives]:
    y, dt = measured[:, None], run.dt
    # Equations 5.26 and 5.27 need the resolution; a uniform error of that size has the variance of the noise.
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
    """Return forward differences: velocities half a sample late, accelerations one sample late.

    ``smooth``: smoothed positions, m, shape (N, 1).
    """
    qd = np.diff(smooth, axis=0, append=smooth[-1:]) / dt
    return Derivatives(smooth, qd, np.diff(qd, axis=0, append=qd[-1:]) / dt, None)


def relative_errors(run: EmpsRun, found: Derivatives, border: int = 0) -> Errors:
    """Return the relative errors of position, velocity and acceleration, percent.

    ``run``: noise-free motion; ``found``: estimated signals, shape (N, 1) each; ``border``: number of samples omitted
    at either end.
    """
    inner = slice(border, run.q.size - border)

    def relative(estimate: Array, truth: Array) -> float:
        return 100 * float(np.linalg.norm((estimate[:, 0] - truth)[inner]) / np.linalg.norm(truth[inner]))

    return relative(found.q, run.q), relative(found.qd, run.qd), relative(found.qdd, run.qdd)


@compiled(nogil=False)
def _acceleration(q, qd, q_ref, parameters):  # type: ignore[no-untyped-def]
    mass, viscous, coulomb, smoothing, loop, kp = parameters
    force = loop * (kp * (q_ref - q) - qd)
    return (force - viscous * qd - coulomb * 2.0 / np.pi * np.arctan(smoothing * qd)) / mass


@compiled(kept=True, nogil=False)
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
