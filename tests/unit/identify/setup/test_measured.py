"""The set-up of measured arms: no mistake as recorded, and mistakes that are made on purpose are found."""

from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat

from armident.configs import RobotConfig, load_robot
from armident.daq.interchange.importing import import_recording
from armident.identify.identification.from_recording import experiments_from_recording
from armident.identify.setup.check import check_setup
from armident.identify.signals.experiments import Experiment
from tests.fixtures import setups

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def robot() -> RobotConfig:
    return load_robot("tx40")


@pytest.fixture(scope="module")
def measured(shared_data: Path, robot: RobotConfig) -> list[Experiment]:
    folder = shared_data / "tx40"
    if not folder.is_dir():
        pytest.skip("no tx40 folder in the measured data")
    q, tau = (
        np.loadtxt(folder / name, delimiter=",", skiprows=1)[:37500] for name in ("pos_read_data.csv", "curr_data.csv")
    )
    ratios = robot.transmission_matrix
    joints = np.asarray(np.linalg.solve(ratios, q.T).T, dtype=np.float64)
    return [Experiment(joints, tau @ ratios, None, 2e-4)]


def test_the_set_up_of_the_measured_tx40_is_right(measured: list[Experiment], robot: RobotConfig) -> None:
    found = check_setup(measured, robot)
    assert found.findings == ()
    assert found.joints_not_understood == ()


@pytest.mark.nightly
def test_torques_exchanged_in_the_measured_tx40_are_found(measured: list[Experiment], robot: RobotConfig) -> None:
    order = setups.in_order(0, 2, 1, 3, 4, 5)
    found = check_setup(setups.with_torques(measured, order), robot)
    assert [(f.kind, f.joints) for f in found.findings] == [("joint_order", ("joint_2", "joint_3"))]


def test_the_set_up_of_the_measured_axis_is_right(shared_data: Path) -> None:
    file = shared_data / "emps" / "DATA_EMPS.mat"
    if not file.is_file():
        pytest.skip(f"no {file.name} in the measured data")
    data = loadmat(file)
    q, tau, demand = (data[name].astype(float).reshape(-1, 1) for name in ("qm", "vir", "qg"))
    experiments = [Experiment(q, 35.15065 * tau, demand, 1e-3)]
    axis = load_robot("emps")
    assert check_setup(experiments, axis).findings == ()
    found = check_setup(setups.with_torques(experiments, -np.eye(1)), axis)
    assert [f.kind for f in found.findings] == ["torque_sign"]


@pytest.mark.parametrize("number", [pytest.param(1, marks=pytest.mark.nightly), 3])
def test_the_set_up_of_the_measured_kuka_is_right(shared_data: Path, number: int) -> None:
    """Joints 5 and 6 carry little torque, and ripples that the model lacks leave half of it: no unit explains that."""
    file = shared_data / "kuka_lwr4" / f"measurements_{number}.npz"
    if not file.is_file():
        pytest.skip(f"no {file.name} in the measured data")
    robot = load_robot("kuka_lwr4")
    recording = import_recording(file, robot, rate_hz=200.0, names={"demand": "-"})
    assert check_setup(experiments_from_recording(recording, robot)[0], robot).findings == ()


def test_the_set_up_of_the_measured_panda_is_right(shared_data: Path) -> None:
    """Friction is most of the torque of joint 7, so that its unit of position changes little."""
    positions, torques = (shared_data / "panda" / f"exciting_traj_{name}.txt" for name in ("positions", "torques"))
    if not positions.is_file() or not torques.is_file():
        pytest.skip("no Panda in the measured data")
    robot = load_robot("panda")
    recording = import_recording(positions, robot, effort=torques, rate_hz=1000.0, polled=True)
    assert check_setup(experiments_from_recording(recording, robot)[0], robot).findings == ()
