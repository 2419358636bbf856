"""Whether what a model leaves is noise: its power at the frequencies of the motion beside that of noise.

Noise of currents and encoders is about as strong beyond the frequencies of the motion as at them; what a model lacks
follows the motion. So the residual's spectrum at the frequencies of the motion is held against its strongest part
beyond. Where the arm makes the same motion twice nothing has to be supposed of the noise: it is what differs
between the two times, at every frequency by itself, and what is the same both times is the model's fault.
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
"""Edges of the frequencies of the motion, over its bandwidth: octaves, for what is slow has few frequencies."""

BEYOND = (1.0, 1.5, 2.0, 2.5, 3.5)
"""Edges of those that noise is looked at; the filters begin above them."""

HEADROOM = 4.0
"""Density that noise may have at the frequencies of the motion over that beyond: loops and filters colour it."""

MATERIAL = 0.05
"""Share of a joint's residual power that must not be noise for it to be a gap."""

TOGETHER = 1 / 3
"""Part of the chance of a false alarm that is for all joints together."""

SPREAD = 1.5
"""Neighbouring frequencies under a Hann window that count as one."""


@dataclass(frozen=True)
class Excess:
    """What of a joint's residual is not noise.

    Parameters
    ----------
    joint
        Its number.
    share
        Share of the residual's power that is not noise.
    p_value
        That noise alone is so strong at the frequencies of the motion, of this one joint.
    repeated
        Whether the noise is known from a repetition of the motion.
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

    One criterion for every robot: at the frequencies of the motion, octave by octave, power over that of noise has an
    F-distribution if the residual is noise, and the octaves of a joint are combined by Fisher's method. A joint is
    among them if chance makes it so strong with a probability under ``alpha`` over all joints, and at least `MATERIAL`
    of the residual's power is more than noise. Of several joints a third of ``alpha`` is for what shows at none of them
    alone (a base that shakes): the joints are combined likewise, and the one that is least like noise stands for all.

    Parameters
    ----------
    alpha
        Chance of a false alarm over all joints.
    """
    looks = (excess_of(fit, j, own) for j, own in enumerate(pieces(fit)))
    every = [e for e in looks if e is not None]
    one, several = (1.0 - TOGETHER, TOGETHER) if len(every) > 1 else (1.0, 0.0)
    material = sorted((e for e in every if e.share >= MATERIAL), key=lambda e: e.p_value)
    alone = [e for e in material if e.p_value < one * alpha / fit.study.robot.n]
    together = float(stats.combine_pvalues([e.p_value for e in every]).pvalue) if every else 1.0
    return sorted(alone or (material[:1] if together < several * alpha else []), key=lambda e: e.joint)


def excess_of(fit: Fit, joint: int, pieces: Pieces) -> Excess | None:
    """What of one joint's residual is not noise; ``None`` where too little was recorded to say.

    Parameters
    ----------
    pieces
        The joint's residual where the arm moves, and what is noise of it, if that is known.
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
    """Of every joint: sums and differences of repetitions, or else the held-out residual."""
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
        Mean square of all pieces, by their length, less what is constant.
    """

    f: Array
    density: Array
    power_sum: float

    @classmethod
    def of(cls, pieces: Sequence[Array], dt: float) -> "Spectrum":
        """Of pieces (N,) each, under a Hann window."""
        f, density, length = [], [], 0.0
        for piece in pieces:
            of_piece = 2 * dt * periodogram(hann_window(piece.size) * piece)
            f.append(np.fft.rfftfreq(piece.size, dt)[1:])
            density.append(of_piece[1:])
            length += piece.size * dt
        every = np.concatenate(density)
        return cls(np.concatenate(f), every, float(every.sum()) / length)

    def level(self, low: float, high: float) -> tuple[float, float]:
        """Mean density between two frequencies, and its degrees of freedom; zeros where there is no frequency."""
        inside = (self.f >= low) & (self.f < high)
        count = int(inside.sum())
        return (float(self.density[inside].mean()), max(2.0 * count / SPREAD, 2.0)) if count else (0.0, 0.0)
