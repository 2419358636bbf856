"""Health of an axis: what the documents of a plant say, over OPC UA, with its changes and alarms."""

import asyncio
import os
import shutil
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from asyncua import Client, ua

from armident.identify.documents.diagnosis import (
    BeforeAfter,
    DiagnosisDocument,
    Explanation,
    Finding,
    Gap,
    Gaps,
    Verdict,
)
from armident.identify.documents.files import to_json, write_atomically
from armident.identify.opcua.health import WIDTH, health_of
from armident.identify.opcua.nodes import OWN
from armident.identify.page.attention import CellView
from armident.identify.page.cells import Drift, cells_in
from armident.identify.page.plant import Plant
from tests.fixtures import plant
from tests.unit.identify.opcua.conftest import LONGEST_S, Heard, asked, health, serving

pytestmark = pytest.mark.slow

GAP = Gap(all=3.0, by_joint={"joint_1": 3.0})
WORN = Finding(
    effect="asymmetric_viscous_friction",
    joint="joint_1",
    kind="structure",
    parameters={"fva": 30.0},
    confidence=0.97,
    alternatives=[],
    gap_before=3.0,
    gap_after=1.0,
    evidence={"std": {"fva": 2.0}, "units": {"fva": "N s/m"}},
)
SPRUNG = WORN.model_copy(update={"effect": "joint_spring", "parameters": {"k": 80.0}, "confidence": 0.6})


