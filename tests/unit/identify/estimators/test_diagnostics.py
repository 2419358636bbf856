"""Size and power of the diagnostic tests; seeds are fixed, 400 draws determine sizes to 1.5 %, 150 to 2 %."""

import json
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import signal, stats

from armident.identify.estimators.diagnostics import diagnose_estimate, nested_f_test
from armident.identify.estimators.idim_ls import idim_ls
from armident.identify.estimators.instrument_tests import WEAK_F, durbin_wu_hausman, instrument_relevance
from armident.identify.estimators.residual_tests import breusch_pagan, ljung_box, residual_tests
from armident.identify.regression.ar_noise import WHITE, ArModel
from armident.identify.regression.equations import (
    Estimate,
    ExperimentEquations,
    whitened_residuals,
)
from armident.identify.regression.iv import factored
from armident.identify.regression.least_squares import inverse_gram, least_squares
from armident.identify.regression.whitening import whitened

Array = NDArray[np.float64]

NAMES = ("zz1", "fv1", "fc1")
JOINTS = ("joint_1", "joint_2")
THETA = np.array([1.0, -2.0, 0.5])
AR1 = ArModel(np.array([-0.8]), 1.0, 0.0)


def coloured(rng: np.random.Generator, samples: int, ar: ArModel, columns: int = 2) -> Array:
    white = rng.standard_normal((samples + 100, columns)) * np.sqrt(ar.variance)
    out: Array = signal.lfilter([1.0], np.append(1.0, ar.coefficients), white, axis=0)[100:]
    return out


def drawn(
    rng: np.random.Generator, ar: ArModel, *, errors_in_variables: bool, samples: int = 300
) -> tuple[ExperimentEquations, Array]:
    """Two joints, three parameters: a smooth motion, a noisy regressor, instruments with independent noise."""
    slow, fast = signal.butter(2, 0.1), 0.5
    motion = 3 * signal.lfilter(*slow, rng.standard_normal((samples, 2, 3)), axis=0)
    x = motion + fast * rng.standard_normal(motion.shape)
    z = motion + 0.1 * rng.standard_normal(motion.shape)
    cause = motion if errors_in_variables else x
    y = cause @ THETA + coloured(rng, samples, ar)
    return ExperimentEquations(y, x, np.ones((samples, 2), np.bool_), np.arange(float(samples))), z


@pytest.fixture(params=[150, pytest.param(400, marks=pytest.mark.nightly)])
def draws(request: pytest.FixtureRequest) -> int:
    """Recordings to draw."""
    count: int = request.param
    return count


def size(draws: int) -> tuple[float, float]:
    """Range of rejections for a test of size 5 %, with probability 0.999: 1 to 18 of 150, 8 to 36 of 400."""
    lowest, highest = stats.binom.interval(0.999, draws, 0.05)
    return float(lowest), float(highest)


def rejections(p_values: list[float]) -> int:
    return int(np.sum(np.array(p_values) < 0.05))


@pytest.mark.slow
@pytest.mark.parametrize("prefiltered", [True, False], ids=["weighted by the noise model", "white weights"])
def test_hausman_rejects_five_percent_of_exogenous_regressors_under_serial_correlation(
    prefiltered: bool, draws: int
) -> None:
    rng = np.random.default_rng(0)
    weights = [AR1 if prefiltered else WHITE] * 2
    p_values = []
    for _ in range(draws):
        block, z = drawn(rng, AR1, errors_in_variables=False)
        found = durbin_wu_hausman(NAMES, [block], [z], weights, [AR1] * 2)
        p_values.append(found.p_value)
        assert found.degrees == 3
    assert size(draws)[0] <= rejections(p_values) <= size(draws)[1]


@pytest.mark.slow
def test_hausman_that_ignored_the_serial_correlation_would_reject_far_too_often(draws: int) -> None:
    rng = np.random.default_rng(1)
    p_values = []
    for _ in range(draws):
        block, z = drawn(rng, AR1, errors_in_variables=False)
        variance = ArModel(np.empty(0), 1.0 / (1 - 0.8**2), 0.0)
        # Slow errors in the regressor: white ones average the serial correlation out.
        slow = signal.lfilter([1.0], [1.0, -0.9], rng.standard_normal(z.shape), axis=0)
        block = replace(block, y=block.y + 0.3 * slow @ THETA, x=block.x + 0.3 * slow)
        p_values.append(durbin_wu_hausman(NAMES, [block], [z], [variance] * 2, [variance] * 2).p_value)
    assert rejections(p_values) > 2 * size(draws)[1]


