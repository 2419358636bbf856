"""Base parameters that a motion supports."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg

from armident.arrays import Array, Mask
from armident.identify.documents.rounding import plus_minus
from armident.identify.identification.equations import Prepared
from armident.identify.identification.identification_criteria import IdentificationCriteria
from armident.identify.identification.identification_result import units
from armident.identify.identification.verdict import enumerated
from armident.identify.regression.ar_noise import ArModel
from armident.identify.regression.equations import ExperimentEquations, filtered_regressor
from armident.identify.regression.least_squares import RANK_TOLERANCE, Triangle
from armident.identify.regression.qr import triangularize_parts
from armident.identify.robot.arm import ArmModel
from armident.identify.signals.decimate import Decimation
from armident.identify.signals.differentiate import Derivatives
from armident.identify.signals.streamed import kept, mapped

NEGLIGIBLE = 1e-6
"""Torque per SI unit of a parameter, relative to the greatest of all, below which a motion does not show it."""

TIE = 1e-6
"""Relative advantage, in the order of pivoted QR, of the parameter with most torque per SI unit: among those that the
motion cannot separate at all, rounding would decide."""

NON_NEGATIVE = ("fv", "fc", "ia")
"""First letters of the parameters that cannot be negative: viscous and Coulomb friction, rotor inertia."""


@dataclass(frozen=True, eq=False)
class Support:
    """Base parameters (b,) that a motion of the ``moving`` joints (n,) supports.

    Each includes what the motion cannot separate from it. ``theta``, ``std``: estimate of these alone, SI; else NaN.
    """

    moving: Mask
    supported: Mask
    theta: Array
    std: Array

    def determined(self, model: ArmModel, share: float) -> Mask:
        """Mask (b,) of supported parameters with relative std up to ``share``, not negative where impossible."""
        possible = np.array([not name.startswith(NON_NEGATIVE) for name in model.base.names]) | (self.theta > 0)
        with np.errstate(invalid="ignore"):
            return np.asarray(self.supported & possible & (self.std <= share * np.abs(self.theta)), dtype=np.bool_)

    def sentence(self, model: ArmModel, criteria: IdentificationCriteria) -> str:
        """List the parameters that the motion determines in words, with values if they are few."""
        found = np.flatnonzero(self.determined(model, criteria.max_relative_std))
        limit = f"within {100 * criteria.max_relative_std:.0f} %"
        if not found.size:
            return f"it determines none of the {self.supported.size} base parameters {limit}"
        count = f"it determines {found.size} of {self.supported.size} base parameters {limit}"
        if found.size > criteria.max_listed:
            return count
        unit = units(model)
        values = [f"{model.base.names[k]} = {plus_minus(self.theta[k], self.std[k])} {unit[k]}" for k in found]
        return f"{count}, each with what cannot be separated from it: {enumerated(values, criteria.max_listed)}"


def examine_support(
    prepared: Prepared,
    blocks: Sequence[ExperimentEquations],
    decimation: Decimation,
    moving: Mask,
    criteria: IdentificationCriteria,
    noise: Sequence[ArModel] | None = None,
) -> Support:
    """Find the base parameters that a motion supports, by rank-revealing QR of the weighted regressor.

    Joints at rest are held still, so that noise is no excitation. The largest leading subset of pivoted QR counts in
    which one standard deviation moves the torques by less than ``max_relative_std``.
    """
    model = prepared.model
    b, rows = model.base.b, 0
    powers = np.zeros((model.n, b + 1))

    def joint_by_joint() -> Iterator[tuple[Array]]:
        nonlocal rows
        for j, own in _moving_rows(prepared, blocks, decimation, moving, noise):
            powers[j] += np.einsum("ij,ij->j", own, own)
            rows += own.shape[0]
            yield (own,)

    top, norms = triangularize_parts(joint_by_joint(), columns=b + 1)
    # Rounding errors, such as that of cos(pi / 2), give columns that no real parameter fills.
    scale = np.where(norms[:b] > NEGLIGIBLE * norms[:b].max(), norms[:b], np.inf)
    preferred = 1.0 + TIE * norms[:b] / norms[:b].max()
    factor, order = linalg.qr(top[:, :b] * (preferred / scale), mode="r", pivoting=True)
    limit = criteria.max_relative_std * np.sqrt(powers[:, b] @ (powers[:, :b] / scale**2))[order]
    pivots = np.abs(np.diag(factor))
    count = int(np.sum(pivots > RANK_TOLERANCE * max(float(pivots[0]), 1e-300)))
    while count:
        inverse = linalg.solve_triangular(factor[:count, :count], np.eye(count))
        if np.all(np.linalg.norm(inverse, axis=1) <= limit[:count]):
            break
        count -= 1
    supported = np.zeros(b, dtype=np.bool_)
    supported[order[:count]] = True
    theta, std = np.full((2, b), np.nan)
    if count:
        # An orthogonal transformation of all rows: the least squares of a part of the columns are the same.
        chosen, y = top[:, :b][:, supported], top[:, b]
        solved = Triangle.of([(chosen, y)])
        theta[supported] = solved.theta
        rest = y - chosen @ solved.theta
        variance = float(rest @ rest) / max(rows - count, 1)
        std[supported] = np.sqrt(variance * np.diag(solved.inverse_gram))
    return Support(moving, supported, theta, std)


def _moving_rows(
    prepared: Prepared,
    blocks: Sequence[ExperimentEquations],
    decimation: Decimation,
    moving: Mask,
    noise: Sequence[ArModel] | None,
) -> Iterator[tuple[int, Array]]:
    """Yield moving joints, with regressor and torques (R, b + 1) in residual standard deviations, by experiment."""
    regressors = mapped(lambda b: b.x, blocks)
    if not moving.all():
        blocks = prepared.equations(decimation)
        still = (_held(s, moving) for s in prepared.signals)
        regressors = kept((filtered_regressor(prepared.model, s, decimation) for s in still), like=blocks)
    if noise is None:
        torques = [(b.y, b.keep) for b in blocks]
        variances = [np.concatenate([y[used[:, j], j] for y, used in torques]).var() for j in range(moving.size)]
    else:
        variances = [ar.variance for ar in noise]
    stds = np.maximum(np.sqrt(variances), 1e-150)
    for block, regressor in zip(blocks, regressors, strict=True):
        for j in np.flatnonzero(moving).tolist():
            used = block.keep[:, j]
            yield j, np.column_stack([regressor[used, j], block.y[used, j]]) / stds[j]


def _held(signals: Derivatives, moving: Mask) -> Derivatives:
    """Motion with the joints at rest held at their mean position."""
    q = np.where(moving, signals.q, signals.q.mean(axis=0))
    return replace(signals, q=q, qd=np.where(moving, signals.qd, 0.0), qdd=np.where(moving, signals.qdd, 0.0))
