"""Modules beside an exported file: with their torques, the program that reads the file has those of the model."""

import re
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from numpy.typing import NDArray

from armident.configs import RobotConfig, load_robot
from armident.configs.schema.robot import Effect
from armident.identify.effects.terms import arm_model
from armident.identify.model_export.exported_model import ExportedModel
from armident.identify.model_export.formats import export_model
from armident.identify.model_export.sheet import LimitationSheet
from armident.identify.model_export.source_urdf import source_for
from armident.identify.model_export.verification import motion_of
from tests.model_exports import exported, random_motion, random_theta, relative_error
from tests.tools.export_figures import model_with
from tests.urdf_chains import configuration, random_urdf

Floats = NDArray[np.float64]

ROUNDING_PCT = 1e-7
"""Largest difference of torques that are the same formulas in another order, percent."""

TILTED = (1.5, -3.0, -9.0)
"""Gravity of an arm on a tilted base, m/s^2."""


def sheet_of(model: ExportedModel, format_name: str, folder: Path) -> LimitationSheet:
    """The sheet of an export with its figures."""
    return export_model(model, format_name, folder, motion_of(model))[1]


def figures(sheet: LimitationSheet) -> tuple[float, float]:
    """Torque differences without and with the module, percent."""
    assert sheet.measured is not None
    assert sheet.measured.error_pct is not None, sheet.measured.missing
    assert sheet.measured.error_pct_with_supplement is not None
    return sheet.measured.error_pct, sheet.measured.error_pct_with_supplement


def of_python(model: ExportedModel, folder: Path) -> float:
    """Torque difference of the Python module of the whole model, percent."""
    measured = sheet_of(model, "python", folder).measured
    assert measured is not None
    assert measured.error_pct is not None
    return measured.error_pct


def tx40_with(*effects: Effect, values: tuple[float, ...]) -> ExportedModel:
    """A random TX40 on a tilted base, with a coupling, whose effects have these linear parameters."""
    robot: RobotConfig = load_robot("tx40").model_copy(update={"effects": effects, "gravity": TILTED})
    arm = arm_model(robot)
    theta = random_theta(arm, 5)
    theta[len(arm.names) - arm.e :] = values
    return exported(robot, theta)


@pytest.fixture(scope="module")
def tx40() -> ExportedModel:
    """An arm with every kind of part that some format cannot hold."""
    return tx40_with(
        Effect(effect="load_dependent_friction", joint="joint_2", parameters={"rotor": 0.0}),
        Effect(effect="rotor_inertia", joint="joint_3"),
        Effect(effect="joint_spring", joint="joint_2"),
        Effect(effect="friction_drift", joint="joint_1", parameters={"time_constant": 1.5}),
        values=(0.05, 0.3, 20.0, 2.0, 1.0),
    )


@pytest.mark.parametrize("format_name", ["urdf", "pinocchio", pytest.param("sdf", marks=pytest.mark.slow)])
def test_a_file_and_its_module_are_as_exact_as_the_whole_python_module(
    format_name: str, tx40: ExportedModel, tmp_path: Path
) -> None:
    alone, with_supplement = figures(sheet_of(tx40, format_name, tmp_path))
    assert alone > 1.0
    assert with_supplement == pytest.approx(of_python(tx40, tmp_path), abs=ROUNDING_PCT)
    assert with_supplement < 0.01


@pytest.mark.parametrize("right_angles", [True, False])
def test_the_module_is_right_in_the_frames_of_a_urdf(right_angles: bool, tmp_path: Path) -> None:
    urdf, config = tmp_path / "arm.urdf", tmp_path / "arm.yaml"
    urdf.write_text(random_urdf(np.random.default_rng(11), 5, right_angles))
    config.write_text(configuration(urdf, 5, np.array(TILTED)))
    robot = load_robot(config)
    model = exported(robot, random_theta(arm_model(robot), 5)).in_frames_of(source_for(robot, urdf))
    assert figures(sheet_of(model, "urdf", tmp_path / "out"))[1] < ROUNDING_PCT


