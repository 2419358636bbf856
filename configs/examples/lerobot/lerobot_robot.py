"""An SO-101 of LeRobot as the program of `armident investigate --robot-command 'python lerobot_robot.py PORT ID'`.

Torques are measured as motor currents.
"""

import sys
import time

import numpy as np

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
COUNT_A, SIGN = 0.0065, 1 << 15  # Present_Current of an STS3215: A per count, and the bit of its sign
APPROACH_S = 5.0  # time to the first row, s
RATE_HZ = 50.0  # of commands and samples: what a bus of six servos takes


def action(q):
    """Return the action of joint positions (n,), rad."""
    return {f"{joint}.pos": float(np.degrees(angle)) for joint, angle in zip(JOINTS, q, strict=True)}


def sample(observation, counts):
    """Return positions, rad, and currents, A, (2 n,) of an observation and of the registers Present_Current."""
    currents = [COUNT_A * (counts[j] & (SIGN - 1)) * (-1 if counts[j] & SIGN else 1) for j in JOINTS]
    return [*np.radians([observation[f"{j}.pos"] for j in JOINTS]), *currents]


def play(robot, t, q):
    """Move the arm along positions q (N, n) at times t (N,) and return times and samples, (M, 1 + 2 n)."""
    rows, begin = [], time.perf_counter()
    while (now := time.perf_counter() - begin) < t[-1]:
        robot.send_action(action([np.interp(now, t, column) for column in q.T]))
        observation, counts = robot.get_observation(), robot.bus.sync_read("Present_Current", normalize=False)
        rows.append([time.perf_counter() - begin, *sample(observation, counts)])
        time.sleep(max(0.0, begin + now + 1.0 / RATE_HZ - time.perf_counter()))
    return np.array(rows)


def even(rows):
    """Return samples (M, 1 + 2 n) at even times."""
    t = np.arange(rows[0, 0], rows[-1, 0], 1.0 / RATE_HZ)
    return np.column_stack([t - t[0], *(np.interp(t, rows[:, 0], column) for column in rows[:, 1:].T)])


if __name__ == "__main__":
    from lerobot.robots.so_follower import SO101Follower, SO101FollowerConfig

    port, name, trajectory, out = sys.argv[1:]
    table = np.loadtxt(trajectory, delimiter=",", skiprows=1)
    robot = SO101Follower(SO101FollowerConfig(port=port, id=name, disable_torque_on_disconnect=False))
    robot.connect(calibrate=False)
    try:
        here = np.radians([robot.get_observation()[f"{j}.pos"] for j in JOINTS])
        play(robot, np.array([0.0, APPROACH_S]), np.array([here, table[0, 1:]]))
        rows = even(play(robot, table[:, 0], table[:, 1:]))
    finally:
        robot.disconnect()
    names = ["t", *(f"{kind}{j + 1}" for kind in ("q", "current") for j in range(len(JOINTS)))]
    np.savetxt(out, rows, "%.9g", ",", header=",".join(names), comments="")
