"""Parameters of the virtual TX40, simulated by another library, identified from its recordings."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from armident.configs import RobotConfig, load_robot
from armident.identify.effects.terms import arm_model
from armident.identify.estimators.methods import Method
from armident.identify.identification.from_recording import experiments_from_recording
from armident.identify.identification.identification_result import IdentificationResult
from armident.identify.identification.options import Options
from armident.identify.identification.pipeline import identify_experiment
from armident.identify.signals.experiments import Experiment
from armident.virtual_robot.inertias import plant_parameters
from tests.fixtures import arms

pytestmark = pytest.mark.slow

ESSENTIAL = (
    *("zz1r", "fv1", "fc1", "xx2r", "xz2r", "zz2r", "mx2r", "fv2", "fc2", "xx3r", "zz3r", "my3r", "ia3", "fv3", "fc3"),
    *("mx4", "ia4", "fv4", "fc4", "my5r", "ia5", "fv5", "fc5", "ia6", "fv6", "fc6", "fvm6", "fcm6"),
)
"""Table B.4."""


@cache
def robot() -> RobotConfig:
    return load_robot("tx40")


@cache
def truth() -> NDArray[np.float64]:
    model = arm_model(robot())
    plant = plant_parameters(robot())
    base: NDArray[np.float64] = model.base.regroup @ np.array([plant[name] for name in model.names])
    return base


def recorded(period: float | None = None) -> list[Experiment]:
    """Seed 1 with the noise of the thesis."""
    data = arms.recording("tx40", "tx40_excitation", 1, period=period)
    return list(experiments_from_recording(data, robot())[0])


def identified(
    seed: int = 1, noise: float = 1.0, method: Method = "idim-piv", period: float | None = None
) -> IdentificationResult:
    return arms.identified("tx40", "tx40_excitation", seed, method, noise=noise, period=period, checked=False).result


def essential(result: IdentificationResult) -> list[int]:
    return [result.names.index(name) for name in ESSENTIAL]


@pytest.mark.parametrize(
    "method", ["idim-iv", *(pytest.param(m, marks=pytest.mark.nightly) for m in ("idim-ls", "idim-piv"))]
)
def test_without_noise_the_bias_is_far_below_what_noise_will_cost(method: Method) -> None:
    clean = identified(noise=0.0, method=method)
    noisy = identified()
    chosen = essential(clean)
    bias = np.abs(clean.theta - truth())[chosen]
    assert (bias < 0.15 * noisy.std[chosen]).all()
    assert clean.relative_error_pct < 0.1


def test_relative_error_is_near_the_five_percent_of_the_thesis() -> None:
    result = identified()
    assert 4.0 < result.relative_error_pct < 6.5


def test_controller_is_found_without_knowing_its_structure() -> None:
    clean = identified(noise=0.0, method="idim-iv")
    assert clean.controller["kind"] == "crc"
    assert all(joint["fit_pct"] > 99.9 for joint in clean.controller["joints"])
    noisy = identified()
    assert noisy.controller["kind"] == "crc"
    assert noisy.controller["velocity_error_pct"] < 10


def test_the_same_recording_gives_the_same_bits() -> None:
    first = identified(period=arms.FAST)
    second = identify_experiment(recorded(arms.FAST), robot(), Options())
    np.testing.assert_array_equal(first.theta, second.theta)
    np.testing.assert_array_equal(first.covariance, second.covariance)


def test_a_recording_without_reference_still_gives_the_parameters() -> None:
    blind = [replace(e, q_ref=None) for e in recorded()]
    result = identify_experiment(blind, robot(), Options(method="idim-iv"))
    chosen = essential(result)
    assert any("no reference trajectory" in warning for warning in result.warnings)
    assert (np.abs(result.theta - truth())[chosen] < 5 * identified().std[chosen]).all()


@pytest.mark.parametrize(
    "seeds",
    [2, pytest.param(20, marks=[pytest.mark.nightly, pytest.mark.timeout(1800)])],
    ids=lambda n: f"{n} seeds",
)
def test_essential_parameters_are_recovered_within_their_own_standard_deviations(seeds: int) -> None:
    deviations, outside = [], []
    for seed in range(1, seeds + 1):
        result = identified(seed)
        assert result.converged
        chosen = essential(result)
        deviations.append(((result.theta - truth()) / result.std)[chosen])
        outside.append([w.fraction_outside_2sigma for w in result.whiteness])
    z = np.abs(np.array(deviations))
    # Normal deviations are beyond 3 with probability 0.0027: a binomial number of them, and a Bonferroni bound for the
    # greatest, each with probability 0.999. 2 seeds: 2 of 56 at most, all below 4.3; 20 seeds: 6 of 560, below 4.8.
    assert np.sum(z >= 3) <= stats.binom.ppf(0.999, z.size, 2 * stats.norm.sf(3))
    assert z.max() < stats.norm.isf(0.001 / z.size / 2)
    # White residuals have 5 % of their lags outside; the mean over 20 seeds and 20 lags is accurate to 1 %.
    known = 0.01 * np.sqrt(20 / seeds)
    assert (np.mean(outside, axis=0) < 0.05 + 3 * known).all()
