"""What a diagnosis promises: a model that is right, numbers told from structure, effects of other packages."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from armident.configs import load_robot
from armident.configs.schema.scenario import HiddenEffect
from armident.daq.cli import application
from armident.identify.diagnosis.diagnose import run_diagnosis
from armident.identify.documents.diagnosis import Finding
from armident.identify.effects.registry import catalogue
from armident.identify.identification.from_recording import experiments_from_recording
from tests.fixtures.arms import recording
from tests.fixtures.diagnoses import WORN_AND_SPRUNG, diagnosis

pytestmark = pytest.mark.slow
MISSED = pytest.mark.xfail(strict=True, reason="the stepwise selection misses it: docs/diagnosis.md, What is missed")
"""Promises of the former search that the selection does not keep yet."""

TX40_2, TX40_3 = (pytest.param("tx40", joint, marks=pytest.mark.nightly) for joint in ("joint_2", "joint_3"))

PLUGIN = '''
import numpy as np
from armident.identify.effects.effect import Effect, Linear, Shape


class TightSpot(Effect):
    name = "tight_spot"
    title = "a tight spot"
    description = "something pushes back near one position"
    reference = "the machine's log book"
    required_motion = "motion across the spot"
    linear = (Linear("height", ("N m", "N")),)
    shapes = (Shape("position", ("rad", "m")),)

    def columns(self, motion, place, shapes):
        """Torque (N, 1) per unit of height: a bell 10 mm wide around a position."""
        return np.exp(-0.5 * ((motion.q[:, place.joint, None] - shapes["position"]) / 0.01) ** 2)

    def trial_values(self, motion, place):
        return ([0.01 * k for k in range(1, 12)],)
'''


def test_the_resulting_model_has_no_gap_on_a_new_recording() -> None:
    first = diagnosis("emps", "emps_1", 1, *WORN_AND_SPRUNG)
    assert {f.effect for f in first.document.findings} == {hidden.effect for hidden in WORN_AND_SPRUNG}
    assert all(f.gap_after < f.gap_before and f.evidence["p_value"] < 0.05 for f in first.document.findings)
    experiments, _ = experiments_from_recording(recording("emps", "emps_1", 2, *WORN_AND_SPRUNG), first.robot)
    assert run_diagnosis(experiments, [], first.robot).document.verdict == "no_gap"


def test_what_could_hide_does_up_to_the_size_that_is_told_and_no_further() -> None:
    told = diagnosis("emps", "emps_1", 1).document
    assert told.verdict == "no_gap"
    (spring,) = [h for h in told.detection_limits if h.effect == "joint_spring"]
    for share, found in ((0.2, []), (2.0, ["joint_spring"])):
        stiffness = share * spring.limits["ks"]
        hidden = HiddenEffect(effect="joint_spring", joint="joint_1", parameters={"stiffness": stiffness})
        document = diagnosis("emps", "emps_1", 2, hidden).document
        assert [f.effect for f in document.findings] == found, share


def against_baseline(robot: str, seed: int, *effects: HiddenEffect) -> list[Finding]:
    motion = {"emps": "emps_1", "tx40": "tx40_excitation"}[robot]
    return diagnosis(robot, motion, seed, *effects, against_baseline=True).document.findings


@pytest.mark.parametrize(("robot", "joint"), [("emps", "joint_1"), TX40_3])
def test_other_friction_of_one_joint_is_another_number_and_no_structure(robot: str, joint: str) -> None:
    cold = HiddenEffect(effect="friction_scale", joint=joint, parameters={"factor": 1.3})
    (finding,) = against_baseline(robot, 3, cold)
    assert (finding.kind, finding.effect, finding.joint) == ("numbers", "friction_change", joint)


@pytest.mark.parametrize(
    ("robot", "joint", "fva"),
    [("emps", "joint_1", 0.15 * 203.5), pytest.param("tx40", "joint_2", 0.2 * 5.5, marks=pytest.mark.nightly)],
)
def test_a_structural_effect_is_no_other_number(robot: str, joint: str, fva: float) -> None:
    worn = HiddenEffect(effect="asymmetric_viscous_friction", joint=joint, parameters={"fva": fva})
    (finding,) = against_baseline(robot, 4, worn)
    assert (finding.kind, finding.effect, finding.joint) == ("structure", "asymmetric_viscous_friction", joint)


@pytest.mark.parametrize(("robot", "joint"), [("emps", "joint_1"), TX40_2])
def test_the_gain_of_one_drive_is_named(robot: str, joint: str) -> None:
    gain = HiddenEffect(effect="drive_gain_error", joint=joint, parameters={"error": 0.1})
    findings = [f for f in against_baseline(robot, 5, gain) if f.effect == "drive_gain_error"]
    assert [f.joint for f in findings] == [joint]


@pytest.mark.nightly
@MISSED
def test_a_drive_that_gives_twice_its_torque_is_sized_by_what_the_model_with_it_predicts() -> None:
    """Of the torque that the model without it predicts, which reports half of it, it would be another share."""
    gain = HiddenEffect(effect="drive_gain_error", joint="joint_1", parameters={"error": 0.96})
    document = diagnosis("tx40", "tx40_1", 8, gain).document
    (finding,) = document.findings
    assert (finding.effect, finding.joint) == ("drive_gain_error", "joint_1")
    std = finding.evidence["std"]["gain_error"]
    assert finding.parameters["gain_error"] == pytest.approx(-0.96 / 1.96, abs=3.0 * std)
    assert document.simulated is not None
    before, after = (document.simulated[when]["joint_1"] for when in ("torque_before", "torque_after"))
    assert after < before


def exchanged_joints() -> list[tuple[str, str, str | None]]:
    """Effects and joints that are found where the joints 4 and 5 of a TX40 are exchanged."""
    both = {"position": 1.0, "torque": 1.0}
    exchanged = HiddenEffect(effect="joint_order", joint="joint_4", other="joint_5", parameters=both)
    document = diagnosis("tx40", "tx40_4", 5, exchanged, repeats=3).document
    return [(f.effect, f.joint, f.other) for f in document.findings]


@pytest.mark.nightly
def test_like_joints_that_were_exchanged_are_found_first() -> None:
    assert exchanged_joints()[0] == ("joint_order", "joint_4", "joint_5")


@pytest.mark.nightly
@pytest.mark.xfail(strict=True, reason="at a probability of 0.7 the order stays, and what it leaves is unnamed")
def test_like_joints_that_were_exchanged_are_found_though_nothing_else_is_amiss() -> None:
    assert exchanged_joints() == [("joint_order", "joint_4", "joint_5")]


@pytest.mark.nightly
def test_a_base_that_was_tilted_is_named() -> None:
    tilted = HiddenEffect(effect="gravity_direction", joint="joint_1", parameters={"tilt": 0.1, "azimuth": 0.7})
    assert [f.effect for f in against_baseline("tx40", 6, tilted)] == ["gravity_direction"]


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """Folder with an installed distribution of somebody else's, which brings one effect along."""
    site = tmp_path / "site"
    info = site / "tight_spots-1.0.dist-info"
    info.mkdir(parents=True)
    (site / "tight_spots.py").write_text(PLUGIN)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: tight-spots\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[armident.effects]\ntight_spot = tight_spots:TightSpot\n")
    return site


