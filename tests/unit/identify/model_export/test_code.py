"""Generated Python, C and CSV: compiled and called, they give the torques of the model with its effects."""

import csv
import ctypes
import re
import subprocess
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from armident.configs import RobotConfig, load_robot
from armident.configs.schema.robot import Effect as Entry
from armident.identify.effects.registry import catalogue
from armident.identify.effects.terms import arm_model
from armident.identify.effects.wiring import SignalMistake
from armident.identify.model_export.exported_model import ExportedModel
from armident.identify.model_export.formats import export_model
from armident.identify.model_export.formulas import hat, instant_model
from tests.model_exports import exported, random_motion, relative_error
from tests.pinocchio_oracle import random_parameters
from tests.urdf_chains import configuration, random_urdf

Floats = NDArray[np.float64]

TOLERANCE = 1e-12
"""Largest difference of torques, relative to the largest of the joint: rounding of another order of operations."""

NO_FORMULA = {"time_delay", "actuator_bandwidth", "encoder_eccentricity", "unnamed/time", "unnamed/time_and_direction"}
"""Effects with derivatives of the torque, or of the time of the recordings."""

STATES = {"presliding_friction", "friction_drift", "friction_drift/work"}
"""Effects with a state that relaxes."""

GEARS = {"joint_elasticity", "backlash"}
"""Effects with a link that moves relative to its motor."""

MEMORYLESS = {key for key, effect in catalogue().items() if not isinstance(effect, SignalMistake)}
MEMORYLESS -= NO_FORMULA | STATES | GEARS
"""All others: their torque depends on the present instant alone."""

RECORDED_S = 20.0
"""Duration of the recordings of the identification, s."""


def with_effect(robot: RobotConfig, key: str, *others: str) -> RobotConfig:
    """The robot with effects of the catalogue at its second joint, and third where there are two."""
    return robot.model_copy(update={"effects": tuple(_entry(robot, each) for each in (key, *others))})


def _entry(robot: RobotConfig, key: str) -> Entry:
    effect = catalogue()[key]
    shapes = {s.name: 0.5 if s.default is None else s.default for s in effect.shapes}
    if "low" in shapes:
        shapes |= {"low": -1.5, "high": 1.5}
    other = robot.joints[2].name if effect.two_joints else None
    return Entry(effect=effect.name, law=effect.law, joint=robot.joints[1].name, other=other, parameters=shapes)


def parameters(robot: RobotConfig, rng: np.random.Generator) -> Floats:
    """Standard parameters of a physical arm, with couplings and effects of moderate size."""
    arm = arm_model(robot)
    theta = random_parameters(arm, rng, friction=True)
    rigid = len(theta) - arm.e
    theta[arm.columns.coupling] = rng.uniform(0.05, 0.1, arm.columns.coupling.shape)
    theta[rigid:] = rng.uniform(0.02, 0.2, arm.e)
    return theta


@pytest.fixture(params=("tx40", "panda", "emps", "urdf"))
def model(request: pytest.FixtureRequest, tmp_path: Path) -> ExportedModel:
    """An arm with random parameters on a tilted base; one has skew axes and a prismatic joint, one a coupling."""
    if request.param == "urdf":
        urdf = tmp_path / "arm.urdf"
        urdf.write_text(random_urdf(np.random.default_rng(11), 5, right_angles=False))
        config = tmp_path / "arm.yaml"
        config.write_text(configuration(urdf, 5, np.array([1.5, -3.0, -9.0])))
        robot = load_robot(config)
    else:
        robot = load_robot(request.param).model_copy(update={"gravity": (1.5, -3.0, -9.0)})
    return exported(robot, parameters(robot, np.random.default_rng(5)))


