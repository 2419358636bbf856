"""Glossary: no parameter, verdict, dependence or key without an entry; the page in docs is the one of the code."""

from pathlib import Path
from typing import get_args

import pytest

from armident.configs import load_robot
from armident.identify.diagnosis.free_functions import Kind
from armident.identify.documents.diagnosis import (
    BeforeAfter,
    DiagnosisDocument,
    Finding,
    Gap,
    Gaps,
    Unexplained,
    Verdict,
)
from armident.identify.documents.diagnosis_version_1 import EVIDENCE_1
from armident.identify.effects.registry import catalogue
from armident.identify.effects.terms import arm_model
from armident.identify.effects.wiring import Wiring
from armident.identify.report import glossary

PAGE = Path(__file__).resolve().parents[4] / "docs" / "glossary.md"


def test_the_page_is_the_one_of_the_code() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert text == glossary.markdown(), "run: python -m armident.identify.report.glossary"


def test_every_parameter_of_every_effect_is_explained() -> None:
    assert set(glossary.EFFECT_PARAMETERS) == set(catalogue())
    text = PAGE.read_text(encoding="utf-8")
    for effect in catalogue().values():
        names = [p.name for p in effect.linear] + [s.name for s in effect.shapes]
        texts = glossary.EFFECT_PARAMETERS[effect.key]
        assert set(names) == set(texts) or isinstance(effect, Wiring), effect.key
        section = text.split(f"### {effect.key}\n")[1].split("\n#")[0]
        for name, meaning in texts.items():
            assert f"| `{name}` |" in section
            assert meaning in section


@pytest.mark.parametrize("robot", ["tx40", "emps", "panda", "kuka_lwr4"])
def test_every_base_parameter_of_the_shipped_robots_is_explained(robot: str) -> None:
    model = arm_model(load_robot(robot))
    for name in (*model.names, *model.base.names):
        entry = glossary.base_entry(name)
        assert entry is not None, name
        assert name.startswith(entry.name)


def test_names_from_the_thesis_are_of_their_kinds() -> None:
    kinds = {"zz1r": "zz", "iam6": "ia", "my5r": "my", "fva2": "fva", "off3": "off", "m1": "m", "cgc2_2": "cgc"}
    for name, kind in kinds.items():
        entry = glossary.base_entry(name)
        assert entry is not None
        assert entry.name == kind
    assert glossary.base_entry("nothing") is None


def test_every_verdict_and_every_dependence_is_explained() -> None:
    terms = {entry.name for entry in glossary.DIAGNOSIS_TERMS}
    assert set(get_args(Verdict)) <= terms
    assert {entry.name for entry in glossary.DEPENDENCES} == set(get_args(Kind))


def test_the_terms_of_a_report_are_explained() -> None:
    names = {e.name for e in (*glossary.IDENTIFICATION_TERMS, *glossary.DIAGNOSIS_TERMS, *glossary.CONVENTIONS)}
    wanted = {
        "essential", "relative standard deviation", "whiteness", "NVR", "gap", "gap without derivative noise",
        "detection limit", "held out", "noise floor", "confidence", "alternatives", "considered", "suffix r",
        "joint side",
    }  # fmt: skip
    assert wanted <= names
    assert "gap_without_derivative_noise" in EVIDENCE_1.values()


def test_a_report_carries_the_entries_that_it_uses() -> None:
    gap = Gap(all=5.0, by_joint={"joint_1": 5.0})
    both = BeforeAfter(before=gap, after=gap)
    finding = Finding(
        effect="joint_spring",
        joint="joint_1",
        kind="structure",
        parameters={"ks": 3.0},
        confidence=1.0,
        alternatives=[],
        gap_before=5.0,
        gap_after=4.0,
        evidence={},
    )
    changed = finding.model_copy(update={"effect": "changed_parameters", "kind": "numbers", "parameters": {"fv2": 1.0}})
    left = Unexplained(joint="joint_1", share_of_residual=0.1, varies_with="torque of joint_2", hint="h")
    document = DiagnosisDocument(
        robot="tx40",
        recordings=[],
        verdict="partly_explained",
        findings=[finding, changed],
        unexplained=[left],
        gap=Gaps(train=both, validation=both),
        noise_floor=gap,
        recommended_experiment=None,
        model=None,
        timing_s={},
        versions={},
        warnings=[],
    )
    names = {entry.name for entry in glossary.diagnosis_entries(document)}
    assert {"ks (joint spring)", "fv", "partly_explained", "unexplained", "torque of another joint"} <= names
    assert {"changed_parameters", "baseline"} <= names
    assert not {"no_gap", "transients", "torque", "fva", "simulated closed loop"} & names
