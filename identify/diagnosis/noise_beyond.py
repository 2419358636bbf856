"""Noise models of a residual beyond free functions, corrected for the noise that the functions take away."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from armident.identify.diagnosis.regression import MAX_AR_ORDER, Fit
from armident.identify.regression.ar_noise import ArModel, lagged_sums, lowest_aic

Array = NDArray[np.float64]

PASSES = 3
"""Iterations between the noise model and the noise that the functions take away."""

RANK = 1e-8
"""Power of a direction, relative to a unit column, below which functions do not span it."""


def noise_beyond(fit: Fit, functions: Sequence[Sequence[Array]]) -> list[ArModel]:
    """Autoregressive noise model of each joint, of the residual beyond functions and beyond the regressor of the model.

    Least squares on k functions removes not only an effect but also the noise in their directions, which are those of
    low frequency. The expected autocovariances of this part, by the noise model itself, are added.

    Parameters
    ----------
    fit
        Fit of the model.
    functions
        Functions of each joint in the band of the comparison, (M, k) of every stretch.
    """
    errors = fit.errors(fit.theta, held=False)
    out = []
    for j, own in enumerate(functions):
        model = [rows[1][:, j] for rows in fit.equations.train]
        columns = [np.concatenate([z, c], axis=1) for z, c in zip(model, own, strict=True)]
        out.append(noise_orthogonal_to([e[:, j] for e in errors], columns))
    return out


def noise_orthogonal_to(errors: Sequence[Array], columns: Sequence[Array]) -> ArModel:
    """Autoregressive model of the noise in a residual that also contains a combination of functions.

    Parameters
    ----------
    errors
        Residual of one joint, (M,) of every stretch, zero where the joint stands still.
    columns
        Functions, (M, k) of every stretch.
    """
    span = _orthonormal(columns)
    inside = sum(q.T @ e for q, e in zip(span, errors, strict=True))
    left = [e - q @ inside for q, e in zip(span, errors, strict=True)]
    rows = sum(int(np.count_nonzero(e)) for e in errors)
    highest = max(0, min(MAX_AR_ORDER, rows // 10, min(e.size for e in errors) - 1))
    sums = np.zeros(highest + 1)
    for e in left:
        sums += lagged_sums(e[:, None], highest)
    free = rows - span[0].shape[1]
    if sums[0] <= 0 or free <= 0:
        return ArModel(np.empty(0), np.finfo(np.float64).tiny, -np.inf)
    noise = lowest_aic(sums / free, rows)
    for _ in range(PASSES):
        better = lowest_aic((sums + _taken(noise, span, highest)) / rows, rows)
        if not np.isfinite(better.variance) or better.variance <= 0:
            break
        noise = better
    return noise


def _orthonormal(columns: Sequence[Array]) -> list[Array]:
    """Orthonormal functions with the same span, (M, r) of every stretch."""
    size = np.sqrt(sum(np.einsum("mk,mk->k", c, c) for c in columns))
    size = np.where(size > 0, size, np.inf)
    scaled = [c / size for c in columns]
    power, right = np.linalg.eigh(sum(c.T @ c for c in scaled))
    kept = power > RANK
    return [c @ (right[:, kept] / np.sqrt(power[kept])) for c in scaled]


def _taken(noise: ArModel, span: Sequence[Array], highest: int) -> Array:
    """Expected sums of lagged products, lags 0 to ``highest``, that least squares on a span takes out of noise.

    With the projector P on the span and the covariance matrix W of the noise these are the sums along the diagonals of
    ``P W + W P - P W P``.
    """
    size = fft.next_fast_len(2 * max(q.shape[0] for q in span), real=True)
    gain = np.fft.rfft(np.append(1.0, noise.coefficients), size)
    density = noise.variance / np.abs(gain[:, None]) ** 2
    spectra = [fft.rfft(q, size, axis=0) for q in span]
    coloured = [fft.irfft(a * density, size, axis=0)[: q.shape[0]] for a, q in zip(spectra, span, strict=True)]
    gram = sum(q.T @ w for q, w in zip(span, coloured, strict=True))
    total = np.zeros(size // 2 + 1)
    for a, q, w in zip(spectra, span, coloured, strict=True):
        other = fft.rfft(2.0 * w - q @ gram, size, axis=0)
        total += np.sum((other * a.conj()).real, axis=1)
    return np.asarray(fft.irfft(total, size)[: highest + 1])