def test_hausman_finds_errors_in_variables_and_names_whose_bias_is_largest() -> None:
    rng = np.random.default_rng(2)
    found = []
    for _ in range(50):
        block, z = drawn(rng, AR1, errors_in_variables=True)
        found.append(durbin_wu_hausman(NAMES, [block], [z], [AR1] * 2, [AR1] * 2))
    assert rejections([f.p_value for f in found]) >= 49
    # All columns are equally noisy: the attenuation is largest where the parameter is.
    assert sum(f.parameter == "fv1" for f in found) >= 45
    assert all("least squares is biased" in f.verdict for f in found if f.rejected)


def test_hausman_says_nothing_where_the_instruments_are_the_regressors() -> None:
    block, _ = drawn(np.random.default_rng(3), WHITE, errors_in_variables=True)
    found = durbin_wu_hausman(NAMES, [block], [block.x], [WHITE] * 2, [WHITE] * 2)
    assert (found.degrees, found.p_value, found.rejected) == (0, 1.0, False)


@pytest.mark.slow
def test_hausman_leaves_out_directions_in_which_the_two_estimators_are_one(draws: int) -> None:
    rng = np.random.default_rng(4)
    p_values = []
    for _ in range(draws):
        block, z = drawn(rng, WHITE, errors_in_variables=False)
        one_joint = ExperimentEquations(block.y, block.x * np.array([[[1.0], [0.0]]]), block.keep, block.t)
        z[:, :, 0] = one_joint.x[:, :, 0]
        # A regressor that is its own instrument is exogenous by assumption: two directions are left.
        found = durbin_wu_hausman(NAMES, [one_joint], [z * np.array([[[1.0], [0.0]]])], [WHITE] * 2, [WHITE] * 2)
        assert found.degrees == 2
        p_values.append(found.p_value)
    assert size(draws)[0] <= rejections(p_values) <= size(draws)[1]


def test_shea_r2_is_the_share_of_the_variance_that_least_squares_would_have() -> None:
    block, z = drawn(np.random.default_rng(5), WHITE, errors_in_variables=False)
    keep = [block.keep]
    x, zeta = (whitened([v], [AR1] * 2, keep) for v in (block.x, z))
    found = instrument_relevance(NAMES, [block], [z], [AR1] * 2)
    share = np.diag(inverse_gram(x)) / np.diag(factored(zeta, x, x[:, 0]).covariance)
    np.testing.assert_allclose([r.partial_r2 for r in found], share, rtol=1e-9)
    assert not any(r.weak for r in found)


def test_first_stage_f_of_white_errors_is_the_textbook_one() -> None:
    rng = np.random.default_rng(6)
    z = rng.standard_normal((4000, 1, 1))
    x = 0.3 * z + rng.standard_normal(z.shape)
    block = ExperimentEquations(x[:, :, 0], x, np.ones((4000, 1), np.bool_), np.arange(4000.0))
    (found,) = instrument_relevance(["zz1"], [block], [z], [WHITE])
    r2 = np.corrcoef(z[:, 0, 0], x[:, 0, 0])[0, 1] ** 2
    # The robust variance is accurate to about 2 sqrt(lags / M) = 20 %.
    assert found.first_stage_f == pytest.approx(r2 / (1 - r2) * 3998, rel=0.4)
    assert found.partial_r2 == pytest.approx(r2, rel=0.02)


def test_an_instrument_that_has_nothing_to_do_with_its_regressor_is_called_weak() -> None:
    rng = np.random.default_rng(7)
    weak = 0
    for _ in range(100):
        block, z = drawn(rng, WHITE, errors_in_variables=False)
        z[:, :, 1] = rng.standard_normal(z.shape[:2])
        weak += instrument_relevance(NAMES, [block], [z], [WHITE] * 2)[1].weak
    assert weak >= 99


