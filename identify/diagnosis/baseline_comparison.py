"""Comparison of a fit with a baseline, along the directions in which changes of the plant move the parameters."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from armident.configs import DataError
from armident.identify.diagnosis.regression import MAX_AR_ORDER, IvFit
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.effects.effect import Effect, Place
from armident.identify.regression.equations import COVARIANCE_PASSES, noise_models

Array = NDArray[np.float64]

RANK_TOLERANCE = 1e-7
"""Relative singular value below which a direction of normalised changes is dropped: rounding of the covariances."""


@dataclass(frozen=True)
class Change:
    """Candidate change of the plant; ``directions`` (k, m): change of the known parameters per unit of the effect's."""

    effect: Effect
    place: Place
    directions: Array


@dataclass(frozen=True, eq=False)
class BaselineComparison:
    """A fit and a baseline, with the covariance of their difference; ``known``: numbers of the baseline's k parameters.

    ``absorbed`` (k, m): change of the baseline by terms that it lacks. They may not have acted in its data, so
    differences along these directions are no evidence.
    """

    fit: IvFit
    known: NDArray[np.int64]
    theta0: Array
    covariance0: Array
    covariance: Array
    absorbed: Array

    @property
    def difference(self) -> Array:
        """Fit less baseline, (k,)."""
        difference: Array = self.fit.theta[self.known] - self.theta0
        return difference

    def whitened(self, values: Array) -> Array:
        """``L^-1 values`` with ``L L'`` the covariance of the difference."""
        scale = np.sqrt(np.diag(self.covariance))
        lower = linalg.cholesky(self.covariance / np.outer(scale, scale), lower=True)
        out: Array = linalg.solve_triangular(lower, (values.T / scale).T, lower=True)
        return out

    def solved(self, changes: Sequence[Change]) -> tuple[Array, Array, Array, float, int]:
        """Parameters of changes by generalised least squares (of `absorbed` first), and their covariance.

        Then the mask of those estimable one by one, the remaining chi-square and its degrees of freedom.
        """
        stack = np.column_stack([self.absorbed, *(c.directions for c in changes)])
        target = self.whitened(self.difference)
        columns = self.whitened(stack)
        scale = np.linalg.norm(columns, axis=0)
        scale[scale == 0] = 1.0
        u, s, vt = np.linalg.svd(columns / scale, full_matrices=False)
        kept = s > RANK_TOLERANCE * max(float(s.max(initial=0.0)), 1e-300)
        u, s, vt = u[:, kept], s[kept], vt[kept]
        inverse = (vt.T / s) / scale[:, None]
        rest = target - u @ (u.T @ target)
        own = np.einsum("kj,kj->j", vt, vt) > self.fit.study.criteria.estimable
        return inverse @ (u.T @ target), inverse @ inverse.T, own, float(rest @ rest), target.size - int(kept.sum())

    def predicted(self, changes: Sequence[Change]) -> Array:
        """Parameters (b,) of the baseline after these changes; terms that it lacks follow by `with_unknown`."""
        values = self.solved(changes)[0]
        stack = np.column_stack([self.absorbed, *(c.directions for c in changes)])
        return self.with_unknown(self.theta0 + stack @ values)

    def with_unknown(self, known: Array) -> Array:
        """All parameters of the fit (b,) given those of the baseline: the others by conditional mean."""
        theta = self.fit.theta.copy()
        free = np.setdiff1d(np.arange(theta.size), self.known)
        if free.size:
            c = self.fit.covariance
            scale = np.sqrt(np.diag(c))[self.known]
            inner = c[np.ix_(self.known, self.known)] / np.outer(scale, scale)
            theta[free] += (
                c[np.ix_(free, self.known)] / scale @ np.linalg.solve(inner, (known - theta[self.known]) / scale)
            )
        theta[self.known] = known
        return theta


def with_baseline(fit: IvFit, baseline: IdentificationDocument) -> BaselineComparison:
    """Comparison of a fit with a baseline, which must be of the same model and size (else DataError)."""
    names = fit.study.model.base.names
    rigid = names[: len(names) - fit.study.model.e]
    listed = [p.name for p in baseline.parameters]
    missing = [name for name in rigid if name not in listed]
    if missing:
        raise DataError(
            f"the baseline of robot {baseline.robot!r} lacks {', '.join(missing[:5])}"
            f"{' and more' if len(missing) > 5 else ''}: it was identified with another model"
        )
    theirs = np.array(baseline.covariance, dtype=np.float64)
    if theirs.shape != (len(listed), len(listed)):
        raise DataError(f"the baseline's covariance has shape {theirs.shape} for {len(listed)} parameters")
    known = np.array([k for k, name in enumerate(names) if name in listed], dtype=np.int64)
    chosen = [listed.index(names[k]) for k in known]
    theta0 = np.array([baseline.parameters[k].value for k in chosen])
    covariance0 = theirs[np.ix_(chosen, chosen)]
    free = np.setdiff1d(np.arange(len(names)), known)
    cross, scale = fit.regression.solution.cross, fit.regression.solution.scale
    absorbed = np.zeros((known.size, 0))
    if free.size:
        through = cross[np.ix_(known, free)] * scale[free]
        absorbed = np.linalg.solve(cross[np.ix_(known, known)], through) / scale[known, None]
    covariance = fit.covariance[np.ix_(known, known)] + covariance0
    return BaselineComparison(fit, known, theta0, covariance0, covariance, absorbed)


def conservative_fit(fit: IvFit) -> IvFit:
    """Fit whose noise models include the part absorbed by the parameters and their own uncertainty.

    Needed where two recordings are compared by covariances; candidates of a search are compared in one recording.
    """
    for _ in range(COVARIANCE_PASSES - 1):
        fit = fit.renoised(noise_models(fit.equations.train, fit.theta, fit.covariance, MAX_AR_ORDER))
    return fit
