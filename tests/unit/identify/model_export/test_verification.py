"""Figures of exported files: the program that reads a file computes the torques of the identified model."""

import csv
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from armident.configs import ConfigError, load_robot
from armident.identify.effects.terms import arm_model
from armident.identify.model_export.exported_model import ExportedModel
from armident.identify.model_export.formats import export_model
from armident.identify.model_export.saturated_dampers import TOLERANCE, saturated_dampers
from armident.identify.model_export.verification import SETTLED_S, identified_torque, motion_of
from tests.fixtures import arms
from tests.model_exports import exported, random_theta
from tests.tools.export_figures import model_with

Floats = NDArray[np.float64]

CLOSE_PCT = 1.0
"""Largest difference of the torques of a format that holds the whole model, percent."""

HELD_BY_MUJOCO = (
    "stribeck_friction", "stribeck_friction on a bristle", "stribeck_friction/exponential",
    "asymmetric_coulomb_friction", "nonlinear_viscous_friction", "presliding_friction", "joint_elasticity", "backlash",
    "cogging_torque",
)  # fmt: skip

STATES = ("stribeck_friction on a bristle", "presliding_friction", "friction_drift", "friction_drift/work")


@pytest.fixture(scope="module")
def emps() -> ExportedModel:
    robot = load_robot("emps")
    return exported(robot, random_theta(arm_model(robot), 5))


def error_pct(model: ExportedModel, format_name: str, folder: Path) -> float:
    """The figure on the sheet of an export, percent."""
    _, sheet = export_model(model, format_name, folder, motion_of(model))
    assert sheet.measured is not None
    assert sheet.measured.error_pct is not None, sheet.measured.missing
    return sheet.measured.error_pct


@pytest.mark.parametrize("format_name", ["mjcf", "c", "python", "fmu"])
def test_formats_with_the_law_of_friction_have_the_torques_of_the_model(
    format_name: str, emps: ExportedModel, tmp_path: Path
) -> None:
    assert error_pct(emps, format_name, tmp_path) < CLOSE_PCT
    page = (tmp_path / f"emps_{format_name}_limits.md").read_text()
    assert "computes torques that differ by" in page
    assert ("a call at 1 kHz takes" in page) == (format_name == "c")


@pytest.mark.parametrize(("format_name", "least"), [("urdf", 1.0), ("pinocchio", 1.0), ("lerobot", 1.0)])
def test_the_figure_tells_what_a_format_lacks(
    format_name: str, least: float, emps: ExportedModel, tmp_path: Path
) -> None:
    # Friction is large on this axis: a sharp sign, or velocities from positions at 50 Hz, are visible.
    assert least < error_pct(emps, format_name, tmp_path) < 50.0


