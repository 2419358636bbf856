"""Exported files: the copy of a URDF, effects, the sheet of limits, refusals and the command."""

import json
import xml.etree.ElementTree as ET
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray

import armident
from armident.configs import ConfigError, DataError, RobotConfig, load_robot
from armident.configs.schema.robot import Effect
from armident.daq.cli import application
from armident.identify.documents.files import to_json
from armident.identify.documents.identification import VerdictReason
from armident.identify.effects.terms import arm_model
from armident.identify.model_export.exported_model import ExportedModel, load_exported_model
from armident.identify.model_export.formats import FORMATS, export_model
from armident.identify.model_export.saturated_dampers import TOLERANCE
from armident.identify.model_export.source_urdf import SourceUrdf
from tests.fixtures import arms
from tests.model_exports import (
    exported,
    identification_of,
    mujoco_torque,
    random_motion,
    random_theta,
    relative_error,
    rigid_torque,
)

Floats = NDArray[np.float64]

INERTIA = '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>'

ARM = """<?xml version="1.0"?>
<robot name="lift_arm">
  <!-- drawn by hand -->
  <link name="world"/>
  <link name="column"><visual><geometry><mesh filename="meshes/column.stl"/></geometry></visual></link>
  <joint name="stand" type="fixed"><parent link="world"/><child link="column"/><origin rpy="0 0 1.5708"/></joint>
  <joint name="Lift" type="prismatic"><parent link="column"/><child link="slide"/><origin xyz="0 0 0.2"/>
    <axis xyz="0 0 2"/><limit lower="0" upper="0.6" effort="400" velocity="0.5"/></joint>
  <link name="slide"><inertial><mass value="9"/>{I}</inertial>
    <visual><geometry><mesh filename="package://lift_arm/slide.dae"/></geometry></visual></link>
  <link name="plate"><inertial><mass value="3"/>{I}</inertial></link>
  <joint name="bolted" type="fixed"><parent link="slide"/><child link="plate"/><origin xyz="0.1 0 0"/></joint>
  <joint name="Shoulder" type="revolute"><parent link="plate"/><child link="upper"/>
    <origin xyz="0 0.1 0.05" rpy="1.5708 0 0"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="90" velocity="2"/><dynamics damping="7" friction="8"/></joint>
  <link name="upper"/>
  <joint name="Elbow" type="continuous"><parent link="upper"/><child link="fore"/>
    <origin xyz="0.3 0 0" quat_xyzw="0.5 0.5 0.5 0.5"/><axis xyz="1 0 0"/></joint>
  <link name="fore"/>
  <joint name="tool" type="fixed"><parent link="fore"/><child link="hand"/><origin xyz="0 0 0.1"/></joint>
  <link name="hand"><inertial><mass value="1"/>{I}</inertial></link>
  <joint name="finger" type="prismatic"><parent link="hand"/><child link="tip"/><axis xyz="0 1 0"/>
    <limit lower="0" upper="0.04" effort="5" velocity="0.1"/></joint>
  <link name="tip"><inertial><mass value="0.1"/>{I}</inertial></link>
</robot>
""".replace("{I}", INERTIA)

ARM_YAML = (
    "schema: armident/robot/1\nname: lift_arm\nurdf: {file: lift_arm.urdf, tip: fore}\ngravity: [0.5, 0.0, -9.7]\n"
)


@pytest.fixture
def arm(tmp_path: Path) -> tuple[Path, RobotConfig, Floats]:
    """A configuration with a URDF, the robot, and its random parameters; the folder has an identification of it."""
    (tmp_path / "lift_arm.urdf").write_text(ARM)
    (tmp_path / "arm.yaml").write_text(ARM_YAML)
    robot = load_robot(tmp_path / "arm.yaml")
    theta = random_theta(arm_model(robot), 3)
    (tmp_path / "identification.json").write_text(to_json(identification_of(robot, theta)))
    return tmp_path, robot, theta


def read(model: ExportedModel, format_name: str, out: Path) -> ET.Element:
    """The root element of an exported file."""
    return ET.parse(export_model(model, format_name, out)[0][0]).getroot()


def test_the_copy_of_a_urdf_keeps_meshes_names_limits_and_comments(arm: tuple[Path, RobotConfig, Floats]) -> None:
    folder = arm[0]
    model = load_exported_model(folder, folder / "arm.yaml")
    root = read(model, "urdf", folder / "out")
    text = (folder / "out" / "lift_arm.urdf").read_text()
    assert "drawn by hand" in text
    assert [mesh.get("filename") for mesh in root.iter("mesh")] == [
        "../meshes/column.stl",
        "package://lift_arm/slide.dae",
    ]
    joints = {str(joint.get("name")): joint for joint in root.findall("joint")}
    limit = joints["Shoulder"].find("limit")
    assert limit is not None
    assert limit.attrib == {"lower": "-2", "upper": "2", "effort": "90", "velocity": "2"}
    assert joints["Elbow"].get("type") == "continuous"
    dynamics = joints["Shoulder"].find("dynamics")
    assert dynamics is not None
    assert float(dynamics.get("damping", "")) == model.joints[1].viscous
    assert float(dynamics.get("friction", "")) == model.joints[1].coulomb


