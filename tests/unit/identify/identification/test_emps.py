"""EMPS, a measured axis with recorded reference and known controller: reproduction of the published fit."""

from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat

from armident.configs import load_robot
from armident.identify.effects.terms import arm_model
from armident.identify.identification.equations import published_equations
from armident.identify.identification.identification_result import IdentificationResult
from armident.identify.identification.options import ControllerName, Options
from armident.identify.identification.pipeline import identify_experiment
from armident.identify.signals.experiments import Experiment

FORCE_PER_VOLT = 35.15065
NAMES = ("m1", "fv1", "fc1", "off1")


@pytest.fixture(scope="module")
def emps(shared_data: Path) -> Experiment:
    file = shared_data / "emps" / "DATA_EMPS.mat"
    if not file.is_file():
        pytest.skip(f"no {file.name} in the measured data")
    data = loadmat(file)
    return Experiment(
        q=data["qm"].astype(float).reshape(-1, 1),
        tau=FORCE_PER_VOLT * data["vir"].astype(float).reshape(-1, 1),
        q_ref=data["qg"].astype(float).reshape(-1, 1),
        dt=1e-3,
    )


@pytest.fixture(scope="module")
def ls(emps: Experiment) -> IdentificationResult:
    return identify_experiment(emps, load_robot("emps"), Options(method="idim-ls"))


def test_idim_ls_prints_the_published_digits(ls: IdentificationResult) -> None:
    assert ls.names == NAMES
    assert [f"{value:.4f}" for value in ls.theta] == ["95.1089", "203.5034", "20.3935", "-3.1648"]
    assert f"{ls.relative_error_pct:.4f}" == "4.0834"
    assert ls.units == ("kg", "N s/m", "N", "N")


def test_condition_number_is_the_published_one(emps: Experiment) -> None:
    robot = load_robot("emps")
    assert robot.preprocessing is not None
    (block,) = published_equations(arm_model(robot), [emps], robot.preprocessing)
    assert f"{np.linalg.cond(block.x[:, 0]):.4f}" == "25.9883"


def test_irwsm_without_any_knowledge_of_bandwidths_agrees_with_the_published_fit(
    emps: Experiment, ls: IdentificationResult
) -> None:
    free = identify_experiment(emps, load_robot("emps"), Options(method="idim-ls", derivatives="irwsm"))
    # Residuals of the published model are serially correlated, so the fits differ by 2 rather than 1 of its std.
    np.testing.assert_allclose(free.theta, ls.theta, atol=2.5 * ls.std.max(), rtol=0.02)
    assert free.relative_error_pct < ls.relative_error_pct


@pytest.mark.parametrize("controller", ["crc", "known"])
def test_simulation_with_the_controller_follows_the_measurement(emps: Experiment, controller: ControllerName) -> None:
    options = Options(method="idim-iv", controller=controller)
    found = identify_experiment(emps, load_robot("emps"), options)
    # The published closed-loop simulation misses the measured velocity by 0.229 %.
    assert found.controller["kind"] == controller
    assert found.controller["velocity_error_pct"] < 0.229


@pytest.mark.slow
def test_instruments_from_identified_and_from_known_controller_give_the_same_parameters(emps: Experiment) -> None:
    robot = load_robot("emps")
    crc = identify_experiment(emps, robot, Options(method="idim-iv"))
    known = identify_experiment(emps, robot, Options(method="idim-iv", controller="known"))
    assert (np.abs(crc.theta - known.theta) < 0.1 * known.std).all()


def test_crc_finds_the_recorded_gains(emps: Experiment) -> None:
    found = identify_experiment(emps, load_robot("emps"), Options(method="idim-iv"))
    (response,) = found.controller["joints"]
    assert response["fit_pct"] > 99.9


@pytest.mark.slow
def test_prefilter_that_contradicts_the_instruments_is_not_believed(emps: Experiment, ls: IdentificationResult) -> None:
    found = identify_experiment(emps, load_robot("emps"))
    assert found.method == "idim-piv"
    assert found.converged
    (reason,) = found.verdict.of_kind("residual")
    assert found.verdict.level == "doubtful"
    assert "a noise model would move fc1 by" in reason.message
    assert "errors of the model" in reason.message
    np.testing.assert_allclose(found.theta, ls.theta, rtol=0.02)
    assert (found.std > 1.2 * ls.std).all()
    assert found.whiteness[0].fraction_outside_2sigma <= 0.1


@pytest.mark.slow
def test_two_runs_agree_to_the_last_bit(emps: Experiment) -> None:
    first, second = (identify_experiment(emps, load_robot("emps"), Options(method="idim-iv")) for _ in range(2))
    np.testing.assert_array_equal(first.theta, second.theta)
    np.testing.assert_array_equal(first.covariance, second.covariance)
