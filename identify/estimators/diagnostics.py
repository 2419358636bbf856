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
from scipy import linalg
from scipy.special import fdtrc

from armident.arrays import Array
from armident.identify.estimators.instrument_tests import (
    SIGNIFICANCE,
    Endogeneity,
    Relevance,
    durbin_wu_hausman,
    instrument_relevance,
    normalised,
)
from armident.identify.estimators.residual_tests import JointResiduals, residual_tests
from armident.identify.regression.ar_noise import ArModel
from armident.identify.regression.equations import Estimate, ExperimentEquations, noise_models
from armident.identify.regression.iv import serial_covariance
from armident.identify.regression.orders import MAX_AR_ORDER
from armident.identify.regression.whitening import whitened


@dataclass(frozen=True)
class NestedFit:
    """F test of a set of parameters against the full set: all others are zero.

    ``kept``, ``left_out``: numbers of parameters. ``sufficient``: the set suffices at `SIGNIFICANCE`. It was chosen on
    the same data, which makes the test lenient.
    """

    kept: int
    left_out: int
    f: float
    degrees: tuple[int, int]
    p_value: float
    sufficient: bool


@dataclass(frozen=True)
class Diagnostics:
    """Results of the tests of an estimate; ``None`` where there are no instruments, or no essential set.

    ``condition_regressor``: of the whitened, column-normalised regressor; ``condition_instruments``: of ``Z' W X``.
    ``relevance``: first stage of every parameter. ``serial_std_ratio``: largest ratio of the standard deviation of a
    parameter that allows for serially correlated residuals to that of the estimate; 1 where it models them.
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
) -> Diagnostics:
    """Test an estimate with its equations; ValueError if shapes do not belong together.

    ``instruments``: regressor (M, n, b) at simulated signals at the final theta; ``None``: least squares. ``weights``:
    noise models of the rows, those of the estimate by default; they differ where a model entered the covariance alone.
    ``essential``: mask (b,) for the F test.
    """
    _check(names, joints, blocks, instruments)
    weights = list(weights or estimate.noise)
    noise = weights
    if not any(w.order for w in weights):
        noise = noise_models(blocks, estimate.theta, estimate.covariance, MAX_AR_ORDER)
    keep, x = [b.keep for b in blocks], [b.x for b in blocks]
    rows = whitened(x, weights, keep)
    condition, relevance, endogeneity, ratio = None, None, None, 1.0
    if not any(w.order for w in [*weights, *estimate.noise]):
        zeta = x if instruments is None else instruments
        ratio = _largest_ratio(serial_covariance(zeta, x, keep, weights, noise), estimate.covariance)
    if instruments is not None:
        z = whitened(instruments, weights, keep)
        condition = float(np.linalg.cond(normalised(z).T @ normalised(rows)))
        relevance = instrument_relevance(names, blocks, instruments, weights)
        endogeneity = durbin_wu_hausman(names, blocks, instruments, weights, noise)
    return Diagnostics(
        condition_regressor=float(np.linalg.cond(normalised(rows))),
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


def nested_f_test(theta: Array, covariance: Array, kept: NDArray[np.bool_], equations: int) -> NestedFit:
    """F test (least squares), or its Wald form, that all parameters but those of the mask (b,) are zero together."""
    out = np.flatnonzero(~kept)
    degrees = (out.size, max(equations - theta.size, 1))
    if out.size == 0:
        return NestedFit(int(kept.sum()), 0, 0.0, degrees, 1.0, True)
    std = np.sqrt(np.diag(covariance)[out])
    scaled = theta[out] / std
    f = float(scaled @ linalg.solve(covariance[np.ix_(out, out)] / np.outer(std, std), scaled)) / out.size
    p = float(fdtrc(*degrees, f))
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


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value