def test_bodies_fixed_to_a_link_are_part_of_it_and_joints_after_the_tip_are_fixed(
    arm: tuple[Path, RobotConfig, Floats],
) -> None:
    folder, robot, _ = arm
    model = load_exported_model(folder, folder / "arm.yaml")
    files, sheet = export_model(model, "urdf", folder / "out")
    loaded = pin.buildModelFromUrdf(str(files[0]))
    loaded.gravity.linear = model.frames.gravity
    assert list(loaded.names)[1:] == ["Lift", "Shoulder", "Elbow"]
    assert sum(inertia.mass for inertia in loaded.inertias) == pytest.approx(sum(body.mass for body in model.links))
    motion, data = random_motion(robot, np.random.default_rng(1)), loaded.createData()
    torque = [
        pin.rnea(loaded, data, pin.integrate(loaded, pin.neutral(loaded), q), qd, qdd)
        for q, qd, qdd in zip(*motion, strict=True)
    ]
    assert relative_error(np.array(torque), rigid_torque(model, motion)) < 1e-9
    assert model.choice == "the lightest physical arm"  # the upper arm has no mass in the URDF
    remarks = " ".join(sheet.remarks)
    assert "masses of plate, hand, tip" in remarks
    assert "joints finger after the tip are fixed" in remarks


def test_a_urdf_that_is_named_gives_the_frames_of_a_robot_without_one(arm: tuple[Path, RobotConfig, Floats]) -> None:
    folder, robot, _ = arm
    by_name = load_exported_model(folder, robot, folder / "lift_arm.urdf")
    by_configuration = load_exported_model(folder, folder / "arm.yaml")
    for one, other in zip(by_name.links, by_configuration.links, strict=True):
        assert one.name == other.name
        assert one.inertia == pytest.approx(other.inertia)
    assert load_exported_model(folder, robot).frames.links[0] == "Lift_link"


def test_a_urdf_of_another_geometry_is_refused(arm: tuple[Path, RobotConfig, Floats]) -> None:
    folder, robot, _ = arm
    other = folder / "other.urdf"
    other.write_text(ARM.replace('xyz="0.3 0 0"', 'xyz="0.31 0 0"'))
    with pytest.raises(ConfigError, match="another geometry"):
        load_exported_model(folder, robot, other)
    other.write_text(ARM.replace('"Elbow"', '"Ellbow"'))
    with pytest.raises(ConfigError, match=r"no joint 'Elbow'.*Lift, Shoulder, Ellbow"):
        load_exported_model(folder, robot, other)


def tx40_with(*effects: Effect, **updates: Any) -> RobotConfig:
    """The TX40 with effects in its configuration."""
    return load_robot("tx40").model_copy(update={"effects": effects, **updates})


def with_effects(robot: RobotConfig, *values: float) -> ExportedModel:
    """An export of a random TX40 whose effects have these linear parameters."""
    arm = arm_model(robot)
    theta = random_theta(arm, 2)
    theta[len(arm.names) - arm.e :] = values
    return exported(robot, theta)


def test_mujoco_has_springs_couplings_rotors_and_a_tilted_base_of_the_effects(tmp_path: Path) -> None:
    model = with_effects(
        tx40_with(
            Effect(effect="joint_spring", joint="joint_2"),
            Effect(effect="coupling_friction", joint="joint_3", other="joint_4"),
            Effect(effect="rotor_inertia", joint="joint_1"),
            Effect(effect="gravity_direction", joint="joint_1"),
        ),
        *(40.0, 0.05, 0.2, 0.0, 0.3, 0.02, -0.01),
    )
    files, sheet = export_model(model, "mjcf", tmp_path)
    assert not [o for o in sheet.omitted if "coupling of joint_3" in o.part or "spring" in o.part]
    motion = random_motion(model.robot, np.random.default_rng(4))
    smooth = np.array([0.0 if name.startswith(("fc", "off")) else 1.0 for name in model.arm.names])
    expected = model.model.inverse_dynamics(*motion, theta=model.theta * smooth, dt=1e-3)
    assert relative_error(mujoco_torque(files[0], motion), expected) < 1e-9


