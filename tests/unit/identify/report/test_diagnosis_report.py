"""Report of a diagnosis: one figure per finding, drawn from the curves of its numbers."""

import json
import re

import numpy as np
import pytest

from armident.identify.diagnosis.diagnose import DiagnosisResult
from armident.identify.documents.rounding import alike
from armident.identify.report.diagnosis_report import SHOWN, diagnosis_report, followed_variable, telling_stretch
from tests.fixtures import diagnoses
from tests.fixtures.diagnoses import WORN_AND_SPRUNG


@pytest.fixture(scope="module")
def diagnosis() -> DiagnosisResult:
    found = diagnoses.diagnosis("emps", "emps_1", 1, *WORN_AND_SPRUNG)
    assert {f.effect for f in found.document.findings} == {h.effect for h in WORN_AND_SPRUNG}
    return found


@pytest.fixture(scope="module")
def page(diagnosis: DiagnosisResult) -> str:
    return diagnosis_report(diagnosis, diagnosis.document)


@pytest.mark.slow
def test_the_curves_without_and_with_a_finding_are_those_of_its_errors(diagnosis: DiagnosisResult) -> None:
    def error(torque: np.ndarray) -> float:
        rest = diagnosis.measured - torque
        return float(100 * np.linalg.norm(rest) / np.linalg.norm(diagnosis.measured))

    for finding, lacking in zip(diagnosis.document.findings, diagnosis.lacking, strict=True):
        assert lacking is not None
        assert error(lacking) == pytest.approx(finding.gap_before, rel=1e-6)
        assert error(diagnosis.after) == pytest.approx(finding.evidence["gap_at_measured_motion"], rel=1e-6)
        assert finding.gap_after <= finding.evidence["gap_at_measured_motion"]


@pytest.mark.slow
def test_every_finding_has_a_picture_of_its_own_in_a_page_that_needs_no_other_file(
    diagnosis: DiagnosisResult, page: str
) -> None:
    sources = re.findall(r'(?:src|href)="([^"]*)"', page)
    assert all(source.startswith("data:image/svg+xml;base64,") for source in sources)
    pictures = re.findall(r'<img alt="residual of joint_1" src="([^"]*)"', page)
    assert len(set(pictures)) == len(WORN_AND_SPRUNG)
    for finding in diagnosis.document.findings:
        for name, value in finding.parameters.items():
            assert f'<td>{name}</td><td class="n">{alike(value, finding.evidence["std"].get(name))[0]}</td>' in page


@pytest.mark.slow
def test_a_loop_that_diverges_leaves_out_its_table_and_nothing_else(diagnosis: DiagnosisResult, page: str) -> None:
    assert diagnosis.document.simulated is not None
    assert "Simulated closed loop" in page
    partly = diagnosis_report(diagnosis, diagnosis.document.model_copy(update={"simulated": None}))
    assert "Simulated closed loop" not in partly
    assert "Dependence of the residual" in partly


@pytest.mark.slow
def test_a_finding_is_drawn_over_what_it_follows(diagnosis: DiagnosisResult) -> None:
    over = {}
    for finding, own in zip(diagnosis.document.findings, diagnosis.own, strict=True):
        assert own is not None
        name, unit, _ = followed_variable(diagnosis, 0, own[:, 0])
        over[finding.effect] = (name, unit)
    assert over == {
        "asymmetric_viscous_friction": ("joint speed", "m/s"),
        "joint_spring": ("joint position", "m"),
    }
    noise = np.random.default_rng(1).standard_normal(diagnosis.t.size)
    assert followed_variable(diagnosis, 0, noise)[:2] == ("torque of the effect", "N")


def test_a_long_recording_is_drawn_where_the_finding_changes_most() -> None:
    added = np.zeros(10 * SHOWN)
    added[3 * SHOWN + 10 : 3 * SHOWN + 50] = 1.0
    stretch = telling_stretch(added)
    assert stretch.stop - stretch.start == SHOWN
    assert stretch.start <= 3 * SHOWN + 10
    assert stretch.stop >= 3 * SHOWN + 50
    assert telling_stretch(added[:SHOWN]) == slice(0, SHOWN)


@pytest.mark.slow
def test_the_verdict_and_the_next_step_stand_before_the_findings(page: str) -> None:
    card = page.index('<div class="verdict doubtful"><b>explained</b>')
    assert card < page.index("<p>Next: identify with the findings") < page.index('class="finding"')
    assert "Half the difference of the viscous friction" in page


@pytest.mark.slow
def test_held_out_torques_are_drawn_of_both_models(page: str) -> None:
    found = re.search(r'<script type="application/json">(.*?)</script>', page)
    assert found is not None
    (plot,) = json.loads(found[1])
    curves = {series["name"]: np.array(series["y"], dtype=np.float64) for series in plot["series"]}
    np.testing.assert_allclose(
        curves["difference as configured"], curves["measured"] - curves["model as configured"], atol=0.02
    )
    assert np.linalg.norm(curves["difference"]) < 0.1 * np.linalg.norm(curves["difference as configured"])
