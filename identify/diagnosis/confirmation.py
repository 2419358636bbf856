"""Confirmation of a finding by the report part of the data, which chose nothing."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from armident.identify.diagnosis.model_state import ModelState
from armident.identify.diagnosis.predictive_score import SUMS
from armident.identify.diagnosis.regression import applied
from armident.identify.diagnosis.whitening import rows_of_joints, whitened

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Confirmation:
    """Comparison of two models on the report part.

    Parameters
    ----------
    p_value
        Probability of so large a projection of the errors without the effect on the change by the effect, if the effect
        is not there.
    share
        Share of the power of the errors of each joint that the effect removes, (n,).
    before, after
        Relative errors without and with the effect, percent, (n,).
    """

    p_value: float
    share: Array
    before: Array
    after: Array

    @property
    def joint(self) -> int:
        """Joint at which the effect removes the largest share."""
        return int(np.argmax(self.share))


def confirmed(with_it: ModelState, without: ModelState) -> Confirmation:
    """Compare two models that differ in one effect on the report part.

    The errors of the model without the effect are projected on the change of the prediction (Clark, West 2007, Journal
    of Econometrics 138). The change is computed at the simulated motion, which is free of noise. Its variance comes
    from sums over blocks of time, whatever the serial correlation of the errors.

    Parameters
    ----------
    with_it, without
        Models with and without the effect.
    """
    noise = with_it.fit.noise
    before, after = (state.fit.errors(state.fit.theta, held=True) for state in (without, with_it))
    if with_it.study.recorded == without.study.recorded:
        theta = _less(with_it, without)
        change = [applied(z, theta) for _, z, _ in with_it.fit.equations.held]
    else:
        change = [b - a for b, a in zip(before, after, strict=True)]
    lengths = [e.shape[0] for e in before]
    products = whitened(before, noise) * whitened(change, noise)
    sums = np.zeros(SUMS)
    for rows in rows_of_joints(lengths, noise):
        sums += [part.sum() for part in np.array_split(products[rows], SUMS)]
    size = [float(sum(np.sum(e[:, j] ** 2) for e in errors)) for errors in (before, after) for j in range(len(noise))]
    n = len(noise)
    power, left = np.array(size[:n]), np.array(size[n:])
    torque = np.array([sum(float(s.y[:, j] @ s.y[:, j]) for s in with_it.study.held) for j in range(n)])
    spread = float(sums.std(ddof=1)) / np.sqrt(SUMS)
    statistic = float(sums.mean()) / max(spread, 1e-300)
    return Confirmation(
        float(stats.t.sf(statistic, SUMS - 1)),
        1.0 - left / np.maximum(power, 1e-300),
        100 * np.sqrt(power / np.maximum(torque, 1e-300)),
        100 * np.sqrt(left / np.maximum(torque, 1e-300)),
    )


def _less(with_it: ModelState, without: ModelState) -> Array:
    """Parameters of the model with the effect less those of the model without it, (b,)."""
    names = with_it.study.model.base.names
    difference: Array = with_it.fit.theta.copy()
    for name, value in zip(without.study.model.base.names, without.fit.theta, strict=True):
        difference[names.index(name)] -= value
    return difference
