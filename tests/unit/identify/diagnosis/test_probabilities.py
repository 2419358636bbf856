"""Probabilities of findings and of joints without one, and their 90 % sets."""

from dataclasses import replace
from typing import Any

import pytest

from armident.identify.diagnosis.probabilities import (
    STATES,
    Calibration,
    calibration,
    features,
    joint_outcomes,
    judged,
    outcomes,
)
from armident.identify.documents.diagnosis import Alternative, Finding, Unexplained

SHARES = {"rival": 0.5, "unnamed": 0.3, "nothing": 0.2}
KNOWN = Calibration(
    intercept=-2.0,
    weights={"margin": 1.0, "confirmed": 0.0, "fall": 1.0, "explained": 1.0},
    shares=dict.fromkeys(STATES, SHARES),
    temper=1.0,
    level=0.9,
)
EVIDENCE: dict[str, Any] = {"margin": 5.0, "odds": {}, "p_value": 1e-6, "fall": 0.2, "share_explained": 1.0}


def finding(effect: str = "stribeck_friction", joint: str = "joint_1", **evidence: Any) -> Finding:
    return Finding(
        effect=effect, joint=joint, kind="structure", parameters={}, confidence=0.0, alternatives=[],
        gap_before=5.0, gap_after=4.0, evidence=EVIDENCE | evidence,
    )  # fmt: skip


def left(joint: str = "joint_1") -> Unexplained:
    return Unexplained(joint=joint, share_of_residual=0.3, varies_with="velocity", hint="")


@pytest.mark.parametrize(
    "more", [{"margin": 9.0}, {"p_value": 1e-9}, {"share_explained": 1.0}], ids=lambda more: next(iter(more))
)
def test_more_evidence_is_never_less_probable(more: dict[str, float]) -> None:
    weak = finding(margin=3.0, p_value=1e-4, share_explained=0.5)
    strong = weak.model_copy(update={"evidence": weak.evidence | more})
    known = calibration()
    assert known.probability(features(strong)) >= known.probability(features(weak))


def test_the_shipped_map_is_sure_of_strong_evidence_only() -> None:
    known = calibration()
    strong = finding(margin=100.0, p_value=1e-20, fall=2.8)
    weak = finding(margin=0.1, p_value=5e-3, share_explained=0.1)
    assert known.probability(features(strong)) > 0.9
    assert known.probability(features(weak)) < 0.5
    assert known.level >= 0.9


def test_outcomes_have_the_sum_one() -> None:
    named = finding(odds={"joint_spring": 0.4, "backlash": 0.1})
    for one in (named, finding("unnamed", odds={"joint_spring": 1.0}), finding("unnamed")):
        assert sum(outcomes(one, KNOWN).values()) == pytest.approx(1.0)
    assert all(sum(joint_outcomes(state, KNOWN).values()) == pytest.approx(1.0) for state in STATES)
    found = outcomes(named, KNOWN)
    # The rest is divided by the odds.
    assert found["joint_spring"] == pytest.approx(4.0 * found["backlash"])


def test_names_that_the_data_cannot_separate_are_in_the_set_together() -> None:
    known = replace(
        KNOWN, intercept=-3.0, shares={state: {"rival": 0.98, "unnamed": 0.01, "nothing": 0.01} for state in STATES}
    )
    (one,), (entry,) = judged([finding(odds={"joint_spring": 0.9})], [], ["joint_1"], known)
    assert entry.likely[:2] == ["stribeck_friction", "joint_spring"]
    assert one.confidence == entry.names["stribeck_friction"]
    assert one.evidence["ambiguous_with"] == ["joint_spring"]


def test_every_joint_has_an_entry_and_every_finding_its_own() -> None:
    findings = [finding(), finding("unnamed"), finding("backlash", "joint_3")]
    joints = ["joint_1", "joint_2", "joint_3"]
    found, entries = judged(findings, [left("joint_2")], joints, calibration())
    assert [entry.joint for entry in entries] == ["joint_1", "joint_1", "joint_2", "joint_3"]
    # A term without a name claims that something is missing, and no cause.
    assert found[1].confidence == pytest.approx(1.0 - entries[1].names["nothing"])


def test_a_joint_without_anything_is_healthy_and_one_with_a_dependence_is_not() -> None:
    _, (clear,) = judged([], [], ["joint_1"], calibration())
    assert clear.likely == ["nothing"]
    assert not clear.doubtful
    _, (rest,) = judged([], [left()], ["joint_1"], calibration())
    assert rest.likely[0] == "unnamed"
    assert rest.doubtful


def test_a_change_against_a_baseline_keeps_its_posterior_probability() -> None:
    change = Finding(
        effect="payload", joint="joint_1", kind="numbers", parameters={}, confidence=0.6, gap_before=5.0, gap_after=4.0,
        alternatives=[Alternative(effect="rotor_inertia", joint="joint_1", score=-1.0)], evidence={},
    )  # fmt: skip
    (kept,), (entry,) = judged([change], [], ["joint_1"], calibration())
    assert kept == change
    assert entry.names["payload"] == 0.6
    assert entry.names["rotor_inertia"] == pytest.approx(0.6 * 0.3679, rel=1e-3)
    assert sum(entry.names.values()) == pytest.approx(1.0)
