"""Fit and figures of the calibration, from documents with known truth."""

from typing import Any

import numpy as np
import pytest

from armident.identify.diagnosis.probabilities import features
from armident.identify.documents.diagnosis import DiagnosisDocument, Finding
from tests.evaluation.calibrate import COVERAGE, Entry, calibrated, entries_of, figures

JOINTS = ("axis_1", "axis_2")
HIDDEN = {"family": "effect", "accepted": ["joint_spring"], "joints": ["axis_2"], "visibility": 2.0}


def finding(effect: str, joint: str, **evidence: Any) -> Finding:
    known = {"margin": 3.0, "odds": {}, "p_value": 1e-5, "fall": 0.7, "share_explained": 1.0}
    return Finding(
        effect=effect, joint=joint, kind="structure", parameters={}, confidence=0.0, alternatives=[],
        gap_before=10.0, gap_after=5.0, evidence=known | evidence,
    )  # fmt: skip


def document(*findings: Finding) -> DiagnosisDocument:
    gap = {"all": 1.0, "by_joint": dict.fromkeys(JOINTS, 1.0)}
    both = {"before": gap, "after": gap}
    return DiagnosisDocument.model_validate(
        {
            "robot": "arm", "recordings": [], "verdict": "explained", "findings": list(findings), "unexplained": [],
            "gap": {"train": both, "validation": both}, "noise_floor": gap, "recommended_experiment": None,
            "model": None, "timing_s": {}, "versions": {}, "warnings": [],
        }
    )  # fmt: skip


def truths(*findings: Finding, **hidden: Any) -> list[tuple[str, str]]:
    return [(entry.state, entry.truth) for entry in entries_of(0, document(*findings), HIDDEN | hidden)]


def test_a_name_is_right_at_its_joint_once() -> None:
    spring = finding("joint_spring", "axis_2")
    assert truths(spring) == [("named", "joint_spring"), ("clear", "nothing")]
    assert truths(spring, finding("backlash", "axis_2"))[1] == ("named", "nothing")
    assert truths(finding("joint_spring", "axis_1")) == [("named", "nothing"), ("clear", "unnamed")]
    assert truths(finding("joint_spring", "axis_1"), joints=[])[0] == ("named", "joint_spring")


def test_a_wrong_name_has_the_right_one_beside_it_or_none() -> None:
    assert truths(finding("backlash", "axis_2", odds={"joint_spring": 0.1}))[0] == ("named", "joint_spring")
    assert truths(finding("backlash", "axis_2"))[0] == ("named", "unnamed")
    assert truths(finding("backlash", "axis_2"), family="outside", accepted=[])[0] == ("named", "unnamed")
    assert truths(family="healthy", accepted=[], joints=[]) == [("clear", "nothing")] * 2


@pytest.mark.slow
def test_fitted_probabilities_and_sets_hold_for_other_cases() -> None:
    rng = np.random.default_rng(1)
    entries = []
    for case in range(400):
        margin = float(rng.uniform(0.0, 8.0))
        right = rng.random() < 1.0 / (1.0 + np.exp(-2.0 * (np.log1p(margin) - 1.0)))
        one = finding("joint_spring", "axis_1", margin=margin, odds={"backlash": 0.5})
        truth = "joint_spring" if right else str(rng.choice(["backlash", "nothing"]))
        entries.append(Entry(case, "named", one, truth, visible=True))
    known = calibrated(entries)
    assert known.probability(features(finding("joint_spring", "axis_1", margin=1.718))) == pytest.approx(0.5, abs=0.08)
    rows: list[tuple[str, ...]] = []
    found = figures(entries, rows)
    assert found.ece < 0.08
    assert found.coverage > COVERAGE - 0.03
    assert len(rows) == 10
