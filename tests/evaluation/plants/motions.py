"""Motions of random arms: periodic Fourier series and point-to-point moves."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tests.evaluation.plants.arm import PRISMATIC_SCALE, Arm, Generator

Floats = NDArray[np.float64]
MotionKind = Literal["fourier", "point_to_point"]

HARMONICS = 5
"""Harmonics of a periodic motion."""
SETTLE_S = 0.8
"""Time in which a periodic motion starts from rest, s."""


@dataclass(frozen=True, eq=False)
class Motion:
    """Reference of a recording at every step.

    ``position``, ``velocity``: joint side, rad or m, and rad/s or m/s, shape (K, n).
    """

    position: Floats
    velocity: Floats


def random_motion(rng: Generator, arm: Arm, kind: MotionKind, duration: float, step: float) -> Motion:
    """Draw a motion that uses the speed and the range of each joint. ``kind``: family of the motion."""
    t = np.arange(round(duration / step), dtype=np.float64) * step
    make = _fourier if kind == "fourier" else _point_to_point
    position = np.column_stack(
        [make(rng, t, arm.speed[j], PRISMATIC_SCALE if arm.prismatic[j] else 1.0) for j in range(arm.n)]
    )
    return Motion(position, np.gradient(position, step, axis=0))


def _fourier(rng: Generator, t: Floats, speed: float, metre: float) -> Floats:
    base = 2.0 * np.pi * rng.uniform(0.08, 0.16)
    out = np.zeros_like(t)
    for k in range(1, HARMONICS + 1):
        out += rng.normal() / k**0.7 * np.sin(k * base * t + rng.uniform(0.0, 2.0 * np.pi))
    rate = np.abs(np.gradient(out, t)).max()
    out *= min(speed / rate, 1.5 * metre / np.abs(out).max())
    start = np.clip(t / SETTLE_S, 0.0, 1.0)
    return np.asarray(out * start**3 * (10.0 - 15.0 * start + 6.0 * start**2))


def _point_to_point(rng: Generator, t: Floats, speed: float, metre: float) -> Floats:
    """Moves of fifth order between random points, each with a rest."""
    out = np.zeros_like(t)
    at, begin = 0.0, rng.uniform(0.05, 0.3)
    while begin < t[-1]:
        to = rng.uniform(-1.4, 1.4) * metre
        peak = speed * rng.uniform(0.4, 1.0)
        time = max(1.875 * abs(to - at) / peak, 0.25)
        x = np.clip((t - begin) / time, 0.0, 1.0)
        out += (to - at) * x**3 * (10.0 - 15.0 * x + 6.0 * x**2)
        at, begin = to, begin + time + rng.choice([0.0, rng.uniform(0.05, 0.4)])
    return out
