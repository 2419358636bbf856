"""Glossary: texts of effects, documents and variables; a report has the terms that it mentions."""

from copy import copy
from typing import get_args

import pytest

from armident.configs import load_robot
from armident.identify.diagnosis.variables import Kind
from armident.identify.documents.diagnosis import DiagnosisDocument, Finding, Negligible, Verdict
from armident.identify.effects.effect import Linear
from armident.identify.effects.registry import catalogue
from armident.identify.effects.terms import arm_model
from armident.identify.report import glossary


def test_every_parameter_of_every_effect_is_explained_by_its_class() -> None:
    for effect in catalogue().values():
        for parameter in effect.parameters_of_entry:
            assert parameter.meaning.endswith("."), f"{effect.key}: {parameter.name}"
            assert glossary.GlossaryEntry(parameter.name, parameter.meaning, parameter.unit) in glossary.effect_entries(
                effect
            )


def test_a_parameter_without_a_meaning_is_explained_by_its_effect() -> None:
    spring = copy(catalogue()["joint_spring"])
    spring.linear = (Linear("ks", ("N m/rad", "N/m")),)
    assert [entry.text for entry in glossary.effect_entries(spring)] == [spring.description]


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


def test_every_verdict_and_every_variable_is_explained() -> None:
    assert [entry.name for entry in glossary.verdict_entries()] == [v.replace("_", " ") for v in get_args(Verdict)]
    assert {entry.name for entry in glossary.variable_entries()} == set(get_args(Kind))


def test_the_keys_of_documents_are_terms_with_the_text_of_the_schema() -> None:
    found = {entry.name: entry.text for entry in glossary.all_terms()}
    for key, name in (("noise_floor", "noise floor"), ("change_of_torque_pct", "change of torque")):
        kind = Negligible if key.endswith("pct") else DiagnosisDocument
        assert found[name] == kind.model_json_schema()["properties"][key]["description"].replace("``", "`")


def test_a_report_has_the_terms_that_it_mentions() -> None:
    page = (
        "<p>Noise floor 1 %; confidence.</p><p>Methods: idim-iv, SEP-PEM.</p>"
        '<img src="data:x,NVR"><script>essential</script>'
    )
    names = {entry.name for entry in glossary.mentioned(page)}
    assert names == {"noise floor", "confidence", "IDIM-IV", "SEP-PEM"}


def test_findings_have_the_entries_of_their_own_parameters() -> None:
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
    names = [entry.name for entry in glossary.finding_entries([finding, changed])]
    assert names == ["ks (joint spring)", "fv"]