def test_an_effect_of_somebody_else_is_listed(site: Path) -> None:
    paths = os.pathsep.join([str(site), *filter(None, [os.environ.get("PYTHONPATH")])])
    command = [sys.executable, "-m", "armident.daq.cli", "effects", "tight_spot"]
    listed = subprocess.run(
        command, env={**os.environ, "PYTHONPATH": paths}, capture_output=True, text=True, check=True
    )
    assert "something pushes back near one position" in listed.stdout
    words = ["effects", "tight_spot"]
    assert CliRunner().invoke(application(words), words).exit_code == 2


@pytest.fixture
def installed(site: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The distribution is installed in this process."""
    monkeypatch.syspath_prepend(str(site))
    catalogue.cache_clear()
    yield
    catalogue.cache_clear()
    sys.modules.pop("tight_spots", None)


@pytest.mark.usefixtures("installed")
def test_an_effect_of_somebody_else_is_found_by_name() -> None:
    bump = HiddenEffect(
        effect="torque_bump", joint="joint_1", parameters={"torque": 3.0, "position": 0.06, "width": 0.01}
    )
    experiments, _ = experiments_from_recording(recording("emps", "emps_1", 7, bump), load_robot("emps"))
    (finding,) = run_diagnosis(experiments, [], load_robot("emps")).document.findings
    assert (finding.effect, finding.joint) == ("tight_spot", "joint_1")
    # The torque works against the joint.
    assert abs(finding.parameters["height"]) == pytest.approx(3.0, abs=4 * finding.evidence["std"]["height"])
    assert finding.parameters["position"] == pytest.approx(0.06, abs=0.003)
