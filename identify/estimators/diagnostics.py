"""Tests of an estimate: instruments, endogeneity, residuals, and the set of essential parameters.

All tests use the equations as the estimator weights them (thesis 2.24, 6.30). Where it weights without a noise model
(IDIM-LS, IDIM-IV), one is fitted first (6.21 to 6.25), so that no test is disturbed by serial correlation.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, signal, stats

from armident.identify.regression.ar_noise import ArModel, lagged_sums
from armident.identify.regression.equations import MAX_AR_ORDER, Estimate, ExperimentEquations, noise_models
from armident.identify.regression.hac import newey_west
from armident.identify.regression.iv import factored, serial_covariance
from armident.identify.regression.least_squares import inverse_gram, least_squares
from armident.identify.regression.whitening import whitened

Array = NDArray[np.float64]

SIGNIFICANCE = 0.05
"""Probability of rejecting a true hypothesis, in every test here except those of the residuals."""

FALSE_ALARM_RATE = 0.01
"""Probability that the tests of one kind reject the residuals of any joint of a correct model (Bonferroni)."""

WEAK_F = 23.1
"""Robust first-stage F below which an instrument is weak: bias over 10 % of the worst case cannot be excluded at 5 %
(Montiel Olea and Pflueger 2013, table 1, one instrument per regressor)."""

LAGS = 20
"""Lags of the whiteness test beyond the order of the noise model."""

LAGS_PER_ROOT_SAMPLE = 1.3
"""Lags of the Newey-West variance of M samples over ``sqrt(M)`` (Lazarus, Lewis, Stock and Watson 2018)."""

SAME = 1e-8
"""Share of the IV variance below which the two estimators of the endogeneity test count as identical."""


@dataclass(frozen=True)
class Relevance:
    """First stage of one parameter.

    Parameters
    ----------
    parameter
        Base parameter.
    partial_r2
        Shea's partial R^2: variance of least squares over that of the instruments, 0 to 1.
    first_stage_f
        F statistic of the instruments given all other regressors (Sanderson and Windmeijer 2016), robust against
        serial and cross-joint correlation; ``inf`` where the instruments are the regressors.
    weak
        True if ``first_stage_f`` is below ``WEAK_F``.
    """

    parameter: str
    partial_r2: float
    first_stage_f: float
    weak: bool


@dataclass(frozen=True)
class Endogeneity:
    """Durbin-Wu-Hausman test of exogeneity: least squares and instruments differ by chance alone.

    Parameters
    ----------
    statistic, degrees, p_value
        Chi-square statistic of the difference, its degrees of freedom, and the probability of a larger statistic under
        exogeneity. The degrees of freedom are the directions in which the two estimators differ at all.
    largest_shift, parameter
        Greatest difference of the two, in standard deviations of the IV estimate, and its parameter. It measures the
        size of the bias of least squares; the statistic only measures its significance.
    rejected, verdict
        True if exogeneity is rejected, and the result as a sentence.
    """

    statistic: float
    degrees: int
    p_value: float
    largest_shift: float
    parameter: str
    rejected: bool
    verdict: str


@dataclass(frozen=True)
class JointResiduals:
    """Tests of the residuals of one joint, whitened by a noise model.

    Parameters
    ----------
    joint
        Name of the joint.
    order
        Order of the noise model.
    lags
        Number of lags of the whiteness test.
    ljung_box, ljung_box_degrees, ljung_box_p
        Statistic of Ljung and Box, degrees of freedom (lags less order), probability of more if white.
    white
        True if whiteness is not rejected: p is at least ``FALSE_ALARM_RATE`` over the number of joints.
    breusch_pagan, breusch_pagan_degrees, breusch_pagan_p
        Koenker's form of the Breusch-Pagan statistic against the magnitudes in ``against``.
    homoskedastic
        True if a constant variance is not rejected, at the same level.
    against
        Magnitudes on which the variance may depend: ``speed``, ``torque``.
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


