"""Parameter changes against a baseline: named effects, and no finding without a change."""

from collections.abc import Callable

import numpy as np
import pytest

from armident.configs import DataError, RobotConfig, load_robot
from armident.configs.schema.scenario import HiddenEffect
from armident.daq.recording import Recording
from armident.identify.diagnosis.baseline_comparison import conservative_fit, with_baseline
from armident.identify.diagnosis.candidates import ColumnCache
from armident.identify.diagnosis.changed_parameters import NumbersFinding, stale_numbers
from armident.identify.diagnosis.regression import IvFit, fit_model
from armident.identify.diagnosis.study import build_study
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.identification.from_recording import experiments_from_recording
from tests.fixtures.arms import FAST, recording, tx40_baseline

pytestmark = pytest.mark.slow

REPEATS = 2
Recorded = Callable[..., Recording]


@pytest.fixture(scope="module")
def robot() -> RobotConfig:
    return load_robot("tx40")


@pytest.fixture(scope="module")
def recorded() -> Recorded:
    def record(seed: int, *effects: HiddenEffect) -> Recording:
        return recording("tx40", "tx40_excitation", seed, *effects, repeats=REPEATS, period=FAST)

    return record


@pytest.fixture(scope="module")
def baseline() -> IdentificationDocument:
    return tx40_baseline()


def studied(robot: RobotConfig, data: Recording) -> tuple[IvFit, ColumnCache]:
    study = build_study(experiments_from_recording(data, robot)[0], [], robot)
    found = fit_model(study)
    return found, ColumnCache(study, found.theta)


@pytest.fixture(scope="module")
def clean(robot: RobotConfig, recorded: Recorded) -> tuple[IvFit, ColumnCache]:
    return studied(robot, recorded(1))


def only(findings: list[NumbersFinding]) -> NumbersFinding:
    (finding,) = findings
    return finding


def test_numbers_of_the_same_plant_still_hold(
    clean: tuple[IvFit, ColumnCache], baseline: IdentificationDocument
) -> None:
    assert stale_numbers(*clean, baseline) == []


def test_a_mounted_payload_is_one_payload_of_the_right_mass(
    robot: RobotConfig, recorded: Recorded, baseline: IdentificationDocument
) -> None:
    mass = HiddenEffect(effect="payload", joint="joint_6", parameters={"mass": 1.0, "z": 0.1})
    finding = only(stale_numbers(*studied(robot, recorded(2, mass)), baseline))
    assert (finding.effect, finding.joint) == ("payload", "joint_6")
    assert finding.std["mp"] < 0.05
    assert finding.parameters["mp"] == pytest.approx(1.0, abs=4 * finding.std["mp"])
    assert finding.parameters["mzp"] == pytest.approx(0.1, abs=4 * finding.std["mzp"])
    assert finding.p_value < 1e-10
    assert finding.gap_after < 0.7 * finding.gap_before
    assert "kg" in finding.words


def test_cold_grease_is_friction_of_that_joint(
    robot: RobotConfig, recorded: Recorded, baseline: IdentificationDocument
) -> None:
    cold = HiddenEffect(effect="friction_scale", joint="joint_3", parameters={"factor": 1.3})
    finding = only(stale_numbers(*studied(robot, recorded(3, cold)), baseline))
    assert (finding.effect, finding.joint) == ("friction_change", "joint_3")
    numbers = {p.name: p.value for p in baseline.parameters}
    for name, change in (("fv3", "fvx"), ("fc3", "fcx")):
        assert finding.parameters[change] == pytest.approx(0.3 * numbers[name], abs=4 * finding.std[change])
    assert finding.gap_after < finding.gap_before


def test_a_constant_torque_is_an_offset(
    robot: RobotConfig, recorded: Recorded, baseline: IdentificationDocument
) -> None:
    dragging = HiddenEffect(effect="torque_offset", joint="joint_5", parameters={"torque": 1.0})
    finding = only(stale_numbers(*studied(robot, recorded(4, dragging)), baseline))
    assert (finding.effect, finding.joint) == ("torque_offset", "joint_5")
    assert finding.parameters["offx"] == pytest.approx(1.0, abs=4 * finding.std["offx"])


def test_what_no_effect_explains_is_told_by_its_names(
    clean: tuple[IvFit, ColumnCache], baseline: IdentificationDocument
) -> None:
    std = {p.name: p.std for p in baseline.parameters}
    # An inertia of a link in the middle, far outside its errors: no payload, friction or gain does that.
    moved = [
        p.model_copy(update={"value": p.value + 25 * std["xx3r"]}) if p.name == "xx3r" else p
        for p in baseline.parameters
    ]
    findings = stale_numbers(*clean, baseline.model_copy(update={"parameters": moved}))
    rest = findings[-1]
    assert rest.effect == "changed_parameters"
    assert "xx3r" in rest.parameters
    assert rest.joint == "joint_3"
    assert rest.gap_after < rest.gap_before


def test_differences_between_recordings_are_as_large_as_their_covariances_say(
    clean: tuple[IvFit, ColumnCache], baseline: IdentificationDocument
) -> None:
    comparison = with_baseline(conservative_fit(clean[0]), baseline)
    z = comparison.whitened(comparison.difference)
    # 61 squares of standard normal numbers: their mean is within 0.5 of 1 but once in 200 times.
    assert 0.5 < float(np.mean(z**2)) < 1.5


def test_a_baseline_of_another_model_is_refused(
    clean: tuple[IvFit, ColumnCache], baseline: IdentificationDocument
) -> None:
    fewer = baseline.model_copy(update={"parameters": baseline.parameters[1:]})
    with pytest.raises(DataError, match="zz1r"):
        stale_numbers(*clean, fewer)
    torn = baseline.model_copy(update={"covariance": baseline.covariance[1:]})
    with pytest.raises(DataError, match="covariance has shape"):
        stale_numbers(*clean, torn)
