"""Mechanics of the virtual arm: Pinocchio's rigid bodies, rotor inertias, friction and hidden effects."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pinocchio
from numpy.typing import ArrayLike

from armident.arrays import Array
from armident.configs import ConfigError, RobotConfig
from armident.configs.schema.scenario import Scenario
from armident.virtual_robot import dynamics
from armident.virtual_robot.arm_parameters import ArmParameters, arm_parameters, with_scenario
from armident.virtual_robot.effects import Hidden, hidden_effects
from armident.virtual_robot.effects.bodies import add_rotors, base_vibrations, change_bodies, hinge_damping, rest_angles
from armident.virtual_robot.effects.bristles import bristle_table
from armident.virtual_robot.effects.forces import force_table
from armident.virtual_robot.effects.gears import gear_rows, twist_under
from armident.virtual_robot.model import build_model

pin: Any = pinocchio

BRAKE = 1e9
"""Viscous coefficient (N m s/rad) of a closed holding brake: it creeps less than an encoder count per hour."""

FINE_STEP = 34e-6
"""Longest inner step (s) with elastic gears or bristles: a twentieth of the fastest contact's period."""

POSTURES = 100
"""Number of postures for the least inertia of a joint."""

SETTLING = 20
"""Iterations for the static twist of gears under the weight of their links, which depends on the twist."""


class Plant:
    """State and equations of motion of the arm; SI, joint side.

    Mass matrix and nonlinear effects are evaluated once per period, at the predicted middle, friction in finer steps;
    the error is far below an encoder count. ``q``, ``qd`` (n,): of the motors; ``coordinates``, ``velocities`` (N,):
    with links behind elastic gears and swinging masses; ``bristles`` (B,): deflection, rad.
    """

    def __init__(
        self,
        robot: RobotConfig,
        q: ArrayLike,
        scenario: Scenario | None = None,
        parameters: ArmParameters | None = None,
    ) -> None:
        parameters = arm_parameters(robot) if parameters is None else parameters
        standard = with_scenario(parameters, robot, scenario).standard
        hidden = hidden_effects(scenario, robot)
        n, start = robot.n, np.array(q, dtype=np.float64)
        self.model = build_model(robot, standard)
        change_bodies(self.model, hidden)
        self._data = self.model.createData()
        self._gravity, self._vibrations = (
            np.array(self.model.gravity.linear),
            base_vibrations(hidden, np.array(robot.gravity)),
        )
        swing = rest_angles(self.model, hidden, start)
        links = _symmetric(pin.crba(self.model, self._data, np.concatenate([start, swing])))[:n, :n]
        rotor, friction, pairs = _healthy(robot, standard)
        add_rotors(rotor, hidden, links)
        table = force_table(hidden, robot, friction)
        bristles = bristle_table(hidden, robot, friction, np.diag(rotor) + np.diag(links))
        least = self._least_inertia(robot, rotor) if any(h.target == "gear" for h in hidden) else np.zeros(n)
        gears, moved = gear_rows(hidden, robot, rotor, links, least)
        _add_coupling_friction(hidden, friction, pairs)
        # A bristle replaces the joint's Coulomb friction.
        friction[bristles[:, 0].astype(np.int64), 1] = 0.0

        soft, behind = len(gears), gears[:, 0].astype(np.int64)
        total = n + soft + swing.size
        link = np.arange(n)
        link[behind] = n + np.arange(soft)
        self._link = np.concatenate([link, np.arange(n + soft, total)])
        self.rotor: Array = np.zeros((total, total))
        self.rotor[:n, :n] = rotor
        self.rotor[behind, behind] += moved
        self.rotor[link[behind], link[behind]] -= moved
        hinges = [[n + soft + k, -1, 0.0, d, 0.0, 0.0] for k, d in enumerate(hinge_damping(hidden, self._gravity))]
        gears = np.vstack([gears, np.array(hinges).reshape(-1, gears.shape[1])])

        # Position, velocity, and both as predicted for the middle of the next period.
        self._state = np.zeros((4, total))
        self.coordinates, self.velocities = self._state[:2]
        self.coordinates[:] = np.concatenate([start, start[behind], swing])
        bias = self._settle(start, gears, soft)
        self.q, self.qd = self.coordinates[:n], self.velocities[:n]
        self.bristles = np.zeros(len(bristles))
        self._time = 0.0
        self._state[2] = self.coordinates
        self.brake = friction[:, 3]
        self._load = bias[:n].copy()
        self._rows = bristles
        self._gears = gears
        self._resisting: tuple[Any, ...] = (
            friction, robot.sign_smoothing, np.array(pairs).reshape(-1, 4), robot.transmission_matrix, table,
            self._load,
        )  # fmt: skip
        self._rigid, self._fine = total == n, bool(gears.size or bristles.size)
        self._check(robot, hidden)

    def _least_inertia(self, robot: RobotConfig, rotor: Array) -> Array:
        """Least inertia at each joint if all others are free, over random postures within the limits, shape (n,)."""
        n, least = robot.n, np.full(robot.n, np.inf)
        low, high = np.array([joint.limits.position for joint in robot.joints]).T
        swing = np.zeros(self.model.nq - n)
        for q in np.random.default_rng(0).uniform(low, high, (POSTURES, n)):
            mass = _symmetric(pin.crba(self.model, self._data, np.concatenate([q, swing])))[:n, :n] + rotor
            least = np.minimum(least, 1.0 / np.diag(np.linalg.inv(mass)))
        return least

    def _settle(self, start: Array, gears: Array, soft: int) -> Array:
        """Twist the first ``soft`` gears under the weight of their links; return the nonlinear effects at rest."""
        for _ in range(SETTLING if soft else 1):
            bias = pin.nonLinearEffects(self.model, self._data, self.coordinates[self._link], np.zeros(self._link.size))
            for e, j in enumerate(gears[:soft, 0].astype(np.int64)):
                self.coordinates[start.size + e] = start[j] - twist_under(gears[e], float(bias[j]))
        return np.asarray(bias, np.float64)

    def _check(self, robot: RobotConfig, hidden: tuple[Hidden, ...]) -> None:
        if hidden and np.linalg.eigvalsh(self._inertia(self.coordinates)).min() <= 0.0:
            raise ConfigError(f"{hidden[0].where}: robot {robot.name!r} is left without inertia by its hidden effects")

    def mass_matrix(self) -> Array:
        """Mass matrix at the present position, joint side, shape (n, n), rotors included, with rigid gears."""
        n = self.q.size
        position = self.coordinates[self._link]
        position[:n] = self.q
        folded = self.rotor[:n, :n].copy()
        for j in range(n):
            if self._link[j] != j:
                folded[j, j] += self.rotor[self._link[j], self._link[j]]
        mass: Array = _symmetric(pin.crba(self.model, self._data, position))[:n, :n] + folded
        return mass

    def advance(self, tau: Array, period: float) -> None:
        """Integrate over one control period with constant torques. ``tau``: joint torques, N m or N, shape (n,)."""
        if self._vibrations.size:
            self._add_base_vibration(self._time + 0.5 * period)
        middle, speed = self._state[2], self._state[3]
        steps = dynamics.SUBSTEPS
        if not self._rigid:
            middle, speed = middle[self._link], speed[self._link]
        if self._fine:
            steps = max(steps, math.ceil(period / FINE_STEP))
        mass = pin.crba(self.model, self._data, middle)
        bias = pin.nonLinearEffects(self.model, self._data, middle, speed)
        arguments = (
            period, steps, self._time, self._state, self.bristles, tau, mass, bias, self.rotor, self._link,
            *self._resisting, self._gears, self._rows,
        )  # fmt: skip
        dynamics.advance(*arguments)
        self._time += period

    def _inertia(self, q: Array) -> Array:
        mass = self.rotor.copy()
        rows, columns = np.ix_(self._link, self._link)
        mass[rows, columns] += _symmetric(pin.crba(self.model, self._data, q[self._link]))
        return mass

    def _add_base_vibration(self, t: float) -> None:
        """Add the acceleration of the base at ``t`` to gravity."""
        rows = self._vibrations
        self.model.gravity.linear = self._gravity - np.sin(rows[:, 3] * t) @ rows[:, :3]