def python_torque(model: ExportedModel, folder: Path, motion: tuple[Floats, Floats, Floats]) -> Floats:
    """Torques (N, n) of the generated Python module."""
    text = export_model(model, "python", folder / "model.py")[0][0].read_text()
    assert set(re.findall(r"^(?:from|import) (\w+)", text, re.MULTILINE)) == {"math"}
    module = ModuleType("generated")
    exec(compile(text, "model.py", "exec"), vars(module))
    return np.array([module.inverse_dynamics(*(x.tolist() for x in row)) for row in zip(*motion, strict=True)])


def compiled(model: ExportedModel, folder: Path) -> Any:
    """The generated C source as a library, compiled with all warnings as errors."""
    source, header, _ = export_model(model, "c", folder / "model.c")[0]
    assert header.suffix == ".h"
    library = folder / "model.so"
    strict = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O2"]
    subprocess.run(["gcc", *strict, "-shared", "-fPIC", str(source), "-o", str(library), "-lm"], check=True)
    return ctypes.CDLL(str(library))


def c_call(library: Any, model: ExportedModel, name: str, motion: tuple[Floats, Floats, Floats]) -> Floats:
    """Results (N, n) of a function of the generated C source along a motion."""
    function, rows = getattr(library, f"{model.robot.name}_{name}"), []
    for row in zip(*motion, strict=True):
        out = (ctypes.c_double * model.arm.n)()
        assert not function(*((ctypes.c_double * model.arm.n)(*x) for x in row), out) or name == "inverse_dynamics"
        rows.append(list(out))
    return np.array(rows)


def expected(model: ExportedModel, motion: tuple[Floats, Floats, Floats]) -> Floats:
    """Torques (N, n) of the model, its effects included."""
    return model.model.inverse_dynamics(*motion, dt=1e-3)


def test_generated_python_and_c_have_the_torques_of_the_model(model: ExportedModel, tmp_path: Path) -> None:
    motion = random_motion(model.robot, np.random.default_rng(7))
    assert relative_error(python_torque(model, tmp_path, motion), expected(model, motion)) < TOLERANCE
    library = compiled(model, tmp_path)
    assert relative_error(c_call(library, model, "inverse_dynamics", motion), expected(model, motion)) < TOLERANCE


def test_generated_forward_dynamics_are_those_of_the_model(model: ExportedModel, tmp_path: Path) -> None:
    q, qd, _ = random_motion(model.robot, np.random.default_rng(7))
    tau = np.random.default_rng(8).uniform(-20.0, 20.0, q.shape)
    found = c_call(compiled(model, tmp_path), model, "forward_dynamics", (q, qd, tau))
    # Rounding grows with the condition of the mass matrix.
    worst = float(np.linalg.cond(model.arm.mass_matrix(model.theta, q)).max())
    assert relative_error(found, model.arm.forward_dynamics(model.theta, q, qd, tau)) < 1e-14 * worst + 1e-12


@pytest.mark.parametrize("key", sorted(MEMORYLESS))
def test_an_effect_without_memory_has_formulas(key: str) -> None:
    robot = with_effect(load_robot("tx40"), key)
    arm = arm_model(robot)
    found = instant_model(arm, parameters(robot, np.random.default_rng(5)), RECORDED_S)
    assert (found.held, len(found.memory)) == (frozenset({0}), 0)


@pytest.mark.parametrize("key", sorted(NO_FORMULA))
def test_an_effect_of_more_than_an_instant_has_none(key: str) -> None:
    robot = with_effect(load_robot("tx40"), key)
    found = instant_model(arm_model(robot), parameters(robot, np.random.default_rng(5)), RECORDED_S)
    assert (found.held, found.torques) == (frozenset(), {})