def test_mujoco_accelerates_as_our_model_under_the_torque_that_a_drive_reports(tmp_path: Path) -> None:
    mujoco = pytest.importorskip("mujoco")
    model = with_effects(tx40_with())
    files, _ = export_model(model, "mjcf", tmp_path)
    loaded = mujoco.MjModel.from_xml_path(str(files[0]))
    loaded.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    data = mujoco.MjData(loaded)
    q, qd, _ = random_motion(model.robot, np.random.default_rng(6), 20)
    # Inside the limits of the drives; the offsets are in the torque.
    tau = np.random.default_rng(8).uniform(-10.0, 10.0, q.shape)
    expected = model.arm.forward_dynamics(model.theta, q, qd, tau)
    found = []
    for data.qpos[:], data.qvel[:], data.ctrl[:] in zip(q, qd, tau, strict=True):
        mujoco.mj_forward(loaded, data)
        found.append(data.qacc.copy())
    # Accelerations times the mass matrix: the dampers have the friction of the model within their tolerance.
    wrong = np.einsum("kij,kj->ki", model.arm.mass_matrix(model.theta, q), np.array(found) - expected)
    coulomb = np.array([joint.coulomb for joint in model.joints])
    coulomb[4:] += model.couplings[0].coulomb
    assert np.all(np.abs(wrong).max(axis=0) <= TOLERANCE * coulomb)
    assert np.abs(wrong).max() > 1e-6
    assert loaded.nu == 6


def test_a_coupling_that_no_tendon_has_is_named_on_the_sheet(tmp_path: Path) -> None:
    robot = load_robot("tx40")
    arm = arm_model(robot)
    theta = random_theta(arm, 2)
    theta[[arm.names.index(name) for name in ("fv5", "fv6", "fvm6")]] = 1.0, 1.0, 2.0
    model = exported(robot, theta)
    root = read(model, "mjcf", tmp_path)
    assert [tendon.get("name") for tendon in root.iter("fixed")] == ["m6_armature", "m6_both"]
    assert "viscous friction of coupling m6: 2. It is larger" in (tmp_path / "tx40_mjcf_limits.md").read_text()
    theta[arm.names.index("fv5")] = 9.0
    model = exported(robot, theta)
    files, sheet = export_model(model, "mjcf", tmp_path)
    motion = random_motion(robot, np.random.default_rng(4))
    assert not sheet.omitted
    assert relative_error(mujoco_torque(files[0], motion), rigid_torque(model, motion, "ia", "fv")) < 1e-9


def test_the_sheet_names_all_that_a_format_cannot_hold(tmp_path: Path) -> None:
    tight = Effect(effect="position_dependent_friction", joint="joint_2", parameters={"period": 2.0})
    model = with_effects(tx40_with(tight), 0.4, 0.3)
    for format_name, missing in (
        ("urdf", ("rotor inertia of joint_1", "offset of joint_3", "coupling m6", "gravity (0, 0, -9.81)")),
        ("sdf", ("offset of joint_3", "coupling m6", "gravity (0, 0, -9.81)")),
        ("pinocchio", ("offset of joint_3", "coupling m6")),
        ("mjcf", ()),
    ):
        files, sheet = export_model(model, format_name, tmp_path)
        parts = [omission.part for omission in sheet.omitted]
        for part in (*missing, "position-dependent friction (position_dependent_friction) of joint_2"):
            assert any(each.startswith(part) for each in parts), (format_name, part)
            assert part in files[-1].read_text()
        assert any("fpc = 0.4 N m" in each for each in parts)
        assert sheet.undetermined["m1"].startswith("no effect on the torques")
        assert sheet.undetermined["zz1"].startswith("determined only together with others")
        assert "zz6" not in sheet.undetermined


def test_every_link_of_the_lightest_arm_has_mass_and_extent() -> None:
    robot = load_robot("emps")
    theta = np.zeros(len(arm_model(robot).names))
    theta[[arm_model(robot).names.index(name) for name in ("m1", "fv1", "fc1")]] = 95.0, 200.0, 20.0
    model = exported(robot, theta)
    assert model.links[0].mass == pytest.approx(95.0)
    assert np.linalg.eigvalsh(model.links[0].central_inertia).min() > 0.0


@pytest.mark.slow
def test_an_impossible_arm_is_refused_unless_the_nearest_one_is_wanted(tmp_path: Path) -> None:
    robot = load_robot("tx40")
    arm = arm_model(robot)
    theta = random_theta(arm, 2)
    theta[arm.names.index("fv3")] = -1.0
    with pytest.raises(DataError, match=r"fv3 changes most.*armident diagnose.*--nearest"):
        exported(robot, theta)
    nearest = exported(robot, theta, nearest=True)
    assert nearest.joints[2].viscous >= 0.0
    _, sheet = export_model(nearest, "urdf", tmp_path)
    assert any("differ from the estimate by up to" in remark and "fv3" in remark for remark in sheet.remarks)


