"""Tests of the residuals of each joint: whiteness, and a variance that does not depend on speed or torque.

The residuals are whitened by noise models (thesis 6.21 to 6.25), so that no test is disturbed by serial correlation.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from armident.arrays import Array
from armident.identify.regression.ar_noise import ArModel, lagged_sums
from armident.identify.regression.equations import Estimate, ExperimentEquations

FALSE_ALARM_RATE = 0.01
"""Probability that the tests of one kind reject the residuals of any joint of a correct model (Bonferroni)."""

LAGS = 20
"""Lags of the whiteness test beyond the order of the noise model."""


@dataclass(frozen=True)
class JointResiduals:
    """Tests of the residuals of one joint, whitened by a noise model of ``order``.

    ``ljung_box``: statistic over ``lags``, its degrees of freedom (lags less order), and p-value; ``white``: not
    rejected at `FALSE_ALARM_RATE` over the number of joints. ``breusch_pagan``: Koenker's form against the magnitudes
    ``against`` (``speed``, ``torque``); ``homoskedastic``: not rejected at the same level.
    """

    joint: str
    order: int
    lags: int
    ljung_box: float
    ljung_box_degrees: int
    ljung_box_p: float
    white: bool
    breusch_pagan: float
    breusch_pagan_degrees: int
    breusch_pagan_p: float
    homoskedastic: bool
    against: tuple[str, ...]


def residual_tests(
    names: Sequence[str],
    joints: Sequence[str],
    blocks: Sequence[ExperimentEquations],
    estimate: Estimate,
    noise: Sequence[ArModel],
    instruments: Sequence[Array] | None = None,
) -> tuple[JointResiduals, ...]:
    """Whiteness and homoskedasticity of the residuals of every joint, whitened by ``noise``.

    Speed and torque magnitudes are those at the ``instruments``, (M, n, b) per experiment, where there are any: the
    measured ones share their errors with the residuals.
    """
    motion = [b.x for b in blocks] if instruments is None else list(instruments)
    tests = []
    for j, (joint, ar) in enumerate(zip(joints, noise, strict=True)):
        kept = [b.keep[ar.order :, j] for b in blocks]
        errors = [ar.whiten(b.y[:, j] - b.x[:, j] @ estimate.theta) for b in blocks]
        series = [e[k] for e, k in zip(errors, kept, strict=True)]
        sensitivities = [ar.whiten(b.x[:, j])[k] for b, k in zip(blocks, kept, strict=True)]
        lags = ar.order + LAGS
        q, degrees, p = ljung_box(series, lags, ar.order, _absorbed(sensitivities, estimate.covariance, lags))
        against, magnitudes = _magnitudes(names, motion, blocks, estimate.theta, j, ar.order)
        lm, lm_degrees, lm_p = breusch_pagan(np.concatenate(series), magnitudes)
        tests.append(
            JointResiduals(
                joint=joint,
                order=ar.order,
                lags=lags,
                ljung_box=q,
                ljung_box_degrees=degrees,
                ljung_box_p=p,
                white=p >= FALSE_ALARM_RATE / len(joints),
                breusch_pagan=lm,
                breusch_pagan_degrees=lm_degrees,
                breusch_pagan_p=lm_p,
                homoskedastic=lm_p >= FALSE_ALARM_RATE / len(joints),
                against=against,
            )
        )
    return tuple(tests)


def ljung_box(
    series: Sequence[Array], lags: int = LAGS, fitted: int = 0, absorbed: Array | None = None
) -> tuple[float, int, float]:
    """Statistic, degrees of freedom and p-value of Ljung and Box (1978): residuals (M,) by experiment are white.

    The mean is not removed; short series have fewer lags. ``fitted``: coefficients of the noise model, taken off the
    degrees of freedom. ``absorbed``: sums of the autocovariances (lags + 1,) that fitted parameters took out, to be
    given back.
    """
    total = sum(s.size for s in series)
    lags = max(min([lags, *(s.size - 1 for s in series)]), 0)
    r = np.zeros(lags + 1) if absorbed is None else absorbed[: lags + 1].copy()
    for s in series:
        r += lagged_sums(s[:, None], lags)
    degrees = lags - fitted
    if degrees < 1 or r[0] <= 0:
        return 0.0, 0, 1.0
    pairs = np.sum([s.size - np.arange(1, lags + 1) for s in series], axis=0)
    statistic = float(total * (total + 2) * np.sum((r[1:] / r[0]) ** 2 / pairs))
    return statistic, degrees, float(chdtrc(degrees, statistic))


def breusch_pagan(residuals: Array, magnitudes: Array) -> tuple[float, int, float]:
    """Koenker's (1981) form of Breusch and Pagan's test, valid without normality: statistic, degrees of freedom, p."""
    squares = residuals**2
    centred = magnitudes - magnitudes.mean(axis=0)
    u, singular, _ = np.linalg.svd(
        centred / np.maximum(np.linalg.norm(magnitudes, axis=0), 1e-300), full_matrices=False
    )
    u = u[:, singular > 1e-8]
    spread = squares - squares.mean()
    total = float(spread @ spread)
    if u.shape[1] == 0 or total <= 0:
        return 0.0, 0, 1.0
    statistic = residuals.size * float(np.sum((u.T @ spread) ** 2)) / total
    return statistic, u.shape[1], float(chdtrc(u.shape[1], statistic))


def _absorbed(sensitivities: Sequence[Array], covariance: Array, lags: int) -> Array:
    """Sums of the autocovariances of ``X C X'``, absorbed from the residuals, at lags 0..lags."""
    out = np.zeros(lags + 1)
    for x in sensitivities:
        weighed = x @ covariance
        for lag in range(min(lags, x.shape[0] - 1) + 1):
            out[lag] += float(np.vdot(weighed[lag:], x[: x.shape[0] - lag]))
    return out


def _magnitudes(
    names: Sequence[str],
    motion: Sequence[Array],
    blocks: Sequence[ExperimentEquations],
    theta: Array,
    joint: int,
    order: int,
) -> tuple[tuple[str, ...], Array]:
    """Speed and torque magnitudes of a joint (M, k) at the instants of its residuals, and their names."""
    against, columns = ["torque"], [[np.abs(x[:, joint] @ theta) for x in motion]]
    if f"fv{joint + 1}" in names:
        k = list(names).index(f"fv{joint + 1}")
        against.insert(0, "speed")
        columns.insert(0, [np.abs(x[:, joint, k]) for x in motion])
    stacked = [
        np.concatenate([c[order:][b.keep[order:, joint]] for c, b in zip(column, blocks, strict=True)])
        for column in columns
    ]
    return tuple(against), np.stack(stacked, axis=1)
