"""Prismatic axis with dry friction in closed loop, with noise of encoder and torque; quick enough for Monte Carlo runs.

The axis is integrated apart from the package: 20 steps per sample of the method ``ode23s`` for one mass.
"""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from armident.compiled import compiled
from armident.configs import RobotConfig
from armident.identify.signals.experiments import Experiment

Floats = NDArray[np.float64]

DT = 1e-3
STEPS = 20
"""Integration steps per sample."""
MASS, VISCOUS, COULOMB = 95.0, 203.0, 20.0
"""kg, N s/m, N: about those of the EMPS (Janot, Gautier, Brunot 2019)."""
TRUTH = np.array([MASS, VISCOUS, COULOMB, 0.0])
KP, KV = 160.0, 8557.0
"""Cascade gains of the EMPS, 1/s and N s/m; velocity over two samples."""
SMOOTHING = 5000.0
"""``g`` of the friction, s/m."""
MOVES, STROKE, SPEEDS, ACCELERATION = 14, 0.2, (0.03, 0.15), 1.5
"""Number of moves, largest position, m, range of speeds, m/s, and acceleration, m/s^2."""


def robot() -> RobotConfig:
    """The axis with the friction law of the plant."""
    return RobotConfig.model_validate(
        {
            "schema": "armident/robot/1",
            "name": "axis",
            "gravity": [0.0, -9.81, 0.0],
            "joints": [
                {
                    "name": "axis",
                    "type": "prismatic",
                    "mdh": {"alpha": 0.0, "d": 0.0, "theta": 0.0, "r": 0.0},
                    "limits": {"position": [-1.0, 1.0], "velocity": 0.5, "acceleration": 5.0, "torque": 2000.0},
                    "drive": {"signal": "torque"},
                    "rotor_inertia": False,
                }
            ],
            "transmission": [[1.0]],
            "friction": {"sign_smoothing": SMOOTHING},
        }
    )


def recorded(
    seed: int,
    *,
    torque: float = 0.0,
    pole: float = 0.0,
    position: float = 0.0,
    count: float = 1e-7,
    moves: int = MOVES,
) -> Experiment:
    """A recording of random moves, the same for every seed; the noise differs.

    ``torque``, ``pole``: standard deviation of the noise of the recorded force, N, and its pole: AR(1). ``position``:
    standard deviation of the white noise of the encoder, m; it passes through the controller. ``count``: encoder
    resolution, m; 0: none.
    """
    rng = np.random.default_rng(seed)
    reference = _reference(moves)
    white = torque * np.sqrt(1 - pole**2) * rng.normal(size=reference.size)
    noise = np.asarray(signal.lfilter([1.0], [1.0, -pole], white))
    q, force = _simulate(reference, position * rng.normal(size=reference.size), count)
    return Experiment(q[:, None], (force + noise)[:, None], reference[:, None], DT)


def _reference(moves: int) -> Floats:
    """Trapezoidal moves between random positions, m."""
    rng = np.random.default_rng(7)
    points = np.concatenate([[0.0], rng.uniform(-STROKE, STROKE, moves)])
    parts = []
    for a, b in pairwise(points):
        distance = abs(b - a)
        speed = min(rng.uniform(*SPEEDS), np.sqrt(distance * ACCELERATION))
        ramp = speed / ACCELERATION
        total = ramp + distance / speed
        t = DT * np.arange(int(np.ceil(total / DT)))
        rising, steady = 0.5 * ACCELERATION * t**2, speed * (t - ramp / 2)
        falling = distance - 0.5 * ACCELERATION * (total - t) ** 2
        way = np.where(t < ramp, rising, np.where(t < total - ramp, steady, falling))
        parts.append(a + np.sign(b - a) * np.clip(way, 0.0, distance))
    return np.concatenate(parts)


@compiled(kept=True, nogil=False)
def _simulate(reference: Floats, noise: Floats, count: float) -> tuple[Floats, Floats]:
    """Recorded positions and forces (N,)."""
    q, force = np.empty(reference.size), np.empty(reference.size)
    p, v, h = reference[0], 0.0, DT / STEPS
    gamma, dry = 1.0 / (2.0 + np.sqrt(2.0)), 2.0 / np.pi * COULOMB
    for k in range(reference.size):
        measured = p + noise[k]
        if count > 0.0:
            measured = np.floor(measured / count) * count
        q[k] = measured
        speed = (measured - q[max(k - 2, 0)]) / (2 * DT)
        force[k] = KV * (KP * (reference[k] - measured) - speed)
        for _ in range(STEPS):
            x = SMOOTHING * v
            stiff = MASS + gamma * h * (VISCOUS + dry * SMOOTHING / (1.0 + x * x))
            k1 = (force[k] - VISCOUS * v - dry * np.arctan(x)) / stiff
            middle = v + 0.5 * h * k1
            rest = force[k] - VISCOUS * middle - dry * np.arctan(SMOOTHING * middle)
            k2 = (rest - MASS * k1) / stiff + k1
            p += h * (v + 0.5 * h * k2)
            v += h * k2
    return q, force
