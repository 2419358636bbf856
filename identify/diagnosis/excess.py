"""Torques that no recorded motion explains: parts of the residual that are not broadband noise of drives and encoders.

Such noise has the spectrum of its filters and the same power at all times. A noise model would take a vibration, a
slow signal or a contact for noise: here the spectrum is compared with that of drives and encoders, and the power with
that of other moments.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, chdtri, fdtrc

from armident.arrays import Array
from armident.identify.signals.periodogram import hann_window, periodogram

LEAST_FREQUENCIES = 40
"""Fewest frequencies from which the level of the noise is estimated: its median is known within a quarter then."""

NOISE_TIME_CONSTANTS = (0.0, 0.002, 0.005, 0.01, 0.02, 0.035, 0.05)
"""Time constants of noise, s: torque filters and current loops of drives have less. What is slower is a signal."""

RISES = tuple((rise, power) for power in (2, 4) for rise in (0.0, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0))
"""Noise of differentiated encoders at the Nyquist frequency over the level at zero, and the power of its rise: twice
the number of derivatives."""

LEAST_KEPT = 0.5
"""Least share of the power of noise that a refit leaves at a frequency of the comparison: its half has its shape."""

HIGHEST = 0.7
"""Highest frequency over the Nyquist frequency: the filter of the comparison begins to fall there."""

PER_FREQUENCY = 1.5
"""Frequencies of a Hann window that count as one independent one."""

NARROW = 6
"""Frequencies about a line that hold most of its power: the main lobe of a Hann window, and one more at either side."""

MOST = 0.9
"""Share of the power beyond noise that a line has within `NARROW` frequencies."""

CLEAR = 1e-3
"""Probability below which a further band, found among all, is no noise."""

SHOWN = 40
"""Frequencies to either side of the strongest one in a figure."""

WINDOW = 8
"""Equations whose mean power is that of a moment: about four periods at the highest frequency of the comparison."""

CLIPPED = 3.0
"""Robust standard deviations to which a residual is limited for the time over which its noise is correlated."""

LISTED = 3
"""Largest number of moments that are named."""

LOG_2 = float(np.log(2.0))


@dataclass(frozen=True)
class Excess:
    """Part of one joint's residual beyond broadband noise; an event, which other data need not repeat.

    ``share`` of the power of the residual, whose rms is ``error``, N m or N. ``where``: frequency, Hz, the first
    moments, s, or a factor. ``x``, ``value``, ``noise`` (G,): amplitude over frequency or time, and that of the noise.
    ``narrow``: share of the power beyond noise at the strongest frequency, as wide as the window allows.
    """

    kind: Literal["frequency", "unrecorded signal", "bursts", "recording"]
    p_value: float
    share: float
    error: float
    where: tuple[float, ...]
    x: Array
    value: Array
    noise: Array
    narrow: float = 0.0


def spectral_excess(
    series: Sequence[Array], velocities: Sequence[Array], dt: float, slow: float = 0.0, taken: Sequence[Array] = ()
) -> Excess | None:
    """Band of frequencies with most power over what noise of drives and encoders has there; each series is evidence.

    ``series``: residuals (M,) of one joint in the band of the comparison, zero at rest. Times about reversals and under
    the velocity ``slow``, where dry friction has no model, are left out. The band is that of the series with most power
    beyond noise: a signal need not be in every recording. ``taken``: directions (M, k), orthonormal in all series
    together, that a fit has taken out of them.
    """
    out = taken or [np.empty((e.size, 0)) for e in series]
    each = [_in_series(e, qd, dt, slow, own) for e, qd, own in zip(series, velocities, out, strict=True)]
    found = [one for one in each if one is not None]
    if not found:
        return None
    strongest = max(found, key=lambda one: one.share * one.error**2)
    return replace(strongest, p_value=fisher(one.p_value for one in found))


def fisher(p_values: Iterable[float]) -> float:
    """Return the probability of so small p-values of independent tests together (Fisher's method)."""
    logarithms = [float(np.log(max(p, 1e-300))) for p in p_values]
    return float(chdtrc(2 * len(logarithms), -2.0 * sum(logarithms)))


def _in_series(e: Array, qd: Array, dt: float, slow: float, taken: Array) -> Excess | None:
    """Return the excess of one series (M,); ``None`` if it is short or at rest."""
    (away,) = away_from_reversals([e], [qd], slow)
    window = hann_window(e.size)
    power = periodogram(window * away)
    kept = _kept(window * (away != 0.0), taken)
    power /= np.maximum(kept, LEAST_KEPT)
    f = np.arange(power.size) / (e.size * dt)
    used = np.flatnonzero((f > 0.0) & (f < HIGHEST * 0.5 / dt) & (kept >= LEAST_KEPT))
    if used.size < LEAST_FREQUENCIES or not away.any():
        return None
    level = _noise_level(f, power, used, dt)
    ratio, more = power[used] / level[used], power[used] - level[used]
    sums, excess = (np.append(0.0, np.cumsum(one)) for one in (ratio, more))
    widths = [2**k for k in range((used.size // 4).bit_length())]
    bands = np.array([(k, k + w) for w in widths for k in range(0, used.size - w + 1, max(1, w // 2))])
    wide = bands[:, 1] - bands[:, 0]
    mean = (sums[bands[:, 1]] - sums[bands[:, 0]]) / wide
    p = fdtrc(2.0 * np.maximum(1.0, wide / PER_FREQUENCY), 2.0 * used.size / PER_FREQUENCY * LOG_2**2, mean)
    p_value = min(1.0, bands.shape[0] * float(p.min()))
    # Of the bands that are no noise, either, the one with most power beyond it.
    power_of = excess[bands[:, 1]] - excess[bands[:, 0]]
    first, last = bands[int(np.argmax(np.where(p <= max(p.min(), CLEAR / p.size), power_of, -np.inf)))]
    inside = np.exp(-ratio) * used.size < 1.0
    inside[first:last] = True
    beyond = np.zeros(power.size)
    beyond[used] = np.where(inside, more, 0.0)
    # Of the whole residual: a signal is there about reversals, too, and so are larger errors.
    rms = float(np.sqrt(np.mean(e[e != 0.0] ** 2)))
    part = float(np.mean(away[away != 0.0] ** 2)) / rms**2
    peak, share = int(np.argmax(beyond)), float(np.clip(part * beyond.sum() / power.sum(), 0.0, 1.0))
    # A line is as narrow as the window allows; wider, it is a signal with a spectrum of its own.
    lobe = beyond[max(peak - NARROW // 2, 0) : peak + NARROW // 2 + 1].sum() if peak > NARROW else 0.0
    narrow = float(lobe / max(beyond.sum(), 1e-300))
    around = slice(max(peak - SHOWN, 0), peak + SHOWN)
    value, noise = (np.sqrt(2.0 * dt * one[around]) for one in (power, level))
    return Excess(
        "frequency" if narrow > MOST else "unrecorded signal", p_value, share, rms,
        (float(f[peak]),), f[around], value, noise, narrow,
    )  # fmt: skip


def _kept(window: Array, taken: Array) -> Array:
    """Share (F,) of the power of noise in a window (M,) that is left at each frequency without ``taken`` (M, k)."""
    lost = np.abs(np.fft.rfft(window[:, None] * taken, axis=0)) ** 2
    return np.asarray(1.0 - lost.sum(axis=1) / max(float(window @ window), 1e-300))


def together(one: Excess | None, other: Excess | None) -> tuple[Excess | None, Excess | None]:
    """Signals of two parts of the data; at one frequency both are evidence for either (Fisher's method).

    It is a line if both have most of their power there. Errors of parameters that a vibration disturbs add frequencies
    of the motion; a slow signal has others in each part.
    """
    if one is None or other is None:
        return one, other
    step = max(float(part.x[1] - part.x[0]) for part in (one, other))
    if abs(one.where[0] - other.where[0]) > PER_FREQUENCY * step:
        return one, other
    p_value = fisher(part.p_value for part in (one, other))
    line = min(one.narrow, other.narrow) > 0.5
    first, second = (replace(p, p_value=p_value, kind="frequency" if line else p.kind) for p in (one, other))
    return first, second


def _noise_level(f: Array, power: Array, used: NDArray[np.int64], dt: float) -> Array:
    """Spectrum (F,) of drives and encoders: white, of one time constant, and rising.

    Least absolute errors of the logarithms: a band that is not the greater part of the frequencies does not move it.
    """
    best, level = np.inf, np.zeros(0)
    for constant in NOISE_TIME_CONSTANTS:
        falling = 1.0 / (1.0 + (2.0 * np.pi * constant * f) ** 2)
        for rise, order in RISES:
            shape = falling + rise * (2.0 * dt * f) ** order
            ratio = power[used] / shape[used]
            median = max(float(np.median(ratio)), 1e-300)
            loss = float(np.mean(np.abs(np.log(np.maximum(ratio / median, 1e-300)))))
            if loss < best:
                best, level = loss, shape * median / LOG_2
    return level


def away_from_reversals(series: Sequence[Array], velocities: Sequence[Array], slow: float) -> list[Array]:
    """Residuals (M,) of one joint, zero about reversals and under ``slow``, where dry friction has no model."""
    return [np.where(about_reversals(e != 0.0, qd, slow), 0.0, e) for e, qd in zip(series, velocities, strict=True)]


def about_reversals(moving: NDArray[np.bool_], qd: Array, slow: float) -> NDArray[np.bool_]:
    """Return true for samples about a reversal, rest or motion under ``slow``, (M,)."""
    turns = np.append(False, np.sign(qd[1:]) != np.sign(qd[:-1])) | ~moving | (np.abs(qd) < slow)
    begin = WINDOW // 2
    return np.asarray(np.convolve(turns, np.ones(WINDOW + 1))[begin : begin + qd.size] > 0.0)


def bursts(
    series: Sequence[Array], times: Sequence[Array], velocities: Sequence[Array], slow: float = 0.0
) -> Excess | None:
    """Moments with more power than the others, of the residual (M,) of one joint with its times and velocities (M,).

    Times about rest, reversals and under the velocity ``slow``, where dry friction has no model, are left out.
    """
    powers, moments = [], []
    for e, t, qd in zip(series, times, velocities, strict=True):
        count = e.size // WINDOW
        used = ~about_reversals(e != 0.0, qd, slow)[: count * WINDOW].reshape(count, WINDOW).any(axis=1)
        powers.append(np.mean(e[: count * WINDOW].reshape(count, WINDOW) ** 2, axis=1)[used])
        moments.append(t[: count * WINDOW : WINDOW][used])
    power, moment = np.concatenate(powers), np.concatenate(moments)
    if power.size < LEAST_FREQUENCIES:
        return None
    free = _independent(series)
    usual = float(np.median(power) * free / chdtri(free, 0.5))
    if usual <= 0.0:
        return None
    p = np.asarray(chdtrc(free, free * power / usual) * power.size)
    strong = np.flatnonzero(p < 1.0)
    if strong.size == 0:
        return None
    share = float(np.sum(power[strong] - usual) / np.sum(power))
    first = strong[np.argsort(-power[strong])][:LISTED]
    error = float(np.sqrt(power.mean()))
    level = np.full(power.size, np.sqrt(usual))
    when = tuple(np.sort(moment[first]).tolist())
    return Excess("bursts", float(min(1.0, p.min())), share, error, when, moment, np.sqrt(power), level)


def larger_errors(
    training: Sequence[Array], held: Sequence[Array], variance: float, times: Sequence[Array], factor: float
) -> Excess | None:
    """Errors of the report part that are ``factor`` times as large as the training data explain.

    ``training``, ``held``: residuals (M,) of one joint `away_from_reversals`, held-out ones at ``times`` (M,);
    ``variance``: mean one of the prediction by the uncertainty of the parameters.
    """
    (one, count), (other, rest) = _power(training), _power(held)
    expected = one + variance
    if not other > factor**2 * expected > 0.0:
        return None
    e, t = np.concatenate(held), np.concatenate(times)
    rms = np.sqrt(np.mean(e[: e.size // WINDOW * WINDOW].reshape(-1, WINDOW) ** 2, axis=1))
    level = np.full(rms.size, np.sqrt(expected))
    p_value = float(fdtrc(rest, count, other / expected))
    times_as_large = float(np.sqrt(other / expected))
    share, error = 1.0 - expected / other, float(np.sqrt(other))
    return Excess("recording", p_value, share, error, (times_as_large,), t[::WINDOW][: rms.size], rms, level)


def _power(series: Sequence[Array]) -> tuple[float, float]:
    """Mean square of the residual of a moving joint, and its number of independent equations."""
    e = np.concatenate(series)
    moving = int(np.count_nonzero(e))
    return float(e @ e) / max(moving, 1), max(moving / WINDOW * _independent(series), 1.0)


def _independent(series: Sequence[Array]) -> float:
    """Independent ones among the equations of a moment, by the autocorrelation of the residual without its extremes."""
    longest = max(series, key=lambda e: e.size)
    scale = CLIPPED * 1.4826 * float(np.median(np.abs(longest[longest != 0.0]))) if longest.any() else 0.0
    e = np.clip(longest, -scale, scale)
    products = [float(e[: e.size - k] @ e[k:]) / max(float(e @ e), 1e-300) for k in range(1, WINDOW)]
    return WINDOW / (1.0 + 2.0 * sum((1 - k / WINDOW) * r**2 for k, r in enumerate(products, start=1)))
