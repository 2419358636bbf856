"""Every method by name, from a recording of the virtual arm to the result document and report."""

import json
from functools import cache
from typing import Any

import numpy as np
import pytest

from armident.configs import ConfigError
from armident.identify.documents.files import to_json
from armident.identify.effects.terms import arm_model
from armident.identify.estimators.methods import METHODS, Method, estimator
from armident.identify.identification.identify_recording import IdentificationOutcome, identify_recording
from armident.identify.identification.options import Options, parse_decimation, parse_nvr
from armident.identify.report.identification_report import identification_report
from armident.virtual_robot.inertias import plant_parameters
from tests.fixtures import arms
from tests.fixtures.arms import recording

pytestmark = pytest.mark.slow


@cache
def identified(options: Options, robot: str = "tx40", period: float | None = None) -> IdentificationOutcome:
    if options == Options(options.method):
        return arms.identified(robot, f"{robot}_excitation", 1, options.method, period=period, checked=False)
    return identify_recording(recording(robot, f"{robot}_excitation", 1, period=period), options=options, check=None)


def at_1_khz(options: Options) -> IdentificationOutcome:
    """The TX40, a fifth of whose samples tell as much."""
    return identified(options, period=arms.FAST)


def options(method: Method) -> Options:
    """Options; output-error methods need an exact controller: its law instead of an impulse response."""
    return Options(method=method, controller="crc" if estimator(method).measured else "parametric")


def test_the_list_of_estimators_is_that_of_their_modules() -> None:
    assert [estimator(method).name for method in METHODS] == list(METHODS)
    assert sum(estimator(method).solve is None for method in METHODS) == 1


OTHERS = [m for m in METHODS if m not in {"clie", "cloe", "idim-ls"}]


@pytest.mark.parametrize(
    ("robot_name", "noise_pct", "least", "method"),
    [
        *(("emps", 6.3, 4, m) for m in OTHERS),
        # Least squares are biased by the noise of the EMPS.
        ("tx40", 5.5, 25, "idim-ls"),
        *(pytest.param("tx40", 5.5, 25, m, marks=pytest.mark.nightly) for m in OTHERS),
    ],
)
def test_every_method_meets_the_arm(robot_name: str, noise_pct: float, least: int, method: Method) -> None:
    outcome = identified(options(method), robot_name)
    robot = outcome.robot
    model = arm_model(robot)
    plant = plant_parameters(robot)
    truth = model.base.regroup @ np.array([plant[name] for name in model.names])
    result = outcome.result
    assert result.converged, result.stop_reason
    assert result.relative_error_pct < noise_pct
    chosen = result.essential & (np.abs(truth) > 0)
    assert chosen.sum() >= least
    assert (np.abs(result.theta - truth)[chosen] < 5 * result.std[chosen]).all()


# The noise alone is 6.1 % of the torque of the EMPS by every method, and 4.6 % of that of the TX40.
@pytest.mark.parametrize(
    ("robot", "noise_pct"), [("emps", 6.3), pytest.param("tx40", 5.5, marks=pytest.mark.nightly)], ids=["emps", "tx40"]
)
@pytest.mark.parametrize("method", ["clie", "cloe"])
def test_output_errors_meet_the_arm_too(method: Method, robot: str, noise_pct: float) -> None:
    outcome = identified(options(method), robot)
    assert outcome.result.converged, outcome.result.stop_reason
    assert outcome.result.relative_error_pct < noise_pct
    assert outcome.document.noise_model["of"] == ("joint position" if method == "cloe" else "joint torque")


@pytest.mark.parametrize("method", ["idim-ls", "idim-piv"])
def test_document_and_page_hold_what_the_tests_say(method: Method) -> None:
    outcome = at_1_khz(options(method))
    document = json.loads(to_json(outcome.document))
    assert len(document["diagnostics"]["joints"]) == 6
    assert (document["diagnostics"]["endogeneity"] is None) == (method == "idim-ls")
    assert (document["torque_delay_samples"] is None) == (method == "idim-ls")
    page = identification_report(outcome.recordings, outcome.robot, outcome.result, outcome.document)
    assert "Statistical tests" in page
    assert ("Durbin" in page) == (method != "idim-ls")


def test_the_torque_is_where_the_drive_holds_it() -> None:
    delays = at_1_khz(options("idim-piv")).document.torque_delay_samples
    assert delays is not None
    assert all(abs(samples - 0.5) < 4 * std for samples, std in delays.values())


def test_a_physical_arm_is_found_on_request() -> None:
    outcome = at_1_khz(Options(method="idim-iv", physical=True))
    physical = outcome.document.physical
    assert physical is not None
    assert len(physical["parameters"]) == 87
    assert physical["compatible"]
    page = identification_report(outcome.recordings, outcome.robot, outcome.result, outcome.document)
    assert "Nearest physically consistent parameters" in page


def test_the_grey_box_agrees_with_the_black_box() -> None:
    black = at_1_khz(options("idim-piv")).result
    grey = at_1_khz(Options(noise_model="grey-box")).result
    assert grey.noise_model["of"] == "motor position"
    assert (np.abs(grey.theta - black.theta)[black.essential] < 3 * black.std[black.essential]).all()


@pytest.mark.parametrize(
    ("period", "slowest"), [(arms.FAST, 10.0), pytest.param(None, 5000 / 250, marks=pytest.mark.nightly)]
)
def test_decimation_from_the_noise_gives_the_same_arm(period: float | None, slowest: float) -> None:
    """The thesis chose a factor of 125 by hand (section 6.2.3), at 5 kHz."""
    usual = identified(options("idim-iv"), period=period).result
    chosen = identified(Options(method="idim-iv", decimation="noise"), period=period).result
    rate = chosen.noise_model["rate_hz"]
    assert slowest <= rate <= 5000 / 40
    assert (np.abs(chosen.theta - usual.theta)[usual.essential] < 3 * chosen.std[usual.essential]).all()


def test_unweighted_least_squares_is_another_estimate_of_the_same() -> None:
    weighted, plain = (at_1_khz(Options(method="idim-ls", weighted=w)).result for w in (True, False))
    assert not np.array_equal(weighted.theta, plain.theta)
    assert abs(weighted.relative_error_pct - plain.relative_error_pct) < 0.5


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"method": "idim"}, f"method: 'idim' is not one of {', '.join(METHODS)}"),
        ({"controller": "pid"}, "controller: 'pid' is not one of crc, parametric, known"),
        ({"noise_model": "white"}, "noise_model: 'white' is not one of black-box, grey-box"),
        ({"nvr": parse_nvr("likelyhood")}, "nvr: 'likelyhood' is neither a number nor one of automatic"),
        ({"nvr": parse_nvr("-1e-5")}, "nvr: expected a ratio above 0, got -1e-05"),
        ({"bandwidth_hz": 0.0}, "bandwidth_hz: expected a frequency above 0, got 0.0"),
        ({"max_ar_order": -1}, "max_ar_order: expected 0 or more, got -1"),
        ({"decimation": 0}, "decimation: expected a number of samples or noise, got 0"),
        ({"decimation": parse_decimation("some")}, "decimation: expected a number of samples or noise, got some"),
    ],
)
def test_what_is_not_offered_is_refused_by_name(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as error:
        Options(**wrong)
    assert message in str(error.value)
