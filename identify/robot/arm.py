"""The dynamic model of a serial arm: regressor, inverse and direct dynamics, base parameters."""

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from armident.configs import ArmidentError, RobotConfig
from armident.identify.robot.base_parameters import BaseParameters, base_parameters, with_terms
from armident.identify.robot.chain import (
    INERTIAL,
    Chain,
    Columns,
    Floats,
    Values,
    chain_of,
    columns_of,
    standard_names,
    values_of,
)
from armident.identify.robot.kernels import (
    fill_forward_dynamics,
    fill_inverse_dynamics,
    fill_mass_matrices,
    fill_regressor,
)
from armident.identify.robot.motion import Motion
from armident.identify.robot.terms import ModelTerm

PIECE = 4096
"""Samples (rows) of a long regressor that one thread fills per call."""


@dataclass(frozen=True, eq=False)
class ArmModel:
    """Inverse dynamic model ``tau = phi(q, qd, qdd) theta`` of a serial arm (thesis 2.3, 2.8); joint side, SI.

    Friction is ``fv qd + fc sign(qd) + off`` (2.7), with ``sign`` as ``(2/pi) atan(g qd)`` (section B.2) unless
    ``sharp_sign``. The last e of the p ``names`` and b ``base.names`` are those of the terms: torques linear in them.
    Mass matrix, Newton-Euler recursion and simulation step omit the terms. ``anchor``: parameters, (p,) or (b,), that
    predict the torques for terms that depend on them.

    >>> from armident.configs import load_robot
    >>> ArmModel.from_config(load_robot("tx40")).base.formulas["my5r"]
    'my5 - mz6'
    """

    robot: RobotConfig
    names: tuple[str, ...]
    chain: Chain
    columns: Columns
    base_columns: Columns
    base: BaseParameters
    terms: tuple[ModelTerm, ...] = ()
    anchor: Floats | None = None

    @classmethod
    def from_config(cls, robot: RobotConfig, terms: tuple[ModelTerm, ...] = ()) -> Self:
        """Build the model of a robot without its ``effects``; see `armident.identify.effects.terms.arm_model`."""
        chain = chain_of(robot)
        names = standard_names(robot)
        columns = columns_of(robot, names)
        base = base_parameters(robot, chain, columns, names)
        base_columns = columns_of(robot, tuple(names[k] for k in base.independent))
        further = tuple(name for term in terms for name in term.names)
        return cls(robot, names + further, chain, columns, base_columns, with_terms(base, further), terms)

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.robot.n

    @cached_property
    def smoothing(self) -> Floats:
        """``g`` of each joint's smoothed sign, s/rad or s/m, (n,)."""
        return self.robot.sign_smoothing

    @property
    def e(self) -> int:
        """Number of linear parameters of the terms: the last ones of ``names`` and of ``base.names``."""
        return sum(len(term.names) for term in self.terms)

    @property
    def of_links(self) -> NDArray[np.bool_]:
        """Mask (p,) of the standard parameters of links: no friction, offset, rotor inertia or term."""
        rigid = self.names[: len(self.names) - self.e]
        links = [name.rstrip("0123456789") in INERTIAL for name in rigid]
        return np.array(links + [False] * self.e, dtype=np.bool_)

    def anchored(self, theta: ArrayLike) -> Self:
        """Return the model whose terms predict torques with ``theta``, standard (p,) or base (b,); SI."""
        return replace(self, anchor=np.asarray(theta, dtype=np.float64))

    def with_effects_of(self, robot: RobotConfig, terms: tuple[ModelTerm, ...]) -> Self:
        """Return the model of a configuration; faster than `from_config` if only the effects differ."""
        if robot.model_copy(update={"effects": self.robot.effects}) != self.robot:
            return self.from_config(robot, terms)
        rigid, further = self.without_terms(), tuple(name for term in terms for name in term.names)
        return replace(
            rigid,
            robot=robot,
            names=rigid.names + further,
            base=with_terms(rigid.base, further),
            terms=terms,
            anchor=None,
        )

    def without_terms(self) -> Self:
        """Return the model without its additional terms."""
        if not self.terms:
            return self
        rigid = len(self.names) - self.e
        return replace(self, names=self.names[:rigid], base=self.base.without(self.e), terms=(), anchor=None)

    def with_gravity(self, gravity: ArrayLike) -> Self:
        """Return the model under another gravity vector (3,) in the base frame, m/s^2."""
        return replace(self, chain=self.chain._replace(gravity=np.asarray(gravity, dtype=np.float64)))

    def smooth_sign(self, qd: Floats, joints: tuple[int, ...] | None = None) -> Floats:
        """``(2/pi) atan(g qd)`` of velocities of all joints (..., n), or of a series of ``joints`` (thesis B.2).

        ``joints``: one, or the two of a coupling, which has the smaller ``g`` of both.
        """
        g = self.smoothing if joints is None else self.smoothing[list(joints)].min()
        smooth: Floats = 2 / np.pi * np.arctan(g * qd)
        return smooth

    def motion(
        self, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, dt: float, start: float = 0.0, *, sharp_sign: bool = False
    ) -> Motion:
        """Return the motion from which the terms compute their columns; ``start``: s since the first recording."""
        q, qd, qdd = self._motion(q, qd, qdd)
        return Motion(self, q, qd, qdd, dt, start, self.anchor, sharp=sharp_sign)

    def term_regressor(self, motion: Motion) -> Floats:
        """Regressor of the terms, shape (N, n, e): joint torque (N m or N) per unit of each linear parameter."""
        columns = [term.columns(motion) for term in self.terms]
        return np.concatenate(columns, axis=2) if columns else np.zeros((motion.samples, self.n, 0))

    def term_torque(self, motion: Motion, values: Floats) -> Floats:
        """Joint torques (N, n) of the terms, N m or N, with their linear parameters (e,)."""
        torque, first = np.zeros((motion.samples, self.n)), 0
        for term in self.terms:
            last = first + len(term.names)
            term.add_torque(motion, values[first:last], torque)
            first = last
        return torque

    def regressor(
        self,
        q: ArrayLike,
        qd: ArrayLike,
        qdd: ArrayLike,
        *,
        sharp_sign: bool = False,
        out: Floats | None = None,
    ) -> Floats:
        """Regressor (N, n, p - e) of the standard parameters without those of the terms.

        ``out``: array to write into: zeros, or an earlier regressor of this model and length.
        """
        return self._regressor(self.columns, len(self.names) - self.e, q, qd, qdd, sharp_sign, out)

    def base_regressor(
        self,
        q: ArrayLike,
        qd: ArrayLike,
        qdd: ArrayLike,
        *,
        sharp_sign: bool = False,
        dt: float | None = None,
        start: float = 0.0,
    ) -> Floats:
        """Regressor (N, n, b) of the base parameters; with terms it needs ``dt``, ``start`` and the whole motion."""
        rigid = self.rigid_regressor(q, qd, qdd, sharp_sign=sharp_sign)
        if not self.terms:
            return rigid
        if dt is None:
            raise ValueError("dt is missing: the model has torque terms, which need the sampling period")
        further = self.term_regressor(self.motion(q, qd, qdd, dt, start, sharp_sign=sharp_sign))
        return np.concatenate([rigid, further], axis=2)

    def rigid_regressor(self, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, *, sharp_sign: bool = False) -> Floats:
        """Regressor (N, n, b - e) of the base parameters without those of the terms."""
        return self._regressor(self.base_columns, self.base.b - self.e, q, qd, qdd, sharp_sign)

    def inverse_dynamics(
        self, theta: ArrayLike, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, *, sharp_sign: bool = False
    ) -> Floats:
        """Joint torques (N, n) along a motion, by the Newton-Euler recursion (A.22 to A.26), without the terms."""
        q, qd, qdd = self._motion(q, qd, qdd)
        out = np.empty_like(q)
        smoothing = np.zeros(self.n) if sharp_sign else self.smoothing
        fill_inverse_dynamics(self.chain, self.values(theta), smoothing, q, qd, qdd, out)
        return out

    def mass_matrix(self, theta: ArrayLike, q: ArrayLike) -> Floats:
        """Mass matrices (N, n, n) with rotors and couplings at postures (N, n), kg m^2, kg m or kg."""
        (q,) = self._motion(q)
        out = np.empty((q.shape[0], self.n, self.n))
        fill_mass_matrices(self.chain, self.values(theta), q, out)
        return out

    def forward_dynamics(self, theta: ArrayLike, q: ArrayLike, qd: ArrayLike, tau: ArrayLike) -> Floats:
        """Joint accelerations (N, n) (2.9), without the terms; ArmidentError if a mass matrix is not definite."""
        q, qd, tau = self._motion(q, qd, tau)
        out = np.empty_like(q)
        failed = fill_forward_dynamics(self.chain, self.values(theta), self.smoothing, q, qd, tau, out)
        if failed >= 0:
            raise ArmidentError(
                f"the mass matrix is not positive definite at sample {failed}: the parameters are not physical"
            )
        return out

    def standard_from_base(self, theta_base: ArrayLike) -> Floats:
        """Standard parameters (p,) with the base values (b,) and zeros elsewhere: the dynamics are the same."""
        theta = np.zeros(len(self.names))
        theta[self.base.independent] = theta_base
        return theta

    def values(self, theta: ArrayLike) -> Values:
        """Parameter arrays for the kernels, from standard (p,) or base (b,) parameters in SI units."""
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
        self,
        columns: Columns,
        width: int,
        q: ArrayLike,
        qd: ArrayLike,
        qdd: ArrayLike,
        sharp_sign: bool,
        given: Floats | None = None,
    ) -> Floats:
        q, qd, qdd = self._motion(q, qd, qdd)
        shape = (q.shape[0], self.n, width)
        if given is not None and given.shape != shape:
            raise ValueError(f"out has shape {given.shape}; expected {shape}")
        out = np.zeros(shape) if given is None else given
        smoothing = np.zeros(self.n) if sharp_sign else self.smoothing

        def fill(first: int) -> None:
            rows = slice(first, first + PIECE)
            fill_regressor(self.chain, columns, smoothing, q[rows], qd[rows], qdd[rows], out[rows])

        if q.shape[0] <= PIECE:
            fill(0)
            return out
        # Threads on all processors: the kernel releases the interpreter lock. Memory access takes most of the time.
        with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
            for _ in pool.map(fill, range(0, q.shape[0], PIECE)):
                pass
        return out
