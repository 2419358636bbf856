"""What must hold for any signal: smoothing, decimation and whitening are linear and leave polynomials alone."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from armident.identify.regression.ar_noise import ArModel, fit_ar
from armident.identify.signals.decimate import design
from armident.identify.signals.irwsm import irwsm, negative_log_likelihood, optimal_nvr

seeds = st.integers(0, 2**32 - 1)
orders = st.sampled_from([2, 3])
ratios = st.floats(-6, 3).map(lambda exponent: 10.0**exponent)


def series(seed: int, samples: int) -> NDArray[np.float64]:
    return np.random.default_rng(seed).standard_normal(samples)


@given(seeds, orders, ratios, st.integers(10, 300))
def test_smoother_solves_its_normal_equations(seed: int, order: int, nvr: float, samples: int) -> None:
    y = series(seed, samples)
    x = irwsm(y, order, nvr).level
    d = np.diff(np.eye(samples), n=order, axis=0)
    # Rounding of x enters the check through D' D / nvr, whose norm is up to 64 / nvr.
    np.testing.assert_allclose(x + d.T @ (d @ x) / nvr, y, atol=1e-9 + 1e-12 * 64 / nvr)


@given(orders, ratios, st.integers(20, 400), st.floats(-1e3, 1e3), st.floats(-1, 1), st.floats(-0.01, 0.01))
def test_polynomials_below_the_order_pass_unchanged(
    order: int, nvr: float, samples: int, level: float, slope: float, curvature: float
) -> None:
    k = np.arange(samples)
    y = level + slope * k + (curvature * k**2 if order == 3 else 0.0)
    # Rounding of the values enters through differences and comes out through a factor of size 1 / nvr.
    np.testing.assert_allclose(irwsm(y, order, nvr).level, y, atol=1e-12 * np.abs(y).max() * max(1.0, 64 / nvr) + 1e-12)


@given(seeds, orders, st.floats(1e-6, 1e6))
def test_the_likeliest_ratio_does_not_depend_on_the_unit(seed: int, order: int, unit: float) -> None:
    y = np.cumsum(series(seed, 400))
    one, other = optimal_nvr(y, order), optimal_nvr(unit * y, order)
    assert abs(np.log10(one / other)) < 0.05
    shift = 2 * (y.size - order) * np.log(unit)
    at_one, at_other = (negative_log_likelihood(np.diff(x, n=order), order, 1.0) for x in (y, unit * y))
    assert abs(at_other - at_one - shift) < 1e-5


@given(seeds, st.integers(2000, 4000), st.integers(0, 40))
def test_decimated_instants_do_not_depend_on_how_much_follows(seed: int, samples: int, more: int) -> None:
    x = series(seed, samples + more)
    low_pass = design(1e-3, 20.0)
    short, long = low_pass(x[:samples]), low_pass(x)
    np.testing.assert_allclose(short, long[: short.size], rtol=0, atol=1e-13)
    assert low_pass.instants(samples).size == short.size
    assert low_pass.instants(samples)[-1] + low_pass.margin < samples


@given(seeds, st.integers(1, 12))
def test_fitted_ar_models_are_stable_and_never_worse_than_white(seed: int, order: int) -> None:
    x = np.cumsum(series(seed, 500)) * 0.1
    model = fit_ar([x], order)
    assert isinstance(model, ArModel)
    assert model.variance <= np.mean(x**2) * (1 + 1e-12)
    roots = np.roots(np.append(1.0, model.coefficients))
    assert (np.abs(roots) < 1 + 1e-9).all()
