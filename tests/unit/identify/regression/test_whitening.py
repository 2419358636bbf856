"""Noise models and whitening of all joints at once, against plain formulas."""

import numpy as np
import pytest
from numpy.typing import NDArray

from armident.identify.regression.ar_noise import LEAST_VARIANCE, ArModel, ar_models, fit_ar
from armident.identify.regression.whitening import joints_of, nonzero_columns, rows_of_joints, whitened, whitened_series

Array = NDArray[np.float64]


@pytest.fixture
def errors() -> list[Array]:
    """Two stretches of two joints: a resonance, and white noise."""
    rng = np.random.default_rng(3)
    made = []
    for samples in (700, 400):
        e = rng.standard_normal((samples, 2))
        for k in range(2, samples):
            e[k, 0] += 1.6 * e[k - 1, 0] - 0.9 * e[k - 2, 0]
        made.append(e)
    return made


def test_each_joint_has_a_model_of_its_own(errors: list[Array]) -> None:
    found = ar_models(errors, 30)
    for j, ar in enumerate(found):
        expected = fit_ar([e[:, j] for e in errors], 30)
        np.testing.assert_array_equal(ar.coefficients, expected.coefficients)
        assert ar.variance == expected.variance
    assert found[0].order >= 2


def test_parameters_widen_the_variances_of_all_joints_alike(errors: list[Array]) -> None:
    plain, corrected = ar_models(errors, 30), ar_models(errors, 30, parameters=22)
    for one, other in zip(plain, corrected, strict=True):
        np.testing.assert_array_equal(one.coefficients, other.coefficients)
        assert other.variance == pytest.approx(one.variance / (1 - 22 / 2200), rel=1e-12)


def test_white_noise_leaves_out_the_equations_that_are_not_kept(errors: list[Array]) -> None:
    keep = [np.ones(e.shape, dtype=np.bool_) for e in errors]
    keep[0][100:300, 1] = False
    found = ar_models(errors, 0, keep=keep, parameters=20)
    own = np.concatenate([np.delete(errors[0][:, 1], slice(100, 300)), errors[1][:, 1]])
    assert found[1].variance == pytest.approx(float(np.mean(own**2)) / (1 - 20 / 2000), rel=1e-12)
    with pytest.raises(ValueError, match="without gaps"):
        ar_models(errors, 1, keep=keep)


def test_no_residual_is_white_noise_of_next_to_no_size() -> None:
    for ar in (
        *ar_models([np.zeros((100, 1))], 5),
        *ar_models([np.ones((9, 1))], 0, keep=[np.zeros((9, 1), np.bool_)]),
    ):
        assert ar.order == 0
        assert ar.variance == LEAST_VARIANCE


def test_whitening_leaves_out_nothing_but_what_is_zero(errors: list[Array]) -> None:
    noise = ar_models(errors, 30)
    columns = [np.stack([e, e[::-1]], axis=2) for e in errors]
    for c in columns:
        c[:, 1] = 0.0
    expected = np.concatenate([ar.whiten(c[:, j]) for j, ar in enumerate(noise) for c in columns])
    np.testing.assert_array_equal(whitened(columns, noise), expected)


def test_series_are_the_rows_of_each_joint(errors: list[Array]) -> None:
    noise = [ArModel(np.array([-1.6, 0.9]), 0.5, 0.0), ArModel(np.empty(0), 2.0, 0.0)]
    stacked, rows = whitened(errors, noise), rows_of_joints(sum(e.shape[0] - ar.order for e in errors) for ar in noise)
    for own, series in zip(rows, whitened_series(errors, noise), strict=True):
        np.testing.assert_array_equal(stacked[own], np.concatenate(series))


def test_equations_left_out_are_no_rows_but_serve_the_filter(errors: list[Array]) -> None:
    noise = [ArModel(np.array([-1.6, 0.9]), 0.5, 0.0), ArModel(np.empty(0), 2.0, 0.0)]
    keep = [np.ones(e.shape, dtype=np.bool_) for e in errors]
    keep[1][50:60, 0], keep[0][:3, 1] = False, False
    expected = np.concatenate(
        [ar.whiten(e[:, j])[k[ar.order :, j]] for j, ar in enumerate(noise) for e, k in zip(errors, keep, strict=True)]
    )
    np.testing.assert_array_equal(whitened(errors, noise, keep), expected)


def test_series_no_longer_than_the_filter_have_no_rows() -> None:
    ar = ArModel(np.array([-1.6, 0.9]), 0.5, 0.0)
    assert ar.whiten(np.ones(2)).shape == (0,)
    assert ar.whiten(np.ones((1, 3))).shape == (0, 3)


def test_columns_are_those_with_a_number_that_is_not_zero() -> None:
    values = np.zeros((50, 4))
    values[49, 1], values[0, 3] = 1e-300, np.nan
    np.testing.assert_array_equal(nonzero_columns(values), [1, 3])


def test_joints_are_those_with_a_number_that_is_not_zero() -> None:
    columns = np.zeros((50, 4, 2))
    columns[49, 1, 1], columns[0, 3, 0] = 1e-300, np.nan
    assert joints_of(columns) == [1, 3]
    assert joints_of(columns.transpose(0, 1, 2)[:, ::-1]) == [0, 2]
