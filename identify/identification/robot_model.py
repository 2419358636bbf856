"""The dynamic model of a robot: of a configuration, or identified, with its parameters."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from armident.arrays import Array
from armident.configs import ConfigError, RobotConfig, Trajectory, load_robot, load_trajectory
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.effects.terms import arm_model
from armident.identify.robot.controller import DiscreteController

if TYPE_CHECKING:
    from armident.identify.robot.arm import ArmModel
    from armident.identify.robot.simulation import Simulation


IN_MEMORY = Path("(in memory)")
"""File of a model that comes from none, in messages."""


class RobotModel:
    """The dynamic model of a robot: regressor, inverse and forward dynamics, closed loop.

    All quantities are in SI units on the joint side. Parameters ``theta`` are base parameters (b,) in the order of
    ``names``, or standard parameters (p,) in that of ``standard_names`` (thesis equations 2.3 to 2.9). The model of an
    identification, ``result.model``, knows its own; ``theta=`` of a method replaces them.

    Parameters
    ----------
    robot
        Configuration, or the path or shipped name of one; its effects are terms of the model.
    theta
        Parameters (b,) or (p,); by default those of ``identification``, else none.
    identification
        Document of the identification that the parameters come from.
    path
        File of the document.

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

    def __init__(
        self,
        robot: RobotConfig | str | Path,
        theta: ArrayLike | None = None,
        *,
        identification: IdentificationDocument | None = None,
        path: Path = IN_MEMORY,
    ) -> None:
        self.robot = robot if isinstance(robot, RobotConfig) else load_robot(robot)
        self.robot.check_filled("identify", "" if isinstance(robot, RobotConfig) else str(robot))
        self.path = path
        self._identification = identification
        if theta is None and identification is not None:
            theta = [p.value for p in identification.parameters]
        self._theta = None if theta is None else np.asarray(theta, dtype=np.float64)
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

    @property
    def theta(self) -> Array:
        """Parameters of the model, (b,) or (p,).

        Raises
        ------
        ValueError
            If it has none.
        """
        if self._theta is None:
            raise ValueError(f"{self.robot.name}: a configuration has no parameters; give theta, or use result.model")
        return self._theta

    @property
    def document(self) -> IdentificationDocument:
        """The identification that the parameters come from.

        Raises
        ------
        ValueError
            If they come from none.
        """
        if self._identification is None:
            raise ValueError(f"{self.robot.name}: the model was not identified")
        return self._identification

    @property
    def covariance(self) -> Array:
        """Covariance of the identified base parameters, (b, b)."""
        return np.array(self.document.covariance, dtype=np.float64)

    @property
    def arm(self) -> "ArmModel":
        """The equations; terms that depend on torques predict them with the parameters of this model."""
        return self._arm.anchored(self.theta)

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
        self, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, *, theta: ArrayLike | None = None, dt: float | None = None
    ) -> Array:
        """Return the joint torques along a motion, (N, n), N m or N.

        Parameters
        ----------
        q, qd, qdd
            Positions, velocities and accelerations, (N, n) each; rad or m and their derivatives.
        theta
            Base parameters (b,) or standard parameters (p,); by default those of the model.
        dt
            Sampling period, s; needed where the configuration has effects.

        Raises
        ------
        ValueError
            If shapes do not fit, or ``theta`` or ``dt`` is missing.
        """
        values = self._values(theta)
        torque = self._arm.inverse_dynamics(values, q, qd, qdd)
        if self._arm.e == 0:
            return torque
        if dt is None:
            raise ValueError("the effects of the configuration need the sampling period dt")
        known = self._arm.anchored(values)
        further: Array = known.term_regressor(known.motion(q, qd, qdd, dt)) @ values[values.size - self._arm.e :]
        return torque + further

    def mass_matrix(self, q: ArrayLike, *, theta: ArrayLike | None = None) -> Array:
        """Return the mass matrices, rotors and couplings included, (N, n, n).

        Parameters
        ----------
        q
            Positions (N, n), rad or m.
        theta
            Base parameters (b,) or standard parameters (p,); by default those of the model.

        Raises
        ------
        ValueError
            If shapes do not fit, or ``theta`` is missing.
        """
        return self._arm.mass_matrix(self._values(theta), q)

    def forward_dynamics(self, q: ArrayLike, qd: ArrayLike, tau: ArrayLike, *, theta: ArrayLike | None = None) -> Array:
        """Return the joint accelerations under given torques (thesis equation 2.9), (N, n).

        Parameters
        ----------
        q, qd
            Positions and velocities, (N, n) each.
        tau
            Joint torques (N, n), N m or N.
        theta
            Base parameters (b,) or standard parameters (p,); by default those of the model.

        Raises
        ------
        ConfigError
            If the configuration has effects: they need a whole motion, see `simulate`.
        ArmidentError
            If a mass matrix is not positive definite: these parameters are not physical.
        """
        if self._arm.e:
            raise ConfigError(f"{self.robot.name}: forward dynamics leave effects out; use simulate for a whole motion")
        return self._arm.forward_dynamics(self._values(theta), q, qd, tau)

    def simulate(
        self,
        trajectory: Trajectory | str | Path | ArrayLike,
        *,
        dt: float,
        theta: ArrayLike | None = None,
        controller: DiscreteController | None = None,
    ) -> "Simulation":
        """Simulate the closed loop along a reference (thesis section B.3).

        Parameters
        ----------
        trajectory
            Reference: a trajectory, the path or shipped name of one, or positions (N, n), rad or m.
        dt
            Sampling period of loop and controller, s.
        theta
            Base parameters (b,) or standard parameters (p,); by default those of the model.
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
        values = self._values(theta)
        if controller is None:
            if self.robot.controller is not None:
                controller = known_controller(self.robot, dt)
            elif self.robot.bandwidth_hz is not None:
                controller = nominal_controller(self._arm, values, positions, dt, self.robot.bandwidth_hz)
            else:
                raise ConfigError(f"{self.robot.name}: simulate needs a controller; the configuration has none")
        return simulate_with_terms(self._arm, values, controller, positions, dt)

    def _values(self, theta: ArrayLike | None) -> Array:
        return self.theta if theta is None else np.asarray(theta, dtype=np.float64)

    def __repr__(self) -> str:
        effects_ = f", {self._arm.e} of effects" if self._arm.e else ""
        return f"RobotModel({self.robot.name}: {self.n} joints, {len(self.names)} base parameters{effects_})"
