"""Statistics agree with independent implementations: scipy, statsmodels, and closed forms.

The tests import statsmodels themselves: it takes seconds, and most test processes run none of them.
"""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import linalg, signal, stats

from armident.identify.diagnosis.spectral_lines import SpectralLine
from armident.identify.estimators.instrument_tests import LAGS_PER_ROOT_SAMPLE, instrument_relevance
from armident.identify.estimators.residual_tests import breusch_pagan, ljung_box
from armident.identify.regression.ar_noise import WHITE, fit_ar, levinson_durbin
from armident.identify.regression.equations import ExperimentEquations
from armident.identify.regression.hac import newey_west
from armident.identify.regression.iv import factored
from armident.identify.regression.least_squares import least_squares
from armident.identify.regression.multiple_testing import holm
from armident.identify.signals.periodogram import hann_window, periodogram

Array = NDArray[np.float64]


def ar_process(samples: int, seed: int) -> Array:
    """AR(3) noise (M,) with a resonance."""
    white = np.random.default_rng(seed).standard_normal(samples + 500)
    return np.asarray(signal.lfilter([1.0], [1.0, -1.6, 0.95, -0.2], white))[500:]


def autocovariances(x: Array, lags: int) -> Array:
    """Biased autocovariances at lags 0..lags; the mean is not removed."""
    return np.array([x[k:] @ x[: x.size - k] for k in range(lags + 1)]) / x.size


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, 2, 7, 30, 60])
def test_levinson_durbin_solves_the_yule_walker_equations(order: int) -> None:
    from statsmodels.tsa.stattools import levinson_durbin as reference_levinson_durbin

    r = autocovariances(ar_process(3000, 1), order)
    coefficients, variances = levinson_durbin(r)
    assert coefficients.shape == (order + 1, order)
    np.testing.assert_allclose(coefficients[order], -linalg.solve_toeplitz(r[:-1], r[1:]), rtol=1e-9, atol=1e-11)
    variance, phi, _, _, _ = reference_levinson_durbin(r, order, isacov=True)
    np.testing.assert_allclose(coefficients[order], -phi, rtol=1e-9, atol=1e-11)
    assert variances[order] == pytest.approx(variance, rel=1e-12)


def test_levinson_durbin_stops_at_an_exact_model() -> None:
    """A sine of one frequency obeys a difference equation of order 2 without innovations."""
    coefficients, variances = levinson_durbin(np.cos(0.3 * np.arange(6)))
    assert variances.size == coefficients.shape[0] == 2


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:yule_walker currently returns:FutureWarning")
@pytest.mark.parametrize("seed", range(4))
def test_ar_model_is_the_yule_walker_estimate_of_lowest_aic(seed: int) -> None:
    import statsmodels.api as sm
    from statsmodels.tsa.stattools import levinson_durbin as reference_levinson_durbin

    x = ar_process(2000, seed)
    model = fit_ar([x], 30)
    rho, sigma = sm.regression.yule_walker(x, order=model.order, method="mle", demean=False)
    np.testing.assert_allclose(model.coefficients, -rho, rtol=1e-9, atol=1e-11)
    assert model.variance == pytest.approx(sigma**2, rel=1e-10)
    r = autocovariances(x, 30)
    variances = np.append(r[0], reference_levinson_durbin(r, 30, isacov=True)[3][1:])
    assert model.order == np.argmin(2 * np.arange(31) + x.size * np.log(variances))


