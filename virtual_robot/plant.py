"""The arm's mechanics: Pinocchio's rigid bodies, rotor inertias, friction and whatever is hidden in it."""

from typing import Any

import numpy as np
import pinocchio
from numpy.typing import ArrayLike, NDArray

from configs import RobotConfig
from configs.scenario import Scenario
from virtual_robot import dynamics
from virtual_robot.effects import effect_table
from virtual_robot.inertias import plant_parameters
from virtual_robot.model import build_model

pin: Any = pinocchio

BRAKE = 1e9
"""Viscous coefficient (N m s/rad) of a closed holding brake: it creeps less than an encoder count an hour."""


class Plant:
    """State and equations of motion of the arm; SI, joint side.

    Over one period mass matrix and nonlinear effects are taken once, at the predicted middle; friction
    is integrated in finer steps. Against a reference at a relative tolerance of 1e-9 the positions
    stay far below an encoder count.

    Parameters
    ----------
    robot
        Geometry, gravity, couplings and smoothing of Coulomb friction.
    q
        Initial position, shape (n,), rad or m; the arm stands still.
    scenario
        Hidden effects.
    """

    def __init__(self, robot: RobotConfig, q: ArrayLike, scenario: Scenario | None = None) -> None:
        standard = plant_parameters(robot)
        n = robot.n
        self.model = build_model(robot, standard)
        self._data = self.model.createData()
        self.q = np.array(q, dtype=np.float64)
        self.qd = np.zeros(n)
        self._middle, self._speed = self.q.copy(), np.zeros(n)
        names = [joint.name for joint in robot.joints]
        self.rotor = np.diag([standard[f"ia{j + 1}"] for j in range(n)])
        friction = np.array([[standard[f"{k}{j + 1}"] for k in ("fv", "fc", "off")] for j in range(n)])
        pairs = np.array([[names.index(j) for j in c.joints] for c in robot.couplings], np.int64).reshape(-1, 2)
        pair_friction = np.array([[standard[f"{k}{c.name}"] for k in ("fv", "fc")] for c in robot.couplings]).reshape(
            -1, 2
        )
        for c, (i, j) in zip(robot.couplings, pairs, strict=True):
            self.rotor[i, j] = self.rotor[j, i] = standard[f"ia{c.name}"]
        self.brake = np.zeros(n)
        effects = effect_table(scenario, robot)
        self._resisting: tuple[Any, ...] = (
            friction, robot.friction.sign_smoothing, pairs, pair_friction, self.brake, robot.transmission_matrix,
            effects.code, effects.joint, effects.parameters,
        )  # fmt: skip

    def mass_matrix(self) -> NDArray[np.float64]:
        """Joint-side mass matrix (n, n) at the present position, rotors included."""
        upper = np.triu(pin.crba(self.model, self._data, self.q))
        mass: NDArray[np.float64] = upper + np.triu(upper, 1).T + self.rotor
        return mass

    def resistance(self, q: NDArray[np.float64], qd: NDArray[np.float64]) -> NDArray[np.float64]:
        """Friction, brakes and hidden effects (n,): the torque that resists the motion."""
        out, slope = np.empty(q.size), np.empty((q.size, q.size))
        arguments = (q, qd, *self._resisting, out, slope)
        dynamics.resist(*arguments)
        return out

    def acceleration(
        self, q: NDArray[np.float64], qd: NDArray[np.float64], tau: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Direct dynamics (n,) at any state: what ``advance`` integrates, without its approximations."""
        upper = np.triu(pin.crba(self.model, self._data, q))
        mass = upper + np.triu(upper, 1).T + self.rotor
        bias = pin.nonLinearEffects(self.model, self._data, q, qd)
        out: NDArray[np.float64] = np.linalg.solve(mass, tau - bias - self.resistance(q, qd))
        return out

    def advance(self, tau: NDArray[np.float64], period: float) -> None:
        """Hold the joint torques ``tau`` (n,) for ``period`` seconds."""
        mass = pin.crba(self.model, self._data, self._middle)
        bias = pin.nonLinearEffects(self.model, self._data, self._middle, self._speed)
        dynamics.advance(
            period, self.q, self.qd, self._middle, self._speed, tau, mass, bias, self.rotor, *self._resisting
        )
