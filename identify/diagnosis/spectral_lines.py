"""Residual at the working rate, and its spectral lines: torques of a fixed frequency, independent of the motion."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc, fdtrc

from armident.arrays import Array
from armident.identify.diagnosis.study import Study
from armident.identify.identification.options import CONTROLLERS
from armident.identify.signals.periodogram import hann_window, periodogram

BLOCK = 128
"""Independent frequencies from whose median the spectrum around a line is estimated."""

ASIDE = 10.0
"""Distance, in widths of a modulated line, of the spectrum it is compared with: sidebands raise the nearer one."""

PADDING = 2
"""Number of searched frequencies per independent one."""

HIGHEST = 0.35
"""Highest frequency of the search over the working rate: the first filter begins there."""

EQUIVALENT = BLOCK / 1.5 * np.log(2) ** 2
"""Shape of the gamma distribution with the spread of such a median; a Hann window makes 1.5 frequencies one."""


@dataclass(frozen=True)
class SpectralLine:
    """Spectral line of one joint; ``share`` of the held-out residual's power at the working rate, ``size`` in N m or N.

    ``p_train``: probability of such a line at any frequency without one; ``p_held``: at this frequency in the held-out
    data. ``f``, ``amplitude``, ``noise`` (G,): frequencies around it, Hz; amplitudes of the training residual;
    amplitudes exceeded without a line at one frequency in twenty.
    """

    frequency: float
    p_train: float
    p_held: float
    share: float
    size: float
    f: Array
    amplitude: Array
    noise: Array

    @property
    def p_value(self) -> float:
        """Both combined (Fisher's method)."""
        return float(chdtrc(4, -2.0 * sum(np.log(max(p, 1e-300)) for p in (self.p_train, self.p_held))))


def bandwidth_of_motion(study: Study) -> float:
    """Bandwidth of the motion, Hz; below it the repeatable part of the residual has lines, too."""
    return 0.5 / (study.dt * study.decimation.factor * study.criteria.band)


def lines_of_joints(study: Study, theta: Array) -> Iterator[tuple[int, SpectralLine]]:
    """Strongest line of each joint above the frequencies of the motion that the references do not contain."""
    train, held = ([study.residual(s, theta) for s in part] for part in (study.train, study.held))
    lowest = bandwidth_of_motion(study)
    for j in range(study.robot.n):
        line = strongest_line([e[:, j] for e in train], [e[:, j] for e in held], study.dt, lowest)
        if line is not None and not (line.p_value < study.criteria.line_level and of_references(study, line.frequency)):
            yield j, line


def strongest_line(train: Sequence[Array], held: Sequence[Array], dt: float, lowest: float) -> SpectralLine | None:
    """Strongest line of residuals (N,) above ``lowest``, Hz; ``None`` where the recording is too short.

    Without a line, power over that of the surroundings has an F-distribution. Its phase may differ between stretches.
    """
    spectra = [_Spectrum.of(e, dt) for e in train]
    size = max(s.power.size for s in spectra)
    f = np.linspace(0.0, 0.5 / dt, size)
    chosen = np.flatnonzero((f >= lowest) & (f <= HIGHEST / dt))
    if chosen.size < PADDING * BLOCK:
        return None
    ratio = np.mean([np.interp(f[chosen], s.f, s.power / s.background) for s in spectra], axis=0)
    peak = int(np.argmax(ratio))
    frequency = float(f[chosen[peak]])
    unseen = [_Spectrum.of(e, dt) for e in held]
    there = [s.at(frequency) for s in unseen]
    power = sum(max(p - b, 0.0) * s.to_power for (p, b), s in zip(there, unseen, strict=True)) / len(unseen)
    total = sum(float(e @ e) for e in held) / sum(e.size for e in held)
    longest = max(spectra, key=lambda s: s.power.size)
    around = np.flatnonzero(np.abs(longest.f - frequency) <= 40 * longest.f[1])
    return SpectralLine(
        frequency,
        min(1.0, chosen.size * _chance(float(ratio[peak]), len(spectra))),
        _chance(float(np.mean([p / b for p, b in there])), len(there)),
        power / max(total, 1e-300),
        float(np.sqrt(power)),
        longest.f[around],
        np.sqrt(2.0 * longest.to_power * longest.power[around]),
        np.sqrt(2.0 * longest.to_power * longest.background[around] * np.log(20.0)),
    )


def of_references(study: Study, frequency: float) -> bool:
    """Return true if the references contain the line, too: set points have a rate of their own.

    The motion modulates the line, so its width is a share of the bandwidth of the motion.
    """
    wide, criteria = study.criteria.modulated_line * bandwidth_of_motion(study), study.criteria
    recorded = study.loop in CONTROLLERS
    every = (joint for reference in study.auxiliary.references for joint in reference.T)
    return any(
        has_line(joint, study.sample, frequency, wide, criteria.reference_line, recorded=recorded) for joint in every
    )


def has_line(reference: Array, sample: float, frequency: float, wide: float, least: float, *, recorded: bool) -> bool:
    """Return true if a reference (N,) has a line within ``wide``, Hz, with ``least`` times the power beside it.

    Where none is recorded, the measured motion stands for it, which a vibration shakes, too: set points come once in a
    whole number of samples.
    """
    spectrum = _Spectrum.of(np.diff(reference, 2), sample)
    sharp = 2 * PADDING * spectrum.f[1]
    samples = 1.0 / (frequency * sample)
    if not recorded and abs(samples - round(samples)) > samples * sharp / frequency:
        return False
    near = np.abs(spectrum.f - frequency) <= max(wide, sharp)
    beside = np.interp([frequency - ASIDE * wide, frequency + ASIDE * wide], spectrum.f, spectrum.background)
    return bool(np.any(spectrum.power[near] > least * beside.max()))


def _chance(ratio: float, stretches: int) -> float:
    """Probability of so large a mean of power over background without a line."""
    return float(fdtrc(2 * stretches, 2 * EQUIVALENT * stretches, ratio))


@dataclass(frozen=True, eq=False)
class _Spectrum:
    """Power at frequencies f, and that of the surroundings; ``to_power`` times power is the mean square of a line."""

    f: Array
    power: Array
    background: Array
    to_power: float
    windowed: Array
    dt: float

    @classmethod
    def of(cls, e: Array, dt: float) -> "_Spectrum":
        """Return the spectrum of a series with a Hann window. ``e``: series, (N,)."""
        window = hann_window(e.size)
        windowed = window * (e - e.mean())
        power = periodogram(windowed, PADDING)
        parts = np.array_split(np.arange(power.size), max(1, power.size // (PADDING * BLOCK)))
        level = np.array([np.log(max(np.median(power[part]) / np.log(2), 1e-300)) for part in parts])
        background = np.exp(np.interp(np.arange(power.size), [part.mean() for part in parts], level))
        f = np.arange(power.size) / (PADDING * e.size * dt)
        return cls(f, power, background, 2.0 / float(window.sum()) ** 2, windowed, dt)

    def at(self, frequency: float) -> tuple[float, float]:
        """Return power and background at any frequency."""
        turning = np.exp(-2j * np.pi * frequency * self.dt * np.arange(self.windowed.size))
        return float(np.abs(self.windowed @ turning) ** 2), float(np.interp(frequency, self.f, self.background))