@dataclass(frozen=True)
class NestedFit:
    """F test of a set of parameters against the full set: all others are zero.

    Parameters
    ----------
    kept, left_out
        Number of parameters in the set, and of those tested to be zero.
    f, degrees, p_value
        Statistic, its two degrees of freedom, probability of more if they are zero. The set was chosen on the same
        data, which makes the test lenient.
    sufficient
        True if the set suffices at ``SIGNIFICANCE``.
    """

    kept: int
    left_out: int
    f: float
    degrees: tuple[int, int]
    p_value: float
    sufficient: bool


@dataclass(frozen=True)
class Diagnostics:
    """Results of the tests of an estimate.

    Parameters
    ----------
    condition_regressor
        Condition number of the whitened, column-normalised regressor.
    condition_instruments
        The same of ``Z' W X``; ``None`` without instruments.
    relevance, endogeneity
        First stage of every parameter, and test of exogeneity; ``None`` without instruments.
    weak_instruments
        Parameters whose instruments are weak.
    joints
        Residual tests, one per joint.
    essential
        F test of the essential set; ``None`` where no set was given.
    serial_std_ratio
        Largest ratio of the standard deviation of a parameter that allows for serially correlated residuals to that of
        the estimate; 1 where the estimator already models the correlation.
    """

    condition_regressor: float
    condition_instruments: float | None
    relevance: tuple[Relevance, ...] | None
    weak_instruments: tuple[str, ...]
    endogeneity: Endogeneity | None
    joints: tuple[JointResiduals, ...]
    essential: NestedFit | None
    serial_std_ratio: float = 1.0

    def document(self) -> dict[str, Any]:
        """Plain numbers, strings, lists and dictionaries; numbers that are not finite become ``None``."""
        plain: dict[str, Any] = _plain(asdict(self))
        return plain


def diagnose_estimate(
    names: Sequence[str],
    joints: Sequence[str],
    blocks: Sequence[ExperimentEquations],
    estimate: Estimate,
    *,
    instruments: Sequence[Array] | None = None,
    weights: Sequence[ArModel] | None = None,
    essential: NDArray[np.bool_] | None = None,
    max_order: int = MAX_AR_ORDER,
) -> Diagnostics:
    """Test an estimate.

    Parameters
    ----------
    names, joints
        Base parameters (b,) and joints (n,).
    blocks
        The equations of the estimate.
    estimate
        Of any estimator.
    instruments
        Regressor at simulated signals, one (M, n, b) per experiment, at the final theta; ``None``: least squares.
    weights
        Noise models by which the estimator weighed its rows; ``None``: those of the estimate. They differ where a noise
        model entered the covariance alone.
    essential
        Mask (b,) of the parameters kept; ``None``: no F test.
    max_order
        Highest order of the noise models fitted to the residuals where the weights have none.

    Raises
    ------
    ValueError
        If shapes do not belong together.
    """
    _check(names, joints, blocks, instruments)
    weights = list(weights or estimate.noise)
    noise = weights
    if not any(w.order for w in weights):
        noise = noise_models(blocks, estimate.theta, estimate.covariance, max_order)
    keep, x = [b.keep for b in blocks], [b.x for b in blocks]
    rows = whitened(x, weights, keep)
    condition, relevance, endogeneity, ratio = None, None, None, 1.0
    if not any(w.order for w in [*weights, *estimate.noise]):
        zeta = x if instruments is None else instruments
        ratio = _largest_ratio(serial_covariance(zeta, x, keep, weights, noise), estimate.covariance)
    if instruments is not None:
        z = whitened(instruments, weights, keep)
        condition = float(np.linalg.cond(_normalised(z).T @ _normalised(rows)))
        relevance = instrument_relevance(names, blocks, instruments, weights)
        endogeneity = durbin_wu_hausman(names, blocks, instruments, weights, noise)
    return Diagnostics(
        condition_regressor=float(np.linalg.cond(_normalised(rows))),
        condition_instruments=condition,
        relevance=relevance,
        weak_instruments=tuple(r.parameter for r in relevance or () if r.weak),
        endogeneity=endogeneity,
        joints=residual_tests(names, joints, blocks, estimate, noise, instruments),
        essential=None
        if essential is None
        else nested_f_test(estimate.theta, estimate.covariance, essential, rows.shape[0]),
        serial_std_ratio=ratio,
    )


