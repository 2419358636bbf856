"""An FMU, run by FMPy: its motion is that of the model's forward dynamics."""

import shutil
import subprocess
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from armident.configs import ConfigError, load_robot
from armident.identify.effects.terms import arm_model
from armident.identify.model_export.exported_model import ExportedModel
from armident.identify.model_export.formats import export_model
from tests.model_exports import exported
from tests.pinocchio_oracle import random_parameters

Floats = NDArray[np.float64]

STEP = 0.005
"""Communication step, s: torques change at that rate."""

TOLERANCE = 1e-6
"""Largest difference of positions (rad) and velocities (rad/s) in 0.2 s."""

EXACT = 1e-10
"""Tolerance of the integration in one step; friction that reverses in a millisecond multiplies it."""


@pytest.fixture(scope="module")
def model() -> ExportedModel:
    """The TX40 with random parameters, friction included."""
    robot = load_robot("tx40")
    return exported(robot, random_parameters(arm_model(robot), np.random.default_rng(5), friction=True))


@pytest.fixture(scope="module")
def fmu(model: ExportedModel, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return export_model(model, "fmu", tmp_path_factory.mktemp("fmu") / "arm.fmu")[0][0]


def names(model: ExportedModel, *kinds: str) -> list[str]:
    """Names of variables of all joints."""
    return [f"{kind}_{joint.name}" for kind in kinds for joint in model.joints]


@contextmanager
def running(fmu: Path, folder: Path) -> Iterator[tuple[Any, dict[str, int]]]:
    """The instance of an FMU in its initialisation, and value references by name."""
    fmpy = pytest.importorskip("fmpy")
    description = fmpy.read_model_description(str(fmu), validate=True)
    slave = fmpy.fmi2.FMU2Slave(
        guid=description.guid,
        unzipDirectory=fmpy.extract(str(fmu), unzipdir=str(folder)),
        modelIdentifier=description.coSimulation.modelIdentifier,
        instanceName="arm",
    )
    slave.instantiate()
    slave.setupExperiment(startTime=0.0, tolerance=EXACT)
    slave.enterInitializationMode()
    try:
        yield slave, {v.name: v.valueReference for v in description.modelVariables}
    finally:
        slave.terminate()
        slave.freeInstance()


def integrated(model: ExportedModel, state: Floats, torques: Floats) -> Floats:
    """States (N, 2 n) of the model after each of N steps with constant torques, by scipy."""
    n, rows, forward = model.arm.n, [], model.model.forward_dynamics

    def rate(_: float, x: Floats, tau: Floats) -> Floats:
        ddq = forward(x[None, :n], x[None, n:], tau[None])
        return np.concatenate([x[n:], ddq[0]])

    for tau in torques:
        found = solve_ivp(rate, (0.0, STEP), state, args=(tau,), method="LSODA", rtol=EXACT, atol=EXACT)
        state = found.y[:, -1]
        rows.append(state)
    return np.array(rows)


@pytest.mark.slow
def test_an_fmu_moves_as_the_forward_dynamics_of_the_model(model: ExportedModel, fmu: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    q, dq = rng.uniform(-1.0, 1.0, (2, model.arm.n))
    torques = rng.uniform(-20.0, 20.0, (40, model.arm.n))
    with running(fmu, tmp_path) as (slave, reference):
        inputs, outputs = ([reference[name] for name in names(model, *kinds)] for kinds in (("tau",), ("q", "dq")))
        slave.setReal(outputs, [*q, *dq])
        slave.exitInitializationMode()
        rows = []
        for k, tau in enumerate(torques):
            slave.setReal(inputs, tau.tolist())
            slave.doStep(currentCommunicationPoint=k * STEP, communicationStepSize=STEP)
            rows.append(slave.getReal(outputs))
        acceleration = slave.getReal([reference[name] for name in names(model, "ddq")])
    expected = integrated(model, np.concatenate([q, dq]), torques)
    assert np.abs(np.array(rows) - expected).max() < TOLERANCE
    last = expected[-1][None]
    ddq = model.model.forward_dynamics(last[:, :6], last[:, 6:], torques[-1:])[0]
    assert acceleration == pytest.approx(ddq, rel=1e-3, abs=1e-2)


def test_fmpy_validates_and_simulates_an_fmu(model: ExportedModel, fmu: Path) -> None:
    fmpy, validation = pytest.importorskip("fmpy"), pytest.importorskip("fmpy.validation")
    assert validation.validate_fmu(str(fmu)) == []
    found = fmpy.simulate_fmu(str(fmu), stop_time=0.1, output_interval=0.01, start_values={"q_joint_2": 0.5})
    assert found["q_joint_2"][0] == 0.5
    # Without torque, the arm falls.
    assert abs(found["dq_joint_2"][-1]) > 0.01


def test_a_state_of_an_fmu_can_be_kept_and_restored(model: ExportedModel, fmu: Path, tmp_path: Path) -> None:
    with running(fmu, tmp_path) as (slave, reference):
        slave.exitInitializationMode()
        position = [reference[name] for name in names(model, "q")]
        slave.doStep(currentCommunicationPoint=0.0, communicationStepSize=0.05)
        kept, here = slave.getFMUstate(), slave.getReal(position)
        slave.doStep(currentCommunicationPoint=0.05, communicationStepSize=0.05)
        assert slave.getReal(position) != here
        slave.setFMUstate(kept)
        assert slave.getReal(position) == here
        slave.freeFMUstate(kept)


def test_the_sources_of_an_fmu_compile_without_a_warning(fmu: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(fmu) as archive:
        archive.extractall(tmp_path)
    files = sorted(map(str, (tmp_path / "sources").glob("*.c")))
    strict = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror"]
    subprocess.run(["gcc", *strict, "-c", *files], cwd=tmp_path, check=True)


@pytest.mark.slow
def test_equal_models_give_equal_units(model: ExportedModel, fmu: Path, tmp_path: Path) -> None:
    again = export_model(model, "fmu", tmp_path / "arm.fmu")[0][0]
    with zipfile.ZipFile(again) as one, zipfile.ZipFile(fmu) as other:
        assert one.read("modelDescription.xml") == other.read("modelDescription.xml")


def test_without_a_compiler_the_refusal_is_one_line(
    model: ExportedModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.raises(ConfigError, match="needs a C compiler: install gcc, or use --format c"):
        export_model(model, "fmu", tmp_path / "arm.fmu")
    assert not (tmp_path / "arm.fmu").exists()
