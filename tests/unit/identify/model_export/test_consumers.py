"""Exported models in the programs that read them: their inverse dynamics are those of our model."""

import re
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray

from armident.configs import load_robot
from armident.identify.effects.terms import arm_model
from armident.identify.model_export.exported_model import ExportedModel
from armident.identify.model_export.formats import export_model
from armident.identify.model_export.link_frames import LinkFrames
from armident.identify.model_export.source_urdf import SourceUrdf, known_bodies, source_for, source_frames, source_of
from tests.model_exports import (
    Motion,
    exported,
    mujoco_torque,
    random_motion,
    random_theta,
    relative_error,
    rigid_torque,
)
from tests.urdf_chains import configuration, random_urdf

Floats = NDArray[np.float64]

TOLERANCE = 1e-9
"""Largest difference of inverse dynamics, relative to the torque: rounding, not modelling."""

TILTED = (1.5, -3.0, -9.0)
"""Gravity of an arm on a tilted base, m/s^2."""

ARMS = ("tx40", "panda", "emps", "urdf", "urdf_right_angles")


@pytest.fixture(params=ARMS)
def model(request: pytest.FixtureRequest, tmp_path: Path) -> ExportedModel:
    """An arm with random parameters on a tilted base; two come from a URDF, with a prismatic joint and skew axes."""
    if not request.param.startswith("urdf"):
        robot = load_robot(request.param).model_copy(update={"gravity": TILTED})
        return exported(robot, random_theta(arm_model(robot), 5))
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(random_urdf(np.random.default_rng(11), 5, right_angles=request.param != "urdf"))
    config = tmp_path / "arm.yaml"
    config.write_text(configuration(urdf, 5, np.array(TILTED)))
    robot = load_robot(config)
    assert {joint.type for joint in robot.joints} == {"revolute", "prismatic"}
    source = source_of(config)
    assert source is not None
    return exported(robot, random_theta(arm_model(robot), 5)).in_frames_of(source)


@pytest.fixture
def motion(model: ExportedModel) -> Motion:
    return random_motion(model.robot, np.random.default_rng(7))


@pytest.mark.parametrize("right_angles", [True, False])
def test_masses_that_torques_leave_open_are_those_of_the_urdf(right_angles: bool, tmp_path: Path) -> None:
    urdf, config = tmp_path / "arm.urdf", tmp_path / "arm.yaml"
    urdf.write_text(random_urdf(np.random.default_rng(11), 5, right_angles))
    config.write_text(configuration(urdf, 5, np.array(TILTED)))
    robot, source = load_robot(config), SourceUrdf(urdf)
    arm, frames = arm_model(robot), source_frames(source, robot)
    maker = known_bodies(source, arm, frames)
    assert maker is not None
    lightest = exported(robot, maker)
    model = lightest.in_frames_of(source)
    assert arm.base.regroup @ model.theta == pytest.approx(arm.base.regroup @ lightest.theta, rel=1e-9, abs=1e-9)
    masses = pin.buildModelFromUrdf(str(urdf)).inertias
    assert [link.mass for link in model.links] == pytest.approx([body.mass for body in list(masses)[1:]], rel=1e-3)
    assert [link.mass for link in lightest.links] != pytest.approx([link.mass for link in model.links], rel=0.1)
    assert model.choice == "the physical arm nearest to the masses in arm.urdf"


@pytest.mark.parametrize("mass", ["-1", "heavy"])
def test_masses_that_no_body_has_are_not_taken(mass: str, tmp_path: Path) -> None:
    urdf, config = tmp_path / "arm.urdf", tmp_path / "arm.yaml"
    text = random_urdf(np.random.default_rng(11), 3, right_angles=True)
    urdf.write_text(re.sub(r'(<link name="link_2"><inertial><mass value=)"[^"]*"', rf'\1"{mass}"', text))
    config.write_text(configuration(urdf, 3, np.array(TILTED)))
    robot = load_robot(config)
    model = exported(robot, random_theta(arm_model(robot), 1)).in_frames_of(SourceUrdf(urdf))
    assert model.choice == "the lightest physical arm"


@pytest.mark.parametrize("right_angles", [True, False])
@pytest.mark.parametrize("seed", range(8))
def test_a_urdf_with_another_base_takes_the_inertias_of_an_arm_without_urdf(
    seed: int, right_angles: bool, tmp_path: Path
) -> None:
    rng, urdf, config = np.random.default_rng(seed), tmp_path / "arm.urdf", tmp_path / "arm.yaml"
    text = random_urdf(rng, 4, right_angles)
    urdf.write_text(text)
    config.write_text(configuration(urdf, 4, np.array(TILTED)))
    robot = load_robot(config)
    on_table = '<link name="table"/><joint name="bolts" type="fixed"><parent link="table"/><child link="base"/>'
    urdf.write_text(text.replace("</robot>", f'{on_table}<origin xyz="0.3 -0.2 0.7" rpy="0.4 -1 2"/></joint></robot>'))
    model = exported(robot, random_theta(arm_model(robot), seed)).in_frames_of(source_for(robot, urdf))
    assert model.frames.base == "table"
    arm = pin.buildModelFromUrdf(str(written(model, "urdf", tmp_path)))
    arm.gravity.linear = model.frames.gravity
    motion = random_motion(robot, rng)
    assert relative_error(pinocchio_torque(arm, motion), rigid_torque(model, motion)) < TOLERANCE


