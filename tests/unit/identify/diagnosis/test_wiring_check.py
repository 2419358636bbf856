"""Wrong signs and exchanged drives: detection in rewired recordings, none in correct ones."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat

from armident.configs import DataError, RobotConfig, load_robot
from armident.configs.schema.robot import Effect
from armident.identify.diagnosis.wiring_check import find_wiring
from armident.identify.effects.wiring import rewired
from armident.identify.experiment import Experiment
from armident.identify.identification.from_recording import experiments_from_recording
from tests.fixtures.arms import FAST, recording

pytestmark = pytest.mark.slow

POSITION, TORQUE, BOTH = {"position": 1.0}, {"torque": 1.0}, {"position": 1.0, "torque": 1.0}


def sign(joint: str, signals: dict[str, float]) -> Effect:
    return Effect(effect="sign_error", joint=joint, parameters=signals)


def order(joint: str, other: str, signals: dict[str, float]) -> Effect:
    return Effect(effect="joint_order", joint=joint, other=other, parameters=signals)


def mistaken(experiments: list[Experiment], robot: RobotConfig, *stanzas: Effect) -> list[Experiment]:
    """Experiments with wiring errors; each is its own inverse."""
    return rewired(experiments, robot.model_copy(update={"effects": stanzas}))


@pytest.fixture(scope="module")
def robot() -> RobotConfig:
    return load_robot("tx40")


@pytest.fixture(scope="module")
def virtual(robot: RobotConfig) -> list[Experiment]:
    data = recording("tx40", "tx40_excitation", 3, period=FAST)
    return experiments_from_recording(data, robot)[0]


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


@pytest.fixture(scope="module")
def emps(shared_data: Path) -> list[Experiment]:
    file = shared_data / "emps" / "DATA_EMPS.mat"
    if not file.is_file():
        pytest.skip(f"no {file.name} in the measured data")
    data = loadmat(file)
    q, tau, demand = (data[name].astype(float).reshape(-1, 1) for name in ("qm", "vir", "qg"))
    return [Experiment(q, 35.15065 * tau, demand, 1e-3)]


MISTAKES = [
    sign("joint_1", TORQUE),
    sign("joint_2", BOTH),
    sign("joint_3", POSITION),
    sign("joint_5", POSITION),
    sign("joint_6", TORQUE),
    order("joint_1", "joint_4", TORQUE),
    order("joint_3", "joint_4", POSITION),
    order("joint_1", "joint_2", BOTH),
]


@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda m: f"{m.effect}-{m.joint}-{'-'.join(m.parameters)}")
def test_a_single_mistake_is_named_and_undone(virtual: list[Experiment], robot: RobotConfig, mistake: Effect) -> None:
    wrong = mistaken(virtual, robot, mistake)
    found = find_wiring(wrong, robot)
    assert found is not None
    assert found.stanzas == (mistake,)
    assert found.p_values[0] < 0.01
    assert 2 * found.unexplained_after.sum() < found.unexplained_before.sum()
    assert mistake.joint in found.words[0]
    (undone,) = rewired(wrong, robot.model_copy(update={"effects": found.stanzas}))
    np.testing.assert_allclose(undone.q, virtual[0].q, atol=1e-12)
    np.testing.assert_allclose(undone.tau, virtual[0].tau, atol=1e-9)
    assert undone.q_ref is not None
    assert virtual[0].q_ref is not None
    np.testing.assert_allclose(undone.q_ref, virtual[0].q_ref, atol=1e-12)


def test_two_mistakes_are_both_named(virtual: list[Experiment], robot: RobotConfig) -> None:
    made = sign("joint_2", TORQUE), order("joint_1", "joint_4", TORQUE)
    found = find_wiring(mistaken(virtual, robot, *made), robot)
    assert found is not None
    assert set(s.effect for s in found.stanzas) == {"sign_error", "joint_order"}
    (undone,) = rewired(mistaken(virtual, robot, *made), robot.model_copy(update={"effects": found.stanzas}))
    np.testing.assert_allclose(undone.tau, virtual[0].tau, atol=1e-9)


def test_a_recording_as_it_should_be_is_left_alone(virtual: list[Experiment], robot: RobotConfig) -> None:
    assert find_wiring(virtual, robot) is None


def test_what_the_robot_names_already_is_not_found_again(virtual: list[Experiment], robot: RobotConfig) -> None:
    known = sign("joint_3", TORQUE)
    told = robot.model_copy(update={"effects": (known,)})
    assert find_wiring(mistaken(virtual, robot, known), told) is None


def test_the_measured_tx40_is_wired_well(measured: list[Experiment], robot: RobotConfig) -> None:
    assert find_wiring(measured, robot) is None


def test_signals_exchanged_in_the_measured_tx40_are_found(measured: list[Experiment], robot: RobotConfig) -> None:
    made = order("joint_2", "joint_3", TORQUE)
    found = find_wiring(mistaken(measured, robot, made), robot)
    assert found is not None
    assert found.stanzas == (made,)


def test_of_a_single_axis_physics_alone_tells_a_wrong_sign(emps: list[Experiment]) -> None:
    axis = load_robot("emps")
    assert find_wiring(emps, axis) is None
    found = find_wiring(mistaken(emps, axis, sign("joint_1", TORQUE)), axis)
    assert found is not None
    assert found.stanzas[0].effect == "sign_error"
    # Without gravity nothing tells which of the two signals it is.
    assert len(found.alternatives[0]) == 1


def test_different_rates_are_refused(virtual: list[Experiment], robot: RobotConfig) -> None:
    with pytest.raises(DataError, match="sampling rates"):
        find_wiring([*virtual, replace(virtual[0], dt=2e-3)], robot)


def test_like_joints_exchanged_as_a_whole_are_suspected(virtual: list[Experiment], robot: RobotConfig) -> None:
    made = order("joint_4", "joint_5", BOTH)
    found = find_wiring(mistaken(virtual, robot, made), robot)
    assert found is not None
    assert found.stanzas == (made,)
    assert found.p_values[0] < 0.01
