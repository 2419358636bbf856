"""Estimate and covariance from sums of whitened rows, against those from orthogonal triangularisation."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from armident.identify.regression.ar_noise import ArModel
from armident.identify.regression.equations import InstrumentedEquations, stacked
from armident.identify.regression.fir import filter_columns
from armident.identify.regression.iv import CHUNK_ROWS, factored, iv_products
from armident.identify.regression.whitening import whitened

Floats = NDArray[np.float64]

NOISE = [
    ArModel(np.array([-0.9]), 0.5, 0.0),
    ArModel(np.empty(0), 2.0, 0.0),
    ArModel(np.array([-0.4, 0.2, 0.1, -0.05]), 1.3, 0.0),
]
"""Noise models of three joints, one of them white."""


def problem(samples: int, columns: int, similarity: float = 0.0, left_out: bool = False) -> list[InstrumentedEquations]:
    """Two experiments of three joints; the last two regressors differ by a share of 10 to the ``-similarity``."""
    rng = np.random.default_rng(3)
    blocks = []
    for m in (samples, samples // 2):
        z = rng.standard_normal((m, 3, columns)) * np.logspace(-3, 3, columns)
        z[:, :, -1] = z[:, :, -2] * (1 + 10.0**-similarity * rng.standard_normal((m, 3)))
        x = z + 0.1 * np.abs(z).mean(axis=(0, 1)) * 10.0**-similarity * rng.standard_normal(z.shape)
        keep = np.ones((m, 3), dtype=np.bool_)
        if left_out:
            keep[::3, 0], keep[m // 2 :, 2] = False, False
        y = x @ (1 / np.logspace(-3, 3, columns)) + rng.standard_normal((m, 3))
        blocks.append(InstrumentedEquations(y, x, keep, np.arange(m, dtype=np.float64), z))
    return blocks


@pytest.mark.parametrize("samples", [60, CHUNK_ROWS + 5, 3 * CHUNK_ROWS + 1])
@pytest.mark.parametrize("left_out", [False, True])
def test_estimate_and_covariance_are_those_of_the_triangular_factors(samples: int, left_out: bool) -> None:
    blocks = problem(samples, 7, left_out=left_out)

    found = iv_products(blocks, NOISE)

    z = whitened([b.z for b in blocks], NOISE, [b.keep for b in blocks])
    exact = factored(z, *stacked(blocks, NOISE))
    np.testing.assert_allclose(found.theta, exact.theta, rtol=1e-10)
    np.testing.assert_allclose(found.covariance, exact.covariance, rtol=1e-8, atol=1e-12 * found.covariance.max())


def test_regressors_alike_to_six_digits_cost_the_sums_no_more_digits_than_the_triangular_factors() -> None:
    blocks = problem(20000, 7, similarity=6.0)
    truth = 1 / np.logspace(-3, 3, 7)
    silent = [replace(b, y=b.x @ truth) for b in blocks]

    found = iv_products(silent, NOISE).theta

    z = whitened([b.z for b in blocks], NOISE, [b.keep for b in blocks])
    by_factors = factored(z, *stacked(silent, NOISE)).theta
    scale = np.abs(truth)
    # Products of the unchanged instruments would square the condition number: 1e12, four digits left.
    assert np.max(np.abs(found - truth) / scale) < 10 * np.max(np.abs(by_factors - truth) / scale) + 1e-12
    assert np.max(np.abs(found - truth) / scale) < 1e-7


def test_the_same_data_give_the_same_bits() -> None:
    blocks = problem(5000, 9)

    first, second = (iv_products(blocks, NOISE) for _ in range(2))

    assert np.array_equal(first.theta, second.theta)
    assert np.array_equal(first.covariance, second.covariance)


def test_a_parameter_without_any_equation_has_no_solution() -> None:
    blocks = problem(200, 5)
    for block in blocks:
        block.z[:, :, 2], block.x[:, :, 2] = 0.0, 0.0

    products = iv_products(blocks, NOISE)

    with pytest.raises(np.linalg.LinAlgError):
        _ = products.theta


@given(
    taps=st.integers(1, 70),
    rows=st.integers(1, 300),
    columns=st.integers(1, 5),
    seed=st.integers(0, 2**16),
)
def test_strided_columns_are_filtered_like_one_by_one(taps: int, rows: int, columns: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    response, x = rng.standard_normal(taps), rng.standard_normal((rows + taps - 1, 3, columns))

    found = filter_columns(response, x[:, 1])

    expected = np.stack([np.convolve(x[:, 1, c], response, mode="valid") for c in range(columns)], axis=1)
    np.testing.assert_allclose(found, expected, atol=1e-12 * taps)


def test_fewer_rows_than_taps_are_refused() -> None:
    with pytest.raises(ValueError, match="4 rows are fewer than the 5 of the impulse response"):
        filter_columns(np.ones(5), np.ones((4, 2)))
