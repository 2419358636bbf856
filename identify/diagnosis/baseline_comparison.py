"""Difference between two identifications of one arm with the same model, which `compare` and a diagnosis share.

Runs are independent, so that covariances add. Errors that both models have, on the same motion, cancel.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import chdtrc

from armident.arrays import Array
from armident.configs import DataError
from armident.identify.documents.identification import IdentificationDocument

RANK_TOLERANCE = 1e-9
"""Eigenvalues of the difference's correlation, relative to the largest, that count as rounding errors."""

MUCH_WORSE = 10.0
"""Median ratio of standard deviations of the two identifications above which the test is inconclusive: a change by the
three standard deviations that the better one would show is a third of a standard deviation of the worse one."""


class Inconclusive(DataError):
    """Two identifications cannot confirm or exclude a change."""


@dataclass(frozen=True, eq=False)
class Difference:
    """Parameters (k,) of two identifications in the order of the later one, and the covariance of ``now - before``."""

    names: tuple[str, ...]
    before: Array
    now: Array
    covariance: Array

    @property
    def values(self) -> Array:
        """Later less earlier parameters, (k,)."""
        return np.asarray(self.now - self.before)

    def widened(self, factor: float) -> "Difference":
        """The difference with larger standard deviations."""
        return replace(self, covariance=factor**2 * self.covariance)

    @property
    def std(self) -> Array:
        """Standard deviations of the difference, (k,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @cached_property
    def whitening(self) -> Array:
        """``W`` (r, k) with ``W C W' = 1``, without the directions of rounding size."""
        return whitening(self.covariance)

    def chi_square(self, rows: slice | list[int] = slice(None)) -> tuple[float, int]:
        """``d' C^-1 d`` of some parameters with the others free, and its degrees of freedom."""
        whitened = whitening(self.covariance[rows][:, rows]) @ self.values[rows]
        return float(whitened @ whitened), whitened.size

    @property
    def p_value(self) -> float:
        """Probability of so large a difference of all parameters together without a change."""
        statistic, degrees = self.chi_square()
        return float(chdtrc(degrees, statistic))


def whitening(covariance: Array) -> Array:
    """``W`` (r, k) with ``W C W' = 1``, without the directions of rounding size."""
    std = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(std, std))
    kept = values > RANK_TOLERANCE * values[-1]
    return np.asarray((vectors[:, kept] / np.sqrt(values[kept])).T / std)


def difference_of(baseline: IdentificationDocument, now: IdentificationDocument) -> Difference:
    """Difference of two identifications; DataError or Inconclusive if they cannot be compared."""
    for name, document in (("the baseline", baseline), ("the identification", now)):
        if not document.converged:
            raise Inconclusive(
                f"{now.robot}: {name} did not converge ({document.stop_reason}): whether the arm has changed is unknown"
            )
        if document.verdict == "unusable":
            defect = document.reasons[0].message
            raise Inconclusive(f"{now.robot}: {name} is unusable ({defect}): whether the arm has changed is unknown")
    if baseline.robot != now.robot:
        raise DataError(f"the baseline is of robot {baseline.robot!r}, the identification of {now.robot!r}")
    old = {p.name: k for k, p in enumerate(baseline.parameters)}
    new = {p.name: k for k, p in enumerate(now.parameters)}
    if old.keys() != new.keys():
        odd = ", ".join(sorted(old.keys() ^ new.keys())[:5])
        raise DataError(f"{now.robot}: baseline and identification have different base parameters: {odd}")
    for document in (baseline, now):
        if np.shape(document.covariance) != (len(new), len(new)):
            raise DataError(
                f"{now.robot}: a covariance has shape {np.shape(document.covariance)} for {len(new)} parameters"
            )
    if not all(p.std > 0 for p in (*now.parameters, *baseline.parameters)):
        raise DataError(f"{now.robot}: a parameter without a standard deviation cannot be compared")
    order = [old[p.name] for p in now.parameters]
    worse = float(np.median([p.std / baseline.parameters[k].std for p, k in zip(now.parameters, order, strict=True)]))
    if not 1.0 / MUCH_WORSE < worse < MUCH_WORSE:
        raise Inconclusive(
            f"{now.robot}: standard deviations are {worse:.2g} times those of the baseline: "
            "whether the arm has changed is unknown"
        )
    return Difference(
        tuple(p.name for p in now.parameters),
        np.array([baseline.parameters[k].value for k in order]),
        np.array([p.value for p in now.parameters]),
        np.array(now.covariance) + np.array(baseline.covariance)[np.ix_(order, order)],
    )
