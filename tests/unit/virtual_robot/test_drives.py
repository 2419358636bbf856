"""Virtual drives without a bus: states, set points, noise, hidden effects, recordings, replay."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from armident.configs import ConfigError, DataError, RobotConfig, Trajectory, load_robot
from armident.configs.loading import load_scenario
from armident.configs.schema.trajectory import Move
from armident.configs.units import counts_per_si
from armident.daq.recording import Recording
from armident.drivers.canopen.objects import Control, DriveState, drive_state
from armident.virtual_robot.arm import Arm
from armident.virtual_robot.cia402 import next_state, statusword
from armident.virtual_robot.inertias import rest_posture
from armident.virtual_robot.noise import DECIMATED_VARIANCE, RESIDUAL_VARIANCE, Noise
from armident.virtual_robot.offline import simulate_recording
from armident.virtual_robot.plant import Plant
from armident.virtual_robot.replay import Replay

PERIOD = 200e-6


@pytest.fixture(scope="module")
def tx40() -> RobotConfig:
    return load_robot("tx40.yaml")


@pytest.fixture(scope="module")
def short() -> Trajectory:
    return Trajectory(
        schema="armident/trajectory/1",
        start=(0.0, 0.0, 1.57, 0.0, 0.0, 0.0),
        moves=(Move(to=(0.3, 0.2, 1.3, 0.4, 0.4, -0.4), duration=0.5),),
    )


@pytest.fixture(scope="module")
def recording(tx40: RobotConfig, short: Trajectory) -> Recording:
    return simulate_recording(tx40, short, seed=7, settle=0.1)


def joint_side(recording: Recording, stream: str, name: str) -> NDArray[np.float64]:
    out: NDArray[np.float64] = recording.streams[stream].si(name) @ np.linalg.inv(recording.robot.transmission_matrix).T
    return out


def test_the_state_machine_walks_up_and_down_the_cia_402_ladder() -> None:
    state, seen = DriveState.SWITCH_ON_DISABLED, []
    orders = (
        Control.SHUTDOWN,
        Control.SWITCH_ON,
        Control.ENABLE_OPERATION,
        Control.QUICK_STOP,
        Control.DISABLE_VOLTAGE,
    )
    before = 0
    for order in orders:
        state, before = next_state(state, order, before), order
        seen.append(state)
        assert drive_state(statusword(state)) is state
    assert seen == [
        DriveState.READY,
        DriveState.SWITCHED_ON,
        DriveState.ENABLED,
        DriveState.QUICK_STOP_ACTIVE,
        DriveState.SWITCH_ON_DISABLED,
    ]


def test_a_drive_cannot_be_enabled_past_its_fault_or_from_switch_on_disabled() -> None:
    assert next_state(DriveState.SWITCH_ON_DISABLED, Control.ENABLE_OPERATION, 0) is DriveState.SWITCH_ON_DISABLED
    assert next_state(DriveState.FAULT, Control.ENABLE_OPERATION, 0) is DriveState.FAULT
    assert next_state(DriveState.FAULT, Control.FAULT_RESET, 0) is DriveState.SWITCH_ON_DISABLED
    assert next_state(DriveState.FAULT, Control.FAULT_RESET, Control.FAULT_RESET) is DriveState.FAULT


def test_demand_is_the_line_between_set_points(tx40: RobotConfig) -> None:
    arm = Arm(tx40, rest_posture(tx40), noise=0.0)
    for joint in range(6):
        arm.enable(joint, True)
        arm.interpolation_time(joint, 1e-3)
    start = arm.demand.copy()
    seen = []
    for k in range(10):
        if k == 0:
            arm.set_targets(start + np.int32(500), np.ones(6, np.bool_))
        seen.append(arm.demand - start)
        arm.advance()
    expected = np.minimum(np.arange(10) * 100, 500)
    np.testing.assert_array_equal(np.array(seen), np.tile(expected[:, None], (1, 6)))


def test_the_recorded_demand_is_the_trajectory_between_the_marks(recording: Recording, short: Trajectory) -> None:
    first, last = recording.experiments()[0]
    stream = recording.streams["demand"]
    inside = (stream.sync >= first) & (stream.sync <= last)
    resolution = np.abs(np.linalg.inv(recording.robot.transmission_matrix)) @ (0.5 / counts_per_si(recording.robot))
    error = np.abs(joint_side(recording, "demand", "demand")[inside] - short.sample(1e-3))
    assert (error.max(axis=0) <= resolution * (1 + 1e-6)).all()
    assert stream.sync[0] == 4
    assert set(np.diff(stream.sync)) == {5}


def test_the_arm_follows_within_the_stiffness_of_its_loops(recording: Recording) -> None:
    demand = joint_side(recording, "demand", "demand")
    error = joint_side(recording, "samples", "position")[recording.streams["demand"].sync] - demand
    assert np.abs(error).max() < 0.1
    assert np.abs(error).max() > 1e-3, "proportional loops must show a tracking error"


def test_a_seed_gives_the_same_recording_and_another_seed_another(tx40: RobotConfig, short: Trajectory) -> None:
    one, same, other = (simulate_recording(tx40, short, seed, settle=0.05).sha256 for seed in (1, 1, 2))
    assert one == same != other


@pytest.mark.slow
def test_noise_has_the_size_of_table_6_3(tx40: RobotConfig) -> None:
    noise = Noise(tx40, PERIOD, seed=3)
    rows = [tuple(part.copy() for part in noise.next()) for _ in range(200_000)]
    gain = np.array([joint.drive.gain for joint in tx40.joints])
    white = np.array([row[0] for row in rows]) * gain @ tx40.transmission_matrix
    slow = np.array([row[1] for row in rows])
    total = white + slow
    spectrum = np.abs(np.fft.rfft(total, axis=0)) ** 2 * 2 / len(total) ** 2
    below = spectrum[np.fft.rfftfreq(len(total), PERIOD) < 20.0].sum(axis=0)
    # 40 s hold 1600 independent values below 20 Hz: 3.5 % standard deviation of a variance.
    np.testing.assert_allclose(total.var(axis=0), RESIDUAL_VARIANCE, rtol=0.15)
    np.testing.assert_allclose(below, DECIMATED_VARIANCE, rtol=0.15)


@pytest.mark.parametrize("name", ["tx40_worn_joint2.yaml", "tx40_cable_and_cogging.yaml"])
def test_the_shipped_scenarios_load_and_run(tx40: RobotConfig, name: str) -> None:
    Plant(tx40, rest_posture(tx40), load_scenario(name)).advance(np.zeros(6), PERIOD)


def test_a_scenario_that_is_not_there_is_named() -> None:
    with pytest.raises(ConfigError, match=r"nowhere\.yaml: no such file .*tx40_worn_joint2"):
        load_scenario(Path("nowhere.yaml"))


def played(motion: Replay, count: int) -> NDArray[np.int32]:
    out = []
    for _ in range(count):
        out.append(motion.position.copy())
        motion.advance()
    return np.array(out)


def test_replay_waits_for_all_drives_plays_once_and_holds_the_last_sample(recording: Recording) -> None:
    motion = Replay(recording, recording.robot, PERIOD, (0, 1, 2, 3, 4, 5))
    truth = recording.samples.raw["position"]
    for joint in range(5):
        motion.enable(joint, True)
    assert (played(motion, 10) == truth[0]).all()
    motion.enable(5, True)
    np.testing.assert_array_equal(played(motion, len(truth)), truth)
    assert motion.finished
    assert (played(motion, 3) == truth[-1]).all()


def test_replay_turns_joint_torques_into_what_the_drives_would_report(recording: Recording) -> None:
    robot, samples = recording.robot, recording.samples
    gain = np.array([joint.drive.gain for joint in robot.joints])
    tau = (samples.si("current") * gain) @ robot.transmission_matrix
    q = joint_side(recording, "samples", "position")
    ones = (1.0,) * robot.n
    position, current = samples.fields["position"], samples.fields["current"]
    fields = {
        "position": dataclasses.replace(position, side="joint", scale=ones),
        "torque": dataclasses.replace(current, name="torque", quantity="torque", unit="N m", side="joint", scale=ones),
    }
    measured = dataclasses.replace(samples, fields=fields, raw={"position": q, "torque": tau})
    other = dataclasses.replace(recording, streams={"samples": measured})
    motion = Replay(other, robot, PERIOD, (0,))
    motion.enable(0, True)
    for k in range(200):
        np.testing.assert_array_equal(motion.position, samples.raw["position"][k])
        np.testing.assert_array_equal(motion.current, samples.raw["current"][k])
        motion.advance()


def test_replay_refuses_another_robot_another_rate_and_a_recording_without_efforts(recording: Recording) -> None:
    robot = recording.robot
    with pytest.raises(ConfigError, match="a recording of 'emps'"):
        Replay(dataclasses.replace(recording, robot=load_robot("emps.yaml")), robot, PERIOD, (0,))
    with pytest.raises(ConfigError, match="sampled at 1000 Hz"):
        Replay(dataclasses.replace(recording, sample_rate_hz=1000.0), robot, PERIOD, (0,))
    fields = {name: f for name, f in recording.samples.fields.items() if name != "current"}
    bare = dataclasses.replace(recording.samples, fields=fields)
    with pytest.raises(DataError, match="neither currents nor torques"):
        Replay(dataclasses.replace(recording, streams={"samples": bare}), robot, PERIOD, (0,))
