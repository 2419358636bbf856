"""Scores of diagnoses, and the tables of a suite."""

from dataclasses import replace
from typing import Any

import pytest
from scipy import stats

from armident.identify.documents.diagnosis import DetectionLimit, DiagnosisDocument, Finding
from tests.evaluation.cases import Case, InjectedEffect
from tests.evaluation.report import report, shortfalls
from tests.evaluation.score import Score, closed_share, matches, score, within
from tests.evaluation.store import CaseResult
from tests.evaluation.tables import clopper_pearson, tables

SPRING = InjectedEffect("joint_spring", "joint_2", None, ("joint_spring",), {}, {}, 1.0)
SHAFT = InjectedEffect("coupling_friction", "joint_4", "joint_5", ("coupling_friction",), {}, {}, 1.0)
GRIPPER = InjectedEffect("payload", "joint_6", None, ("payload", "rotor_inertia"), {}, {}, 1.0, arm=True)
JOINTS = [f"joint_{k}" for k in range(1, 7)]


def case(
    *parts: InjectedEffect, kind: Any = "effect", level: Any = "typical", seed: int = 1, baseline: bool = False
) -> Case:
    return Case(kind, level, "tx40", "tx40.yaml", "t.yaml", 1, 1e-3, seed, parts, baseline)


TORQUE = 5.0
"""RMS torque of each joint, N m."""


def finding(effect: str, joint: str, other: str | None = None, **more: Any) -> Finding:
    values = {
        "kind": "structure", "parameters": {}, "confidence": 0.99, "alternatives": [], "gap_before": 10.0,
        "gap_after": 8.0, "evidence": {},
    }  # fmt: skip
    return Finding(effect=effect, joint=joint, other=other, **{**values, **more})


def gap(value: float, torque: float = TORQUE) -> dict[str, Any]:
    """A gap of ``value`` percent in every joint."""
    return {
        "all": value, "by_joint": dict.fromkeys(JOINTS, value), "rms": dict.fromkeys(JOINTS, value * torque / 100),
    }  # fmt: skip


def result(
    *findings: Finding,
    before: float = 10.0,
    after: float = 8.0,
    verdict: str = "explained",
    truth: Any = (),
    torque: float = TORQUE,
    **more: Any,
) -> CaseResult:
    both = {"before": gap(before, torque), "after": gap(after, torque)}
    content = {
        "robot": "tx40", "recordings": [], "verdict": verdict, "findings": list(findings), "unexplained": [],
        "gap": {"train": both, "validation": both}, "noise_floor": gap(8.0), "recommended_experiment": None,
        "model": None, "timing_s": {}, "versions": {}, "warnings": [], **more,
    }  # fmt: skip
    return CaseResult(key="k", truth=list(truth), document=DiagnosisDocument.model_validate(content))


def closed(of: Case, mine: CaseResult, healthy: DiagnosisDocument) -> float | None:
    return closed_share(of, mine.diagnosis, healthy)


HEALTHY = result(before=8.0, after=8.0, verdict="no_gap").diagnosis


def test_a_finding_counts_with_the_right_name_at_the_right_place_only() -> None:
    assert matches(case(SPRING), SPRING, finding("joint_spring", "joint_2"))
    assert not matches(case(SPRING), SPRING, finding("joint_spring", "joint_1"))
    assert not matches(case(SPRING), SPRING, finding("cogging_torque", "joint_2"))


def test_a_pair_counts_in_either_order_and_an_arm_has_no_wrong_joint() -> None:
    assert matches(case(SHAFT), SHAFT, finding("coupling_friction", "joint_5", "joint_4"))
    assert not matches(case(SHAFT), SHAFT, finding("coupling_friction", "joint_5", "joint_6"))
    assert matches(case(GRIPPER), GRIPPER, finding("payload", "joint_1"))
    assert matches(case(GRIPPER), GRIPPER, finding("rotor_inertia", "joint_1"))


