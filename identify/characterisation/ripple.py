"""Torque ripple over position at constant speeds: amplitude of every order, and those that noise does not explain."""

from dataclasses import dataclass

import numpy as np

from armident.arrays import Array
from armident.identify.characterisation.estimates import LEVEL, RATE_HZ
from armident.identify.characterisation.friction import Levels

HIGHEST_HZ = RATE_HZ / 4
"""Highest frequency of a ripple at a plateau: block means keep 90 % of it, and none of its aliases."""
STEPS = 4
"""Orders searched per independent order, as in the order analysis of a diagnosis."""
FINER = 8
"""Steps of the refinement of an order per such step."""
PEAKS = 5
"""Most orders reported."""
SLOW = 0.25
"""Quantile of the speeds at which the highest order reaches `HIGHEST_HZ`."""
CHUNK = 256
"""Orders tested at a time."""


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Amplitudes and noise floor (G,), N m or N, over orders (G,), cycles per unit; ``peaks``: the largest first."""

    orders: Array
    amplitudes: Array
    floor: Array
    peaks: tuple[tuple[float, float, float], ...]
    levels: Levels


def ripples(found: Levels) -> Spectrum | None:
    """Return the ripple beside the levels of constant speeds; ``None`` if no two periods of one were crossed."""
    positions = np.concatenate(found.positions)
    span = float(np.ptp(positions))
    slow = float(np.quantile([abs(p.speed) for p in found.plateaus], SLOW))
    step, highest = 1.0 / span, HIGHEST_HZ / slow
    orders = np.arange(2.0 * step, highest, step / STEPS)
    if not orders.size:
        return None
    limit = -2.0 * np.log(LEVEL * STEPS / orders.size)
    amplitudes, floor, gain = _amplitudes(found, orders)
    peaks: list[float] = []
    rest = found
    while len(peaks) < PEAKS:
        if gain.max() < limit:
            break
        k = int(np.argmax(gain))
        near = orders[k] + step / STEPS * np.linspace(-1.0, 1.0, 2 * FINER + 1)
        peaks.append(float(near[int(np.argmax(_amplitudes(rest, near)[2]))]))
        rest = found.beside(
            [np.hstack(each) for each in zip(*(_waves(found, np.array([o])) for o in peaks), strict=True)]
        )
        gain = _amplitudes(rest, orders)[2]
        gain[np.any(np.abs(orders[:, None] - np.array(peaks)) < step, axis=1)] = 0.0
    first = found.columns[0].shape[1]
    measured = []
    for k, order in enumerate(peaks):
        own = slice(first + 2 * k, first + 2 * k + 2)
        b, c = rest.fit.theta[own], rest.fit.covariance[own, own]
        size = float(np.hypot(*b))
        measured.append((order, size, float(np.sqrt(b @ c @ b)) / size))
    measured.sort(key=lambda each: -each[1])
    return Spectrum(orders, amplitudes, np.sqrt(limit) * floor, tuple(measured), rest)


def _waves(found: Levels, orders: Array) -> list[Array]:
    """Return cosine and sine (M, 2 G) of each plateau, as block means have them; zero where they are too fast."""
    out = []
    for p, q in zip(found.plateaus, found.positions, strict=True):
        f = orders * abs(p.speed)
        kept = np.where(f <= HIGHEST_HZ, np.sinc(f / RATE_HZ), 0.0)
        angle = 2.0 * np.pi * q[:, None] * orders
        out.append(np.hstack([kept * np.cos(angle), kept * np.sin(angle)]))
    return out


def _amplitudes(found: Levels, orders: Array) -> tuple[Array, Array, Array]:
    """Return amplitudes (G,), their standard deviations, and gains of the log likelihood, times two."""
    basis = np.linalg.qr(found.fit.columns)[0]
    sizes, stds, gains = [], [], []
    for part in np.array_split(orders, max(1, orders.size // CHUNK)):
        z = found.fit.whiten(_waves(found, part))
        z -= basis @ (basis.T @ z)
        c, s = z[:, : part.size], z[:, part.size :]
        cc, ss, cs = (np.einsum("ij,ij->j", a, b) for a, b in ((c, c), (s, s), (c, s)))
        yc, ys = found.fit.residual @ c, found.fit.residual @ s
        free = np.maximum(cc * ss - cs**2, 1e-300)
        b, d = (ss * yc - cs * ys) / free, (cc * ys - cs * yc) / free
        sizes.append(np.hypot(b, d))
        stds.append(np.sqrt(0.5 * (cc + ss) / free))
        gains.append(b * yc + d * ys)
    return np.concatenate(sizes), np.concatenate(stds), np.concatenate(gains)
