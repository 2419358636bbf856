"""Lack-of-fit test: power of the residual at the frequencies of the motion against that of the noise.

Noise of currents and encoders is about as strong above the frequencies of the motion as at them; a missing effect
follows the motion. So the spectrum of the residual at the frequencies of the motion is compared with its strongest
part above. Where the arm repeats a motion no assumption on the noise is needed. The difference of the repetitions is
noise, at every frequency by itself; their common part is an error of the model.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from armident.identify.diagnosis.lines import lowest_frequency
from armident.identify.diagnosis.regression import Fit
from armident.identify.diagnosis.repeats import repeats
from armident.identify.signals.periodogram import hann_window, periodogram

Array = NDArray[np.float64]
Pieces = tuple[Sequence[Array], Sequence[Array] | None]

INSIDE = (0.0, 0.125, 0.25, 0.5, 1.0)
"""Edges of the frequencies of the motion, over its bandwidth: octaves, because low ones have few frequencies."""

BEYOND = (1.0, 1.5, 2.0, 2.5, 3.5)
"""Edges of the frequencies that determine the noise, over the bandwidth; the filters act above them."""

HEADROOM = 4.0
"""Greatest ratio of noise densities at the frequencies of the motion and above: loops and filters colour the noise."""

MATERIAL = 0.05
"""Least share of a joint's residual power in excess of noise for a lack of fit."""

TOGETHER = 1 / 3
"""Share of alpha spent on the combined (Fisher) test over joints."""

SPREAD = 1.5
"""Number of neighbouring frequencies per independent one under a Hann window."""


@dataclass(frozen=True)
class Excess:
    """Lack of fit of one joint.

    Parameters
    ----------
    joint
        Its number.
    share
        Share of the residual's power that is not noise.
    p_value
        Probability of so much power at the frequencies of the motion from noise alone, of this one joint.
    repeated
        True if the noise is known from a repetition of the motion.
    f, amplitude, noise
        Centres of the octaves, Hz, and the root of the spectral density there of the residual and of the noise,
        N m/sqrt(Hz) or N/sqrt(Hz), (G,) each.
    """

    joint: int
    share: float
    p_value: float
    repeated: bool
    f: Array
    amplitude: Array
    noise: Array


def excesses(fit: Fit, alpha: float = 0.01) -> list[Excess]:
    """Joints whose residual is not compatible with noise.

    One criterion for every robot. At the frequencies of the motion, octave by octave, power over that of noise has an
    F-distribution if the residual is noise. The octaves of a joint are combined by Fisher's method. A joint is listed
    if its p-value is significant at ``alpha`` over all joints, and at least `MATERIAL` of the residual's power is more
    than noise. With several joints a third of ``alpha`` is spent on the combined (Fisher) test over joints, for errors
    too small at each of them (a base that shakes). The joint with the smallest p-value is then listed.

    Parameters
    ----------
    fit
        Fit whose residuals are tested.
    alpha
        Probability of a false alarm over all joints.
    """
    looks = (excess_of(fit, j, own) for j, own in enumerate(pieces(fit)))
    every = [e for e in looks if e is not None]
    one, several = (1.0 - TOGETHER, TOGETHER) if len(every) > 1 else (1.0, 0.0)
    material = sorted((e for e in every if e.share >= MATERIAL), key=lambda e: e.p_value)
    alone = [e for e in material if e.p_value < one * alpha / fit.study.robot.n]
    together = float(stats.combine_pvalues([e.p_value for e in every]).pvalue) if every else 1.0
    return sorted(alone or (material[:1] if together < several * alpha else []), key=lambda e: e.joint)


def excess_of(fit: Fit, joint: int, pieces: Pieces) -> Excess | None:
    """Lack of fit of one joint; ``None`` where the recording is too short for a test.

    Parameters
    ----------
    fit
        Fit whose residuals are tested.
    joint
        Number of the joint.
    pieces
        Residual of the joint where the arm moves, and its noise, if that is known.
    """
    dt, bandwidth = fit.study.dt * fit.study.decimation.factor, lowest_frequency(fit.study)
    sums, differences = (None if part is None else Spectrum.of(part, dt) for part in pieces)
    assert sums is not None
    octaves = [(low * bandwidth, high * bandwidth) for low, high in pairwise(INSIDE)]
    if differences is None:
        beyond = [sums.level(low * bandwidth, high * bandwidth) for low, high in pairwise(BEYOND)]
        density, free = max(beyond, key=lambda level: level[0])
        noise = [(HEADROOM * density, free)] * len(octaves)
        whole, part = sums.power_sum, 1.0
    else:
        noise = [differences.level(*octave) for octave in octaves]
        # The sum of two times holds the reproducible part twice and the noise once.
        whole, part = 0.5 * (sums.power_sum + differences.power_sum), 0.5
    p, surplus, shown = [], 0.0, []
    for (low, high), (there, its) in zip(octaves, noise, strict=True):
        density, own = sums.level(low, high)
        if own == 0 or its == 0 or there <= 0:
            continue
        p.append(max(float(stats.f.sf(density / there, own, its)), 1e-300))
        surplus += part * max(density - there, 0.0) * (high - low)
        shown.append((np.sqrt(low * high) if low else 0.5 * high, np.sqrt(density), np.sqrt(there)))
    if not p or whole <= 0:
        return None
    f, amplitude, known = np.array(shown).T
    share = min(surplus / whole, 1.0)
    together = float(stats.combine_pvalues(p).pvalue)
    return Excess(joint, share, together, differences is not None, f, amplitude, known)


def pieces(fit: Fit) -> list[Pieces]:
    """Sums and differences of repetitions of every joint, or else the held-out residual."""
    held = fit.errors(fit.theta, held=True)
    both = [*fit.errors(fit.theta, held=False), *held]
    halves = [r.halves(both) for r in repeats(fit.study, 1.0 / lowest_frequency(fit.study))]
    joints = range(fit.study.robot.n)
    if not halves:
        return [([e[:, j] for e in held], None) for j in joints]
    return [([s[:, j] for s, _ in halves], [d[:, j] for _, d in halves]) for j in joints]


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Periodograms of several pieces, one after the other.

    Parameters
    ----------
    f, density
        Frequencies without zero, Hz, and one-sided power densities there, (F,).
    power_sum
        Mean square of all pieces, weighted by their length, without the mean.
    """

    f: Array
    density: Array
    power_sum: float

    @classmethod
    def of(cls, pieces: Sequence[Array], dt: float) -> "Spectrum":
        """Periodograms under a Hann window.

        Parameters
        ----------
        pieces
            One array (N,) each.
        dt
            Sampling period, s.
        """
        f, density, length = [], [], 0.0
        for piece in pieces:
            of_piece = 2 * dt * periodogram(hann_window(piece.size) * piece)
            f.append(np.fft.rfftfreq(piece.size, dt)[1:])
            density.append(of_piece[1:])
            length += piece.size * dt
        every = np.concatenate(density)
        return cls(np.concatenate(f), every, float(every.sum()) / length)

    def level(self, low: float, high: float) -> tuple[float, float]:
        """Mean density between two frequencies, and its degrees of freedom; zeros where there is no frequency.

        Parameters
        ----------
        low, high
            Frequencies, Hz.
        """
        inside = (self.f >= low) & (self.f < high)
        count = int(inside.sum())
        return (float(self.density[inside].mean()), max(2.0 * count / SPREAD, 2.0)) if count else (0.0, 0.0)
