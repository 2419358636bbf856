"""Triangularisation: an orthogonal factorisation with reproducible bits."""

import numpy as np

from armident.identify.regression.qr import triangularize, triangularize_parts


def test_factor_and_projections_are_those_of_a_qr_decomposition() -> None:
    rng = np.random.default_rng(0)
    a, y = rng.standard_normal((300, 7)), rng.standard_normal(300)
    top = triangularize(a, y, columns=7)
    q, r = np.linalg.qr(a)
    signs = np.sign(np.diag(r)) * np.sign(np.diag(top))
    np.testing.assert_allclose(top[:, :7], signs[:, None] * r, atol=1e-12)
    np.testing.assert_allclose(top[:, 7], signs * (q.T @ y), atol=1e-12)
    np.testing.assert_array_equal(np.tril(top[:, :7], -1), 0.0)


def test_ill_conditioned_columns_keep_the_digits_that_normal_equations_lose() -> None:
    rng = np.random.default_rng(1)
    a = rng.standard_normal((1000, 4)) * 1e-7 + np.ones((1000, 1))
    theta = np.array([1.0, -2.0, 3.0, 0.5])
    top = triangularize(a, a @ theta, columns=4)
    # Condition 1e7: rounding is amplified to 1e-9; the Gram matrix would have condition 1e14.
    np.testing.assert_allclose(np.linalg.solve(top[:, :4], top[:, 4]), theta, atol=1e-6)


def test_arguments_are_left_alone_and_the_bits_are_always_the_same() -> None:
    a = np.random.default_rng(2).standard_normal((200, 5))
    before = a.copy()
    np.testing.assert_array_equal(triangularize(a, columns=5), triangularize(a, columns=5))
    np.testing.assert_array_equal(a, before)


def test_columns_of_zeros_and_fewer_rows_than_columns_give_zeros_and_no_nan() -> None:
    a = np.random.default_rng(3).standard_normal((50, 3))
    a[:, 1] = 0.0
    top = triangularize(a, columns=3)
    assert np.isfinite(top).all()
    assert top[1, 1] == 0.0
    assert triangularize(np.ones((1, 3)), columns=3)[1:].any() == np.False_


def test_rows_in_parts_give_the_factor_and_the_column_norms_of_all_rows() -> None:
    rng = np.random.default_rng(4)
    a, y = rng.standard_normal((700, 6)) * np.logspace(-4, 3, 6), rng.standard_normal(700)
    a[:, 2] = 0.0
    parts = ((a[first:last], y[first:last]) for first, last in ((0, 3), (3, 400), (400, 400), (400, 700)))
    top, norms = triangularize_parts(parts, columns=6)
    whole = triangularize(a, y, columns=6)
    expected = np.append(np.linalg.norm(a, axis=0), np.linalg.norm(y))
    np.testing.assert_allclose(top.T @ top, whole.T @ whole, atol=1e-12 * np.outer(expected, expected).max())
    np.testing.assert_allclose(norms, np.where(expected > 0.0, expected, 1.0), rtol=1e-13)
