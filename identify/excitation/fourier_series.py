"""Random search over finite Fourier sums within the limits of a robot: candidates and their neighbours."""

from dataclasses import dataclass

import numpy as np

from armident.configs import Trajectory
from armident.configs.schema.trajectory import Fourier
from armident.identify.excitation.point_to_point import PointToPointSearch
from armident.identify.robot.chain import Floats

HIGHEST_HZ = 1.6
"""Highest harmonic: above it a joint that keeps its velocity limit hardly moves."""

FEWEST = 5
"""Harmonics of a short trajectory; with less there are fewer unknowns than a joint's friction and inertia ask for."""

STEPS = (0.02, 0.1, 0.4)
"""Standard deviations of the changes of coefficients, relative to all of them."""

SAMPLES = 512
"""Instants of a period at which the limits are looked at."""

DIGITS = 7
"""Digits of a coefficient in a file, behind the point."""


@dataclass(frozen=True)
class FourierSeries:
    """Coefficients (2, H, n) of sine and cosine before they are fitted into the limits, and the middle (n,) wanted.

    ``share`` (n,) is how much of what the limits allow is used; ``middle`` where in the free range the motion lies, 0
    to 1.
    """

    coefficients: Floats
    share: Floats
    middle: Floats


class FourierSearch:
    """Candidates within the limits, their neighbours and cost; limits and cost are those of the search for moves.

    Parameters
    ----------
    search
        With limits, noise, and what is known of the robot.
    harmonics
        How many; ``None``: up to `HIGHEST_HZ`.
    """

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
        """Coefficients that fall with the order: as much velocity in each harmonic."""
        coefficients = self._rng.standard_normal((2, self.harmonics, self.n)) / self._weights[0][None, :, None]
        return FourierSeries(coefficients, self._rng.uniform(0.6, 1.0, self.n), self._rng.uniform(0.0, 1.0, self.n))

    def neighbour(self, candidate: FourierSeries) -> FourierSeries:
        """The candidate with a few coefficients changed, and perhaps its place."""
        rng, size = self._rng, self._rng.choice(STEPS)
        chosen = rng.random(candidate.coefficients.shape) < rng.choice([0.05, 0.2, 1.0])
        scale = size / self._weights[0][None, :, None]
        step = rng.standard_normal(candidate.coefficients.shape) * scale
        share = np.clip(candidate.share + size * rng.standard_normal(self.n) * (rng.random(self.n) < 0.3), 0.2, 1.0)
        middle = np.clip(candidate.middle + size * rng.standard_normal(self.n) * (rng.random(self.n) < 0.3), 0.0, 1.0)
        return FourierSeries(np.where(chosen, candidate.coefficients + step, candidate.coefficients), share, middle)

    def trajectory(self, candidate: FourierSeries) -> Trajectory:
        """The candidate at rest in the beginning, as large as the limits allow."""
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

    def cost(self, candidate: FourierSeries) -> float:
        """As that of moves."""
        return self._search.worth(self.trajectory(candidate))