def written(model: ExportedModel, format_name: str, folder: Path) -> Path:
    """The main file of an export."""
    files, _ = export_model(model, format_name, folder / "out")
    return files[0]


def pinocchio_torque(arm: Any, motion: Motion) -> Floats:
    """Inverse dynamics (N, n) by Pinocchio; endless joints have a cosine and a sine as position."""
    data, rows = arm.createData(), []
    for q, qd, qdd in zip(*motion, strict=True):
        rows.append(pin.rnea(arm, data, pin.integrate(arm, pin.neutral(arm), q), qd, qdd))
    return np.array(rows)


def test_pinocchio_computes_our_torques_from_the_urdf(model: ExportedModel, motion: Motion, tmp_path: Path) -> None:
    arm = pin.buildModelFromUrdf(str(written(model, "urdf", tmp_path)))
    arm.gravity.linear = model.frames.gravity
    assert list(arm.names)[1:] == list(model.frames.joints)
    assert relative_error(pinocchio_torque(arm, motion), rigid_torque(model, motion)) < TOLERANCE


def test_pinocchio_computes_our_torques_from_its_archive(model: ExportedModel, motion: Motion, tmp_path: Path) -> None:
    arm = pin.Model()
    arm.loadFromXML(str(written(model, "pinocchio", tmp_path)), "model")
    assert all(arm.existFrame(link) for link in model.frames.links)
    rotors = [name for name in model.arm.names if name.startswith("ia") and name[2:].isdigit()]
    assert relative_error(pinocchio_torque(arm, motion), rigid_torque(model, motion, *rotors)) < TOLERANCE
    assert arm.damping == pytest.approx([joint.viscous for joint in model.joints])
    assert arm.friction == pytest.approx([joint.coulomb for joint in model.joints])
    assert arm.rotorInertia * arm.rotorGearRatio**2 == pytest.approx([joint.rotor_inertia for joint in model.joints])


def test_mujoco_computes_our_torques_with_rotors_viscous_friction_and_couplings(
    model: ExportedModel, motion: Motion, tmp_path: Path
) -> None:
    found = mujoco_torque(written(model, "mjcf", tmp_path), motion)
    assert relative_error(found, rigid_torque(model, motion, "ia", "fv")) < TOLERANCE


def test_mujoco_computes_our_torques_from_the_urdf(model: ExportedModel, motion: Motion, tmp_path: Path) -> None:
    found = mujoco_torque(written(model, "urdf", tmp_path), motion, model.frames.gravity)
    viscous = [name for name in model.arm.names if name.startswith("fv") and name[2:].isdigit()]
    assert relative_error(found, rigid_torque(model, motion, *viscous)) < TOLERANCE


@pytest.mark.slow
def test_drake_computes_our_torques_from_the_sdf(model: ExportedModel, motion: Motion, tmp_path: Path) -> None:
    file = written(model, "sdf", tmp_path)
    viscous = [name for name in model.arm.names if name.startswith("fv") and name[2:].isdigit()]
    rotors = [name for name in model.arm.names if name.startswith("ia") and name[2:].isdigit()]
    found = drake_torque(file, motion, model.frames)
    assert relative_error(found, rigid_torque(model, motion, *viscous, *rotors)) < TOLERANCE
    # Drake has no dry friction; Gazebo reads it from this tag.
    tags = [joint.findtext("axis/dynamics/friction") for joint in ET.parse(file).iter("joint")]
    assert [float(tag) for tag in tags if tag] == pytest.approx([joint.coulomb for joint in model.joints])


def drake_torque(file: Path, motion: Motion, frames: LinkFrames) -> Floats:
    """Inverse dynamics (N, n) by Drake, which reads SDF with the library of Gazebo."""
    from pydrake.multibody.parsing import Parser
    from pydrake.multibody.plant import MultibodyPlant
    from pydrake.multibody.tree import MultibodyForces

    plant = MultibodyPlant(time_step=0.0)
    Parser(plant).AddModels(str(file))
    plant.mutable_gravity_field().set_gravity_vector(frames.gravity)
    plant.Finalize()
    context = plant.CreateDefaultContext()
    order = [plant.GetJointByName(name).velocity_start() for name in frames.joints]
    rows = []
    for values in zip(*motion, strict=True):
        q, qd, qdd = np.zeros((3, len(order)))
        q[order], qd[order], qdd[order] = values
        plant.SetPositions(context, q)
        plant.SetVelocities(context, qd)
        forces = MultibodyForces(plant)
        plant.CalcForceElementsContribution(context, forces)
        rows.append(plant.CalcInverseDynamics(context, qdd, forces)[order])
    return np.array(rows)


def test_gravity_of_the_file_points_as_in_the_model(model: ExportedModel, tmp_path: Path) -> None:
    root = ET.parse(written(model, "mjcf", tmp_path)).getroot()
    option = root.find("option")
    assert option is not None
    gravity = np.array([float(word) for word in option.get("gravity", "").split()])
    assert gravity == pytest.approx(np.array(TILTED))
