"""Links that move relative to their motors, by elasticity or backlash, in generated code."""

import ctypes
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from armident.configs import load_robot
from armident.configs.schema.robot import Effect
from armident.identify.effects.terms import arm_model
from armident.identify.model_export.consumers import GivenMotion, module_torque, run_c
from armident.identify.model_export.exported_model import ExportedModel
from armident.identify.model_export.formats import export_model
from armident.identify.model_export.formulas import instant_model
from armident.identify.model_export.verification import IMPACT_BAND_HZ, identified_torque, motion_of
from armident.identify.signals.bandpass import butterworth
from tests.model_exports import exported
from tests.tools.export_figures import EFFECTS, model_with
from tests.unit.identify.model_export.test_code import compiled

Floats = NDArray[np.float64]

CLOSE = 0.003
"""Largest difference of torques relative to those of the effect: deflections are no differentials."""

OF_MOTOR_PCT = 0.5
"""Largest difference of torques if a hundredth of the largest inertia of a joint moves to its motor, percent: the
effects have 1.4 % and 9.7 % of the torque."""

GEARS = [name for name in EFFECTS if name.startswith(("joint_elasticity", "backlash"))]

SAMPLES, SETTLED = 1000, 500
"""Samples of a motion, and those in which it begins."""

LINK_KG, MOTOR_KG = 76.0, 19.0
"""Masses of an axis with a gear between motor and slide."""

RESONANCE_HZ, DAMPING, GAP_M = 15.0, 0.1, 2e-3

STEP_S, DURATION_S = 1e-3, 0.6
"""Communication step and duration of a simulation, s."""


@pytest.fixture(params=GEARS)
def model(request: pytest.FixtureRequest) -> ExportedModel:
    """A TX40 with one such effect at its second joint."""
    return model_with(request.param)


def short_motion(model: ExportedModel) -> GivenMotion:
    motion = motion_of(model)
    return replace(motion, q=motion.q[:SAMPLES], qd=motion.qd[:SAMPLES], qdd=motion.qdd[:SAMPLES])


def of_effect(model: ExportedModel, motion: GivenMotion) -> Floats:
    """Torques (N, n) of the effect in the model."""
    rigid = model.arm.inverse_dynamics(model.theta, motion.q, motion.qd, motion.qdd)
    return identified_torque(model, motion, model.theta) - rigid


def error(found: Floats, expected: Floats, size: Floats) -> float:
    """Difference over size after the beginning; the instants of impacts are not compared."""
    missing, size = (butterworth(each, STEP_S, IMPACT_BAND_HZ)[SETTLED:] for each in (found - expected, size))
    return float(np.linalg.norm(missing) / np.linalg.norm(size))


def test_c_has_the_torques_of_the_model(model: ExportedModel, tmp_path: Path) -> None:
    motion, files = short_motion(model), export_model(model, "c", tmp_path)[0]
    found = run_c(model, files, motion).torque
    assert error(found, identified_torque(model, motion, model.theta), of_effect(model, motion)) < CLOSE


@pytest.mark.parametrize("name", ["joint_elasticity with its motor", "backlash with its motor"])
def test_the_module_beside_a_file_has_the_torques_of_the_effect_alone(name: str, tmp_path: Path) -> None:
    model = model_with(name)
    # A body of MuJoCo cannot be without the inertia of the motor.
    files, motion = export_model(model, "mjcf", tmp_path)[0], short_motion(model)
    assert files[1].name == "tx40_mjcf_supplement.py"
    effect = of_effect(model, motion)
    assert error(module_torque(files[1], motion), effect, effect) < CLOSE


def test_forward_dynamics_undo_inverse_dynamics_with_the_same_states(tmp_path: Path) -> None:
    for name in ("joint_elasticity with its motor", "backlash with its motor"):
        model = model_with(name)
        library, vector = compiled(model, tmp_path), ctypes.c_double * 6
        q, dq, ddq = (vector(*row) for row in np.random.default_rng(2).uniform(-1.0, 1.0, (3, 6)))
        memory, tau, again = (ctypes.c_double * 5)(), vector(), vector()
        for _ in range(3):
            library.tx40_advance(memory, q, dq, ddq, ctypes.c_double(1e-3))
        library.tx40_inverse_dynamics(q, dq, ddq, memory, tau)
        assert library.tx40_forward_dynamics(q, dq, tau, memory, again) == 0
        assert list(again) == pytest.approx(list(ddq), abs=1e-9)


def test_a_link_without_inertia_moves_in_no_gear() -> None:
    model = model_with("backlash")
    heavy = Effect(effect="backlash", joint="joint_2", parameters={"gap": 2e-4, "rotor": 100.0})
    arm = arm_model(model.robot.model_copy(update={"effects": (heavy,)}))
    assert not instant_model(arm, model.theta, 1.0).held


