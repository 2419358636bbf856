"""Statistics of the residuals that a later identification of the same arm can be compared with.

Piecewise linear functions of position, of position with direction, and of velocity describe what the model lacks. They
are estimated beside all base parameters, weighted for serial correlation. The power in bands of frequency is the rest.
Changes of the plant for which the model has no parameter move parameters and functions along `EffectDirection`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array
from armident.identify.effects.effect import Effect, Place
from armident.identify.effects.free_shapes import hats
from armident.identify.effects.registry import catalogue
from armident.identify.identification.equations import Prepared
from armident.identify.regression.ar_noise import ArModel
from armident.identify.regression.equations import (
    Estimate,
    ExperimentEquations,
    instants,
    noise_models,
    residuals,
)
from armident.identify.regression.orders import MAX_AR_ORDER
from armident.identify.regression.whitening import whitened

POSITION_KNOTS = 9
"""Knots of the functions of position over its range: a period of an eighth of the range is still visible."""

VELOCITY_KNOTS = 9
"""Knots of the functions of velocity between the largest speeds of both directions; one of them is zero."""

DIRECTION = 0.05
"""Speed at which the direction of motion is smoothed, as share of the largest speed of the joint."""

BANDS = (0.0, 1 / 16, 1 / 8, 1 / 4, 1 / 2)
"""Limits of the frequency bands, as shares of half the rate of the equations: octaves. The last octave is left out: it
depends on the smoother of the positions, whose bandwidth is chosen anew from the noise of every run."""

SPEED_QUANTILE = 0.95
"""Quantile of the speed that is the last knot of velocity: the largest speed of a joint that hardly moves is noise."""

RANK = 1e-10
"""Eigenvalues of the normal equations, relative to the largest, that count as rounding errors."""


@dataclass(frozen=True)
class JointResidualStatistics:
    """Statistics of the residuals of one joint; knots span ``position_range`` and ``velocity_limit``.

    ``score`` (k,) is ``P' W e`` and ``information`` (k, k) is ``P' W P``, W the inverse noise covariance and P the
    functions without their projection on the regressor, first ``2 POSITION_KNOTS`` of position. Coefficients are
    ``information^-1 score`` with covariance ``information^-1``. Powers (m,), N^2 m^2 or N^2, are chi-square.
    """

    joint: str
    position_range: tuple[float, float]
    velocity_limit: float
    score: Array
    information: Array
    band_edges_hz: Array
    band_power: Array
    band_degrees: Array


@dataclass(frozen=True)
class EffectDirection:
    """Change by an effect that the model lacks, per linear parameter: ``parameters`` (m, b), ``scores`` (n, m, k)."""

    effect: str
    joint: str
    parameters: Array
    scores: Array


def residual_statistics(
    prepared: Prepared, blocks: Sequence[ExperimentEquations], estimate: Estimate
) -> tuple[tuple[JointResidualStatistics, ...], tuple[EffectDirection, ...]]:
    """Statistics of the residuals of every joint; the noise models of the estimate weigh them, else fitted ones."""
    noise: Sequence[ArModel] = estimate.noise
    if not any(ar.order for ar in noise):
        noise = noise_models(blocks, estimate.theta, estimate.covariance, MAX_AR_ORDER)
    dt = prepared.experiments[0].dt
    numbers = instants(blocks, dt)
    motion = [(s.q[at], s.qd[at]) for s, at in zip(prepared.signals, numbers, strict=True)]
    keep = [block.keep for block in blocks]
    errors = residuals(blocks, estimate.theta)
    x, e = whitened([block.x for block in blocks], noise, keep), whitened(errors, noise, keep)
    scale = np.maximum(np.linalg.norm(x, axis=0), 1e-300)
    values, vectors = np.linalg.eigh((x / scale).T @ (x / scale))
    regular = values > RANK * values[-1]
    basis = vectors[:, regular] / np.sqrt(values[regular])
    whole = (x / scale) @ basis
    effects = [(e, place) for e in catalogue().values() if e.compared for place in e.places(prepared.model.n)]
    columns = effect_columns(prepared, numbers, estimate.theta, effects)
    changes = whitened(columns, noise, keep)
    absorbed = whole.T @ changes
    found, scores, first = [], [], 0
    for j, joint in enumerate(prepared.model.robot.joints):
        q, qd = [q[:, j] for q, _ in motion], [qd[:, j] for _, qd in motion]
        limits = min(float(v.min()) for v in q), max(float(v.max()) for v in q)
        fastest = float(np.quantile(np.abs(np.concatenate(qd)), SPEED_QUANTILE))
        functions = [motion_functions(a, b, limits, fastest) for a, b in zip(q, qd, strict=True)]
        ar = noise[j]
        rows = np.concatenate([ar.whiten(f)[k[ar.order :, j]] for f, k in zip(functions, keep, strict=True)])
        own = slice(first, first + rows.shape[0])
        first += rows.shape[0]
        projection = whole[own].T @ rows
        score = rows.T @ e[own] - projection.T @ (whole.T @ e)
        scores.append(rows.T @ changes[own] - projection.T @ absorbed)
        series = [np.where(k[:, j], r[:, j], 0.0) for r, k in zip(errors, keep, strict=True)]
        rate = 1.0 / float(blocks[0].t[1] - blocks[0].t[0])
        power, degrees = band_powers(series, ar)
        edges = 0.5 * rate * np.array(BANDS)
        information = rows.T @ rows - projection.T @ projection
        found.append(JointResidualStatistics(joint.name, limits, fastest, score, information, edges, power, degrees))
    parameters, of_joints = (basis @ absorbed).T / scale, np.stack(scores).transpose(0, 2, 1)
    directions, at = [], 0
    for effect, place in effects:
        own = slice(at, at + len(effect.linear))
        at = own.stop
        joint_name = prepared.model.robot.joints[place.joint].name
        directions.append(EffectDirection(effect.key, joint_name, parameters[own], of_joints[:, own]))
    return tuple(found), tuple(directions)


def effect_columns(
    prepared: Prepared,
    numbers: Sequence[NDArray[np.int64]],
    theta: Array,
    effects: Sequence[tuple[Effect, Place]],
) -> list[Array]:
    """Columns (M, n, m) of effects in each experiment at some samples; ``theta`` (b,) predicts their torques."""
    columns = []
    for e, s, at in zip(prepared.experiments, prepared.signals, numbers, strict=True):
        motion = replace(prepared.model.motion(s.q[at], s.qd[at], s.qdd[at], e.dt, e.start), theta=theta)
        columns.append(np.concatenate([effect.torque(motion, place, {}) for effect, place in effects], axis=2))
    return columns


def motion_functions(q: Array, qd: Array, limits: tuple[float, float], fastest: float) -> Array:
    """Free functions (M, k) of the motion (M,) of a joint, SI, with knots in ``limits`` and up to ``fastest``."""
    place = hats(q, np.linspace(*limits, POSITION_KNOTS))
    direction = qd / np.hypot(qd, max(DIRECTION * fastest, 1e-300))
    return np.hstack([place, place * direction[:, None], hats(qd, np.linspace(-fastest, fastest, VELOCITY_KNOTS))])


def band_powers(series: Sequence[Array], noise: ArModel) -> tuple[Array, Array]:
    """Mean square of residuals in the frequency bands and its degrees of freedom, by Satterthwaite's approximation.

    Its spectrum is that of the noise model; ordinates of a periodogram are chi-square with two degrees each.
    """
    bands = len(BANDS) - 1
    power, sums, squares = np.zeros(bands), np.zeros(bands), np.zeros(bands)
    total = sum(s.size for s in series)
    for s in series:
        taper = np.hanning(s.size)
        ordinates = np.abs(np.fft.rfft(s * taper))[1:] ** 2
        frequencies = np.arange(1, ordinates.size + 1) / max(ordinates.size, 1)
        response = 1.0 + np.exp(-1j * np.pi * np.outer(frequencies, np.arange(1, noise.order + 1))) @ noise.coefficients
        spectrum = 1.0 / np.abs(response) ** 2
        band = np.searchsorted(BANDS, frequencies, side="left") - 1
        inside = band < bands
        band, ordinates, spectrum = band[inside], ordinates[inside], spectrum[inside]
        power += 2.0 * np.bincount(band, ordinates, bands) / float(taper @ taper) / total
        # A Hann taper correlates neighbours: the variance of a sum is that of independent ordinates times this factor.
        correlation = s.size * float(np.sum(taper**4)) / float(taper @ taper) ** 2
        sums += np.bincount(band, spectrum, bands)
        squares += correlation * np.bincount(band, spectrum**2, bands)
    degrees = 2.0 * sums**2 / np.maximum(squares, 1e-300)
    return power, np.maximum(degrees, 1e-3)