def instrument_relevance(
    names: Sequence[str],
    blocks: Sequence[ExperimentEquations],
    instruments: Sequence[Array],
    weights: Sequence[ArModel],
) -> tuple[Relevance, ...]:
    """Shea's partial R^2 and the conditional first-stage F of every parameter.

    Parameters
    ----------
    names
        Base parameters, shape (b,).
    blocks
        Equations with the regressor at measured signals.
    instruments
        Regressor at simulated signals, one (M, n, b) array per experiment.
    weights
        Noise model of each joint by which the rows are weighted.

    Notes
    -----
    With ``Xp = Z (Z'Z)^-1 Z' X`` and ``A = (Xp'Xp)^-1`` the part of ``Xp`` that is new in column k is
    ``w_k = Xp A[:, k] / A_kk`` and the first-stage error left beside it ``v_k = (X - Xp) A[:, k] / A_kk``: the second
    stage of Sanderson and Windmeijer without a second regression. ``F_k = |w_k|^4 / S_k`` with ``S_k`` the long-run
    variance of ``w_k v_k`` summed over the joints at each instant (Newey and West 1987).
    """
    keep = [b.keep for b in blocks]
    x = whitened([b.x for b in blocks], weights, keep)
    q, _ = linalg.qr(_normalised(whitened(instruments, weights, keep)), mode="economic")
    projected = q.T @ x
    a = inverse_gram(projected)
    r2 = np.diag(inverse_gram(x)) / np.diag(a)
    direction = a / np.diag(a)
    new = q @ (projected @ direction)
    error = (x - q @ projected) @ direction
    scores = _by_instant(new * error, keep, weights)
    strength = np.sum(new**2, axis=0)
    with np.errstate(divide="ignore"):
        f = strength**2 / np.maximum(_long_run_variance(scores), np.finfo(np.float64).eps ** 2 * strength**2)
    f[f > 1 / np.finfo(np.float64).eps] = np.inf
    return tuple(
        Relevance(name, float(min(share, 1.0)), float(value), bool(value < WEAK_F))
        for name, share, value in zip(names, r2, f, strict=True)
    )


def durbin_wu_hausman(
    names: Sequence[str],
    blocks: Sequence[ExperimentEquations],
    instruments: Sequence[Array],
    weights: Sequence[ArModel],
    noise: Sequence[ArModel],
) -> Endogeneity:
    """Durbin-Wu-Hausman test of least squares against instruments, on the same weighted equations.

    Parameters
    ----------
    names
        Base parameters, shape (b,).
    blocks
        Equations with the regressor at measured signals.
    instruments
        Regressor at simulated signals, one (M, n, b) array per experiment.
    weights
        Noise models by which both estimates weight their rows, one per joint.
    noise
        Noise models of the residuals, the same or richer.

    Notes
    -----
    Both estimates are linear in the noise, so their difference is ``D e`` with ``D = (Z'WX)^-1 Z'W - (X'WX)^-1 X'W``
    and its covariance ``D Omega D'``: never indefinite, also with serially correlated residuals. Directions in which
    the two are the same carry no information; they are left out, and the degrees of freedom with them.
    """
    keep = [b.keep for b in blocks]
    x = whitened([b.x for b in blocks], weights, keep)
    z = whitened(instruments, weights, keep)
    y = whitened([b.y for b in blocks], weights, keep)
    shift = factored(z, x, y).theta - least_squares(x, y)
    maps = _estimator_maps(z, x)
    # H' W A' for both estimators at once: its Gram matrix holds their covariances and their cross-covariance.
    coloured = _coloured(maps, keep, weights, noise)
    b = len(names)
    difference = coloured[:, :b] - coloured[:, b:]
    scale = np.linalg.norm(coloured[:, :b], axis=0)
    _, singular, directions = np.linalg.svd(difference / scale, full_matrices=False)
    told = singular**2 > SAME
    degrees = int(told.sum())
    if degrees == 0:
        return Endogeneity(
            0.0, 0, 1.0, 0.0, "", False, "instruments and regressors are the same: nothing can be said of endogeneity"
        )
    statistic = float(np.sum((directions[told] @ (shift / scale) / singular[told]) ** 2))
    p = float(stats.chi2.sf(statistic, degrees))
    shifts = np.abs(shift) / scale
    worst = int(np.argmax(shifts))
    rejected = p < SIGNIFICANCE
    if rejected:
        verdict = (
            f"least squares is biased on these equations: it differs from the instruments by more than chance "
            f"(p = {p:.2g}), most in {names[worst]}, by {shifts[worst]:.1f} standard deviations"
        )
    else:
        verdict = f"no sign that least squares is biased on these equations (p = {p:.2g})"
    return Endogeneity(statistic, degrees, p, float(shifts[worst]), names[worst], rejected, verdict)


