"""Bias by derivatives and encoder noise: subtracted from IDIM-IV and IDIM-PIV, reported by IDIM-LS."""

from functools import cache
from typing import Any

import numpy as np
import pytest

from armident.identify.estimators.methods import Method
from armident.identify.identification.identification_criteria import IdentificationCriteria
from armident.identify.identification.identification_result import IdentificationResult
from armident.identify.identification.options import Options
from armident.identify.identification.pipeline import identify_experiment
from armident.identify.identification.simulated_bias import SIMULATION_ERROR, SimulatedBias, corrected
from armident.identify.regression.ar_noise import ArModel
from armident.identify.regression.equations import Estimate, ExperimentEquations
from armident.identify.signals.differentiate import differentiate
from tests.fixtures.arms import identified
from tests.statistics import axis
from tests.statistics.noise import METHODS, ROBOTS, SETTINGS, Setting, row

ENCODER = 20e-6
"""Encoder noise, m, at 1 kHz."""
RUNS = 4


@cache
def noisy(seed: int, method: Method) -> IdentificationResult:
    return identify_experiment(axis.recorded(seed, torque=1.0, position=ENCODER), axis.robot(), Options(method=method))


@pytest.mark.slow
@pytest.mark.parametrize("method", ["idim-iv", pytest.param("idim-piv", marks=pytest.mark.nightly)])
def test_intervals_hold_the_true_values_with_a_noisy_encoder(method: Method) -> None:
    found = [noisy(seed, method) for seed in range(RUNS)]
    errors = np.array([(f.theta - axis.TRUTH) / f.std for f in found])
    # 16 intervals of 2 sigma: fewer than 13 by chance once in 200.
    assert np.sum(np.abs(errors) <= 2.0) >= 13
    assert all(f.bias is not None for f in found)
    before = np.array([(f.theta + f.bias - axis.TRUTH) / f.std for f in found if f.bias is not None])
    # Without the correction the mass is too large in every run.
    assert (before[:, 0] > 2.0).all()


def test_least_squares_says_that_a_noisy_encoder_makes_its_intervals_doubtful() -> None:
    found = noisy(0, "idim-ls")
    assert any("m1 by about" in warning and "doubtful" in warning for warning in found.interval_warnings)
    assert found.verdict.level != "trustworthy"
    assert any("m1 by about" in reason.message for reason in found.verdict.of_kind("uncertainty"))
    assert abs(found.theta[0] - axis.MASS) > 2 * found.std[0]


@pytest.mark.parametrize("method", ["idim-ls", "didim"])
def test_methods_without_noise_model_say_that_coloured_noise_makes_their_intervals_doubtful(method: Method) -> None:
    experiment = axis.recorded(0, torque=2.0, pole=0.99)
    found = identify_experiment(experiment, axis.robot(), Options(method=method, controller="parametric"))
    assert any("serially correlated" in warning for warning in found.interval_warnings)


@pytest.mark.slow
def test_instrumental_variables_allow_for_coloured_noise() -> None:
    white, coloured = (
        identify_experiment(axis.recorded(0, torque=2.0, pole=pole), axis.robot(), Options(method="idim-iv"))
        for pole in (0.0, 0.99)
    )
    assert (coloured.std > 3 * white.std).all()


@pytest.mark.slow
@pytest.mark.parametrize("position", [0.0, pytest.param(1e-6, marks=pytest.mark.nightly), ENCODER])
def test_no_decimation_does_not_step_back_on_data_of_exactly_the_model(position: float) -> None:
    experiment = axis.recorded(1, torque=0.5, position=position)
    found = identify_experiment(experiment, axis.robot(), Options(decimation=1))
    assert not any("idim-iv" in reason.message for reason in found.verdict.reasons)
    np.testing.assert_allclose(found.theta[:3], axis.TRUTH[:3], rtol=0.02)


@pytest.mark.slow
def test_estimate_without_relevant_bias_stays_as_it_is() -> None:
    outcome = identified("tx40", "tx40_excitation", 1, "idim-iv", checked=False)
    assert outcome.result.bias is None
    assert outcome.document.bias is None
    assert outcome.result.interval_warnings == ()


def test_document_holds_the_bias_that_was_subtracted() -> None:
    found = noisy(0, "idim-iv")
    assert found.bias is not None
    assert np.max(np.abs(found.bias) / found.std) > IdentificationCriteria.max_bias_std


@pytest.mark.slow
def test_instruments_pass_the_bandpass_of_the_measured_positions(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []

    def noted(*arguments: Any, **options: Any) -> object:
        seen.append(arguments[2])
        return differentiate(*arguments, **options)

    monkeypatch.setattr("armident.identify.identification.auxiliary_loop.differentiate", noted)
    experiment = axis.recorded(0, torque=1.0)
    found = identify_experiment(experiment, axis.robot(), Options(derivatives="bandpass", bandwidth_hz=20.0))
    assert found.converged
    assert set(seen) == {"bandpass"}
    seen.clear()
    identify_experiment(experiment, axis.robot(), Options())
    assert not seen


@pytest.mark.nightly
@pytest.mark.parametrize("setting", SETTINGS, ids=lambda s: s.name)
@pytest.mark.parametrize("name", list(ROBOTS))
def test_intervals_hold_or_are_called_doubtful_under_every_noise(name: str, setting: Setting) -> None:
    robot, record = ROBOTS[name]
    for method in METHODS:
        found = row(name, robot(), record, setting, method, 20)
        # 80 correlated intervals of the axis, 560 of the TX40.
        assert found.covered >= 0.90 or found.doubtful > 0.9, found


def test_scatter_of_a_part_of_the_stretches_is_scaled_to_all() -> None:
    rng = np.random.default_rng(3)
    y, x = rng.standard_normal((100, 1)), rng.standard_normal((100, 1, 2))
    block = ExperimentEquations(y, x, np.ones((100, 1), dtype=np.bool_), np.arange(100.0))
    noise = (ArModel(np.empty(0), 1.0, 0.0),)
    estimate = Estimate(np.array([1.0, 2.0]), np.diag([1e-4, 1e-4]), noise, ((y[:, 0],),))
    bias, scatter = np.array([0.01, 0.0]), np.array([0.04, 0.001])
    whole = corrected(estimate, SimulatedBias(bias, scatter, 12), [block])
    part = corrected(estimate, SimulatedBias(bias, scatter, 12, share=0.25), [block])
    np.testing.assert_allclose(part.theta, [0.99, 2.0])
    # The estimates of a quarter scatter twice as much as those of all; the mean of the simulations keeps its error.
    of_bias = scatter**2 / 12 + (SIMULATION_ERROR * bias) ** 2
    np.testing.assert_allclose(np.diag(whole.covariance), np.array([0.04**2, 1e-4]) + of_bias)
    np.testing.assert_allclose(np.diag(part.covariance), np.array([0.02**2, 1e-4]) + of_bias)
