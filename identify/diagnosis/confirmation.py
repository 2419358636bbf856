"""Confirmation of a finding by the report part of the data, which is not used for selection."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtr

from armident.arrays import Array
from armident.identify.diagnosis.criteria import Criteria
from armident.identify.diagnosis.model_state import ModelState, acted_on
from armident.identify.diagnosis.predictive_score import SUMS, block_sums, mean_square
from armident.identify.effects.effect import SIGN_TOLERANCE
from armident.identify.regression.equations import applied


@dataclass(frozen=True)
class Confirmation:
    """Comparison of two models on the report part, without and with an effect; relative errors in percent, (n,).

    ``noiseless``: errors with the torque of the effect at the simulated motion. Measured positions, differentiated
    twice, may add more noise than the effect has torque. ``acts``: joints on whose torques it acts. ``whole_before``,
    ``whole_after``: errors of all joints together. ``scale``: best factor of the effect's torque, 1 as in training.
    ``recordings`` (S, 3, n): the first three of each recording, over the torques of all.
    """

    p_value: float
    before: Array
    after: Array
    noiseless: Array
    acts: NDArray[np.bool_]
    whole_before: float
    whole_after: float
    scale: float
    scale_std: float
    recordings: Array

    @property
    def absent(self) -> bool:
        """True if the report part has less than half of the effect, by two standard deviations."""
        return self.scale + SIGN_TOLERANCE * self.scale_std < 0.5

    @property
    def share(self) -> Array:
        """Share of the power of the errors of each joint that the effect removes, (n,)."""
        return np.asarray(1.0 - (self.best / np.maximum(self.before, 1e-300)) ** 2)

    @property
    def fall(self) -> Array:
        """Logarithm of the factor by which the error of each joint falls in the recording that shows it most, (n,)."""
        before, best = self._errors_of_recordings
        most = np.argmax(before**2 - best**2, axis=0), np.arange(before.shape[1])
        return np.asarray(np.log(np.maximum(before[most], 1e-300) / np.maximum(best[most], 1e-300)))

    @property
    def _errors_of_recordings(self) -> tuple[Array, Array]:
        """Errors of each recording without and with the effect, (S, n), as `before` and `best`."""
        return self.recordings[:, 0], self.recordings[:, 2 if self.best is self.noiseless else 1]

    @property
    def best(self) -> Array:
        """Relative errors with the effect, at measured or at simulated motion: where they are smaller altogether."""
        return min(self.after, self.noiseless, key=lambda errors: float(np.sum(np.log(np.maximum(errors, 1e-300)))))

    @property
    def reduction(self) -> float:
        """Mean logarithm of the factors by which the errors of each joint and of the whole arm fall, nats.

        The norm of all alone would judge the largest joint.
        """
        before, after = np.append(self.before, self.whole_before), np.append(self.best, self.whole_after)
        return float(np.mean(np.log(np.maximum(before, 1e-300) / np.maximum(after, 1e-300))))

    @property
    def smaller(self) -> bool:
        """True if the errors are smaller with the effect."""
        return self.reduction > 0.0

    def is_material(self, criteria: Criteria, *, named: bool) -> bool:
        """True if the errors of one joint on which it acts fall by enough, relative to them and to its torque.

        Motions that do not show an effect say nothing of its size: one recording is enough. A term without a name is
        lack of fit, and judged as that: the error itself falls by `material_pct`.
        """
        before, best = self._errors_of_recordings
        fall = np.maximum(before**2 - best**2, 0.0)
        size = np.sqrt(fall) if named else before - best
        enough = (fall >= criteria.least_share * before**2) & (size >= criteria.material_pct)
        return bool((enough & self.acts).any())


def confirmed(with_it: ModelState, without: ModelState) -> Confirmation:
    """Compare two models that differ in one effect on the report part.

    The errors without the effect are projected on its change of the prediction (Clark, West 2007, J. Econometrics 138)
    at the noise-free simulated motion. Block sums of the rest give the variance for any serial correlation.
    """
    before, after = (state.fit.errors(state.fit.theta, held=True) for state in (without, with_it))
    if with_it.study.recorded == without.study.recorded:
        theta = _less(with_it, without)
        change = [applied(e.z, theta) for e in with_it.fit.equations.held]
    else:
        change = [b - a for b, a in zip(before, after, strict=True)]
    noiseless = [b - c for b, c in zip(before, change, strict=True)]
    # In units of the errors of each joint and recording, as the errors themselves are compared.
    sizes = {s.experiment: s.noise for s in with_it.study.train}
    units = [with_it.score.rms * sizes.get(s.experiment, 1.0) for s in with_it.study.held]
    errors, along = (
        np.concatenate([x / unit for x, unit in zip(parts, units, strict=True)]) for parts in (before, change)
    )
    coefficient = float(np.sum(along * errors)) / max(float(np.sum(along**2)), 1e-300)
    products = np.sum(along * (errors - coefficient * along), axis=1)
    sums = block_sums(products)
    spread = float(sums.std(ddof=1)) * np.sqrt(SUMS) / max(float(np.sum(along**2)), 1e-300)
    torque = np.concatenate([s.y for s in with_it.study.held])
    return Confirmation(
        float(stdtr(SUMS - 1, -coefficient / max(spread, 1e-300))),
        _relative(before, torque),
        _relative(after, torque),
        _relative(noiseless, torque),
        acted_on(with_it, without),
        _whole(before, torque),
        _whole(after, torque),
        coefficient,
        spread,
        np.array([[_share_of(e, torque) for e in own] for own in zip(before, after, noiseless, strict=True)]),
    )


def _relative(errors: list[Array], torque: Array) -> Array:
    """Norm of the errors of each joint over that of its torque, percent, (n,)."""
    size = np.linalg.norm(np.concatenate(errors), axis=0)
    return np.asarray(100 * size / np.maximum(np.linalg.norm(torque, axis=0), 1e-300))


def _share_of(errors: Array, torque: Array) -> Array:
    """Root mean square of the errors of each joint in one recording over that of its torque in all, percent, (n,)."""
    size, whole = (np.sqrt([mean_square(own) for own in x.T]) for x in (errors, torque))
    return np.asarray(100 * size / np.maximum(whole, 1e-300))


def _whole(errors: list[Array], torque: Array) -> float:
    """Norm of the errors of all joints over that of their torques, percent, as `Gap.all`."""
    return float(100 * np.linalg.norm(np.concatenate(errors)) / max(float(np.linalg.norm(torque)), 1e-300))


def _less(with_it: ModelState, without: ModelState) -> Array:
    """Parameters of the model with the effect less those of the model without it, (b,)."""
    names = with_it.study.model.base.names
    difference: Array = with_it.fit.theta.copy()
    for name, value in zip(without.study.model.base.names, without.fit.theta, strict=True):
        difference[names.index(name)] -= value
    return difference