def residual_tests(
    names: Sequence[str],
    joints: Sequence[str],
    blocks: Sequence[ExperimentEquations],
    estimate: Estimate,
    noise: Sequence[ArModel],
    instruments: Sequence[Array] | None = None,
) -> tuple[JointResiduals, ...]:
    """Whiteness and homoskedasticity of the residuals of every joint, whitened by ``noise``.

    Speed and torque magnitudes are the simulated ones where there are instruments: the measured ones share their
    errors with the residuals.

    Parameters
    ----------
    names, joints
        Base parameters (b,) and joints (n,).
    blocks
        Equations with the regressor at measured signals.
    estimate
        The estimate to test.
    noise
        Noise model of each joint.
    instruments
        Regressor at simulated signals, one (M, n, b) array per experiment; ``None``: least squares.
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
    """Test of Ljung and Box (1978) that residuals, pooled over experiments, are white.

    Parameters
    ----------
    series
        One array (M,) per experiment; the mean is not removed.
    lags
        Number of lags; fewer where the series are short.
    fitted
        Coefficients of the noise model, taken off the degrees of freedom.
    absorbed
        Sums of the autocovariances (lags + 1,) that fitted parameters took out of the residuals; they are given back.

    Returns
    -------
    statistic, degrees, p_value
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
    return statistic, degrees, float(stats.chi2.sf(statistic, degrees))


def breusch_pagan(residuals: Array, magnitudes: Array) -> tuple[float, int, float]:
    """Test of Breusch and Pagan in Koenker's (1981) form, valid without normality: ``M R^2`` of the squares.

    Parameters
    ----------
    residuals
        White residuals (M,).
    magnitudes
        Variables on which their variance may depend (M, k).

    Returns
    -------
    statistic, degrees, p_value
    """
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
    return statistic, u.shape[1], float(stats.chi2.sf(statistic, u.shape[1]))


def nested_f_test(theta: Array, covariance: Array, kept: NDArray[np.bool_], equations: int) -> NestedFit:
    """F test that all parameters but the kept ones are zero together.

    For least squares it is the ratio of the sums of squares of the two fits; for instruments the Wald form of it.

    Parameters
    ----------
    theta, covariance
        The full fit, (b,) and (b, b).
    kept
        Mask (b,).
    equations
        Number of rows of the regression.
    """
    out = np.flatnonzero(~kept)
    degrees = (out.size, max(equations - theta.size, 1))
    if out.size == 0:
        return NestedFit(int(kept.sum()), 0, 0.0, degrees, 1.0, True)
    std = np.sqrt(np.diag(covariance)[out])
    scaled = theta[out] / std
    f = float(scaled @ linalg.solve(covariance[np.ix_(out, out)] / np.outer(std, std), scaled)) / out.size
    p = float(stats.f.sf(f, *degrees))
    return NestedFit(int(kept.sum()), out.size, f, degrees, p, p >= SIGNIFICANCE)


