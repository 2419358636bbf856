"""The dynamic model of a serial arm: regressor, inverse and direct dynamics, base parameters."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from configs import ArmidentError, RobotConfig
from identify.model.base_parameters import BaseParameters, base_parameters
from identify.model.chain import Chain, Columns, Floats, Values, chain_of, columns_of, standard_names, values_of
from identify.model.kernels import (
    fill_forward_dynamics,
    fill_inverse_dynamics,
    fill_mass_matrices,
    fill_regressor,
)


@dataclass(frozen=True, eq=False)
class ArmModel:
    """Inverse dynamic model ``tau = phi(q, qd, qdd) theta`` of a serial arm (thesis equations 2.3, 2.8).

    Everything is joint side and SI. Friction is ``fv qd + fc sign(qd) + off``; where ``sharp_sign`` is
    false the sign is ``(2/pi) atan(g qd)`` with the ``sign_smoothing`` g of the robot configuration.

    Examples
    --------
    >>> from configs import load_robot
    >>> model = ArmModel.from_config(load_robot("tx40"))
    >>> len(model.names), len(model.base.names)
    (87, 61)
    >>> model.base.formulas["my5r"]
    'my5 - mz6'
    """

    robot: RobotConfig
    names: tuple[str, ...]
    chain: Chain
    columns: Columns
    base_columns: Columns
    base: BaseParameters

    @classmethod
    def from_config(cls, robot: RobotConfig) -> Self:
        """Build the model of a robot configuration."""
        chain = chain_of(robot)
        names = standard_names(robot)
        columns = columns_of(robot, names)
        base = base_parameters(robot, chain, columns, names)
        base_columns = columns_of(robot, tuple(names[k] for k in base.independent))
        return cls(robot, names, chain, columns, base_columns, base)

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.robot.n

    @property
    def smoothing(self) -> float:
        """``g`` of the smoothed sign, s/rad or s/m."""
        return self.robot.friction.sign_smoothing

    def regressor(self, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, *, sharp_sign: bool = False) -> Floats:
        """Regressor of the standard parameters.

        Parameters
        ----------
        q, qd, qdd
            Positions, velocities, accelerations, each (N, n); rad or m, s.
        sharp_sign
            ``sign(qd)`` instead of its smoothed form.

        Returns
        -------
        ndarray
            Shape (N, n, p): row j of sample k times ``theta`` is the torque of joint j.
        """
        return self._regressor(self.columns, len(self.names), q, qd, qdd, sharp_sign)

    def base_regressor(self, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, *, sharp_sign: bool = False) -> Floats:
        """Regressor of the base parameters, shape (N, n, b); see `regressor`."""
        return self._regressor(self.base_columns, self.base.b, q, qd, qdd, sharp_sign)

    def inverse_dynamics(
        self, theta: ArrayLike, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, *, sharp_sign: bool = False
    ) -> Floats:
        """Joint torques (N, n) along a motion, by the Newton-Euler recursion (A.22 to A.26).

        Parameters
        ----------
        theta
            Standard parameters (p,) or base parameters (b,).
        q, qd, qdd
            Each (N, n).
        """
        q, qd, qdd = self._motion(q, qd, qdd)
        out = np.empty_like(q)
        smoothing = 0.0 if sharp_sign else self.smoothing
        fill_inverse_dynamics(self.chain, self.values(theta), smoothing, q, qd, qdd, out)
        return out

    def mass_matrix(self, theta: ArrayLike, q: ArrayLike) -> Floats:
        """Mass matrices (N, n, n), rotors and couplings included, at postures ``q`` (N, n)."""
        (q,) = self._motion(q)
        out = np.empty((q.shape[0], self.n, self.n))
        fill_mass_matrices(self.chain, self.values(theta), q, out)
        return out

    def forward_dynamics(self, theta: ArrayLike, q: ArrayLike, qd: ArrayLike, tau: ArrayLike) -> Floats:
        """Joint accelerations (N, n) under torques ``tau`` (N, n), smoothed friction (2.9).

        Raises
        ------
        ArmidentError
            If the mass matrix is not positive definite somewhere; names the sample.
        """
        q, qd, tau = self._motion(q, qd, tau)
        out = np.empty_like(q)
        failed = fill_forward_dynamics(self.chain, self.values(theta), self.smoothing, q, qd, tau, out)
        if failed >= 0:
            raise ArmidentError(f"the mass matrix is not positive definite at sample {failed}: parameters not physical")
        return out

    def standard_from_base(self, theta_base: ArrayLike) -> Floats:
        """Fill standard parameters (p,) with the base ones, the others zero: the dynamics are the same."""
        theta = np.zeros(len(self.names))
        theta[self.base.independent] = theta_base
        return theta

    def values(self, theta: ArrayLike) -> Values:
        """Parameters taken apart for the kernels; ``theta`` is (p,) standard or (b,) base.

        Raises
        ------
        ValueError
            If it has neither length.
        """
        vector = np.asarray(theta, dtype=np.float64)
        if vector.shape == (len(self.names),):
            return values_of(self.columns, vector, self.smoothing)
        if vector.shape == (self.base.b,):
            return values_of(self.base_columns, vector, self.smoothing)
        raise ValueError(
            f"theta has shape {vector.shape}; expected ({len(self.names)},) standard or ({self.base.b},) base"
        )

    def _motion(self, *signals: ArrayLike) -> tuple[Floats, ...]:
        arrays = tuple(np.ascontiguousarray(signal, dtype=np.float64) for signal in signals)
        for array in arrays:
            if array.ndim != 2 or array.shape != (arrays[0].shape[0], self.n):
                raise ValueError(f"expected signals of shape (N, {self.n}), found {[a.shape for a in arrays]}")
        return arrays

    def _regressor(
        self, columns: Columns, width: int, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, sharp_sign: bool
    ) -> Floats:
        q, qd, qdd = self._motion(q, qd, qdd)
        out = np.zeros((q.shape[0], self.n, width))
        fill_regressor(self.chain, columns, 0.0 if sharp_sign else self.smoothing, q, qd, qdd, out)
        return out
