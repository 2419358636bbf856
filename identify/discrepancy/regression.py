"""The instrumental-variable regression behind a diagnosis, whitened joint by joint."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

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
    """

    study: Study
    theta: Array
    noise: tuple[ArModel, ...]
    train: Rows
    held: Rows
    fixed: bool = False
    """Whether theta is given (a baseline), so that nothing of a candidate is absorbed by it."""

    @cached_property
    def residual(self) -> Array:
        """Of the training rows, (R,)."""
        return self.train.y - self.train.x @ self.theta

    @cached_property
    def held_residual(self) -> Array:
        """Of the held-out rows, (R,)."""
        return self.held.y - self.held.x @ self.theta

    @cached_property
    def _solver(self) -> tuple[Array, tuple[Array, Array]]:
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
    train = [regressors(study, s, theta0) for s in study.train]
    held = [regressors(study, s, theta0) for s in study.held]
    x, z, y = [a for a, _ in train], [b for _, b in train], [s.y for s in study.train]
    flat = np.concatenate([a.reshape(-1, a.shape[-1]) for a in x])
    names = study.model.base.names
    require_excitation(flat, names)
    theta = np.linalg.lstsq(flat, np.concatenate([b.reshape(-1) for b in y]), rcond=None)[0]
    noise = noise_models([b - a @ theta for a, b in zip(x, y, strict=True)], theta.size, 0)
    for _ in range(PASSES):
        rows = Rows(whitened(x, noise), whitened(z, noise), whitened(y, noise))
        result = Fit(study, np.zeros(theta.size), tuple(noise), rows, rows)
        theta = result.absorbed(rows.y[:, None])[:, 0]
        final = noise
        noise = noise_models([b - a @ theta for a, b in zip(x, y, strict=True)], theta.size, MAX_AR_ORDER)
    held_rows = Rows(
        whitened([a for a, _ in held], final), whitened([b for _, b in held], final),
        whitened([s.y for s in study.held], final),
    )  # fmt: skip
    return Fit(study, theta, tuple(final), rows, held_rows)


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