def diagnose(cell: Path, week: int, *findings: Finding) -> Path:
    """Write a diagnosis of a recording; return its folder."""
    both = BeforeAfter(before=GAP, after=GAP)
    verdict: Verdict = "explained" if findings else "no_gap"
    document = DiagnosisDocument(
        schema_="armident/diagnosis/2",
        robot="emps",
        recordings=[],
        verdict=verdict,
        findings=list(findings),
        unexplained=[],
        gap=Gaps(train=both, validation=both),
        noise_floor=GAP,
        recommended_experiment=None,
        model=None,
        timing_s={},
        versions={},
        warnings=[],
        explanations=[Explanation(joint="joint_1", names={"nothing": 0.9, "joint_spring": 0.1}, likely=["nothing"])],
    )
    folder = cell / f"{plant.name_of(week)}.diagnosis"
    write_atomically(folder / "diagnosis.json", to_json(document))
    os.utime(folder / "diagnosis.json", (1e9 + week, 1e9 + week))
    os.utime(folder, (1e9 + week, 1e9 + week))
    return folder


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cell with the identification of a recording."""
    folder = tmp_path_factory.mktemp("plant")
    plant.session(folder, "press_4")
    plant.results(folder, "press_4")
    return folder


@pytest.fixture
def cell(made: Path) -> Iterator[Path]:
    """Folder of the results of that cell, to which a test may add diagnoses."""
    yield made / "press_4"
    for each in (made / "press_4").glob("*.diagnosis"):
        shutil.rmtree(each)


def seen(cell: Path) -> CellView:
    """State of the cell for the readings."""
    found = Plant(cells_in([cell.parent], None, None), listens=False)
    found.read_files()
    return found.view("press_4")


def test_an_axis_has_what_the_documents_say(cell: Path) -> None:
    diagnose(cell, 5, SPRUNG, WORN)

    async def question(client: Client) -> None:
        found = await health(client, "press_4")
        values = {name: each.Value.Value for name, each in found.items()}
        interval = ua.Range(30.0 - 2.0 * WIDTH, 30.0 + 2.0 * WIDTH)
        assert values == {
            "Verdict": "trustworthy", "Effect": "asymmetric_viscous_friction", "Probability": 0.97, "Parameter": "fva",
            "Size": 30.0, "Interval": interval, "Since": datetime.fromtimestamp(1e9 + 5, UTC), "Drift": None,
        }  # fmt: skip
        assert {name for name, each in found.items() if each.StatusCode.is_good()} == values.keys() - {"Drift"}
        assert found["Drift"].StatusCode.name == "BadNoData"
        place = "MotionDeviceSystem/MotionDevices/press_4/Axes/joint_1/ModelHealth/Size/EngineeringUnits"
        unit = await client.get_node(ua.NodeId(place, await client.get_namespace_index(OWN))).read_value()
        assert unit.DisplayName.Text == "N s/m"

    with serving(cell.parent) as (url, _):
        asked(url, question)


def test_a_new_diagnosis_is_a_change_and_an_alarm_until_it_goes(cell: Path) -> None:
    async def question(client: Client) -> None:
        heard, own = Heard(), await client.get_namespace_index(OWN)
        subscription = await client.create_subscription(500, heard)
        await subscription.subscribe_events(evtypes=ua.ObjectIds.OffNormalAlarmType)
        place = "MotionDeviceSystem/MotionDevices/press_4/Axes/joint_1/ModelHealth"
        await subscription.subscribe_data_change([client.get_node(ua.NodeId(f"{place}/Effect", own))])
        assert await asyncio.wait_for(heard.changes.get(), LONGEST_S) == ("Effect", None)
        made = diagnose(cell, 5, WORN)
        assert await asyncio.wait_for(heard.changes.get(), LONGEST_S) == ("Effect", "asymmetric_viscous_friction")
        alarm: Any = await asyncio.wait_for(heard.events.get(), LONGEST_S)
        assert alarm.Message.Text == (
            "press_4, joint_1: model trustworthy, effect asymmetric viscous friction (probability 0.97), drift unknown"
        )
        assert (alarm.Severity, alarm.Retain, alarm.SourceNode) == (500, True, ua.NodeId(place, own))
        assert (alarm.ActiveState.Text, getattr(alarm, "ActiveState/Id")) == ("Active", True)
        shutil.rmtree(made)
        assert await asyncio.wait_for(heard.changes.get(), LONGEST_S) == ("Effect", None)
        alarm = await asyncio.wait_for(heard.events.get(), LONGEST_S)
        assert (alarm.Severity, alarm.Retain, getattr(alarm, "ActiveState/Id")) == (100, False, False)

    with serving(cell.parent) as (url, _):
        asked(url, question)


def test_without_a_finding_the_effect_is_none_and_its_probability_that_of_nothing(cell: Path) -> None:
    diagnose(cell, 5)
    found = health_of(seen(cell), "joint_1")
    assert found.readings["Effect"] == ("none", "Good")
    assert found.readings["Probability"] == (0.9, "Good")
    assert {found.readings[name] for name in ("Parameter", "Size", "Interval")} == {(None, "BadNoData")}
    assert found.severity == 100


def test_a_damaged_document_is_no_data_and_asks_for_action(cell: Path) -> None:
    (diagnose(cell, 5, WORN) / "diagnosis.json").write_text("{")
    found = health_of(seen(cell), "joint_1")
    assert found.readings["Effect"] == found.readings["Size"] == (None, "BadDataUnavailable")
    assert found.severity == 800
    assert found.sentence == "model trustworthy, effect unreadable, drift unknown"


@pytest.mark.parametrize("evidence", [{}, {"std": [1.0], "units": 3}, {"std": {"fva": "x"}, "units": {"fva": None}}])
def test_evidence_of_another_kind_leaves_out_what_it_would_tell(cell: Path, evidence: dict[str, object]) -> None:
    diagnose(cell, 5, WORN.model_copy(update={"evidence": evidence}))
    found = health_of(seen(cell), "joint_1").readings
    assert (found["Size"], found["Interval"], found["Unit"]) == ((30.0, "Good"), (None, "BadNoData"), ("", "Good"))


def test_since_is_the_time_of_the_oldest_diagnosis_that_says_the_same(cell: Path) -> None:
    for week, findings in ((5, (SPRUNG,)), (6, (WORN,)), (7, (SPRUNG, WORN))):
        diagnose(cell, week, *findings)
    assert health_of(seen(cell), "joint_1").readings["Since"].value == datetime.fromtimestamp(1e9 + 6, UTC)


@pytest.mark.parametrize(
    ("drift", "reading", "severity"),
    [
        (None, (None, "BadNoData"), 100),
        ("the database is locked", (None, "BadDataUnavailable"), 800),
        (Drift("one run so far", None, 1, {}, ""), (None, "BadNoData"), 100),
        (Drift("not changed", False, 2, {}, ""), ("unchanged", "Good"), 100),
        (Drift("changed", True, 2, {}, "", frozenset({"fv1"})), ("changed", "Good"), 800),
        (Drift("changed", True, 2, {}, ""), ("changed", "Good"), 800),
    ],
)
def test_drift_is_that_of_the_history(
    cell: Path, drift: Drift | str | None, reading: tuple[str | None, str], severity: int
) -> None:
    found = health_of(replace(seen(cell), drift=drift), "joint_1")
    assert found.readings["Drift"] == reading
    assert found.severity == severity


def test_a_change_of_one_joint_is_none_of_another(tmp_path: Path) -> None:
    session = plant.session(tmp_path, "press_4")
    session.write_text(session.read_text().replace("emps.yaml", "tx40.yaml"))
    drift = Drift("changed", True, 2, {}, "", frozenset({"fv2", "fs2"}))
    view = replace(seen(tmp_path / "press_4"), drift=drift)
    assert [health_of(view, f"joint_{k}").readings["Drift"].value for k in (1, 2)] == ["unchanged", "changed"]