def test_only_the_first_finding_is_the_name_of_a_single_effect() -> None:
    spring = finding("joint_spring", "joint_2")
    late = score(case(SPRING), result(finding("cogging_torque", "joint_2"), spring), HEALTHY)
    assert (late.first, late.second, late.extra) == (False, True, 1)
    alternatives = [{"effect": "joint_spring", "joint": "joint_2", "score": 9.0}]
    second = score(case(SPRING), result(finding("cogging_torque", "joint_2", alternatives=alternatives)), HEALTHY)
    assert (second.first, second.second) == (False, True)
    right = score(case(SPRING), result(spring), HEALTHY)
    assert (right.first, right.second, right.extra, right.missed) == (True, True, 0, False)


def test_a_pair_of_effects_needs_both_names() -> None:
    both = case(SPRING, SHAFT, kind="pair")
    one = score(both, result(finding("joint_spring", "joint_2")), HEALTHY)
    assert (one.first, one.second) == (False, False)
    two = score(
        both, result(finding("coupling_friction", "joint_4", "joint_5"), finding("joint_spring", "joint_2")), HEALTHY
    )
    assert (two.first, two.extra) == (True, 0)


def test_nothing_found_is_missed_unless_the_motion_cannot_show_it() -> None:
    silent = result(before=8.1, after=8.1, verdict="no_gap")
    assert score(case(SPRING), silent, HEALTHY).missed
    assert not score(case(SPRING), silent, HEALTHY).invisible
    entry = {"effect": "joint_spring", "joint": "joint_2", "reason": "too little motion", "required_motion": "more"}
    stated = result(before=8.1, after=8.1, verdict="no_gap", not_visible=[entry])
    assert score(case(SPRING), stated, HEALTHY).invisible
    # A baseline would show the effect.
    assert not score(case(SPRING, baseline=True), stated, HEALTHY).invisible


def limit(ks: float, joint: str = "joint_2") -> DetectionLimit:
    return DetectionLimit(effect="joint_spring", joint=joint, limits={"ks": ks}, units={"ks": "N m/rad"})


def test_an_effect_below_its_detection_limit_is_no_miss() -> None:
    def invisible(*limits: DetectionLimit, truth: Any = ({"ks": 3.0},)) -> bool:
        silent = result(before=8.1, after=8.1, verdict="no_gap", truth=truth, detection_limits=list(limits))
        return score(case(SPRING), silent, HEALTHY).invisible

    assert invisible(limit(3.1))
    assert not invisible(limit(2.9))
    assert not invisible(limit(10.0, "joint_3"))
    assert not invisible(limit(10.0), truth=({},))


def test_a_detection_limit_excuses_no_wrong_finding_but_one_effect_of_a_pair() -> None:
    limits = [limit(10.0)]
    other = result(finding("cogging_torque", "joint_2"), truth=[{"ks": 3.0}], detection_limits=limits)
    assert not score(case(SPRING), other, HEALTHY).invisible
    half = result(finding("coupling_friction", "joint_4", "joint_5"), truth=[{"ks": 3.0}, {}], detection_limits=limits)
    assert score(case(SPRING, SHAFT, kind="pair"), half, HEALTHY).invisible


def test_the_gap_closed_is_measured_above_the_noise_of_the_healthy_twin() -> None:
    spring = finding("joint_spring", "joint_2")
    assert closed(case(SPRING), result(spring, before=10.0, after=8.0), HEALTHY) == pytest.approx(1.0)
    assert closed(case(SPRING), result(spring, before=10.0, after=82.0**0.5), HEALTHY) == pytest.approx(0.5)
    assert closed(case(SPRING), result(before=8.01, after=8.0), HEALTHY) is None


