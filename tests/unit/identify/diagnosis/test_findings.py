"""Confidence of findings beside an unexplained rest of their joint's error."""

import pytest

from armident.identify.diagnosis.findings import less_certain
from armident.identify.documents.diagnosis import Finding, Unexplained
from armident.identify.effects.unnamed import NAME as UNNAMED


def finding(effect: str = "stribeck_friction", joint: str = "joint_1") -> Finding:
    """A finding that reduces the error of its joint from 5 to 4 %: it takes 9 parts of power and leaves 16."""
    return Finding(
        effect=effect, joint=joint, kind="structure", parameters={}, confidence=0.9, alternatives=[],
        gap_before=5.0, gap_after=4.0, evidence={"gap_joint": joint},
    )  # fmt: skip


def left(share: float, joint: str = "joint_1") -> Unexplained:
    return Unexplained(joint=joint, share_of_residual=share, varies_with="velocity", hint="")


def test_noise_alone_does_not_lower_the_confidence() -> None:
    (kept,) = less_certain([finding()], [])
    assert kept.confidence == 0.9
    assert kept.evidence["share_explained"] == 1.0


def test_a_rest_that_is_no_noise_lowers_the_confidence_by_its_power() -> None:
    (less,) = less_certain([finding()], [left(0.25)])
    # 9 parts taken, a quarter of 16 left.
    assert less.evidence["share_explained"] == pytest.approx(9 / 13)
    assert less.confidence == pytest.approx(0.9 * 9 / 13)


def test_dependences_of_one_joint_overlap_and_those_of_others_do_not_count() -> None:
    (less,) = less_certain([finding()], [left(0.25), left(0.1), left(1.0, "joint_2")])
    assert less.evidence["share_explained"] == pytest.approx(9 / 13)


def test_a_term_without_a_name_claims_no_cause() -> None:
    (kept,) = less_certain([finding(UNNAMED)], [left(0.25)])
    assert kept.confidence == 0.9