def _healthy(robot: RobotConfig, standard: Mapping[str, float]) -> tuple[Array, Array, list[tuple[float, ...]]]:
    """Rotor inertias (n, n); fv, fc, offset and brake of each joint (n, 4); couplings (joints, fv, fc)."""
    n, names = robot.n, [joint.name for joint in robot.joints]
    rotor = np.diag([standard[f"ia{j + 1}"] for j in range(n)])
    friction = np.array([[*(standard[f"{k}{j + 1}"] for k in ("fv", "fc", "off")), 0.0] for j in range(n)])
    pairs: list[tuple[float, ...]] = []
    for c in robot.couplings:
        i, j = (names.index(joint) for joint in c.joints)
        rotor[i, j] = rotor[j, i] = standard[f"ia{c.name}"]
        pairs.append((i, j, standard[f"fv{c.name}"], standard[f"fc{c.name}"]))
    return rotor, friction, pairs


def _add_coupling_friction(hidden: Sequence[Hidden], friction: Array, pairs: list[tuple[float, ...]]) -> None:
    """Add hidden friction between joints to ``friction`` (n, 4) and ``pairs``, in place."""
    for h in hidden:
        if h.effect == "coupling_friction":
            viscous = h.value_or("viscous", 0.3 * h["coulomb"])
            friction[[h.joint, h.other], 0] += viscous
            pairs.append((h.joint, h.other, viscous, h["coulomb"]))


def _symmetric(upper: Array) -> Array:
    out: Array = np.triu(upper) + np.triu(upper, 1).T
    return out
