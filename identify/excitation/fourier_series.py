"""Random search over finite Fourier series within the limits of a robot."""

from dataclasses import dataclass

import numpy as np

from armident.arrays import Array
from armident.configs import Trajectory
from armident.configs.schema.trajectory import Fourier
from armident.identify.excitation.point_to_point import PointToPointSearch, Rank

HIGHEST_HZ = 1.6
"""Frequency of the highest harmonic, Hz: above it the velocity limits allow only small amplitudes."""

FEWEST = 5
"""Least number of harmonics: fewer give too few unknowns to excite friction and inertia of a joint."""

STEPS = (0.02, 0.1, 0.4)
"""Standard deviations of the changes of coefficients, relative to their size."""

SAMPLES = 512
"""Instants of a period at which the limits are checked."""

DIGITS = 7
"""Decimal places of a coefficient in a file."""


@dataclass(frozen=True)
class FourierSeries:
    """Sine and cosine ``coefficients`` (2, H, n), ``share`` (n,) of the amplitude, ``middle`` (n,) in the range."""

    coefficients: Array
    share: Array
    middle: Array


class FourierSearch:
    """Search space of Fourier series with the point-to-point cost; ``harmonics`` ``None``: up to `HIGHEST_HZ`."""

    def __init__(self, search: PointToPointSearch, harmonics: int | None = None) -> None:
        self._search, self._rng, self.n = search, search.rng, search.low.size
        self.frequency = 1.0 / search.duration
        self.harmonics = harmonics or max(FEWEST, int(HIGHEST_HZ * search.duration))
        order = np.arange(1.0, self.harmonics + 1)
        self._weights = np.stack([order, order**2])
        angle = 2 * np.pi * np.outer(np.arange(SAMPLES) / SAMPLES, order)
        rate = 2 * np.pi * self.frequency * order
        self._shapes = [
            np.stack([np.sin(angle), np.cos(angle) - 1.0]),
            np.stack([rate * np.cos(angle), -rate * np.sin(angle)]),
            np.stack([-(rate**2) * np.sin(angle), -(rate**2) * np.cos(angle)]),
        ]

    def random(self) -> FourierSeries:
        """Return random coefficients with the same velocity amplitude in each harmonic."""
        coefficients = self._rng.standard_normal((2, self.harmonics, self.n)) / self._weights[0][None, :, None]
        return FourierSeries(coefficients, self._rng.uniform(0.6, 1.0, self.n), self._rng.uniform(0.0, 1.0, self.n))

    def neighbour(self, candidate: FourierSeries) -> FourierSeries:
        """Return the candidate with some coefficients, shares and positions changed."""
        rng, size = self._rng, self._rng.choice(STEPS)
        chosen = rng.random(candidate.coefficients.shape) < rng.choice([0.05, 0.2, 1.0])
        scale = size / self._weights[0][None, :, None]
        step = rng.standard_normal(candidate.coefficients.shape) * scale
        share = np.clip(candidate.share + size * rng.standard_normal(self.n) * (rng.random(self.n) < 0.3), 0.2, 1.0)
        middle = np.clip(candidate.middle + size * rng.standard_normal(self.n) * (rng.random(self.n) < 0.3), 0.0, 1.0)
        return FourierSeries(np.where(chosen, candidate.coefficients + step, candidate.coefficients), share, middle)

    def trajectory(self, candidate: FourierSeries) -> Trajectory:
        """Return the trajectory of a candidate, at rest at both ends and scaled to the limits."""
        weights = self._weights[:, :, None]
        at_rest = candidate.coefficients - weights * (weights * candidate.coefficients).sum(axis=1, keepdims=True) / (
            weights**2
        ).sum(axis=1, keepdims=True)
        search = self._search
        away, speed, push = (np.einsum("kth,khn->tn", shape, at_rest) for shape in self._shapes)
        low, high = away.min(axis=0), away.max(axis=0)
        allowed = np.minimum.reduce(
            [
                (search.high - search.low) / (high - low),
                search.velocity / np.abs(speed).max(axis=0),
                search.acceleration / np.abs(push).max(axis=0),
            ]
        )
        scale = candidate.share * allowed
        coefficients = at_rest * scale
        free = (search.high - search.low) - scale * (high - low)
        start = search.low - scale * low + candidate.middle * np.maximum(free, 0.0)
        sine, cosine = (tuple(tuple(round(float(v), DIGITS) for v in row) for row in kind) for kind in coefficients)
        return Trajectory(
            schema="armident/trajectory/1",
            start=tuple(round(float(v), DIGITS) for v in start),
            fourier=Fourier(frequency=self.frequency, sine=sine, cosine=cosine),
        )

    def rank(self, candidate: FourierSeries, best: Rank) -> Rank:
        """Return the rank of a candidate, as in `PointToPointSearch`. ``best``: rank that it must beat."""
        return self._search.trajectory_rank(self.trajectory(candidate), best)