def test_whitening_is_that_of_generalised_least_squares() -> None:
    """Filter and parameters are those of statsmodels' GLSAR."""
    import statsmodels.api as sm

    rng = np.random.default_rng(5)
    x = rng.standard_normal((800, 3))
    y = x @ np.array([1.0, -2.0, 0.5]) + ar_process(800, 6)
    model = fit_ar([y - x @ least_squares(x, y)], 10)
    assert model.order >= 2
    reference = sm.GLSAR(y, x, rho=-model.coefficients)
    scale = np.sqrt(model.variance)
    np.testing.assert_allclose(model.whiten(x), reference.wexog / scale, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(model.whiten(y), reference.wendog / scale, rtol=1e-9, atol=1e-11)
    theta = least_squares(model.whiten(x), model.whiten(y))
    np.testing.assert_allclose(theta, reference.fit().params, rtol=1e-9)


@pytest.mark.parametrize("lags", [0, 1, 20, 90])
def test_newey_west_is_the_bartlett_sandwich(lags: int) -> None:
    from statsmodels.stats.sandwich_covariance import S_hac_simple

    x = np.stack([ar_process(700, seed) for seed in range(3)], axis=1)
    expected = np.diag(S_hac_simple(x, nlags=lags))
    np.testing.assert_allclose(newey_west([x], lags), expected, rtol=1e-10)
    for column, value in zip(x.T, expected, strict=True):
        assert float(newey_west([column], lags)) == pytest.approx(value, rel=1e-10)


def test_newey_west_of_a_mean_is_its_hac_covariance() -> None:
    import statsmodels.api as sm

    x = 3.0 + ar_process(500, 8)
    fit = sm.OLS(x, np.ones(x.size)).fit(cov_type="HAC", cov_kwds={"maxlags": 20, "use_correction": False})
    variance = float(newey_west([x - x.mean()], 20)) / x.size**2
    assert variance == pytest.approx(fit.cov_params()[0, 0], rel=1e-10)


def test_newey_west_adds_experiments_and_skips_lags_beyond_them() -> None:
    a, b = ar_process(300, 1), ar_process(5, 2)
    together = newey_west([a, b], 20)
    weights = 1 - np.arange(5) / 21
    products = np.array([b[k:] @ b[: b.size - k] for k in range(5)])
    alone = weights @ products + weights[1:] @ products[1:]
    assert float(together) == pytest.approx(float(newey_west([a], 20)) + alone, rel=1e-12)


def test_first_stage_f_is_the_hac_wald_statistic_of_the_first_stage() -> None:
    import statsmodels.api as sm

    rng = np.random.default_rng(9)
    z = rng.standard_normal(900)
    x = 0.1 * z + ar_process(900, 10)
    block = ExperimentEquations(
        np.zeros((900, 1)), x[:, None, None], np.ones((900, 1), np.bool_), np.arange(900, dtype=np.float64)
    )
    (relevance,) = instrument_relevance(["p"], [block], [z[:, None, None]], [WHITE])
    lags = int(np.ceil(LAGS_PER_ROOT_SAMPLE * np.sqrt(900)))
    first = sm.OLS(x, z).fit(cov_type="HAC", cov_kwds={"maxlags": lags, "use_correction": False})
    assert relevance.first_stage_f == pytest.approx(float(first.tvalues[0]) ** 2, rel=1e-9)
    assert relevance.partial_r2 == pytest.approx(float(np.corrcoef(x, z)[0, 1]) ** 2, abs=0.01)


def test_instrumental_variables_are_two_stage_least_squares() -> None:
    from statsmodels.sandbox.regression.gmm import IV2SLS

    rng = np.random.default_rng(11)
    z = rng.standard_normal((400, 4))
    x = z @ rng.standard_normal((4, 4)) + 0.3 * rng.standard_normal((400, 4))
    y = x @ np.arange(1.0, 5.0) + rng.standard_normal(400)
    np.testing.assert_allclose(factored(z, x, y).theta, IV2SLS(y, x, z).fit().params, rtol=1e-9)


@pytest.mark.parametrize("seed", range(2))
def test_holm_is_that_of_statsmodels(seed: int) -> None:
    from statsmodels.stats.multitest import multipletests

    p = np.random.default_rng(seed).uniform(size=25) ** 3
    p[3] = p[7]
    for alpha in (0.01, 0.05):
        rejected, adjusted, _, _ = multipletests(p, alpha, method="holm")
        np.testing.assert_allclose(holm(p), adjusted, rtol=1e-12)
        np.testing.assert_array_equal(holm(p) <= alpha, rejected)


def test_holm_of_small_families() -> None:
    np.testing.assert_allclose(holm(np.array([0.01, 0.04, 0.03])), [0.03, 0.06, 0.06])
    np.testing.assert_allclose(holm(np.array([0.5, 0.9])), [1.0, 1.0])
    np.testing.assert_array_equal(holm(np.array([0.2])), [0.2])


@pytest.mark.parametrize(("train", "held"), [(0.3, 0.02), (1e-8, 0.9), (1.0, 1.0), (1e-200, 1e-30)])
def test_fishers_combination_of_two_p_values(train: float, held: float) -> None:
    """With four degrees of freedom the chi-square tail is ``x (1 - ln x)``, x the product of the p-values."""
    empty = np.empty(0)
    combined = SpectralLine(10.0, train, held, 0.1, 1.0, empty, empty, empty).p_value
    logarithm = np.log(train) + np.log(held)
    assert combined == pytest.approx(np.exp(logarithm) * (1 - logarithm), rel=1e-9)
    assert combined == pytest.approx(float(stats.chi2.sf(-2 * logarithm, 4)), rel=1e-9)


@pytest.mark.parametrize("fitted", [0, 3])
def test_ljung_box_is_that_of_statsmodels(fitted: int) -> None:
    from statsmodels.stats.diagnostic import acorr_ljungbox

    x = np.random.default_rng(12).standard_normal(600)
    x -= x.mean()
    expected = acorr_ljungbox(x, lags=[20], model_df=fitted)
    statistic, degrees, p = ljung_box([x], 20, fitted)
    assert statistic == pytest.approx(float(expected["lb_stat"].iloc[0]), rel=1e-9)
    assert degrees == 20 - fitted
    assert p == pytest.approx(float(expected["lb_pvalue"].iloc[0]), rel=1e-9)


def test_breusch_pagan_is_koenkers_form_of_statsmodels() -> None:
    import statsmodels.api as sm
    from statsmodels.stats.diagnostic import het_breuschpagan

    rng = np.random.default_rng(13)
    magnitudes = np.abs(rng.standard_normal((500, 2)))
    residuals = rng.standard_normal(500) * (0.5 + magnitudes[:, 0])
    expected, expected_p, _, _ = het_breuschpagan(residuals, sm.add_constant(magnitudes))
    statistic, degrees, p = breusch_pagan(residuals, magnitudes)
    assert statistic == pytest.approx(expected, rel=1e-9)
    assert degrees == 2
    assert p == pytest.approx(expected_p, rel=1e-8)


@pytest.mark.parametrize("samples", [256, 257])
def test_periodogram_is_that_of_scipy_up_to_the_nyquist_frequency(samples: int) -> None:
    x, dt = ar_process(samples, 14), 0.004
    window = np.hanning(samples)
    f, density = signal.periodogram(window * x, 1 / dt, detrend=False)
    density *= samples / (window @ window)
    own = 2 * dt * periodogram(hann_window(samples) * x)
    np.testing.assert_allclose(own[1 : (samples + 1) // 2], density[1 : (samples + 1) // 2], rtol=1e-9)
    if samples % 2 == 0:
        assert own[-1] == pytest.approx(2 * density[-1], rel=1e-9)
    padded = periodogram(hann_window(samples) * x, padding=2)
    np.testing.assert_allclose(2 * dt * padded[: 2 * f.size : 2], own, rtol=1e-9, atol=1e-12)


def test_white_noise_has_its_variance_at_every_frequency() -> None:
    rng = np.random.default_rng(15)
    level = np.mean([periodogram(hann_window(200) * rng.normal(0, 3.0, 200)) for _ in range(2000)], axis=0)
    np.testing.assert_allclose(level, 9.0, rtol=0.2)
