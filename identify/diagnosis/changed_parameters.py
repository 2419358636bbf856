"""Changes of a plant that explain a difference from a baseline: competing explanations, one criterion.

A change moves the difference d, of covariance C, along few directions: ``d = B p``. With ``p`` normal of typical ratios
and free size, ``d`` is normal, too: its likelihood is the criterion. The data choose the size, so that an explanation
with many parameters pays for those that it needs only. What no explanation takes enlarges C: the best one is judged by
the difference that it leaves, not by a covariance that the recordings contradict. Residuals of the same motion are a
part of the difference: changes that the parameters absorb alike differ in what they leave.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from armident.arrays import Array
from armident.identify.diagnosis.baseline_comparison import Difference
from armident.identify.diagnosis.changes import Change
from armident.identify.diagnosis.criteria import Criteria
from armident.identify.effects.link import Payload
from armident.identify.effects.parameter_change import ParameterChange
from armident.identify.regression.multiple_testing import holm

RANK_TOLERANCE = 1e-7
"""Relative singular value below which a direction of normalised changes is dropped: rounding of the covariances."""
SIZES = np.geomspace(1e-2, 1e8, 41)
"""Sizes of a change to try, standard deviations of its best determined combination of parameters."""
SWEEPS = 5
"""Most passes over the sizes of several changes."""


@dataclass(frozen=True, eq=False)
class ExplainedChange:
    """One change of an explanation beside the others; ``own`` (m,): parameters that the motion determines one by one.

    ``coefficients`` (m,): of its directions. ``odds``: logarithms of the odds of other changes in its place.
    """

    change: Change
    coefficients: Array
    std: Array
    own: NDArray[np.bool_]
    p_value: float
    odds: tuple[tuple[Change, float], ...]

    @property
    def parameters(self) -> dict[str, float]:
        """Estimable linear parameters by name, SI."""
        return self._named(self.change.reported(self.coefficients, self.std)[0])

    @property
    def deviations(self) -> dict[str, float]:
        """Their standard deviations."""
        return self._named(self.change.reported(self.coefficients, self.std)[1])

    @property
    def words(self) -> str:
        """The change in one sentence."""
        joint = " and ".join(self.change.joints)
        return self.change.effect.change_in_words(joint, self.parameters, self.deviations)

    def _named(self, values: Array) -> dict[str, float]:
        names = [p.name for p in self.change.effect.linear]
        return {name: float(v) for name, v, own in zip(names, values, self.own, strict=True) if own}

    def probability(self) -> float:
        """Share of the posterior odds among all changes in its place."""
        return float(np.exp(-special.logsumexp([0.0, *(odds for _, odds in self.odds)])))

    def rivals(self, close: float) -> list[Change]:
        """Changes that are not excluded: within odds of ``exp(close)``."""
        return [change for change, odds in self.odds if odds > -close]


@dataclass(frozen=True, eq=False)
class Attribution:
    """Changes that explain a difference; without any, ``rest`` is the whole difference.

    ``rest`` (k,): difference of parameters that is left, with the probability ``p_rest`` without a further change, and
    ``unexplained``: numbers of those of which a significant part is left. ``share``: of the chi-square of parameters
    and residuals beyond its expectation, that the changes explain; 1 if what is left is not significant.
    """

    difference: Difference
    changes: tuple[ExplainedChange, ...]
    rest: Array
    p_rest: float
    unexplained: tuple[int, ...]
    share: float

    def residual_scores(self, joint: int) -> Array | float:
        """Change of the residual statistics of a joint, (s,), that the changes predict."""
        return sum(
            (c.coefficients @ c.change.scores[joint] for c in self.changes if c.change.scores is not None), start=0.0
        )


@dataclass(frozen=True, eq=False)
class Competition:
    """Candidate changes of a difference and of the residuals; ``target`` (r,): both, whitened, the parameters first."""

    difference: Difference
    target: Array
    candidates: "tuple[Whitened, ...]"
    criteria: Criteria

    @classmethod
    def of(
        cls,
        difference: Difference,
        residuals: Sequence[tuple[Array, Array]],
        pool: Sequence[Change],
        criteria: Criteria,
    ) -> "Competition":
        """Competition of a pool; ``residuals``: of each joint the whitened difference and its change per score."""
        target = np.concatenate([difference.whitening @ difference.values, *(own for own, _ in residuals)])
        candidates = []
        for change in pool:
            scores = [np.zeros((own.size, change.sizes.size)) for own, _ in residuals]
            if change.scores is not None:
                scores = [per_score @ own.T for (_, per_score), own in zip(residuals, change.scores, strict=True)]
            columns = np.vstack([difference.whitening @ change.directions, *scores]) * change.sizes
            candidates.append(Whitened(change, columns, _prior(change, pool, criteria)))
        return cls(difference, target, tuple(candidates), criteria)

    def p_value(self) -> float:
        """Probability of so large a part along the best candidate without a change, corrected for their number."""
        whole = float(self.target @ self.target)
        p = [1.0]
        for one in self.candidates:
            left, degrees = _rest_of(self.target, [one])
            p.append(float(special.chdtrc(max(self.target.size - degrees, 1), max(whole - float(left @ left), 0.0))))
        return min(1.0, min(p) * len(self.candidates))

    def explained(self, alpha: float) -> Attribution:
        """Best explanation of a difference that is significant at the level ``alpha`` of all its tests.

        A further change is added while its evidence exceeds the number of candidates over ``alpha`` (Ville 1939).
        After each, all compete once more beside the others.
        """
        found: list[Whitened] = []
        while self.candidates and len(found) < self.criteria.most_findings:
            best = self._best(found)
            if best is None:
                break
            gain = _evidence_of(self.target, [*found, best]) - _evidence_of(self.target, found)
            # The tests of the difference admit the first change; among more, each must be significant by itself.
            if found and (gain < np.log(len(self.candidates) / alpha) or self._within_first_order(found, best)):
                break
            found = self._exchanged([*found, best])
        left, degrees = _rest_of(self.target, found)
        dispersion = max(1.0, float(left @ left) / max(degrees, 1))
        moved = sum((one.change.directions @ v for one, v in zip(found, self._values(found), strict=True)), np.zeros(1))
        rest = self.difference.values - moved
        count = self.difference.whitening.shape[0]
        own, free = _rest_of(self.target[:count], [w.of_parameters(count) for w in found])
        p_rest = float(special.chdtrc(free, own @ own)) if free else 1.0
        single = holm(2 * special.ndtr(-np.abs(rest) / self.difference.std))
        unexplained = tuple(int(k) for k in np.argsort(single) if single[k] < alpha)
        changes = tuple(self._described(found, one, dispersion) for one in found)
        excess = float(self.target @ self.target) - self.target.size
        share = 1.0
        if special.chdtrc(degrees, left @ left) < alpha:
            share = float(np.clip(1.0 - (left @ left - degrees) / max(excess, 1e-300), 0.0, 1.0))
        return Attribution(self.difference, changes, rest, p_rest, unexplained, share)

    def _within_first_order(self, found: Sequence["Whitened"], best: "Whitened") -> bool:
        """True if a further change takes no more than what the directions of the others leave of large changes.

        Those of parameters are exact. The others hold for small changes, and for noise models without them.
        """
        if all(one.change.scores is None for one in found):
            return False
        whole = float(self.target @ self.target)
        before, after = (float(left @ left) for left, _ in (_rest_of(self.target, w) for w in (found, [*found, best])))
        return before - after < self.criteria.least_share * (whole - before)

    def _best(self, found: Sequence["Whitened"]) -> "Whitened | None":
        """Best physically possible candidate beside others."""
        scores = self._scores(found)
        for one in sorted(scores, key=lambda one: -scores[one]):
            if _consistent(self.target, [*found, one]):
                return one
        return None

    def _scores(self, found: Sequence["Whitened"]) -> dict["Whitened", float]:
        """Logarithm of the posterior of each candidate beside others, up to a constant."""
        root, half = _whitened_by(self.target, found)
        white = root @ self.target
        return {
            one: _evidence(white, root @ one.columns)[0] - half + one.prior
            for one in self.candidates
            if one not in found
        }

    def _exchanged(self, found: list["Whitened"]) -> list["Whitened"]:
        """Changes after each has competed beside the others, without those that the others make superfluous."""
        for _ in range(len(found) if len(found) > 1 else 0):
            before = list(found)
            for one in before:
                others = [o for o in found if o is not one]
                best = self._best(others)
                if best is None or best in others:
                    continue
                found = [best if o is one else o for o in found]
            for one in list(found):
                others = [o for o in found if o is not one]
                if others and _evidence_of(self.target, others) > _evidence_of(self.target, found):
                    found = others
            if found == before:
                break
        return found

    def _values(self, found: Sequence["Whitened"]) -> list[Array]:
        """Coefficients of each change."""
        values = _solved(self.target, found)[0]
        return np.split(values, np.cumsum([one.change.sizes.size for one in found])[:-1]) if found else []

    def _described(self, found: Sequence["Whitened"], one: "Whitened", dispersion: float) -> ExplainedChange:
        """A change beside the others, with its odds against all candidates in its place."""
        others = [o for o in found if o is not one]
        m = one.change.sizes.size
        values, covariance, own = _solved(self.target, [*others, one])
        (before, free), (after, left) = _rest_of(self.target, others), _rest_of(self.target, [*others, one])
        scores = self._scores(others)
        odds = [(c.change, score - scores[one]) for c, score in scores.items() if c is not one]
        return ExplainedChange(
            one.change,
            values[-m:],
            np.sqrt(dispersion * np.diag(covariance)[-m:]),
            own[-m:] > self.criteria.estimable,
            float(special.chdtrc(max(free - left, 1), max(float(before @ before - after @ after), 0.0) / dispersion)),
            tuple(sorted(odds, key=lambda pair: -pair[1])),
        )


@dataclass(frozen=True, eq=False)
class Whitened:
    """A change with its whitened directions (r, m), in units of their typical sizes, and its logarithmic prior odds."""

    change: Change
    columns: Array
    prior: float

    def of_parameters(self, count: int) -> "Whitened":
        """The rows of the parameters."""
        return Whitened(self.change, self.columns[:count], self.prior)


def _prior(change: Change, pool: Sequence[Change], criteria: Criteria) -> float:
    """Logarithm of the prior odds, divided among the places of an effect.

    Loads of the flange, friction and offsets change more often than the rest, and loads of other links less.
    """
    alike = [c for c in pool if c.effect == change.effect]
    common = criteria.close if isinstance(change.effect, ParameterChange) else 0.0
    if not isinstance(change.effect, Payload):
        return common - float(np.log(len(alike)))
    return common if change is alike[-1] else common - criteria.close - float(np.log(len(alike) - 1))


def _evidence(target: Array, columns: Array) -> tuple[float, float]:
    """Logarithm of the likelihood of whitened differences (r,) with one change of the best size, and this size.

    The variance of the rest is the larger of 1 and its mean square.
    """
    u, s, _ = np.linalg.svd(columns, full_matrices=False)
    kept = s > RANK_TOLERANCE * max(float(s.max(initial=0.0)), 1e-300)
    along, s = u[:, kept].T @ target, s[kept]
    if not s.size:
        return _log_likelihood(float(target @ target), target.size), 0.0
    sizes = SIZES / s[0]
    ratios = (np.outer(sizes, s)) ** 2
    left = target @ target - (ratios / (1.0 + ratios)) @ along**2
    values = [_log_likelihood(float(q), target.size) for q in left] - 0.5 * np.log1p(ratios).sum(axis=1)
    best = int(np.argmax(values))
    return float(values[best]), float(sizes[best])


def _log_likelihood(square: float, count: int) -> float:
    variance = max(1.0, square / count)
    return -0.5 * (square / variance + count * float(np.log(variance)))


def _whitened_by(target: Array, found: Sequence[Whitened]) -> tuple[Array, float]:
    """Matrix (r, r) that whitens the difference with some changes of their best sizes, and half its log determinant.

    The sizes are those of all changes together: alone, one would take the size of another, too.
    """
    sizes = [0.0] * len(found)
    for _ in range(SWEEPS if len(found) > 1 else 1):
        before = list(sizes)
        for k, one in enumerate(found):
            root, _ = _whitening_of([o for o in found if o is not one], [*sizes[:k], *sizes[k + 1 :]], target.size)
            sizes[k] = _evidence(root @ target, root @ one.columns)[1]
        if sizes == before:
            break
    return _whitening_of(found, sizes, target.size)


def _whitening_of(found: Sequence[Whitened], sizes: Sequence[float], rows: int) -> tuple[Array, float]:
    """Matrix (rows, rows) that whitens the difference with changes of given sizes, and half its log determinant."""
    root, half = np.eye(rows), 0.0
    for one, size in zip(found, sizes, strict=True):
        u, s, _ = np.linalg.svd(root @ one.columns, full_matrices=False)
        ratios = (size * s) ** 2
        root = root - (u * (1.0 - 1.0 / np.sqrt(1.0 + ratios))) @ (u.T @ root)
        half += 0.5 * float(np.log1p(ratios).sum())
    return root, half


def _evidence_of(target: Array, found: Sequence[Whitened]) -> float:
    """Logarithm of the likelihood of a difference with some changes."""
    root, half = _whitened_by(target, found)
    white = root @ target
    return _log_likelihood(float(white @ white), white.size) - half


def _decomposed(found: Sequence[Whitened], rows: int) -> tuple[Array, Array, Array, Array]:
    """Singular value decomposition of the columns of some changes, with the scale of each column."""
    stack = np.hstack([one.columns for one in found]) if found else np.zeros((rows, 0))
    scale = np.linalg.norm(stack, axis=0)
    scale[scale == 0] = 1.0
    u, s, vt = np.linalg.svd(stack / scale, full_matrices=False)
    kept = s > RANK_TOLERANCE * max(float(s.max(initial=0.0)), 1e-300)
    return u[:, kept], s[kept], vt[kept], scale


def _rest_of(target: Array, found: Sequence[Whitened]) -> tuple[Array, int]:
    """Whitened difference (r,) that some changes leave, and its degrees of freedom."""
    u = _decomposed(found, target.size)[0]
    return target - u @ (u.T @ target), target.size - u.shape[1]


def _solved(target: Array, found: Sequence[Whitened]) -> tuple[Array, Array, Array]:
    """Coefficients by least squares, their covariance, and the share of each in the observed directions."""
    u, s, vt, scale = _decomposed(found, target.size)
    sizes = np.concatenate([one.change.sizes for one in found]) / scale
    inverse = sizes[:, None] * (vt.T / s)
    return inverse @ (u.T @ target), inverse @ inverse.T, np.einsum("kj,kj->j", vt, vt)


def _consistent(target: Array, found: Sequence[Whitened]) -> bool:
    """True if the last change is physically possible, as far as the motion determines it."""
    effect, m = found[-1].change.effect, found[-1].columns.shape[1]
    values, covariance, own = _solved(target, found)
    if not isinstance(effect, ParameterChange) or own[-m:].min() < 0.5:
        return True
    left, degrees = _rest_of(target, found)
    return effect.consistent(values[-m:], max(1.0, float(left @ left) / max(degrees, 1)) * covariance[-m:, -m:])