@pytest.mark.parametrize("name", ["joint_elasticity", "backlash"])
def test_an_fmu_takes_the_inertia_of_a_motor_from_its_link(name: str, tmp_path: Path) -> None:
    pytest.importorskip("fmpy")
    model = model_with(name)
    files, sheet = export_model(model, "fmu", tmp_path, short_motion(model))
    assert not any("supplement" in file.name for file in files)
    assert any("1% of the largest inertia of the joint moves from the link to the motor" in r for r in sheet.remarks)
    assert not sheet.omitted
    assert sheet.measured is not None
    assert sheet.measured.error_pct is not None
    assert sheet.measured.error_pct < OF_MOTOR_PCT


def test_c_names_the_inertia_that_forward_dynamics_lack(tmp_path: Path) -> None:
    _, sheet = export_model(model_with("joint_elasticity"), "c", tmp_path)
    assert any("forward dynamics need an inertia of the motor" in remark for remark in sheet.remarks)
    assert not sheet.omitted


def test_an_fmu_leaves_out_a_link_that_its_gear_would_push_away(tmp_path: Path) -> None:
    model = model_with("joint_elasticity")
    theta = model.theta.copy()
    theta[-1] *= -1.0
    _, sheet = export_model(exported(model.robot, theta), "fmu", tmp_path)
    assert any("an elastic joint" in omission.part for omission in sheet.omitted)


def force(t: float) -> float:
    return 60.0 * float(np.sin(4.0 * np.pi * t)) + 40.0 * float(np.sin(10.0 * np.pi * t + 1.0))


def two_masses(name: str, viscous: float, parts: int = 500) -> Floats:
    """Motor positions (N,), m, of a motor that drives a slide through a spring or a gap, in short Euler steps."""
    dt, way, rate, found = STEP_S / parts, 0.0, 0.0, []
    stiffness = LINK_KG * (2.0 * np.pi * RESONANCE_HZ) ** 2
    damping = 2.0 * DAMPING * 2.0 * np.pi * RESONANCE_HZ * LINK_KG
    elastic = name == "joint_elasticity"
    # At the beginning the link hangs behind the first acceleration.
    x, v = -LINK_KG * force(0.0) / (LINK_KG + MOTOR_KG) / stiffness if elastic else -0.5 * GAP_M, 0.0
    for k in range(round(DURATION_S / STEP_S)):
        for _ in range(parts):
            pushed = force(k * STEP_S) - viscous * rate
            together = pushed / (LINK_KG + MOTOR_KG)
            if elastic:
                spring = stiffness * x + damping * v
                a, link = (pushed + spring) / MOTOR_KG, -spring / LINK_KG
            elif abs(x) >= 0.5 * GAP_M and v == 0.0 and together * x < 0.0:
                a = link = together
            else:
                a, link = pushed / MOTOR_KG, 0.0
            rate, v = rate + dt * a, v + dt * (link - a)
            way, x = way + dt * rate, x + dt * v
            if not elastic and abs(x) >= 0.5 * GAP_M and v * x > 0.0:  # plastic: the momentum remains
                rate, v, x = rate + v * LINK_KG / (LINK_KG + MOTOR_KG), 0.0, float(np.copysign(0.5 * GAP_M, x))
        found.append(way)
    return np.array(found)


@pytest.mark.parametrize(
    ("name", "shapes", "tolerance"),
    [
        ("joint_elasticity", {"frequency": RESONANCE_HZ, "damping": DAMPING}, 0.002),
        ("backlash", {"gap": GAP_M}, 0.01),
    ],
)
def test_an_fmu_moves_as_two_masses(name: str, shapes: dict[str, float], tolerance: float, tmp_path: Path) -> None:
    fmpy, viscous = pytest.importorskip("fmpy"), 200.0
    effect = Effect(effect=name, joint="joint_1", parameters={**shapes, "rotor": MOTOR_KG})
    robot = load_robot("emps").model_copy(update={"effects": (effect,)})
    arm = arm_model(robot)
    theta = np.zeros(len(arm.names))
    theta[[arm.names.index("m1"), arm.names.index("fv1")]] = LINK_KG + MOTOR_KG, viscous
    theta[-1] = 1.0 if name == "backlash" else 1.0 / (LINK_KG * (2.0 * np.pi * RESONANCE_HZ) ** 2)
    file = export_model(exported(robot, theta), "fmu", tmp_path)[0][0]
    description = fmpy.read_model_description(str(file))
    unit = fmpy.fmi2.FMU2Slave(
        guid=description.guid,
        unzipDirectory=fmpy.extract(str(file), unzipdir=str(tmp_path / "unit")),
        modelIdentifier=description.coSimulation.modelIdentifier,
        instanceName="axis",
    )
    unit.instantiate()
    unit.setupExperiment(startTime=0.0)
    unit.enterInitializationMode()
    unit.exitInitializationMode()
    found = []
    for k in range(round(DURATION_S / STEP_S)):
        unit.setReal([0], [force(k * STEP_S)])
        unit.doStep(currentCommunicationPoint=k * STEP_S, communicationStepSize=STEP_S)
        found.append(unit.getReal([1])[0])
    unit.terminate()
    unit.freeInstance()
    expected = two_masses(name, viscous)
    assert np.linalg.norm(np.array(found) - expected) < tolerance * np.linalg.norm(expected)