@pytest.mark.slow
def test_drake_lacks_dry_friction(emps: ExportedModel, tmp_path: Path) -> None:
    motion = motion_of(emps)
    dry = emps.joints[0].coulomb * emps.arm.smooth_sign(motion.qd)
    share = 100.0 * float(np.linalg.norm(dry[500:]) / np.linalg.norm(identified_torque(emps, motion)[500:]))
    assert error_pct(emps, "sdf", tmp_path) == pytest.approx(share, rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("name", HELD_BY_MUJOCO)
def test_mujoco_has_named_effects(name: str, tmp_path: Path) -> None:
    model = model_with(name)
    _, sheet = export_model(model, "mjcf", tmp_path)
    assert any(model.effects[0].title in part for part in sheet.held)
    assert error_pct(model, "mjcf", tmp_path) < CLOSE_PCT


@pytest.mark.slow
@pytest.mark.parametrize("name", STATES)
def test_code_and_fmu_remember_bristles_and_slow_changes(name: str, tmp_path: Path) -> None:
    model = model_with(name)
    # The state of a bristle follows the velocity of the end of each period instead of the way.
    assert [error_pct(model, each, tmp_path) < CLOSE_PCT for each in ("c", "python", "fmu")] == [True] * 3


def test_a_recording_is_the_motion_and_is_said_to_be_held_out(emps: ExportedModel, tmp_path: Path) -> None:
    arms.recording("emps", "emps_1", 2).save(tmp_path / "held_out.mcap")
    motion = motion_of(emps, tmp_path / "held_out.mcap")
    assert motion.title == "the first 10000 samples of held_out.mcap (held out)"
    _, sheet = export_model(emps, "python", tmp_path, motion)
    assert sheet.measured is not None
    assert sheet.document()["measured"]["motion"] == motion.title
    assert motion.recorded is not None
    settled = slice(round(SETTLED_S / motion.dt), None)
    wrong = (identified_torque(emps, motion) - motion.recorded)[settled]
    found = f"{100.0 * float(np.linalg.norm(wrong) / np.linalg.norm(motion.recorded[settled])):.2g} %"
    # The module has the torques of the model.
    assert (
        f"the recorded torques differ by {found} from those of the identified model, and by {found} from those of "
        "the file"
    ) in sheet.measured.remarks


def test_a_missing_program_is_named(emps: ExportedModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    _, sheet = export_model(emps, "mjcf", tmp_path, motion_of(emps))
    assert "not measured: mujoco is not installed" in (tmp_path / "emps_mjcf_limits.md").read_text()
    monkeypatch.setattr(shutil, "which", lambda name: None)
    _, sheet = export_model(emps, "c", tmp_path, motion_of(emps))
    assert sheet.measured is not None
    assert sheet.measured.lines() == ["not measured: needs a C compiler: install gcc"]


def test_a_file_that_is_no_motion_is_refused(emps: ExportedModel, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such recording"):
        motion_of(emps, tmp_path / "none.mcap")
    with pytest.raises(ConfigError, match="no such file"):
        motion_of(emps, tmp_path / "none.yaml")


def test_saturated_dampers_have_the_friction_that_they_replace() -> None:
    v = np.linspace(-3.0, 3.0, 10_001)

    def one_sided(x: Floats) -> Floats:
        return np.where(x > 0.0, 4.0, 1.0) * np.arctan(80.0 * x) - 2.0 * x * np.exp(-np.abs(x))

    for law, inputs in ((lambda x: np.arctan(150.0 * x), False), (one_sided, True)):
        dampers = saturated_dampers(law, 3.0)
        found = -sum(np.clip(-each.slope * v, each.low, each.high) for each in dampers)
        assert np.abs(found - law(v)).max() <= 2.0 * TOLERANCE * np.abs(law(v)).max()
        assert any(each.slope < 0.0 or each.low != -each.high for each in dampers) == inputs


def test_drives_are_given_what_they_report(tmp_path: Path) -> None:
    robot = load_robot("tx40")
    model = exported(robot, random_theta(arm_model(robot), 5))
    files, _ = export_model(model, "drives", tmp_path)
    with files[0].open() as stream:
        rows = {(row["motor"], row["term"], row["joint"]): row for row in csv.DictReader(stream)}
    with files[1].open() as stream:
        total = [[float(row[f"{joint.name}_total"]) for joint in robot.joints] for row in csv.DictReader(stream)]
    rated = np.array([joint.drive.gain * joint.drive.rated / 1000.0 for joint in robot.joints])
    found = np.array(total) * rated @ robot.transmission_matrix
    assert found == pytest.approx(identified_torque(model, motion_of(model)), abs=1e-3)
    drive, joint = robot.joints[3].drive, model.joints[3]
    row = rows["joint_4", "Coulomb friction", "joint_4"]
    # The gear of this joint reverses the direction, and dry friction opposes the motor all the same.
    assert float(row["value"]) == pytest.approx(1000.0 * joint.coulomb / (48.0 * drive.gain * drive.rated), rel=1e-5)
    row = rows["joint_4", "viscous friction", "joint_4"]
    counts = 48.0 * 65536 / (2.0 * np.pi)
    assert row["unit"] == "per mille s/counts"
    assert float(row["value"]) == pytest.approx(
        1000.0 * joint.viscous / (48.0 * drive.gain * drive.rated) / counts, rel=1e-5
    )
    # Motor 6 also moves with joint 5, and motor 5 bears a part of the friction of joint 6.
    assert rows["joint_5", "Coulomb friction", "joint_6"]["unit"] == "per mille"
    assert rows["joint_6", "viscous friction", "joint_6"]["unit"] == "per mille s/rad"