def test_the_gap_is_evaluated_where_it_is_clearest() -> None:
    def looped(loop_before: float, loop_after: float, **gaps: Any) -> CaseResult:
        torque = dict.fromkeys(JOINTS, 5.0)
        errors = {"torque_before": torque | {"joint_2": loop_before}, "torque_after": torque | {"joint_2": loop_after}}
        return result(finding("joint_spring", "joint_2"), simulated=errors, **gaps)

    healthy = looped(6.0, 6.0, before=8.0, after=8.0).diagnosis
    # A late torque: measured motion has the noise of a third derivative, the simulated loop shows the delay.
    late = looped(10.0, 6.0, before=8.1, after=9.0)
    assert closed(case(SPRING), late, healthy) == pytest.approx(1.0)
    # Conversely, the larger injected gap decides, not the better closed share.
    seen = looped(6.5, 6.0, before=16.0, after=16.0)
    assert closed(case(SPRING), seen, healthy) == pytest.approx(0.0)


def test_what_findings_change_counts_without_the_noise_of_measured_derivatives() -> None:
    """An elastic joint: the fourth derivative of measured motion increases the error of the correct model."""
    spring = finding("joint_spring", "joint_2")
    assert (closed(case(SPRING), result(spring, before=10.0, after=11.0), HEALTHY) or 0.0) < 0.0
    errors = dict.fromkeys(JOINTS, 8.0)
    simulated = {"torque_without_derivative_noise": errors}
    found = result(spring, before=10.0, after=11.0, simulated=simulated)
    assert closed(case(SPRING), found, HEALTHY) == pytest.approx(1.0)
    # The smaller error of measured motion counts.
    simulated = {"torque_without_derivative_noise": errors | {"joint_2": 9.5}}
    found = result(spring, before=10.0, after=82.0**0.5, simulated=simulated)
    assert closed(case(SPRING), found, HEALTHY) == pytest.approx(0.5)


def test_what_an_effect_brings_with_it_is_no_mistake() -> None:
    bristle = replace(SPRING, brings=("presliding_friction",))
    found = result(finding("joint_spring", "joint_2"), finding("presliding_friction", "joint_2"))
    elsewhere = result(finding("joint_spring", "joint_2"), finding("presliding_friction", "joint_3"))
    assert score(case(bristle), found, HEALTHY).extra == 0
    assert score(case(bristle), elsewhere, HEALTHY).extra == 1
    assert case(bristle).key == case(SPRING).key


def test_stale_numbers_are_judged_by_the_gap_of_their_own_findings() -> None:
    stale = finding("payload", "joint_6", kind="numbers", gap_before=12.0, gap_after=8.0)
    assert closed(case(GRIPPER, baseline=True), result(stale, before=8.0, after=8.0), HEALTHY) == pytest.approx(1.0)


def test_what_the_healthy_twin_shows_as_well_is_not_in_the_data() -> None:
    bump = case(SPRING, kind="outside")
    assert score(bump, result(before=20.0, after=20.0, verdict="no_gap"), HEALTHY).shown
    assert not score(bump, result(before=8.1, after=8.1, verdict="no_gap"), HEALTHY).shown


def test_parameters_are_compared_in_their_own_standard_deviations() -> None:
    found = finding("joint_spring", "joint_2", parameters={"ks": 1.2}, evidence={"std": {"ks": 0.1}})
    assert within(found, {"ks": 1.0}) == [True]
    assert within(found, {"ks": 0.8}) == [False]
    assert within(found, {"other": 0.8}) == []


def _score(**more: Any) -> Score:
    base: dict[str, Any] = {
        "verdict": "explained", "first": True, "second": True, "missed": False, "invisible": False, "extra": 0,
        "closed": 1.0, "within": (True,), "confidence": 0.9, "named": ("joint_spring joint_2",),
    }  # fmt: skip
    return Score(**{**base, **more})


