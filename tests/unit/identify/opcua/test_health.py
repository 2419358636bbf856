"""Health of an axis: what the documents of a plant say, over OPC UA, with its changes and alarms."""

import asyncio
import json
import os
import shutil
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from asyncua import Client, ua

from armident.identify.documents.diagnosis import DiagnosisDocument
from armident.identify.documents.files import load_document
from armident.identify.opcua.health import WIDTH, health_of
from armident.identify.opcua.nodes import OWN
from armident.identify.page.cells import cells_in
from armident.identify.page.plant import Plant
from tests.fixtures import plant
from tests.unit.identify.opcua.conftest import LONGEST_S, Heard, asked, health, serving
from tests.unit.identify.page.conftest import copied, made  # noqa: F401  the plant of the page

pytestmark = pytest.mark.slow

DIAGNOSED = f"{plant.name_of(5)}.diagnosis"


def test_an_axis_has_what_the_documents_say(made: Path) -> None:  # noqa: F811
    document = load_document(made / "press_4" / DIAGNOSED / "diagnosis.json", DiagnosisDocument)
    finding = max(document.findings, key=lambda each: each.confidence)
    (name, size), std = next(iter(finding.parameters.items())), next(iter(finding.evidence["std"].values()))

    async def question(client: Client) -> None:
        changed, calm = await health(client, "press_4"), await health(client, "press_2")
        for _ in range(LONGEST_S):
            # Histories are read in the background.
            if changed["Drift"].StatusCode.is_good():
                break
            await asyncio.sleep(1.0)
            changed, calm = await health(client, "press_4"), await health(client, "press_2")
        values = {name: each.Value.Value for name, each in changed.items()}
        assert values["Verdict"] == "trustworthy"
        assert (values["Effect"], values["Parameter"], values["Size"]) == (finding.effect, name, size)
        assert values["Probability"] == finding.confidence
        assert values["Interval"] == ua.Range(size - WIDTH * std, size + WIDTH * std)
        assert (values["Drift"], calm["Drift"].Value.Value) == ("changed", "unchanged")
        assert abs(values["Since"] - datetime.now(UTC)) < timedelta(days=1)
        own = await client.get_namespace_index(OWN)
        place = "MotionDeviceSystem/MotionDevices/press_4/Axes/joint_1/ModelHealth/Size/EngineeringUnits"
        unit = await client.get_node(ua.NodeId(place, own)).read_value()
        assert unit.DisplayName.Text == finding.evidence["units"][name]
        # Nothing is known: no value, and never 0.
        for each in ("Effect", "Probability", "Parameter", "Size", "Interval"):
            assert (calm[each].Value.Value, calm[each].StatusCode.name) == (None, "BadNoData"), each

    with serving(made) as (url, _):
        asked(url, question)


def test_a_new_diagnosis_is_a_change_and_an_alarm_until_it_goes(copied: Path) -> None:  # noqa: F811
    diagnosed, aside = copied / "press_4" / DIAGNOSED, copied / "aside"
    diagnosed.rename(aside)
    for history in copied.glob("*/history.sqlite"):
        history.unlink()

    async def question(client: Client) -> None:
        heard, own = Heard(), await client.get_namespace_index(OWN)
        subscription = await client.create_subscription(500, heard)
        await subscription.subscribe_events(evtypes=ua.ObjectIds.OffNormalAlarmType)
        below = "MotionDeviceSystem/MotionDevices/press_4/Axes/joint_1/ModelHealth"
        node = client.get_node(ua.NodeId(f"{below}/Effect", own))
        await subscription.subscribe_data_change([node])
        assert await asyncio.wait_for(heard.changes.get(), LONGEST_S) == ("Effect", None)
        aside.rename(diagnosed)
        _, effect = await asyncio.wait_for(heard.changes.get(), LONGEST_S)
        assert effect in {"asymmetric_viscous_friction", "joint_spring"}
        alarm: Any = await asyncio.wait_for(heard.events.get(), LONGEST_S)
        assert f"press_4, joint_1: model trustworthy, effect {effect.replace('_', ' ')}" in alarm.Message.Text
        assert (alarm.Severity, alarm.Retain, alarm.SourceNode) == (500, True, ua.NodeId(below, own))
        assert (alarm.ActiveState.Text, getattr(alarm, "ActiveState/Id")) == ("Active", True)
        shutil.rmtree(diagnosed)
        assert await asyncio.wait_for(heard.changes.get(), LONGEST_S) == ("Effect", None)
        alarm = await asyncio.wait_for(heard.events.get(), LONGEST_S)
        assert (alarm.Severity, alarm.Retain, getattr(alarm, "ActiveState/Id")) == (100, False, False)

    with serving(copied) as (url, _):
        asked(url, question)


def test_a_damaged_document_is_no_data_and_an_alarm(copied: Path) -> None:  # noqa: F811
    cells = {cell.name: cell for cell in cells_in([copied], None, None)}
    (copied / "press_4" / DIAGNOSED / "diagnosis.json").write_text("{")
    found = Plant(list(cells.values()), listens=False)
    found.read_files()
    reading = health_of(found.view("press_4"), "joint_1")
    assert reading.readings["Effect"] == reading.readings["Size"] == (None, "BadDataUnavailable")
    assert reading.severity == 800
    assert reading.sentence == "model trustworthy, effect unreadable, drift unknown"
    assert reading.readings["Since"].status == "Good"


def test_since_is_the_oldest_diagnosis_that_says_the_same(copied: Path) -> None:  # noqa: F811
    out = copied / "press_4"
    first = out / DIAGNOSED
    for number in (6, 7):
        shutil.copytree(first, out / f"{plant.name_of(number)}.diagnosis")
    content = json.loads((first / "diagnosis.json").read_text())
    content["findings"], content["signature"] = [], None
    (first / "diagnosis.json").write_text(json.dumps(content))
    times = {}
    for number in (5, 6, 7):
        file = out / f"{plant.name_of(number)}.diagnosis" / "diagnosis.json"
        os.utime(file, (1e9 + number, 1e9 + number))
        times[number] = datetime.fromtimestamp(1e9 + number, UTC)
    found = Plant(cells_in([copied / "press_4.yaml"], None, None), listens=False)
    found.read_files()
    assert health_of(found.view("press_4"), "joint_1").readings["Since"].value == times[6]
