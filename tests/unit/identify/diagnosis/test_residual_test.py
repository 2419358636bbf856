"""Residuals against those of the baseline: no false alarm, and a change that parameters do not show."""

import numpy as np
import pytest
import yaml

from armident.configs import config_path
from armident.configs.schema.scenario import Scenario
from armident.identify.diagnosis.change_test import compare
from armident.identify.diagnosis.residual_test import compare_residuals
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.identification.residual_statistics import band_powers, motion_functions
from armident.identify.regression.ar_noise import ArModel
from tests.fixtures.arms import document


def with_scenario(name: str) -> IdentificationDocument:
    effects = Scenario.model_validate(yaml.safe_load(config_path(f"scenarios/{name}.yaml").read_text())).effects
    return document(name.partition("_")[0], 50, *effects)


def test_functions_of_position_and_velocity_add_to_one() -> None:
    t = np.linspace(0.0, 7.0, 500)
    functions = motion_functions(np.sin(t), np.cos(t), (-1.0, 1.0), 1.0)
    np.testing.assert_allclose(functions[:, :9].sum(axis=1), 1.0)
    np.testing.assert_allclose(functions[:, 18:].sum(axis=1), 1.0)


def test_power_in_bands_has_the_degrees_of_freedom_of_its_scatter() -> None:
    """400 series of coloured noise: twice the squared mean over the variance, within four standard errors."""
    rng = np.random.default_rng(1)
    noise = ArModel(np.array([-0.8]), 1.0, 0.0)
    powers, degrees = [], np.empty(0)
    for _ in range(400):
        e = rng.standard_normal(900)
        x = np.empty(900)
        x[0] = e[0] / 0.6
        for k in range(1, 900):
            x[k] = 0.8 * x[k - 1] + e[k]
        power, degrees = band_powers([x], noise)
        powers.append(power)
    scatter = 2.0 * np.mean(powers, axis=0) ** 2 / np.var(powers, axis=0)
    np.testing.assert_allclose(scatter / degrees, 1.0, atol=4 * np.sqrt(2 / 400) + 0.1)


@pytest.mark.slow
@pytest.mark.timeout(200)
@pytest.mark.parametrize(("runs", "most"), [(3, 2), pytest.param(39, 10, marks=pytest.mark.nightly)])
def test_healthy_arms_have_no_small_p_values(runs: int, most: int) -> None:
    """The smallest corrected p-value of each run is below 0.1 as often as chance permits."""
    first = document("emps", 1)
    smallest = [
        min(t.p_value for t in compare_residuals(first, document("emps", seed)).tests) for seed in range(2, runs + 2)
    ]
    # Binomial(3, 0.1): more than 2 have a probability of 0.001; of 39, more than 10 one of 0.0012.
    assert sum(p < 0.1 for p in smallest) <= most
    assert min(smallest) > 1e-4


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "joint"),
    [
        ("tx40_worn_joint2", "joint_2"),
        pytest.param("tx40_cable_and_cogging", "joint_1", marks=pytest.mark.nightly),
    ],
)
def test_a_change_of_structure_is_found_in_the_residuals(name: str, joint: str) -> None:
    drift = compare(document("tx40", 1), with_scenario(name))
    assert drift.drifted
    assert joint in {each.joint for each in drift.changed_residuals}
    assert drift.entry["alpha"] == pytest.approx(
        {
            "all": 1e-4,
            "parameters_together": 1e-4 / 3,
            "parameters_and_groups": 1e-4 / 3,
            "changes_of_the_catalogue": 0.0,
            "residuals": 1e-4 / 3,
        }
    )


@pytest.mark.slow
def test_a_baseline_without_statistics_is_named_with_the_remedy() -> None:
    old = document("tx40", 1).model_copy(update={"residual_statistics": None})
    drift = compare(old, document("tx40", 2))
    assert not drift.drifted
    assert "renew it" in drift.words
    assert drift.share == pytest.approx(0.5e-4)
    assert drift.entry["structure_compared"] is False