def _check(
    names: Sequence[str],
    joints: Sequence[str],
    blocks: Sequence[ExperimentEquations],
    instruments: Sequence[Array] | None,
) -> None:
    for k, block in enumerate(blocks):
        if block.x.shape[1:] != (len(joints), len(names)):
            raise ValueError(f"block {k}: regressor of shape {block.x.shape}, {len(joints)} joints, {len(names)} names")
        if instruments is not None and instruments[k].shape != block.x.shape:
            raise ValueError(f"block {k}: instruments of shape {instruments[k].shape}, regressor {block.x.shape}")


def _largest_ratio(covariance: Array, claimed: Array) -> float:
    """Largest ratio of the standard deviations of two covariances (b, b)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = np.sqrt(np.diag(covariance) / np.diag(claimed))
    return float(np.nanmax(ratios, initial=0.0))


def _normalised(x: Array) -> Array:
    return np.asarray(x / np.linalg.norm(x, axis=0))


def _estimator_maps(z: Array, x: Array) -> Array:
    """``A'`` of the IV estimate and of least squares, side by side (R, 2 b): the estimates are ``A y``."""
    scale = np.linalg.norm(x, axis=0)
    qz, _ = linalg.qr(_normalised(z), mode="economic")
    qx, r = linalg.qr(x / scale, mode="economic")
    by_instruments = qz @ linalg.inv(qz.T @ (x / scale)).T
    by_least_squares = linalg.solve_triangular(r, qx.T).T
    return np.hstack([by_instruments / scale, by_least_squares / scale])


def _slices(keep: Sequence[NDArray[np.bool_]], weights: Sequence[ArModel]) -> list[tuple[int, int, slice]]:
    """Joint, experiment and place of every series in the rows of `whitened`."""
    places, first = [], 0
    for j, ar in enumerate(weights):
        for number, kept in enumerate(keep):
            last = first + int(kept[ar.order :, j].sum())
            places.append((j, number, slice(first, last)))
            first = last
    return places


def _coloured(
    maps: Array, keep: Sequence[NDArray[np.bool_]], weights: Sequence[ArModel], noise: Sequence[ArModel]
) -> Array:
    """``H' W' maps``: its Gram matrix is the covariance of ``maps' W e`` where ``e = H white`` by the noise models."""
    parts = []
    for j, number, place in _slices(keep, weights):
        weight, ar, kept = weights[j], noise[j], keep[number][:, j].copy()
        kept[: weight.order] = False
        rows = np.zeros((kept.size, maps.shape[1]))
        rows[kept] = maps[place]
        numerator = np.sqrt(ar.variance / weight.variance) * np.append(1.0, weight.coefficients)
        parts.append(signal.lfilter(numerator, np.append(1.0, ar.coefficients), rows[::-1], axis=0))
    return np.concatenate(parts)


def _by_instant(rows: Array, keep: Sequence[NDArray[np.bool_]], weights: Sequence[ArModel]) -> list[Array]:
    """Rows of `whitened` (R, b) summed over the joints at each instant, one (M, b) per experiment."""
    sums = [np.zeros((kept.shape[0], rows.shape[1])) for kept in keep]
    for j, number, place in _slices(keep, weights):
        order = weights[j].order
        sums[number][order:][keep[number][order:, j]] += rows[place]
    return sums


def _long_run_variance(scores: Sequence[Array]) -> Array:
    """Variance of the sum of serially correlated scores (b,), ``LAGS_PER_ROOT_SAMPLE sqrt(M)`` lags."""
    total = sum(s.shape[0] for s in scores)
    lags = min([math.ceil(LAGS_PER_ROOT_SAMPLE * math.sqrt(total)), *(s.shape[0] - 1 for s in scores)])
    return newey_west(scores, lags)


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


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value
