"""Recordings to learn from and to judge by that are of two states of an arm."""

import pytest

from armident.configs import load_robot
from armident.identify.diagnosis.diagnose import DiagnosisResult, run_diagnosis
from armident.identify.identification.from_recording import experiments_from_recording
from tests.fixtures.arms import FAST, recording
from tests.fixtures.diagnoses import SPRING

pytestmark = pytest.mark.slow


def diagnosed(*, sprung_first: bool) -> DiagnosisResult:
    """One recording of the EMPS with a spring and one without; the first one is learnt from."""
    robot = load_robot("emps")
    with_spring, without = (
        experiments_from_recording(recording("emps", "emps_1", seed, *hidden, period=FAST), robot)[0]
        for seed, hidden in ((1, (SPRING,)), (2, ()))
    )
    parts = (with_spring, without) if sprung_first else (without, with_spring)
    return run_diagnosis(*parts, robot)


def test_an_effect_of_the_first_recording_alone_is_named_there_and_said_to_be_absent_in_the_other() -> None:
    document = diagnosed(sprung_first=True).document
    assert [(f.effect, f.joint) for f in document.findings] == [("joint_spring", "joint_1")]
    (line,) = [line for line in document.warnings if "absent" in line]
    assert "joint_1" in line
    assert "the arm changed between them" in line


def test_an_effect_of_the_second_recording_alone_is_no_healthy_verdict() -> None:
    document = diagnosed(sprung_first=False).document
    assert document.verdict == "unexplained"
    (rest,) = document.unexplained
    assert rest.varies_with == "recording"