def test_bristles_and_slow_changes_are_states_that_relax() -> None:
    robot = with_effect(load_robot("tx40"), *sorted(STATES), "stribeck_friction")
    bristle = robot.effects[-1].model_copy(update={"parameters": {"velocity": 0.5, "displacement": 0.001}})
    robot = robot.model_copy(update={"effects": (*robot.effects[:-1], bristle)})
    found = instant_model(arm_model(robot), parameters(robot, np.random.default_rng(5)), RECORDED_S)
    assert (found.held, len(found.memory)) == (frozenset(range(4)), 4)
    assert [state.rate for state in found.memory] == [
        "1.0 / 0.5", "0.5 * dq[1] * dq[1]", "fabs(dq[1]) / 0.5", "fabs(dq[1]) / 0.001"
    ]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    "keys",
    [
        sorted(key for key in MEMORYLESS if not catalogue()[key].depends_on_torque and key != "payload"),
        sorted(key for key in MEMORYLESS if catalogue()[key].depends_on_torque and "gravity_direction" not in key),
        ["payload"],
        ["gravity_direction"],
        ["gravity_direction/vertical_joint"],
    ],
    ids=["of the motion", "of the torque", "payload", "gravity", "gravity on a vertical joint"],
)
def test_code_with_effects_has_the_torques_of_the_model(keys: list[str], tmp_path: Path) -> None:
    robot = with_effect(load_robot("tx40"), *keys)
    model = exported(robot, parameters(robot, np.random.default_rng(5)))
    motion = random_motion(robot, np.random.default_rng(7))
    assert relative_error(python_torque(model, tmp_path, motion), expected(model, motion)) < TOLERANCE
    library = compiled(model, tmp_path)
    found = c_call(library, model, "inverse_dynamics", motion)
    assert relative_error(found, expected(model, motion)) < TOLERANCE
    # Forward dynamics undo inverse dynamics, also where effects depend on the acceleration.
    again = c_call(library, model, "forward_dynamics", (*motion[:2], found))
    assert relative_error(again, motion[2]) < 1e-8


def test_what_code_cannot_hold_stands_on_the_sheet_and_in_the_file(tmp_path: Path) -> None:
    robot = with_effect(load_robot("tx40"), "encoder_eccentricity", "joint_spring")
    model = exported(robot, parameters(robot, np.random.default_rng(5)))
    files, sheet = export_model(model, "python", tmp_path / "model.py")
    assert ["encoder_eccentricity" in each.part for each in sheet.omitted] == [True]
    assert any("spring" in part for part in sheet.held)
    head = files[0].read_text().split('"""')[1]
    assert "Not in this file: an eccentric encoder" in " ".join(head.split())
    assert "SHA-256" in head


def test_load_dependent_friction_under_a_payload_carries_a_remark(tmp_path: Path) -> None:
    robot = with_effect(load_robot("tx40"), "payload", "load_dependent_friction")
    model = exported(robot, parameters(robot, np.random.default_rng(5)))
    _, sheet = export_model(model, "python", tmp_path / "model.py")
    assert any("computed from torques that include a payload" in remark for remark in sheet.remarks)


def test_the_table_has_every_standard_parameter(tmp_path: Path) -> None:
    robot = with_effect(load_robot("tx40"), "joint_spring")
    model = exported(robot, parameters(robot, np.random.default_rng(5)))
    with export_model(model, "csv", tmp_path / "model.csv")[0][0].open() as stream:
        rows = {row["name"]: row for row in csv.DictReader(stream)}
    assert tuple(rows) == model.arm.names
    assert [float(row["value"]) for row in rows.values()] == model.theta.tolist()
    assert rows["zz1"]["identifiable"] == "group"
    assert rows["m1"]["identifiable"] == "no"
    assert rows["m1"]["std"] == ""
    assert rows["ks2"]["unit"] == "N m/rad"
    assert float(rows["fv2"]["std"]) > 0.0


@pytest.mark.parametrize(
    ("x", "knots", "value"),
    [
        (0.5, (0, 1, 2), 0.5),
        (1.5, (0, 1, 2), 0.5),
        (3.0, (0, 1, 2), 0.0),
        (-9.0, (1, 1, 2), 1.0),
        (9.0, (1, 2, 2), 1.0),
    ],
)
def test_a_hat_is_flat_beyond_the_outermost_knots(x: float, knots: tuple[float, float, float], value: float) -> None:
    assert hat(x, *knots) == value