@pytest.mark.parametrize(("law", "more"), [("", ()), ("vertical_joint", (0.1, 0.2))])
def test_the_module_has_a_payload_and_a_tilt_that_the_file_lacks(
    law: str, more: tuple[float, ...], tmp_path: Path
) -> None:
    model = tx40_with(
        Effect(effect="payload", joint="joint_6"),
        Effect(effect="friction_change", joint="joint_2"),
        Effect(effect="gravity_direction", law=law, joint="joint_1"),
        values=(*(0.02, 0.0, 0.0, 0.02, 0.0, 0.02, 0.0, 0.0, 0.1, 1.0), 0.5, 2.0, 0.02, -0.01, *more),
    )
    found = figures(sheet_of(model, "pinocchio", tmp_path))[1]
    # The payload is tilted in the code and not in the model.
    assert found == pytest.approx(of_python(model, tmp_path), abs=ROUNDING_PCT)
    assert found < 0.5


@pytest.mark.slow
def test_drake_needs_the_same_module_beside_a_urdf_as_pinocchio(tmp_path: Path) -> None:
    from pydrake.multibody.parsing import Parser
    from pydrake.multibody.plant import MultibodyPlant
    from pydrake.multibody.tree import MultibodyForces

    model = tx40_with(Effect(effect="joint_spring", joint="joint_2"), values=(20.0,))
    file, supplement, _ = export_model(model, "urdf", tmp_path)[0]
    plant = MultibodyPlant(time_step=0.0)
    Parser(plant).AddModels(str(file))
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName(model.frames.base))
    plant.mutable_gravity_field().set_gravity_vector(model.frames.gravity)
    plant.Finalize()
    context, module = plant.CreateDefaultContext(), module_of(supplement)
    motion, rows = random_motion(model.robot, np.random.default_rng(7)), []
    for q, qd, qdd in zip(*motion, strict=True):
        plant.SetPositions(context, q)
        plant.SetVelocities(context, qd)
        forces = MultibodyForces(plant)
        plant.CalcForceElementsContribution(context, forces)
        rows.append(plant.CalcInverseDynamics(context, qdd, forces) + module.supplement(q, qd, qdd))
    assert relative_error(np.array(rows), model.model.inverse_dynamics(*motion, dt=1e-3)) < 1e-9


@pytest.mark.slow
def test_drake_has_an_elastic_joint_as_two_joints(tmp_path: Path) -> None:
    model = model_with("joint_elasticity")
    sheet = sheet_of(model, "sdf", tmp_path)
    assert any("an elastic joint" in part for part in sheet.held)
    # Without the second joint, the torques would lack the effect, 1.5 %.
    assert figures(sheet)[1] < 0.45


def test_mujoco_gets_the_effects_alone_that_it_lacks(tmp_path: Path) -> None:
    model = model_with("load_dependent_friction")
    files, sheet = export_model(model, "mjcf", tmp_path, motion_of(model))
    assert [file.name for file in files] == ["tx40.xml", "tx40_mjcf_supplement.py", "tx40_mjcf_limits.md"]
    alone, with_supplement = figures(sheet)
    assert with_supplement < 1.0 < alone
    q, qd, _ = np.random.default_rng(1).uniform(-1.0, 1.0, (3, 6)).tolist()
    # Friction that the file has is not counted twice: joints without the effect have no torque.
    found = module_of(files[1]).supplement(q, qd, [0.0] * 6)
    assert [k for k, torque in enumerate(found) if torque] == [1]


def test_a_file_that_lacks_nothing_has_no_module(tmp_path: Path) -> None:
    files, sheet = export_model(model_with(""), "mjcf", tmp_path)
    assert [file.name for file in files] == ["tx40.xml", "tx40_mjcf_limits.md"]
    assert not any("supplement" in remark for remark in sheet.remarks)


def test_the_page_names_the_module_its_figure_and_its_gaps(tmp_path: Path) -> None:
    model = tx40_with(Effect(effect="time_delay", joint="joint_2"), values=(1e-3,))
    sheet = sheet_of(model, "urdf", tmp_path)
    page = (tmp_path / "tx40_urdf_limits.md").read_text()
    assert re.search(r"and by [0-9.]+ % with the torques of tx40_urdf_supplement\.py", page)
    assert "tx40_urdf_supplement.py computes the torques that the file lacks" in page
    assert "not: a delay of the recorded torque (time_delay) of joint_2" in page
    assert sheet.document()["measured"]["supplement"] == "tx40_urdf_supplement.py"
    assert figures(sheet)[1] < figures(sheet)[0]


def module_of(file: Path) -> ModuleType:
    """A generated module, which needs nothing but ``math``."""
    text = file.read_text()
    assert set(re.findall(r"^(?:from|import) (\w+)", text, re.MULTILINE)) == {"math"}
    module = ModuleType("generated")
    exec(compile(text, file.name, "exec"), vars(module))
    return module
