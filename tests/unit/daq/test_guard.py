"""Monitor of the guard: alarms for an arm beyond its limits, and none for one within them."""

import numpy as np
import pytest
from numpy.typing import NDArray

from armident.configs import RobotConfig, SessionConfig, load_robot, load_session, load_trajectory
from armident.configs.units import counts_per_si
from armident.daq.guard.monitor import MotionMonitor
from armident.daq.guard.motion_limits import motion_limits_of
from armident.daq.matching.streams import bus_numbers, node_ids
from armident.drivers.can.frames import Frames, frames
from armident.drivers.canopen.objects import COB_HEARTBEAT, COB_SYNC, TpdoLayout, rpdo_cob, tpdo_cob

NOW = 1_000_000_000


@pytest.fixture(scope="module")
def robot() -> RobotConfig:
    return load_robot("tx40.yaml")


@pytest.fixture(scope="module")
def session() -> SessionConfig:
    return load_session("tx40_cell.yaml")


def on_the_bus(robot: RobotConfig, q: NDArray[np.float64], current: NDArray[np.int64] | None = None) -> Frames:
    """Return the frames of a motion (N, n): SYNC and samples, with set points and demand at every fifth SYNC."""
    counts = np.rint(q @ robot.transmission_matrix.T * counts_per_si(robot)).astype(np.int64)
    rows: list[tuple[int, bytes]] = []
    for k in range(len(q)):
        rows.append((COB_SYNC, bytes([k % 240 + 1])))
        for j in range(robot.n):
            permille = 0 if current is None else int(current[k, j])
            position = int(counts[k, j]).to_bytes(4, "little", signed=True)
            rows.append((tpdo_cob(1, j + 1), position + permille.to_bytes(2, "little", signed=True) + b"\x37\x12"))
            if k % 5 == 0:
                rows += [(tpdo_cob(2, j + 1), position), (rpdo_cob(1, j + 1), position)]
    return _frames(rows)


def monitor_of(session: SessionConfig, robot: RobotConfig) -> MotionMonitor:
    return MotionMonitor(session, robot, motion_limits_of(robot))


def test_a_motion_within_the_limits_is_no_alarm(session: SessionConfig, robot: RobotConfig) -> None:
    """The shipped trajectory, in batches of random size."""
    assert session.setpoints is not None
    bus = on_the_bus(robot, load_trajectory(session.setpoints.trajectory).sample(session.sync_period)[:10_000])
    guard, at = monitor_of(session, robot), 0
    sizes = np.random.default_rng(0).integers(1, 300, bus.size)
    for size in sizes:
        assert guard.check(bus[at : at + size], NOW) is None
        at += int(size)
        if at >= bus.size:
            break
    assert guard.armed


@pytest.mark.parametrize("joint", range(6))
def test_excess_velocity_is_detected_at_every_joint(session: SessionConfig, robot: RobotConfig, joint: int) -> None:
    """Five per cent above the limit is an alarm, five per cent below is none; joint 5 also turns motor 6."""
    t = np.arange(200) * session.sync_period
    limit = robot.joints[joint].limits.velocity
    for share, expected in ((0.95, None), (1.05, f"{robot.joints[joint].name}: velocity")):
        q = np.zeros((t.size, robot.n))
        q[:, joint] = share * limit * t
        alarm = monitor_of(session, robot).check(on_the_bus(robot, q), NOW)
        assert alarm is None if expected is None else alarm is not None and alarm.text.startswith(expected)


@pytest.mark.parametrize("joint", range(6))
def test_a_torque_above_the_limit_is_detected_and_one_below_is_not(
    session: SessionConfig, robot: RobotConfig, joint: int
) -> None:
    """Longer than the averaging time; the torque of a joint is that of all motors that drive it."""
    torque = np.zeros(robot.n)
    found = []
    for share in (0.97, 1.03):
        torque[joint] = share * robot.joints[joint].limits.torque
        motor = np.linalg.solve(robot.transmission_matrix.T, torque)
        per_mille = motor / np.array([j.drive.gain * j.drive.rated / 1000 for j in robot.joints])
        current = np.repeat(np.rint(per_mille).astype(np.int64)[None], 100, axis=0)
        found.append(monitor_of(session, robot).check(on_the_bus(robot, np.zeros((100, robot.n)), current), NOW))
    assert found[0] is None
    assert found[1] is not None
    assert found[1].text.startswith(f"{robot.joints[joint].name}: torque")


@pytest.mark.parametrize("joint", range(6))
def test_the_following_error_is_that_of_the_demand_which_the_drives_send(
    session: SessionConfig, robot: RobotConfig, joint: int
) -> None:
    """Set points that the drives do not follow yet are no following error of drives that send their demand."""
    q = np.zeros(robot.n)
    q[joint] = 1.02 * motion_limits_of(robot).following[joint]
    ahead = np.rint(robot.transmission_matrix @ q * counts_per_si(robot)).astype(np.int64)
    far = [int(count).to_bytes(4, "little", signed=True) for count in ahead]
    still = on_the_bus(robot, np.zeros((10, robot.n)))
    for cob, expected in ((rpdo_cob, None), (tpdo_cob, f"{robot.joints[joint].name}: following error")):
        guard = monitor_of(session, robot)
        assert guard.check(still, NOW) is None
        moved = _frames([(cob(2 if cob is tpdo_cob else 1, j + 1), far[j]) for j in range(robot.n)])
        alarm = guard.check(moved, NOW) or guard.check(still, NOW)
        assert alarm is None if expected is None else alarm is not None and alarm.text.startswith(expected)


