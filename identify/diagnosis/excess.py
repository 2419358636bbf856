"""Torques that no recorded motion explains: parts of the residual that are not broadband noise of drives and encoders.

Such noise has a smooth spectrum and the same power at all times. A noise model would take a vibration, a slow signal or
a contact for noise: here the spectrum is compared with its surroundings, and the power with that of other moments.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from armident.identify.signals.periodogram import hann_window, periodogram

Array = NDArray[np.float64]

SURROUNDINGS = 20
"""Least number of frequencies at either side whose median is the level of the noise; above, as many as half of those
below: the spectrum of noise with one time constant is nearly linear in the frequency over such a range."""

PER_FREQUENCY = 1.5
"""Frequencies of a Hann window that count as one independent one."""

NARROW = 6
"""Frequencies about a line that hold most of its power: the main lobe of a Hann window, and one more at either side."""

MOST = 0.9
"""Share of the power beyond noise that a line has within `NARROW` frequencies."""

WINDOW = 8
"""Equations whose mean power is that of a moment: about four periods at the highest frequency of the comparison."""

CLIPPED = 3.0
"""Robust standard deviations to which a residual is limited for the time over which its noise is correlated."""

LISTED = 3
"""Largest number of moments that are named."""

LOG_2 = float(np.log(2.0))


@dataclass(frozen=True)
class Excess:
    """Part of one joint's residual beyond broadband noise, of the training or of the held-out data.

    ``share`` of the residual's power; ``size``: rms, N m or N. ``where``: frequency, Hz, or the first moments, s.
    ``x``, ``value``, ``noise`` (G,): amplitude over frequency or time, and that of the noise.
    """

    kind: Literal["frequency", "unrecorded signal", "bursts"]
    p_value: float
    p_held: float
    share: float
    size: float
    where: tuple[float, ...]
    x: Array
    value: Array
    noise: Array


def spectral_excess(train: Sequence[Array], held: Sequence[Array], dt: float) -> Excess | None:
    """Frequencies with more power than their surroundings, by the most significant band; none in a short recording.

    ``train``, ``held``: residuals (M,) of one joint in the band of the comparison, zero at rest; the longest counts.
    """
    longest, unseen = max(train, key=lambda e: e.size), max(held, key=lambda e: e.size)
    if not (longest.any() and unseen.any()):
        return None
    own, other = _Spectrum.of(longest, dt), _Spectrum.of(unseen, dt)
    sums = np.append(0.0, np.cumsum(own.ratio))
    p_value, start, width, tried = 1.0, 1, 0, 0
    for wide in (2**k for k in range(max(own.f.size // 4, 1).bit_length())):
        starts = np.arange(1, own.f.size - wide + 1, max(1, wide // 2))
        p = own.chance((sums[starts + wide] - sums[starts]) / wide, starts + wide // 2, wide)
        tried += starts.size
        if p.min(initial=1.0) < p_value:
            p_value, start, width = float(p.min()), int(starts[np.argmin(p)]), wide
    inside = np.flatnonzero(np.abs(other.f - own.f[start] - 0.5 * width * own.f[1]) <= 0.5 * (width + 1) * own.f[1])
    if width == 0 or inside.size == 0:
        return None
    p_held = float(other.chance(other.ratio[inside].mean()[None], inside[[inside.size // 2]], inside.size)[0])
    numbers = np.arange(own.f.size)
    strong = (own.chance(own.ratio, numbers, 1) * own.f.size < 1.0) | (numbers >= start) & (numbers < start + width)
    strong[0] = False
    beyond = np.where(strong, np.maximum(own.power - own.level, 0.0), 0.0)
    share, peak = float(beyond.sum() / np.sum(own.power)), int(np.argmax(beyond))
    # A line is as narrow as the window allows; wider, it is a signal with a spectrum of its own.
    line = beyond[max(peak - NARROW // 2, 0) : peak + NARROW // 2 + 1].sum() > MOST * beyond.sum()
    narrow = line and peak > NARROW
    around = slice(max(peak - 2 * SURROUNDINGS, 0), peak + 2 * SURROUNDINGS)
    value, noise = (np.sqrt(2.0 * dt * one[around]) for one in (own.power, own.level))
    return Excess(
        "frequency" if narrow else "unrecorded signal", min(1.0, tried * p_value), p_held, share,
        float(np.sqrt(share * np.mean(longest[longest != 0.0] ** 2))), (float(own.f[peak]),),
        own.f[around], value, noise,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Spectrum:
    """Power of a series at frequencies ``f``, Hz, the level of the noise there, and the ratio of both, (F,) each."""

    f: Array
    power: Array
    level: Array
    neighbours: NDArray[np.int64]

    @classmethod
    def of(cls, e: Array, dt: float) -> "_Spectrum":
        power = periodogram(hann_window(e.size) * e)
        numbers = np.arange(power.size)
        half = np.maximum(SURROUNDINGS, numbers // 2)
        first, last = np.maximum(numbers - half, 1), np.minimum(numbers + half + 1, power.size)
        # At the ends of the band as many neighbours as elsewhere.
        first = np.maximum(np.minimum(first, power.size - 2 * half), 1)
        last = np.minimum(np.maximum(last, 2 * half), power.size)
        level = np.array([np.median(power[a:b]) for a, b in zip(first, last, strict=True)]) / LOG_2
        return cls(numbers / (e.size * dt), power, np.maximum(level, 1e-300), last - first)

    @property
    def ratio(self) -> Array:
        return self.power / self.level

    def chance(self, mean: Array, at: NDArray[np.int64], width: int) -> Array:
        """Probability of so large a mean ratio over ``width`` frequencies about those numbered ``at``, in noise."""
        own = 2.0 * max(1.0, width / PER_FREQUENCY)
        return np.asarray(stats.f.sf(mean, own, 2.0 * self.neighbours[at] / PER_FREQUENCY * LOG_2**2))


def bursts(series: Sequence[Array], times: Sequence[Array], velocities: Sequence[Array]) -> Excess | None:
    """Moments with more power than the others, of the residual (M,) of one joint with its times and velocities (M,).

    Times about rest and reversals, where dry friction has no model, are left out.
    """
    powers, moments = [], []
    for e, t, qd in zip(series, times, velocities, strict=True):
        count = e.size // WINDOW
        turns = np.append(False, np.sign(qd[1:]) != np.sign(qd[:-1])) | (e == 0.0)
        near = np.convolve(turns, np.ones(WINDOW + 1), mode="same") > 0.0
        used = ~near[: count * WINDOW].reshape(count, WINDOW).any(axis=1)
        powers.append(np.mean(e[: count * WINDOW].reshape(count, WINDOW) ** 2, axis=1)[used])
        moments.append(t[: count * WINDOW : WINDOW][used])
    power, moment = np.concatenate(powers), np.concatenate(moments)
    if power.size < 2 * SURROUNDINGS:
        return None
    free = _independent(series)
    usual = float(np.median(power) * free / stats.chi2.median(free))
    if usual <= 0.0:
        return None
    p = np.asarray(stats.chi2.sf(free * power / usual, free) * power.size)
    strong = np.flatnonzero(p < 1.0)
    if strong.size == 0:
        return None
    share = float(np.sum(power[strong] - usual) / np.sum(power))
    first = strong[np.argsort(-power[strong])][:LISTED]
    rms = float(np.sqrt(share * power.mean()))
    level = np.full(power.size, np.sqrt(usual))
    when = tuple(np.sort(moment[first]).tolist())
    # An event needs no confirmation by other data: nothing was selected by it.
    return Excess("bursts", float(min(1.0, p.min())), 0.0, share, rms, when, moment, np.sqrt(power), level)


def _independent(series: Sequence[Array]) -> float:
    """Independent ones among the equations of a moment, by the autocorrelation of the residual without its extremes."""
    longest = max(series, key=lambda e: e.size)
    scale = CLIPPED * 1.4826 * float(np.median(np.abs(longest[longest != 0.0]))) if longest.any() else 0.0
    e = np.clip(longest, -scale, scale)
    products = [float(e[: e.size - k] @ e[k:]) / max(float(e @ e), 1e-300) for k in range(1, WINDOW)]
    return WINDOW / (1.0 + 2.0 * sum((1 - k / WINDOW) * r**2 for k, r in enumerate(products, start=1)))