def _mixed() -> list[tuple[Case, Score]]:
    return [
        (case(SPRING, seed=1), _score()),
        (case(SPRING, seed=2), _score(first=False, closed=0.5, within=(False,))),
        (case(SPRING, seed=3), _score(first=False, second=False, missed=True, invisible=True, closed=None, within=())),
        (case(kind="clean", level=None, seed=1), _score(verdict="no_gap", first=None, second=None)),
        (case(kind="clean", level=None, seed=2), _score(verdict="explained", first=None, second=None)),
        (case(SPRING, kind="outside", seed=1), _score(confidence=0.4)),
        (case(SPRING, kind="outside", seed=2), _score(confidence=0.9)),
        (case(SPRING, kind="outside", seed=3), _score(confidence=0.0, verdict="unexplained")),
        (case(SPRING, kind="outside", seed=4), _score(confidence=0.0, verdict="no_gap")),
        (case(SPRING, kind="outside", seed=5), _score(confidence=0.0, verdict="no_gap", shown=False)),
    ]


def test_the_tables_count_what_happened() -> None:
    scored = _mixed()
    counted = tables(scored, [case(SPRING, seed=4)])
    row = counted.effects[0]
    assert (row.n, row.failed, row.first, row.second, row.missed) == (3, 1, 0.5, 1.0, 0.0)
    assert (row.invisible, row.closed, row.closed_enough, row.within) == (1 / 3, 0.75, 0.5, 0.5)
    outside = counted.outside[0]
    assert (outside.low_confidence, outside.named, outside.unexplained, outside.unseen) == (0.2, 0.2, 0.2, 0.2)
    assert outside.absent == 0.2
    assert counted.healthy[0].alarms == 1
    aims = {aim.what: aim.value for aim in counted.aims}
    assert aims["effect and joint correct"] == 0.5
    assert aims["healthy arms with verdict no_gap"] == 0.5
    # One of the five is not in the data, one is named, and one overlooked.
    assert aims["outside the catalogue, gap in the data: unexplained or low confidence"] == 0.5
    assert aims["mean closed share of the injected gap where the effect is correct"] == 1.0


def test_the_report_names_every_case_that_fell_short() -> None:
    scored = [*_mixed(), (case(SPRING, level="detectable"), _score(first=False, second=False))]
    lacks = [(shortcomings, diagnosis) for _, shortcomings, diagnosis in shortfalls(scored)]
    assert lacks == [
        ("false alarm", "explained: joint_spring joint_2, 100% closed"),
        (
            "second choice; a parameter off by over 3 sigma",
            "explained: joint_spring joint_2, 50% closed",
        ),
        ("below the detection limit", "explained: joint_spring joint_2"),
        ("named although outside the catalogue", "explained: joint_spring joint_2, 100% closed"),
        ("not detected", "no gap: joint_spring joint_2, 100% closed"),
    ]
    results = [CaseResult(key=str(k), seconds={"simulate": 100.0, "diagnose": 350.0}) for k in range(10)]
    text = report("title", tables(scored, []), scored, [], 20, results, {"abc": 10, "def": 1}, names=True)
    assert "11 of 20 cases, 0 failed, 1.2 core-hours, code abc (10 cases), def (1 cases)" in text
    # Every table has as many columns in each row as in its heading.
    for table in text.split("\n\n"):
        rows = [line for line in table.splitlines() if line.startswith("|")]
        assert len({row.count("|") for row in rows}) <= 1


def test_the_bounds_of_false_alarms_are_clopper_and_pearsons() -> None:
    # Rule of three: none of n is compatible with 1 - 0.025^(1/n).
    assert clopper_pearson(0, 60) == pytest.approx((0.0, 1 - 0.025 ** (1 / 60)))
    assert clopper_pearson(1, 90) == pytest.approx((0.000281, 0.0604), rel=2e-2)
    # Quantiles of the beta distribution.
    expected = stats.beta.ppf(0.025, 7, 34), stats.beta.ppf(0.975, 8, 33)
    assert clopper_pearson(7, 40) == pytest.approx(expected, rel=1e-9)


def test_the_same_noise_is_a_larger_percentage_of_less_torque() -> None:
    """An arm that lost half of its friction: 20 % of half the torque is the gap, 16 % of it the healthy arm's noise."""
    thinned = result(finding("joint_spring", "joint_2"), before=20.0, after=16.0, torque=TORQUE / 2)
    assert score(case(SPRING), thinned, HEALTHY).closed == pytest.approx(1.0)
