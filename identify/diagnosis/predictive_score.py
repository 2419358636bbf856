"""Predictive score: cross-validated log-likelihood of the torques with serially correlated noise; ranks all models.

Every `FOLDS`-th of `BLOCKS` equal blocks is predicted by the instrumental-variable estimate of the others. The
autoregressive noise model turns these errors into innovations (Box, Jenkins 1976, chapter 7). Noise of measured
accelerations would favour a smaller inertia. Where `references_of` finds it, changes of the rigid parameters are
predicted without it (`noise_of_motion`); the rest is the same for all models.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from armident.arrays import Array
from armident.identify.diagnosis.regression import MAX_AR_ORDER, IvFit
from armident.identify.effects.free_shapes import FreeShape
from armident.identify.effects.terms import effect_terms
from armident.identify.regression.ar_noise import ArModel, ar_models
from armident.identify.regression.iv import JointEquations
from armident.identify.regression.iv_regression import ties

BLOCKS = 10
"""Blocks of the training data: each much longer than the memory of the noise."""
SUMS = 20
"""Blocks of the block sums: long beside the memory of the noise, enough for a variance with 19 degrees of freedom."""
FOLDS = 10
"""Folds of the cross-validation (Hastie, Tibshirani, Friedman 2009, section 7.10)."""

RANK, DETERMINED = 1e-12, 1e-10
"""Singular value of a fold's equations, over the largest, from which a direction is determined; reciprocal condition
from which all are, with a margin for its estimate."""

LAGS = 5
"""Samples to either side in the filter between simulated and measured motion: half a period of the loop's bandwidth,
see `Criteria.band`."""
LEAST_ROWS = 10 * (2 * LAGS + 1)
"""Rows of a stretch from which that filter is estimated: ten for each of its coefficients."""


@dataclass(frozen=True, eq=False)
class PredictiveScore:
    """Cross-validated errors of a fitted model. ``fit``: the fit of all training data, with its noise models."""

    fit: IvFit

    @cached_property
    def folds(self) -> Array:
        """Parameters estimated without each fold, (`FOLDS`, b)."""
        regression = self.fit.regression
        b = self.fit.theta.size
        zx, zy = np.zeros((FOLDS, b, b)), np.zeros((FOLDS, b))
        for joint, rows, ar in zip(self.fit.equations.joints, regression.rows, regression.noise, strict=True):
            for k, own in folds_of([max(len(part) - ar.order, 0) for part in joint.parts]):
                sums = joint.products([rows[own]])
                zx[k][np.ix_(joint.z, joint.x)] += sums[:, : joint.x.size]
                zy[k][joint.z] += sums[:, -1]
        scale, weak = regression.solution.scale, np.diag(self._prior)
        left, right = (zx.sum(0) - zx + weak) / np.outer(scale, scale), (zy.sum(0) - zy) / scale
        left += ties(self.fit.equations.tied, scale)
        return np.array([_solved(a, c) for a, c in zip(left, right, strict=True)]) / scale

    @cached_property
    def _prior(self) -> Array:
        """Inverse prior variances (b,) of free shapes, for folds that do not visit a part of their range; else zero."""
        study = self.fit.study
        inverse = np.zeros(self.fit.theta.size)
        errors = np.concatenate(self.fit.left)
        at = inverse.size - study.model.e
        for term in effect_terms(study.model):
            if isinstance(term.effect, FreeShape):
                size = float(np.mean(errors[:, term.place.joint] ** 2))
                inverse[at : at + len(term.names)] = 1.0 / max(size, 1e-300)
            at += len(term.names)
        return inverse

    def keep_errors(self) -> None:
        """Compute the predicted errors, which need the equations, before these are freed."""
        _ = self._parts

    @cached_property
    def errors(self) -> tuple[Array, ...]:
        """Predicted errors of each joint before whitening, stretch after stretch, N m or N, (M,) each."""
        return tuple(np.concatenate(parts) for parts in self._parts)

    @cached_property
    def _parts(self) -> tuple[tuple[Array, ...], ...]:
        found = []
        for joint, change in zip(self.fit.equations.joints, self._changes, strict=True):
            width = joint.x.size
            rows = joint.parts[0][:] if len(joint.parts) == 1 else np.concatenate([part[:] for part in joint.parts])
            errors = rows[:, -1].copy()
            for k, own in folds_of([len(part) for part in joint.parts]):
                errors[own] -= rows[own, :width] @ self.folds[k, joint.x]
            parts = np.split(errors, np.cumsum([len(part) for part in joint.parts])[:-1])
            if change is not None:
                for part, left in zip(joint.parts, parts, strict=True):
                    rows_of_part = np.arange(len(part))
                    left += noise_of_motion(joint, part[:], change)[rows_of_part, fold_of(len(part))]
            found.append(tuple(parts))
        return tuple(found)

    @property
    def _changes(self) -> Sequence[Array | None]:
        """Parameters of each fold less the reference of a joint, (`FOLDS`, b); ``None`` without one.

        The first model has no effects: the reference of theirs is zero.
        """
        study = self.fit.study
        rigid = self.fit.theta.size - study.model.e
        references = study.references or (None,) * study.robot.n
        return [
            None if r is None or r.size != rigid else self.folds - np.append(r, np.zeros(study.model.e))
            for r in references
        ]

    def innovations(self, noise: Sequence[ArModel]) -> Array:
        """Mean squares of the innovations of each joint and stretch under noise models, (N m)^2 or N^2, (n, S)."""
        found = [
            [ar.variance * float(np.mean(ar.whiten(part) ** 2)) for part in parts]
            for ar, parts in zip(noise, self._parts, strict=True)
        ]
        return np.maximum(found, 1e-300)

    @cached_property
    def rows(self) -> Array:
        """Number of rows of each joint and stretch while it moves, (n, S)."""
        return np.array([[float(np.count_nonzero(part)) for part in parts] for parts in self._parts])

    @cached_property
    def rms(self) -> Array:
        """Root mean square of the predicted errors of each joint, N m or N, (n,)."""
        return np.array([float(np.sqrt(np.mean(errors**2))) for errors in self.errors])

    @cached_property
    def rms_of_recordings(self) -> Array:
        """Root mean square of the predicted errors of each joint and stretch, N m or N, (n, S)."""
        noise = np.transpose([s.noise for s in self.fit.study.train])
        return noise * np.sqrt([[mean_square(part) for part in parts] for parts in self._parts])

    @cached_property
    def own_noise(self) -> tuple[ArModel, ...]:
        """Noise models of the predicted errors, one for each joint, with one filter for stretches of any size."""
        found = []
        for parts, size in zip(self._parts, self.rms, strict=True):
            found += ar_models([part[:, None] * (size / _size(part)) for part in parts], MAX_AR_ORDER)
        return tuple(found)

    @cached_property
    def own_log_likelihoods(self) -> Array:
        """Log-likelihood (n,) of each joint's data under noise models of the model's own predicted errors.

        One is subtracted for each coefficient of the noise models, which are not cross-validated (Akaike's criterion).
        """
        orders = np.array([float(ar.order) for ar in self.own_noise])
        return np.asarray(self.log_likelihoods_under(self.own_noise) - orders)

    @property
    def volume(self) -> Array:
        """Logarithm of the volume by which corrections of the recordings scale the noise, per row, (n,)."""
        return self.fit.study.volume

    def log_likelihoods_under(self, noise: Sequence[ArModel]) -> Array:
        """Log-likelihood of the data of each joint under noise models, without constants of these data, (n,).

        The noise of each stretch has a size of its own: models fit slow and fast motions differently well.
        """
        each = self.volume[:, None] - 0.5 * np.log(self.innovations(noise))
        return np.asarray(np.sum(self.rows * each, axis=1))

    def log_likelihood_under(self, noise: Sequence[ArModel]) -> float:
        """Log-likelihood of the data of all joints, see `log_likelihoods_under`."""
        return float(self.log_likelihoods_under(noise).sum())

    def inflation_over(self, other: "PredictiveScore", noise: Sequence[ArModel]) -> Array:
        """Variance (n,) of the score along the change of prediction over that of white innovations, at least 1.

        Block sums contain the correlation left by slow noise (Kuensch 1989, Annals of Statistics 17(3)).
        """
        found = []
        for ar, own, less in zip(noise, self._parts, other._parts, strict=True):
            white = [ar.whiten(part) for part in own]
            sizes = [_size(part) for part in white]
            e1 = np.concatenate([part / size for part, size in zip(white, sizes, strict=True)])
            change = np.concatenate([ar.whiten(part) / size for part, size in zip(less, sizes, strict=True)]) - e1
            sums = block_sums(change * e1)
            naive = float(np.mean(e1**2) * (change @ change))
            found.append(max(1.0, float(np.sum((sums - sums.mean()) ** 2)) * SUMS / (SUMS - 1) / max(naive, 1e-300)))
        return np.array(found)

    def gain_over(self, other: "PredictiveScore", noise: Sequence[ArModel]) -> float:
        """Gain of log-likelihood over a model without an effect, both under the same noise models.

        These should be of a model in which nothing is missing. Others would take what is missing for noise.
        """
        ratio = np.log(other.innovations(noise) / self.innovations(noise))
        each = np.sum(self.rows * (0.5 * ratio + (self.volume - other.volume)[:, None]), axis=1)
        return float(np.sum(each / self.inflation_over(other, noise)))


def mean_square(x: Array) -> float:
    """Return the mean square of the values that are not zero: a joint at rest has none."""
    return float(x @ x) / max(int(np.count_nonzero(x)), 1)


def _size(errors: Array) -> float:
    """Return the root mean square of errors, or 1 if all are zero."""
    return float(np.sqrt(np.mean(errors**2))) or 1.0 if errors.size else 1.0


def _solved(a: Array, c: Array) -> Array:
    """Solution (b,) of equations (b, b); the smallest one where a fold does not determine all parameters."""
    lu, pivots, singular = lapack.dgetrf(a)
    if singular == 0 and lapack.dgecon(lu, np.abs(a).sum(axis=0).max())[0] > DETERMINED:
        return np.asarray(lapack.dgetrs(lu, pivots, c)[0])
    return np.asarray(np.linalg.lstsq(a, c, rcond=RANK)[0])


def fold_of(rows: int) -> NDArray[np.int64]:
    """Return the fold of each row of a stretch, (R,)."""
    return np.arange(rows) * BLOCKS // max(rows, 1) % FOLDS


def folds_of(lengths: Sequence[int]) -> Iterator[tuple[int, slice]]:
    """Fold and rows of each block of stretches one after the other: no fold lacks a whole motion."""
    for begin, rows in zip(np.cumsum([0, *lengths]), lengths, strict=False):
        edges = [int(begin) - (-block * rows // BLOCKS) for block in range(BLOCKS + 1)]
        for block, span in enumerate(pairwise(edges)):
            yield block % FOLDS, slice(*span)


def block_edges(used: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the edges of `SUMS` blocks with equal numbers of used rows, (SUMS + 1,): a joint may rest for long."""
    rows = np.flatnonzero(used)
    inner = rows[np.arange(1, SUMS) * rows.size // SUMS] if rows.size else np.zeros(SUMS - 1, np.int64)
    return np.concatenate([[0], inner, [used.size]])


def block_sums(values: Array) -> Array:
    """Return the sums of values (R,) over `SUMS` blocks with equal numbers of those that are not zero."""
    return np.array([values[begin:end].sum() for begin, end in pairwise(block_edges(values != 0.0))])


def references_of(fit: IvFit) -> tuple[Array | None, ...]:
    """Rigid parameters (b - e,) for each joint whose motion has much measurement noise; ``None`` for others.

    Unlike real motion, this noise appears in the errors of a fit, with opposite sign (Fuller 1987, section 1.2).
    """
    theta = fit.theta[: fit.theta.size - fit.study.model.e]
    found: list[Array | None] = []
    for joint, ar in zip(fit.equations.joints, fit.noise, strict=True):
        along = power = 0.0
        for part in joint.parts:
            rows = part[:]
            noise = ar.whiten(noise_of_motion(joint, rows, theta[None])[:, 0])
            along -= float(noise @ ar.whiten(rows[:, -1] - rows[:, : joint.x.size] @ fit.theta[joint.x]))
            power += float(noise @ noise)
        found.append(theta if along > fit.study.criteria.noisy_motion * power else None)
    return tuple(found)


def noise_of_motion(joint: JointEquations, rows: Array, theta: Array) -> Array:
    """Torque (M, k) of k sets of rigid parameters at measured signals beyond that at simulated ones.

    Simulated torques first follow the measured ones through a short filter, as simulated and real loop differ a little.
    """
    if rows.shape[0] < LEAST_ROWS:
        return np.zeros((rows.shape[0], theta.shape[0]))
    x, z = (columns[columns < theta.shape[1]] for columns in (joint.x, joint.z))
    simulated = rows[:, joint.x.size :][:, : z.size] @ theta[:, z].T
    apart = rows[:, : x.size] @ theta[:, x].T - simulated
    padded = np.pad(simulated, ((LAGS, LAGS), (0, 0)), mode="edge")
    shifted = np.lib.stride_tricks.sliding_window_view(padded, 2 * LAGS + 1, axis=0)
    taps = np.linalg.lstsq(shifted.mean(axis=1), apart.mean(axis=1), rcond=1e-10)[0]
    return np.asarray(apart - shifted @ taps)