def test_the_offending_frame_does_not_depend_on_the_batches(session: SessionConfig, robot: RobotConfig) -> None:
    """The offending frame is the first sample beyond the limit of joint 3."""
    q = np.zeros((400, robot.n))
    q[:, 2] = np.linspace(2.3, 2.5, 400)
    bus = on_the_bus(robot, q)
    whole = monitor_of(session, robot).check(bus, NOW)
    assert whole is not None
    assert "joint_3: position 2.4" in whole.text
    first = int(np.flatnonzero(q[:, 2] > 2.4)[0])
    samples = np.flatnonzero(bus["can_id"] == tpdo_cob(1, 3))
    assert whole.frame == samples[first]
    guard = monitor_of(session, robot)
    for k in range(bus.size):
        alarm = guard.check(bus[k : k + 1], NOW)
        if alarm is not None:
            break
    assert k == whole.frame
    assert alarm == type(whole)(whole.text, 0)


@pytest.mark.parametrize(("byte", "stops"), [(0x05, False), (0x85, False), (0x7F, True), (0x84, True)])
def test_answers_of_node_guarding_are_heartbeats(
    session: SessionConfig, robot: RobotConfig, byte: int, stops: bool
) -> None:
    guard = monitor_of(session, robot)
    assert guard.check(on_the_bus(robot, np.zeros((10, robot.n))), NOW) is None
    alarm = guard.check(_frames([(COB_HEARTBEAT + 1, bytes([byte]))]), NOW)
    assert (alarm is not None) == stops


def test_missing_heartbeats_are_judged_by_the_time_before_the_frames(
    session: SessionConfig, robot: RobotConfig
) -> None:
    """Heartbeats at 100 ms: lost after 0.4 s."""
    guard = monitor_of(session, robot)
    assert guard.check(on_the_bus(robot, np.zeros((10, robot.n))), NOW) is None
    assert guard.check(frames(0), NOW + 399_000_000) is None
    late = guard.check(frames(0), NOW + 401_000_000)
    assert late is not None
    assert late.frame == -1
    assert late.text == "joint_1: no heartbeat for 0.40 s"


def test_axes_on_several_buses_are_monitored_together(robot: RobotConfig) -> None:
    """Joint 6 is turned by the motors 5 and 6, each on its own bus."""
    session = moving(load_session("tx40_six_buses.yaml"))
    guard = monitor_of(session, robot)
    t = np.arange(400) * session.sync_period
    q = np.zeros((t.size, robot.n))
    # Both joints below half their limits, both turn motor 6; then joint 6 alone exceeds its limit.
    q[:, 4], q[:, 5] = 4.0 * t, 5.0 * t
    q[200:, 5] += 8.0 * (t[200:] - t[199])
    counts = np.rint(q @ robot.transmission_matrix.T * counts_per_si(robot)).astype(np.int64)
    alarm, at = None, -1
    for k in range(t.size):
        for j, bus in enumerate(bus_numbers(session, robot)):
            node, position = node_ids(session, robot)[j], int(counts[k, j]).to_bytes(4, "little", signed=True)
            rows = [(COB_SYNC, bytes([k % 240 + 1])), (tpdo_cob(1, node), position + b"\0\0\x37\x12")]
            if k % 5 == 0:
                rows += [(rpdo_cob(1, node), position), (tpdo_cob(2, node), position)]
            alarm = guard.check(_frames(rows), NOW, bus)
            if alarm is not None:
                at = k
                break
        if alarm is not None:
            break
    assert alarm is not None
    assert alarm.text.startswith("joint_6: velocity")
    # 13 rad/s from sample 200 on: the mean over 50 samples passes 12 after 50 * 7 / 8 of them.
    assert 200 + 42 <= at <= 200 + 46


def test_the_newest_of_packed_samples_is_checked(robot: RobotConfig) -> None:
    packed = moving(load_session("tx40_one_fd.yaml"))
    pack = packed.streams["samples"].pack
    assert pack > 1
    guard = monitor_of(packed, robot)
    node = node_ids(packed, robot)[2]
    far = int(np.rint(2.5 * robot.transmission_matrix[2, 2] * counts_per_si(robot)[2]))
    size = TpdoLayout.of(packed.streams["samples"].objects, pack=pack, fd=True).size
    old, new = (value.to_bytes(4, "little", signed=True) + bytes(size - 4) for value in (0, far))
    start = _frames([(rpdo_cob(1, node), bytes(4))], fd=True)
    assert guard.check(start, NOW) is None
    assert guard.check(_frames([(tpdo_cob(1, node), old * pack)], fd=True), NOW) is None
    alarm = guard.check(_frames([(tpdo_cob(1, node), old * (pack - 1) + new)], fd=True), NOW)
    assert alarm is not None
    assert alarm.text.startswith("joint_3: position 2.5")


def moving(session: SessionConfig) -> SessionConfig:
    """Return a session with set points."""
    setpoints = load_session("tx40_cell.yaml").setpoints
    return session.model_copy(update={"setpoints": setpoints})


def _frames(rows: list[tuple[int, bytes]], fd: bool = False) -> Frames:
    out = frames(len(rows), fd=fd)
    for k, (identifier, data) in enumerate(rows):
        out["can_id"][k], out["length"][k] = identifier, len(data)
        out["data"][k, : len(data)] = np.frombuffer(data, np.uint8)
    return out