def test_a_coupling_larger_than_what_it_couples_is_refused() -> None:
    robot = load_robot("tx40")
    arm = arm_model(robot)
    theta = random_theta(arm, 2)
    theta[arm.names.index("iam6")] = 5.0
    with pytest.raises(DataError, match=r"coupling m6 is larger .* mass matrix is not positive definite at \d+ %"):
        exported(robot, theta)


def test_an_unusable_identification_is_refused(tmp_path: Path) -> None:
    robot = load_robot("emps")
    theta = random_theta(arm_model(robot), 2)
    reason = VerdictReason(level="unusable", kind="fit", joint=None, message="Nothing moves", next_step="move the arm")
    document = identification_of(robot, theta).model_copy(update={"verdict": "unusable", "reasons": [reason]})
    (tmp_path / "identification.json").write_text(to_json(document))
    with pytest.raises(DataError, match=r"unusable: Nothing moves. Next: move the arm"):
        load_exported_model(tmp_path)


def run(*words: object) -> int:
    """Exit code of a command line."""
    point = EntryPoint("export-model", "armident.identify.model_export.command:export_model", "armident.commands")
    arguments = [str(word) for word in words]
    with pytest.raises(SystemExit) as ended:
        application(arguments, [point])(args=arguments, prog_name="armident")
    return int(ended.value.code or 0)


def test_the_command_prints_one_document(
    arm: tuple[Path, RobotConfig, Floats], capsys: pytest.CaptureFixture[str]
) -> None:
    folder = arm[0]
    words = ("export-model", folder, "--config", folder / "arm.yaml", "--format", "mjcf")
    assert run(*words, "--out", folder / "arm.xml", "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert document["files"] == [str(folder / "arm.xml"), str(folder / "arm_mjcf_limits.md")]
    assert document["format"] == "mjcf"
    assert run(*words) == 0
    assert f"written: {folder / 'lift_arm.xml'}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (("--format", "stl"), 2, f"--format: 'stl' is not one of {', '.join(FORMATS)}"),
        (("--format", "urdf", "--config", "tx40"), 3, "the model is of robot 'lift_arm', the configuration of 'tx40'"),
        (("--format", "urdf", "--config", "{folder}/arm.yaml", "--urdf", "none.urdf"), 2, "none.urdf: no such file"),
        (("--format", "urdf", "--config", "{folder}/arm.yaml", "--out", "/proc/x/y.urdf"), 2, "cannot be written"),
        (("--format", "urdf", "--config", "{folder}/arm.yaml"), 2, "lift_arm.urdf: would overwrite what the model is"),
        (("--format", "c", "--out", "{folder}/identification.json"), 2, "would overwrite what the model is read from"),
    ],
)
def test_a_wrong_request_is_one_line(
    arm: tuple[Path, RobotConfig, Floats],
    words: tuple[str, ...],
    code: int,
    message: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder = arm[0]
    assert run("export-model", folder, *(word.format(folder=folder) for word in words)) == code
    err = capsys.readouterr().err
    assert message in err
    assert err.count("\n") == 1


@pytest.mark.slow
def test_an_identification_in_memory_is_exported(tmp_path: Path) -> None:
    recording = arms.recording("emps", "emps_excitation", 1)
    result = armident.identify(recording, method="idim-ls")
    model, page = result.export(tmp_path, "mjcf")
    body = ET.parse(model).getroot().find("worldbody/body/body/inertial")
    assert body is not None
    assert float(body.get("mass", "")) == pytest.approx(result.parameters["m1"].value, rel=1e-6)
    assert page.name == "emps_mjcf_limits.md"
    result.save(tmp_path)
    assert load_exported_model(tmp_path).links[0].mass == pytest.approx(result.parameters["m1"].value, rel=1e-6)


def test_names_that_a_format_reserves_are_changed(arm: tuple[Path, RobotConfig, Floats]) -> None:
    folder, _, theta = arm
    (folder / "lift_arm.urdf").write_text(ARM.replace('name="Elbow"', 'name="fore"'))
    with pytest.raises(DataError, match="its joints are Lift, Shoulder, Elbow, other names"):
        load_exported_model(folder, folder / "arm.yaml")
    robot = load_robot(folder / "arm.yaml")
    model = exported(robot, theta).in_frames_of(SourceUrdf(folder / "lift_arm.urdf", None, "fore"))
    sdf = read(model, "sdf", folder / "out").find("model")
    assert sdf is not None
    names = [str(element.get("name")) for element in sdf]
    assert len(set(names)) == len(names)
    assert "world" not in names
    assert "fore_joint" in names
    mujoco = pytest.importorskip("mujoco")
    loaded = mujoco.MjModel.from_xml_path(str(export_model(model, "mjcf", folder / "out")[0][0]))
    assert [loaded.joint(k).name for k in range(3)] == ["Lift", "Shoulder", "fore"]
    assert loaded.jnt_limited.tolist() == [1, 1, 0]
