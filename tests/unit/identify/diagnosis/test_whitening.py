"""Fast noise models, whitening and products against plain formulas."""

import numpy as np
import pytest
from numpy.typing import NDArray

from armident.identify.diagnosis.whitening import ar_models, summed_backwards, whitened
from armident.identify.regression.ar_noise import ArModel, fit_ar

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


def test_the_models_are_those_of_the_estimators(errors: list[Array]) -> None:
    found = ar_models(errors, 30)
    for j, ar in enumerate(found):
        expected = fit_ar([e[:, j] for e in errors], 30)
        assert ar.order == expected.order
        np.testing.assert_allclose(ar.coefficients, expected.coefficients, rtol=1e-9, atol=1e-12)
        assert ar.variance == pytest.approx(expected.variance, rel=1e-12)
        assert ar.aic == pytest.approx(expected.aic, abs=1e-6)
    assert found[0].order >= 2


def test_no_residual_is_white_noise_of_no_size() -> None:
    (ar,) = ar_models([np.zeros((100, 1))], 5)
    assert ar.order == 0
    assert 0 < ar.variance < 1e-300


def test_whitening_leaves_out_nothing_but_what_is_zero(errors: list[Array]) -> None:
    noise = ar_models(errors, 30)
    columns = [np.stack([e, e[::-1]], axis=2) for e in errors]
    for c in columns:
        c[:, 1] = 0.0
    expected = np.concatenate([ar.whiten(c[:, j]) for j, ar in enumerate(noise) for c in columns])
    np.testing.assert_array_equal(whitened(columns, noise), expected)


def test_weights_are_the_transpose_of_whitening(errors: list[Array]) -> None:
    noise = [ArModel(np.array([-1.6, 0.9]), 0.5, 0.0), ArModel(np.empty(0), 2.0, 0.0)]
    values = [e[::-1].copy() for e in errors]
    direction = np.random.default_rng(4).standard_normal(whitened(values, noise).size)
    weights = summed_backwards(direction, noise, [v.shape[0] for v in values])
    through = sum(float(np.sum(w * v)) for w, v in zip(weights, values, strict=True))
    assert through == pytest.approx(float(direction @ whitened(values, noise)), rel=1e-12)
