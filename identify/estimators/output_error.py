"""Output error methods on the simulated closed loop: the sensitivities and steps that CLIE and CLOE share (4.1.1)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from armident.arrays import Array
from armident.identify.estimators.auxiliary_model import AuxiliaryModel, Response
from armident.identify.estimators.didim import solve_didim
from armident.identify.estimators.sensitivity import Arrays, difference_steps, sensitivities, weighted_columns
from armident.identify.regression.ar_noise import ArModel, ar_models
from armident.identify.regression.equations import Estimate, ExperimentEquations
from armident.identify.regression.iterations import TOLERANCE, iterate
from armident.identify.regression.least_squares import column_norms, inverse_gram
from armident.identify.regression.qr import triangularize
from armident.identify.regression.whitening import whitened, whitened_series

Signal = Callable[[Response], Arrays]

LEAST_DAMPING, FIRST_DAMPING, MOST_DAMPING = 1e-12, 1e-3, 1e6
"""Levenberg-Marquardt damping, for columns of norm one: negligible, first after a failed Gauss-Newton step, largest."""

AS_PREDICTED = 0.1
"""Relative deviation of the decrease of the error from its prediction up to which the sensitivities are kept."""

SMALL_SURPRISE = 1.0
"""The same in squared standard deviations of one equation: a deviation too small to matter to any parameter."""

NEAR = 3.0
"""Standard deviations by which theta may differ from that of the sensitivities in its covariance."""


def output_error(
    signal: Signal, measured: Arrays, blocks: Sequence[ExperimentEquations], auxiliary: AuxiliaryModel, start: Array
) -> Estimate:
    """Minimise the weighted difference between a measured and a simulated ``signal`` of a response (4.1 to 4.4).

    A start as poor as CAD values is first brought near by pseudo-linear regression (4.22), one simulation per
    iteration. Then Gauss-Newton steps with finite-difference sensitivities; Levenberg-Marquardt damping where one does
    not lower the error or leads where the loop cannot be simulated. Weights 2.24 to 2.26 are those of the last
    residuals. ``auxiliary``: not yet used by another estimator.
    """
    search = _approach(signal, measured, blocks, auxiliary, start)
    scale = search.variances()
    keep = search.keep

    def step(_: Array, _k: int) -> tuple[Array, float]:
        search.step()
        return search.theta, float(np.linalg.norm(whitened(search.errors(), scale, keep)))

    theta, done, converged, reason = iterate(step, search.theta)
    if search.stuck:
        converged, reason = False, "no step lowers the error although the sensitivities promise it"
    noise = search.variances()
    covariance = search.covariance(noise)
    residuals = whitened_series(search.errors(), noise, keep)
    return Estimate(theta, covariance, tuple(noise), residuals, done, converged, reason, auxiliary.warnings)


def _approach(
    signal: Signal, measured: Arrays, blocks: Sequence[ExperimentEquations], auxiliary: AuxiliaryModel, start: Array
) -> "_LevenbergMarquardt":
    """Start of the minimisation: the given parameters, or those of pseudo-linear regression (4.22) if better."""
    given = _LevenbergMarquardt(signal, measured, blocks, auxiliary, *auxiliary.reachable(start))
    near, _ = solve_didim(blocks, auxiliary, given.theta)
    found = _LevenbergMarquardt(signal, measured, blocks, auxiliary, *auxiliary.reachable(near.theta))
    return min(given, found, key=_LevenbergMarquardt.log_likelihood_loss)


@dataclass
class _LevenbergMarquardt:
    """State of the minimisation: theta, its response, and the sensitivities last computed."""

    signal: Signal
    measured: Arrays
    blocks: Sequence[ExperimentEquations]
    auxiliary: AuxiliaryModel
    theta: Array
    response: Response
    damping: float = 0.0
    stuck: bool = False
    _columns: list[Arrays] | None = None
    _differentiated_at: Array | None = None

    @property
    def keep(self) -> list[NDArray[np.bool_]]:
        return [block.keep for block in self.blocks]

    def errors(self, response: Response | None = None) -> list[Array]:
        simulated = self.signal(response or self.response)
        return [m - s for m, s in zip(self.measured, simulated, strict=True)]

    def variances(self) -> list[ArModel]:
        return ar_models(self.errors(), 0, keep=self.keep, parameters=self.theta.size)

    def log_likelihood_loss(self) -> float:
        """``sum_j N_j log sigma_j^2``: joints of any unit and size compare."""
        counts = np.sum([kept.sum(axis=0) for kept in self.keep], axis=0)
        return float(counts @ np.log([ar.variance for ar in self.variances()]))

    def step(self) -> None:
        """One accepted step, with fresh sensitivities where the last ones no longer predict."""
        noise = self.variances()
        if self._columns is not None and self._accept(noise):
            return
        self._differentiate()
        self.stuck = not self._accept(noise) and self._step_left(noise) > TOLERANCE

    def covariance(self, noise: Sequence[ArModel]) -> Array:
        """``(Psi' W Psi)^-1`` with the sensitivities at theta; infinite where a sensitivity is zero."""
        b = self.theta.size
        for _ in range(2):
            covariance = np.diag(np.full(b, np.inf))
            if self._columns is not None and self._differentiated_at is not None:
                psi = weighted_columns(self._columns, self.keep, noise)
                felt = np.flatnonzero(psi.any(axis=0))
                covariance[np.ix_(felt, felt)] = inverse_gram(psi[:, felt])
                moved = np.abs(self.theta - self._differentiated_at)
                if (moved <= NEAR * np.sqrt(np.diag(covariance))).all():
                    break
            self._differentiate()
        return covariance

    def _differentiate(self) -> None:
        torques = [b.y for b in self.blocks]
        errors = [y - t for y, t in zip(torques, self.response.torque, strict=True)]
        zeta = self.auxiliary.regressors(self.auxiliary.motions(self.theta))
        steps = difference_steps(zeta, torques, errors, self.keep)
        responses = sensitivities(self.auxiliary, self.theta, self.response, steps)
        self._columns = [self.signal(column) for column in responses]
        self._differentiated_at = self.theta

    def _factors(self, noise: Sequence[ArModel]) -> tuple[Array, Array, Array]:
        """Triangular factor of the normalised Jacobian, projected residuals, and the columns' norms."""
        assert self._columns is not None
        psi = weighted_columns(self._columns, self.keep, noise)
        norms = column_norms(psi)
        top = triangularize(psi / norms, whitened(self.errors(), noise, self.keep), columns=norms.size)
        return top[:, :-1], top[:, -1], norms

    def _step_left(self, noise: Sequence[ArModel]) -> float:
        """Relative change of theta that remains by the sensitivities."""
        factor, projected, norms = self._factors(noise)
        delta = _damped(factor, projected, LEAST_DAMPING)
        return np.inf if delta is None else float(np.linalg.norm(delta / norms) / np.linalg.norm(self.theta))

    def _cost(self, errors: Arrays, noise: Sequence[ArModel]) -> float:
        rows = whitened(errors, noise, self.keep)
        return float(rows @ rows)

    def _accept(self, noise: Sequence[ArModel]) -> bool:
        """Take the first step, from Gauss-Newton's to the most damped, that lowers the error; false if none does."""
        factor, projected, norms = self._factors(noise)
        cost = self._cost(self.errors(), noise)
        damping = self.damping
        while damping <= MOST_DAMPING:
            delta = _damped(factor, projected, damping)
            response = None if delta is None else self.auxiliary.respond(self.theta + delta / norms)
            if response is not None and delta is not None:
                lower = cost - self._cost(self.errors(response), noise)
                if lower > 0.0:
                    self.theta, self.response = self.theta + delta / norms, response
                    predicted = float(projected @ projected - np.sum((projected - factor @ delta) ** 2))
                    surprise = abs(lower - predicted)
                    if damping > 0.0 or surprise > max(AS_PREDICTED * predicted, SMALL_SURPRISE):
                        self._columns = None
                    self.damping = damping / 10.0 if damping > FIRST_DAMPING else 0.0
                    return True
            damping = max(10.0 * damping, FIRST_DAMPING)
        return False


def _damped(factor: Array, projected: Array, damping: float) -> Array | None:
    """Minimise ``|projected - factor delta|^2 + damping |delta|^2``; ``None`` where that has no single solution."""
    b = projected.size
    if damping > 0.0:
        rows = np.vstack([factor, np.sqrt(damping) * np.eye(b)])
        top = triangularize(rows, np.append(projected, np.zeros(b)), columns=b)
        factor, projected = top[:, :b], top[:, b]
    if not np.diag(factor).all():
        return None
    delta: Array = linalg.solve_triangular(factor, projected)
    return delta if np.isfinite(delta).all() else None
