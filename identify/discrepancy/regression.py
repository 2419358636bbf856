"""The instrumental-variable regression behind a diagnosis, whitened joint by joint."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from identify.discrepancy.study import Stretch, Study
from identify.estimators.noise import ArModel, fit_ar
from identify.estimators.regression import require_excitation

Array = NDArray[np.float64]

MAX_AR_ORDER = 30
PASSES = 3
"""Between parameters and noise models; a fourth changes neither visibly."""


@dataclass(frozen=True)
class Rows:
    """Whitened rows of all joints, one below the other: regressor (R, b), instruments (R, b), torques (R,)."""

    x: Array
    z: Array
    y: Array


Equation = tuple[Array, Array, Array]
"""Of one stretch: regressor at measured and at simulated signals (M, n, b) each, torques (M, n)."""


@dataclass(frozen=True, eq=False)
class Equations:
    """Equations in the band of the comparison, one entry per stretch."""

    train: tuple[Equation, ...]
    held: tuple[Equation, ...]


@dataclass(frozen=True, eq=False)
class Fit:
    """Parameters, noise models, and the whitened rows of both parts of the data.

    Parameters
    ----------
    theta
        (b,), those of the terms at the end.
    noise
        AR model of each joint.
    train, held
        Whitened rows.
    equations
        The same before they were whitened.
    fixed
        Whether theta is given (a baseline), so that nothing of a candidate is absorbed by it.
    """

    study: Study
    theta: Array
    noise: tuple[ArModel, ...]
    train: Rows
    held: Rows
    equations: Equations
    fixed: bool = False

    def renoised(self, noise: Sequence[ArModel]) -> "Fit":
        """The fit with other noise models; a given theta stays."""
        return solved(self.study, self.equations, noise, self.theta if self.fixed else None)

    def errors(self, theta: Array, *, held: bool) -> list[Array]:
        """``y - X theta`` at measured signals in the band of the comparison, (M, n) of every stretch."""
        rows = self.equations.held if held else self.equations.train
        return [y - x @ theta for x, _, y in rows]

    @cached_property
    def residual(self) -> Array:
        """Of the training rows, (R,)."""
        return self.train.y - self.train.x @ self.theta

    @cached_property
    def held_residual(self) -> Array:
        """Of the held-out rows, (R,)."""
        return self.held.y - self.held.x @ self.theta

    @cached_property
    def _solver(self) -> tuple[Array, Any]:
        scale = np.linalg.norm(self.train.z, axis=0)
        scale[scale == 0] = 1.0
        return scale, linalg.lu_factor((self.train.z / scale).T @ (self.train.x / scale))

    def absorbed(self, columns: Array) -> Array:
        """Parameters (b, k) that the model would give to torques ``columns`` (R, k): ``(Z'X)^-1 Z' columns``."""
        if self.fixed:
            return np.zeros((self.theta.size, columns.shape[1]))
        scale, factors = self._solver
        found: Array = linalg.lu_solve(factors, (self.train.z / scale).T @ columns) / scale[:, None]
        return found

    def beside(self, instruments: Array) -> Array:
        """Instruments (R, k) less what the model's own explain: ``D - Z (X'Z)^-1 X'D``."""
        if self.fixed:
            return instruments
        scale, factors = self._solver
        inside = linalg.lu_solve(factors, (self.train.x / scale).T @ instruments, trans=1)
        rest: Array = instruments - (self.train.z / scale) @ inside
        return rest

    @cached_property
    def covariance(self) -> Array:
        """``(Z'X)^-1 Z'Z (X'Z)^-1`` (4.34), (b, b)."""
        scale, factors = self._solver
        half = linalg.lu_solve(factors, (self.train.z / scale).T) / scale[:, None]
        covariance: Array = half @ half.T
        return covariance

    def spread(self, direction: Array) -> float:
        """Variance of ``direction' X_held theta`` from the uncertainty of theta, ``direction`` (R,)."""
        if self.fixed:
            return 0.0
        through = direction @ self.held.x
        return float(through @ self.covariance @ through)


def fit(study: Study, theta0: Array | None = None) -> Fit:
    """Alternate instrumental variables and AR noise models (thesis sections 2.3.3 and 6.1.3).

    Parameters
    ----------
    theta0
        Parameters by which terms that depend on the model's torques predict them; ``None``: none do.

    Raises
    ------
    DataError
        If the training motion leaves parameters undetermined.
    """
    equations = Equations(
        tuple((*regressors(study, s, theta0), s.y) for s in study.train),
        tuple((*regressors(study, s, theta0), s.y) for s in study.held),
    )
    flat = np.concatenate([x.reshape(-1, x.shape[-1]) for x, _, _ in equations.train])
    require_excitation(flat, study.model.base.names)
    theta = np.linalg.lstsq(flat, np.concatenate([y.reshape(-1) for _, _, y in equations.train]), rcond=None)[0]
    noise = noise_models([y - x @ theta for x, _, y in equations.train], theta.size, 0)
    found = solved(study, equations, noise)
    for _ in range(PASSES - 1):
        found = found.renoised(noise_models(found.errors(found.theta, held=False), theta.size, MAX_AR_ORDER))
    return found


def solved(study: Study, equations: Equations, noise: Sequence[ArModel], theta: Array | None = None) -> Fit:
    """Parameters by instrumental variables under given noise models; a given ``theta`` is kept as it is."""
    train, held = (
        Rows(*(whitened([row[k] for row in rows], noise) for k in range(3)))
        for rows in (equations.train, equations.held)
    )
    blank = np.zeros(train.x.shape[1])
    if theta is not None:
        return Fit(study, theta, tuple(noise), train, held, equations, fixed=True)
    found = Fit(study, blank, tuple(noise), train, held, equations)
    return replace(found, theta=found.absorbed(train.y[:, None])[:, 0])


def relative_errors(fit: Fit, theta: Array | None = None, *, held: bool) -> tuple[float, Array]:
    """``|y - X theta| / |y|`` in percent in the band of the comparison, overall and of each joint (n,)."""
    y = np.concatenate([s.y for s in (fit.study.held if held else fit.study.train)])
    error = np.concatenate(fit.errors(fit.theta if theta is None else theta, held=held))
    each = np.linalg.norm(error, axis=0) / np.maximum(np.linalg.norm(y, axis=0), 1e-300)
    return 100 * float(np.linalg.norm(error) / np.linalg.norm(y)), 100 * each


def regressors(study: Study, stretch: Stretch, theta: Array | None) -> tuple[Array, Array]:
    """Regressor (M, n, b) at measured and at simulated signals, in the band of the comparison."""
    out = []
    for signals in (stretch.measured, stretch.simulated):
        rigid = study.model.rigid_regressor(signals.q, signals.qd, signals.qdd)
        terms = study.model.term_regressor(study.motion(signals, theta))
        out.append(study.decimation(np.concatenate([rigid, terms], axis=2)))
    return out[0], out[1]


def noise_models(errors: Sequence[Array], parameters: int, order: int) -> list[ArModel]:
    """AR model of each joint's residual (6.21 to 6.25), its variance corrected for the parameters estimated."""
    free = 1 - parameters / sum(e.size for e in errors)
    models = [fit_ar([e[:, j] for e in errors], order) for j in range(errors[0].shape[1])]
    return [ArModel(ar.coefficients, ar.variance / free, ar.aic) for ar in models]


def whitened(values: Sequence[Array], noise: Sequence[ArModel]) -> Array:
    """Stack (M, n) or (M, n, k) joint by joint, each joint whitened by its noise model."""
    return np.concatenate([ar.whiten(value[:, j]) for j, ar in enumerate(noise) for value in values])
