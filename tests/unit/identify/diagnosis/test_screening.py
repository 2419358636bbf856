"""Screening of a whole grid of candidates gives the statistics of single candidates."""

from dataclasses import replace

import numpy as np
import pytest

from armident.configs import load_robot
from armident.configs.schema.scenario import HiddenEffect
from armident.identify.diagnosis.candidates import ColumnCache, candidates
from armident.identify.diagnosis.corrections import screened_correction
from armident.identify.diagnosis.model_state import fitted as model_of
from armident.identify.diagnosis.regression import IvFit
from armident.identify.diagnosis.screening import orthogonal_directions, score_statistics
from armident.identify.diagnosis.study import build_study
from armident.identify.identification.from_recording import experiments_from_recording
from armident.identify.regression.iv_regression import IvRegression
from tests.fixtures.arms import FAST, recording

pytestmark = pytest.mark.slow

DELAY = 0.006


@pytest.fixture(scope="module")
def fitted() -> IvFit:
    """TX40 whose third torque is recorded late, at 1 kHz."""
    robot = load_robot("tx40")
    hidden = HiddenEffect(effect="time_delay", joint="joint_3", parameters={"delay": DELAY})
    data = recording("tx40", "tx40_excitation", 2, hidden, period=FAST, setpoint_every=1)
    experiments, _ = experiments_from_recording(data, robot)
    return model_of(build_study(experiments, [], robot), robot, None).fit


@pytest.mark.parametrize(
    "name", ["stribeck_friction", "coupling_friction", "cogging_torque", "joint_elasticity", "time_delay"]
)
def test_every_shape_of_a_grid_gets_the_statistic_that_it_has_by_itself(fitted: IvFit, name: str) -> None:
    """By the projection of the residual on the instruments beside the model, made for one shape alone."""
    bench = ColumnCache(fitted.study, fitted.theta)
    candidate = next(c for c in candidates(bench) if c.effect.name == name)
    grid = candidate.grid[:6]
    columns = bench.grid(candidate.effect, candidate.place, grid, fitted.noise)
    found = score_statistics(fitted, columns, len(grid))
    for shapes, statistic in zip(grid, found, strict=True):
        basis = orthogonal_directions(
            fitted, bench.instruments(candidate.effect, candidate.place, shapes, fitted.noise)
        )
        assert basis is not None
        alone = float(np.sum((basis[0].T @ fitted.residual) ** 2))
        # Through Gram matrices: directions of a thousandth of the columns are kept, so six digits of the square are.
        assert statistic == pytest.approx(alone, rel=1e-5, abs=1e-6)


def test_a_shape_without_an_effect_has_no_statistic_and_spoils_no_other(fitted: IvFit) -> None:
    columns = np.random.default_rng(0).standard_normal((fitted.regression.rows[2].shape[0], 4))
    whole = score_statistics(fitted, [(2, columns)], 4)
    columns[:, 1], columns[5, 2] = 0.0, np.nan
    found = score_statistics(fitted, [(2, columns)], 4)
    np.testing.assert_array_equal(np.isnan(found), [False, True, True, False])
    np.testing.assert_allclose(found[[0, 3]], whole[[0, 3]], rtol=1e-9)
    assert np.isnan(score_statistics(fitted, [], 3)).all()


def test_products_are_made_anew_only_where_the_noise_is_another(fitted: IvFit) -> None:
    noise = list(fitted.noise)
    noise[4] = replace(noise[4], variance=2.0 * noise[4].variance)
    known = IvRegression.of(fitted.equations, noise, fitted.regression)
    fresh = IvRegression.of(fitted.equations, noise)
    assert [a is b for a, b in zip(known.rows, fitted.regression.rows, strict=True)] == [j != 4 for j in range(6)]
    for name in ("cross", "gram", "projected", "scale"):
        np.testing.assert_array_equal(getattr(known.solution, name), getattr(fresh.solution, name))


def test_statistics_of_a_parameter_with_the_wrong_sign_are_zero(fitted: IvFit) -> None:
    bench = ColumnCache(fitted.study, fitted.theta)
    candidate = next(c for c in candidates(bench) if c.effect.name == "stribeck_friction" and c.effect.law == "")
    columns = bench.grid(candidate.effect, candidate.place, candidate.grid, fitted.noise)
    whole = score_statistics(fitted, columns, len(candidate.grid))
    up, down = (score_statistics(fitted, columns, len(candidate.grid), sign) for sign in (1, -1))
    np.testing.assert_allclose(up + down, whole)
    assert (np.minimum(up, down) == 0.0).all()


def test_a_delay_is_promised_with_about_its_value() -> None:
    robot, delay = load_robot("emps"), 0.003
    hidden = HiddenEffect(effect="time_delay", joint="joint_1", parameters={"delay": delay})
    data = recording("emps", "emps_excitation", 1, hidden, period=FAST, setpoint_every=1)
    state = model_of(build_study(experiments_from_recording(data, robot)[0], [], robot), robot, None)
    fit = state.fit.renoised(state.weights)
    bench = ColumnCache(fit.study, state.fit.theta)
    late = next(c for c in candidates(bench) if c.effect.name == "time_delay")
    (statistic, start), (_, likely) = screened_correction(fit, late, bench)
    assert statistic > 100.0
    # The model absorbs a part of the delay; what remains is found from the corrected torques.
    assert all(0.3 * delay < value < 1.1 * delay for value in (start, likely))
