"""Torques and accelerations of a virtual plant at one instant, without the approximations of its integration."""

import numpy as np
import pinocchio
from numpy.typing import NDArray

from armident.virtual_robot import dynamics
from armident.virtual_robot.effects.bristles import sliding_level
from armident.virtual_robot.plant import Plant

Array = NDArray[np.float64]


def resistance(plant: Plant, q: Array, qd: Array, t: float = 0.0) -> Array:
    """Torques (n,) of friction, brakes and hidden effects against the motors, N m or N; bristles slide steadily."""
    out, slope = np.empty(q.size), np.empty((q.size, q.size))
    arguments = (q, qd, t, *plant._resisting, out, slope)
    dynamics.friction_torques(*arguments)
    for row in plant._rows:
        j = int(row[0])
        out[j] += np.sign(qd[j]) * sliding_level(row, qd[j])[0]
    return out


def acceleration(plant: Plant, q: Array, qd: Array, tau: Array, t: float = 0.0) -> Array:
    """Accelerations (N,) at torques (n,), N m or N, without the approximations of `Plant.advance`."""
    n, total = plant.q.size, plant.coordinates.size
    force, slope = np.zeros(total), np.zeros((total, total))
    force[:n] = resistance(plant, q[:n], qd[:n], t) - tau
    dynamics.gear_torques(q, qd, plant._gears, force, slope, slope)
    if plant._vibrations.size:
        plant._add_base_vibration(t)
    force[plant._link] += pinocchio.nonLinearEffects(plant.model, plant._data, q[plant._link], qd[plant._link])
    return np.asarray(np.linalg.solve(plant._inertia(q), -force), np.float64)