def test_serially_correlated_first_stages_do_not_look_stronger_than_they_are() -> None:
    rng = np.random.default_rng(8)
    slow = ArModel(np.array([-0.95]), 1.0, 0.0)
    ones = np.ones((400, 1), np.bool_)
    strong = 0
    for _ in range(300):
        x, z = coloured(rng, 400, slow, 1)[:, :, None], coloured(rng, 400, slow, 1)[:, :, None]
        (found,) = instrument_relevance(
            ["zz1"], [ExperimentEquations(x[:, :, 0], x, ones, np.arange(400.0))], [z], [WHITE]
        )
        strong += found.first_stage_f > WEAK_F
    # Without the correction more than a third of such instruments, unrelated to the regressor, pass.
    assert strong < 0.05 * 300


def test_ljung_box_has_its_size_after_an_autoregressive_fit(draws: int) -> None:
    rng = np.random.default_rng(9)
    p_values = []
    for _ in range(draws):
        e = coloured(rng, 500, AR1)
        series = []
        for k in range(2):
            c = least_squares(e[:-1, k : k + 1], e[1:, k])
            series.append(e[1:, k] - c[0] * e[:-1, k])
        # Two experiments with a fit each would cost two degrees; one is pooled.
        p_values.append(ljung_box(series[:1], 21, 1)[2])
    assert size(draws)[0] <= rejections(p_values) <= size(draws)[1]


def test_ljung_box_finds_what_the_noise_model_left() -> None:
    rng = np.random.default_rng(10)
    left = ArModel(np.array([-0.3]), 1.0, 0.0)
    assert rejections([ljung_box([coloured(rng, 500, left, 1)[:, 0]])[2] for _ in range(100)]) >= 95


def test_ljung_box_gives_back_what_the_parameters_absorbed(draws: int) -> None:
    rng = np.random.default_rng(11)
    t = np.arange(400)
    x = np.stack([f(np.pi * k * t / 400) for k in range(1, 16) for f in (np.sin, np.cos)], axis=1)
    gram = x @ np.linalg.inv(x.T @ x) @ x.T
    absorbed = np.array([np.trace(gram, offset=k) for k in range(21)])
    plain, corrected = [], []
    for _ in range(draws):
        e = rng.standard_normal(400)
        e -= gram @ e
        plain.append(ljung_box([e])[2])
        corrected.append(ljung_box([e], absorbed=absorbed)[2])
    assert rejections(plain) > size(draws)[1]
    assert rejections(corrected) <= size(draws)[1]


def test_breusch_pagan_has_its_size_without_normality(draws: int) -> None:
    rng = np.random.default_rng(12)
    p_values = []
    for _ in range(draws):
        magnitudes = np.abs(rng.standard_normal((400, 2))) * np.array([1.0, 50.0])
        p_values.append(breusch_pagan(rng.laplace(size=400), magnitudes)[2])
    assert size(draws)[0] <= rejections(p_values) <= size(draws)[1]


