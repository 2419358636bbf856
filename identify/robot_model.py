"""The dynamic model of a robot configuration, as ``import armident`` offers it."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from armident.configs import ConfigError, RobotConfig, Trajectory, load_robot, load_trajectory
from armident.identify.effects.terms import arm_model
from armident.identify.robot.controller import DiscreteController

if TYPE_CHECKING:
    from armident.identify.robot.simulation import Simulation

Array = NDArray[np.float64]


class RobotModel:
    """The dynamic model of a robot configuration: regressor, inverse and forward dynamics, closed loop.

    All quantities are in SI units on the joint side. Parameters ``theta`` are base parameters (b,) in the order of
    ``names``, or standard parameters (p,) in that of ``standard_names`` (thesis equations 2.3 to 2.9).

    Parameters
    ----------
    robot
        Configuration, or the path or shipped name of one; its effects are terms of the model.

    Raises
    ------
    ConfigError
        If there is no such configuration, or it is wrong.

    Examples
    --------
    >>> import armident, numpy as np
    >>> model = armident.RobotModel("tx40")
    >>> q = np.zeros((1, model.n))
    >>> model.regressor(q, q, q).shape
    (1, 6, 61)
    """

    def __init__(self, robot: RobotConfig | str | Path) -> None:
        self.robot = robot if isinstance(robot, RobotConfig) else load_robot(robot, "identify")
        self._arm = arm_model(self.robot)

    @property
    def n(self) -> int:
        """Number of joints."""
        return self._arm.n

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the base parameters, (b,)."""
        return self._arm.base.names

    @property
    def standard_names(self) -> tuple[str, ...]:
        """Names of the standard parameters, (p,)."""
        return self._arm.names

    def regressor(self, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, *, dt: float | None = None) -> Array:
        """Return the regressor of the base parameters (thesis equation 2.8), (N, n, b).

        Parameters
        ----------
        q, qd, qdd
            Positions, velocities and accelerations, (N, n) each; rad or m and their derivatives.
        dt
            Sampling period, s; needed where the configuration has effects.

        Raises
        ------
        ValueError
            If shapes do not fit, or ``dt`` is missing.
        """
        return self._arm.base_regressor(q, qd, qdd, dt=dt)

    def inverse_dynamics(
        self, theta: ArrayLike, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, *, dt: float | None = None
    ) -> Array:
        """Return the joint torques along a motion, (N, n), N m or N.

        Parameters
        ----------
        theta
            Base parameters (b,) or standard parameters (p,).
        q, qd, qdd
            Positions, velocities and accelerations, (N, n) each; rad or m and their derivatives.
        dt
            Sampling period, s; needed where the configuration has effects.

        Raises
        ------
        ValueError
            If shapes do not fit, or ``dt`` is missing.
        """
        torque = self._arm.inverse_dynamics(theta, q, qd, qdd)
        if self._arm.e == 0:
            return torque
        if dt is None:
            raise ValueError("the effects of the configuration need the sampling period dt")
        values = np.asarray(theta, dtype=np.float64)
        known = self._arm.anchored(values)
        further: Array = known.term_regressor(known.motion(q, qd, qdd, dt)) @ values[values.size - self._arm.e :]
        return torque + further

    def mass_matrix(self, theta: ArrayLike, q: ArrayLike) -> Array:
        """Return the mass matrices, rotors and couplings included, (N, n, n).

        Parameters
        ----------
        theta
            Base parameters (b,) or standard parameters (p,).
        q
            Positions (N, n), rad or m.

        Raises
        ------
        ValueError
            If shapes do not fit.
        """
        return self._arm.mass_matrix(theta, q)

    def forward_dynamics(self, theta: ArrayLike, q: ArrayLike, qd: ArrayLike, tau: ArrayLike) -> Array:
        """Return the joint accelerations under given torques (thesis equation 2.9), (N, n).

        Parameters
        ----------
        theta
            Base parameters (b,) or standard parameters (p,).
        q, qd
            Positions and velocities, (N, n) each.
        tau
            Joint torques (N, n), N m or N.

        Raises
        ------
        ConfigError
            If the configuration has effects: they need a whole motion, see `simulate`.
        ArmidentError
            If a mass matrix is not positive definite: these parameters are not physical.
        """
        if self._arm.e:
            raise ConfigError(f"{self.robot.name}: forward dynamics leave effects out; use simulate for a whole motion")
        return self._arm.forward_dynamics(theta, q, qd, tau)

    def simulate(
        self,
        theta: ArrayLike,
        trajectory: Trajectory | str | Path | ArrayLike,
        *,
        dt: float,
        controller: DiscreteController | None = None,
    ) -> "Simulation":
        """Simulate the closed loop along a reference (thesis section B.3).

        Parameters
        ----------
        theta
            Base parameters (b,) or standard parameters (p,).
        trajectory
            Reference: a trajectory, the path or shipped name of one, or positions (N, n), rad or m.
        dt
            Sampling period of loop and controller, s.
        controller
            By default that of the configuration, or else a stiff PD controller for its bandwidth.

        Returns
        -------
        Simulation
            ``q``, ``qd``, ``qdd``, ``tau``, (N, n) each, and ``diverged_at``.

        Raises
        ------
        ConfigError
            If the configuration has neither a controller nor a bandwidth.
        """
        from armident.identify.controller.nominal import known_controller, nominal_controller
        from armident.identify.robot.relaxation import simulate_with_terms

        if isinstance(trajectory, str | Path):
            trajectory = load_trajectory(trajectory)
        positions = trajectory.sample(dt) if isinstance(trajectory, Trajectory) else np.asarray(trajectory, np.float64)
        values = np.asarray(theta, dtype=np.float64)
        if controller is None:
            if self.robot.controller is not None:
                controller = known_controller(self.robot, dt)
            elif self.robot.bandwidth_hz is not None:
                controller = nominal_controller(self._arm, values, positions, dt, self.robot.bandwidth_hz)
            else:
                raise ConfigError(f"{self.robot.name}: simulate needs a controller; the configuration has none")
        return simulate_with_terms(self._arm, values, controller, positions, dt)

    def __repr__(self) -> str:
        effects_ = f", {self._arm.e} of effects" if self._arm.e else ""
        return f"RobotModel({self.robot.name}: {self.n} joints, {len(self.names)} base parameters{effects_})"
