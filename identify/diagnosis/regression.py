"""Instrumental-variable fit of the model of a diagnosis, whitened joint by joint (thesis 2.3.3 and 6.1.3)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from armident.arrays import Array
from armident.configs import DataError
from armident.identify.diagnosis.model_equations import Equations
from armident.identify.diagnosis.study import Study
from armident.identify.regression.ar_noise import WHITE, ArModel, ar_models
from armident.identify.regression.equations import joint_variances, residuals, stacked_parts
from armident.identify.regression.iv_regression import IvRegression
from armident.identify.regression.least_squares import Triangle, require_excitation
from armident.identify.regression.whitening import whitened

MAX_AR_ORDER = 30
"""Highest order of noise models: three periods of the closed-loop bandwidth at the rate of the comparison. Akaike's
criterion chooses one below."""
SINGULAR = 1e-13
"""Singular value of the normalised equations over the largest below which they are singular: rounding errors."""
LOWER_ORDERS = (10, 3, 1)
"""Highest orders of noise models in turn, where those of higher order make the instruments weak: each a third of the
one before, from `MAX_AR_ORDER` on."""
UNDETERMINED = "the motion does not determine all parameters of the model"
PASSES = 3
"""Iterations between parameters and noise models; a fourth changes neither visibly."""


@dataclass(frozen=True, eq=False)
class IvFit:
    """Parameters, noise models, and the whitened rows of both parts of the data."""

    equations: Equations
    regression: IvRegression

    @property
    def study(self) -> Study:
        """Data with the model."""
        return self.equations.study

    def of_study(self, study: Study) -> "IvFit":
        """Return the fit with another study of the same training stretches."""
        return replace(self, equations=self.equations.of_study(study))

    @property
    def theta(self) -> Array:
        """Parameters (b,), those of the terms at the end."""
        return self.regression.solution.theta

    @property
    def noise(self) -> tuple[ArModel, ...]:
        """AR model of each joint."""
        return self.regression.noise

    @property
    def covariance(self) -> Array:
        """Covariance of the parameters (4.34), (b, b)."""
        return self.regression.solution.covariance

    def release(self) -> None:
        """Free the equations and whitened rows; they are computed again, with the same values, when next used."""
        self.equations.release()
        self.regression.release()
        for name in ("left", "instruments", "held", "held_residual"):
            self.__dict__.pop(name, None)

    def renoised(self, noise: Sequence[ArModel]) -> "IvFit":
        """The fit with other noise models; DataError if the equations are singular with them."""
        return solved(self.equations, noise, self.regression)

    def errors(self, theta: Array, *, held: bool) -> list[Array]:
        """``y - X theta`` at measured signals in the band of the comparison, (M, n) of every stretch, N m or N."""
        return residuals(self.equations.held if held else self.equations.train, theta)

    @cached_property
    def left(self) -> list[Array]:
        """Residual of the training rows, (M, n) of every stretch, N m or N."""
        return self.errors(self.theta, held=False)

    def own_noise(self, max_order: int) -> tuple[ArModel, ...]:
        """Noise models of the residual of the training rows, one for each joint. ``max_order``: highest order tried."""
        return tuple(ar_models(self.left, max_order, parameters=self.theta.size))

    @cached_property
    def instruments(self) -> Array:
        """Whitened instruments of the training rows, (R, b)."""
        return whitened([e.z for e in self.equations.train], self.noise)

    @cached_property
    def held(self) -> tuple[Array, Array, Array]:
        """Whitened regressor and instruments (R, b), and torques (R,), of the held-out rows."""
        rows = self.equations.held
        x, z, y = (whitened([getattr(e, name) for e in rows], self.noise) for name in ("x", "z", "y"))
        return x, z, y

    @property
    def residual(self) -> Array:
        """Whitened residual of the training rows, (R,)."""
        return self.regression.residual

    @cached_property
    def held_residual(self) -> Array:
        """Whitened residual of the held-out rows, (R,)."""
        return whitened(self.errors(self.theta, held=True), self.noise)


def fit_model(study: Study, theta0: Array | None = None, noise: Sequence[ArModel] | None = None) -> IvFit:
    """Alternate instrumental variables and AR noise models (thesis sections 2.3.3, 6.1.3), from ``noise`` if given."""
    equations = Equations(study, theta0)
    if noise is None:
        rows = Triangle.of(stacked_parts(equations.train, [WHITE] * study.robot.n))
        require_excitation(rows, study.model.base.names)
        noise = joint_variances(equations.train, rows.theta)
        passes = PASSES
    else:
        passes = 1
    found = solved(equations, noise)
    require_solution(found)
    for _ in range(passes - 1):
        found = found.renoised(found.own_noise(MAX_AR_ORDER))
    return safe(found)


def safe(found: IvFit) -> IvFit:
    """Return the fit, or one with noise models of lower order if its errors are much larger than with white weights.

    Strongly coloured noise emphasises frequencies where simulated and measured motion differ: weak instruments.
    """
    white = found.renoised([ArModel(np.empty(0), ar.variance, 0.0) for ar in found.noise])
    most = found.study.criteria.weighted_errors * _rms(white)
    for order in (*LOWER_ORDERS, 0):
        if np.all(_rms(found) <= most):
            break
        found = found.renoised(white.own_noise(order))
    return found


def _rms(found: IvFit) -> Array:
    """Root mean square of the residual of each joint, N m or N, (n,)."""
    return np.asarray(np.sqrt(np.mean(np.concatenate(found.left) ** 2, axis=0)))


def require_solution(found: IvFit) -> None:
    """Raise DataError if the instruments do not determine all parameters."""
    values = np.linalg.svd(found.regression.solution.cross, compute_uv=False)
    if not np.isfinite(found.theta).all() or values[-1] < SINGULAR * values[0]:
        raise DataError(UNDETERMINED)


def solved(equations: Equations, noise: Sequence[ArModel], known: IvRegression | None = None) -> IvFit:
    """Parameters by instrumental variables under given noise models; DataError if the equations are singular."""
    found = IvFit(equations, IvRegression.of(equations, noise, known))
    try:
        _ = found.theta
    except np.linalg.LinAlgError as error:
        raise DataError(UNDETERMINED) from error
    return found