def test_magnitudes_come_from_the_simulation_because_errors_in_the_regressor_look_like_heteroskedasticity(
    draws: int,
) -> None:
    rng = np.random.default_rng(19)
    measured: list[float] = []
    simulated: list[float] = []
    for _ in range(draws // 2):
        block, z = drawn(rng, WHITE, errors_in_variables=True)
        estimate = Estimate(THETA, np.zeros((3, 3)), (WHITE, WHITE), ())
        for p_values, instruments in ((measured, None), (simulated, [z])):
            tests = residual_tests(NAMES, JOINTS, [block], estimate, [WHITE] * 2, instruments)
            p_values += [test.breusch_pagan_p for test in tests]
    assert rejections(measured) > 2 * size(draws)[1]
    assert rejections(simulated) <= size(draws)[1]


def test_breusch_pagan_finds_noise_that_grows_with_speed() -> None:
    rng = np.random.default_rng(13)
    p_values = []
    for _ in range(100):
        speed = np.abs(rng.standard_normal((400, 1)))
        p_values.append(breusch_pagan(rng.standard_normal(400) * (1 + 0.5 * speed[:, 0]), speed)[2])
    assert rejections(p_values) >= 95


def test_nested_f_is_the_ratio_of_the_sums_of_squares() -> None:
    rng = np.random.default_rng(14)
    x = rng.standard_normal((60, 5))
    y = x[:, :2] @ np.array([1.0, -1.0]) + rng.standard_normal(60)
    kept = np.array([True, True, False, False, False])
    theta = least_squares(x, y)
    full = float(np.sum((y - x @ theta) ** 2))
    small = float(np.sum((y - x[:, kept] @ least_squares(x[:, kept], y)) ** 2))
    found = nested_f_test(theta, inverse_gram(x) * full / 55, kept, 60)
    assert found.f == pytest.approx((small - full) / 3 / (full / 55), rel=1e-9)
    assert found.degrees == (3, 55)


@pytest.mark.slow
def test_nested_f_has_its_size_and_its_power(draws: int) -> None:
    rng = np.random.default_rng(15)
    kept = np.array([True, False, False])
    for theta, lowest, highest in (
        (np.array([1.0, 0.0, 0.0]), *size(draws)),
        (np.array([1.0, 0.0, 0.5]), 0.975 * draws, draws),
    ):
        p_values = []
        for _ in range(draws):
            x = rng.standard_normal((100, 3))
            y = x @ theta + rng.standard_normal(100)
            found = least_squares(x, y)
            variance = float(np.sum((y - x @ found) ** 2)) / 97
            p_values.append(nested_f_test(found, inverse_gram(x) * variance, kept, 100).p_value)
        assert lowest <= rejections(p_values) <= highest


def test_a_set_that_leaves_nothing_out_is_sufficient() -> None:
    found = nested_f_test(np.ones(2), np.eye(2), np.ones(2, np.bool_), 10)
    assert (found.left_out, found.p_value, found.sufficient) == (0, 1.0, True)


def test_all_of_it_for_least_squares_has_no_instruments_and_goes_into_json() -> None:
    block, _ = drawn(np.random.default_rng(16), WHITE, errors_in_variables=False)
    estimate = idim_ls([block], NAMES)
    found = diagnose_estimate(NAMES, JOINTS, [block], estimate, essential=np.array([True, True, False]))
    assert found.relevance is None
    assert found.endogeneity is None
    assert found.condition_instruments is None
    assert [j.against for j in found.joints] == [("speed", "torque"), ("torque",)]
    assert found.essential is not None
    # zz1 = 1 and fc1 = 0.5 are far from zero.
    assert not found.essential.sufficient
    document = json.loads(json.dumps(found.document(), allow_nan=False))
    assert document["joints"][1]["joint"] == "joint_2"


def test_all_of_it_for_instruments_with_rows_left_out_and_two_experiments() -> None:
    rng = np.random.default_rng(17)
    drawn_twice = [drawn(rng, AR1, errors_in_variables=True) for _ in range(2)]
    blocks = [replace(block, keep=rng.random(block.keep.shape) > 0.1) for block, _ in drawn_twice]
    instruments = [z for _, z in drawn_twice]
    keep = [b.keep for b in blocks]
    x, z, y = (whitened(v, [WHITE] * 2, keep) for v in ([b.x for b in blocks], instruments, [b.y for b in blocks]))
    solution = factored(z, x, y)
    theta = solution.theta
    noise = (WHITE, WHITE)
    estimate = Estimate(theta, 3 * solution.covariance, noise, whitened_residuals(blocks, theta, noise))
    found = diagnose_estimate(NAMES, JOINTS, blocks, estimate, instruments=instruments)
    assert found.endogeneity is not None
    assert found.endogeneity.rejected
    assert found.weak_instruments == ()
    assert found.condition_instruments is not None
    assert found.condition_instruments >= 1
    # The weights are white, the noise is not: a model is fitted for the tests.
    assert all(joint.order >= 1 for joint in found.joints)
    assert all(joint.homoskedastic for joint in found.joints)
    itself = diagnose_estimate(NAMES, JOINTS, blocks, estimate, instruments=[b.x for b in blocks])
    assert json.loads(json.dumps(itself.document(), allow_nan=False))["relevance"][0]["first_stage_f"] is None


def test_shapes_that_do_not_belong_together_are_refused() -> None:
    block, z = drawn(np.random.default_rng(18), WHITE, errors_in_variables=False)
    estimate = idim_ls([block], NAMES)
    with pytest.raises(ValueError, match="block 0: regressor of shape"):
        diagnose_estimate(NAMES[:2], JOINTS, [block], estimate)
    with pytest.raises(ValueError, match="block 0: instruments of shape"):
        diagnose_estimate(NAMES, JOINTS, [block], estimate, instruments=[z[1:]])
