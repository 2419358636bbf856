"""Joint states (sensor_msgs/msg/JointState) in rosbag2 files, which are MCAP files."""

from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap.summary import Summary
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer
from numpy.typing import NDArray

from armident.configs import DataError, RobotConfig
from armident.daq.interchange.sandbox import error_line

TOPIC = "/joint_states"
_TYPE = "sensor_msgs/msg/JointState"
DEFINITION = """std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
_NS = 1_000_000_000


def read_joint_states(path: Path, robot: RobotConfig) -> dict[str, NDArray[np.float64]]:
    """Return times ``t`` (N,), s, positions ``q`` and efforts ``tau`` (N, n) of a robot's joints.

    Joints are found by their names. If the bag has none of the robot's names but the same number of joints, they are
    taken in the bag's order. Times are the message stamps, or the log times if stamps are not set.

    Parameters
    ----------
    path
        The rosbag2 file.
    robot
        The robot, for the names of its joints.

    Raises
    ------
    DataError
        If it is not a rosbag2 MCAP file, has no joint states or those of several robots, or lacks a joint.
    """
    t: list[int] = []
    q: list[list[float]] = []
    tau: list[list[float]] = []
    try:
        with path.open("rb") as file:
            reader = make_reader(file, decoder_factories=[DecoderFactory()])
            topic = _topic(path, reader.get_summary())
            order: list[int] | None = None
            for _, _, logged, message in reader.iter_decoded_messages(topics=[topic]):
                names = list(message.name)
                order = _order(path, robot, names) if order is None else order
                stamp = message.header.stamp
                t.append(stamp.sec * _NS + stamp.nanosec or logged.log_time)
                for values, into, what in ((message.position, q, "positions"), (message.effort, tau, "efforts")):
                    if len(values) != len(names):
                        raise DataError(
                            f"{path}: message {len(t)} of {topic} has {len(values)} {what} of {len(names)} joints"
                        )
                    into.append([values[k] for k in order])
    except DataError:
        raise
    except Exception as error:  # the readers of MCAP, zstd and ROS 2 messages raise various errors for damaged files
        raise DataError(f"{path}: not a readable rosbag2 file: {error_line(error)}") from error
    if not t:
        raise DataError(f"{path}: no message on {topic}")
    times = np.array(t, dtype=np.int64)
    return {"t": (times - times[0]) / _NS, "q": np.array(q, np.float64), "tau": np.array(tau, np.float64)}


def _topic(path: Path, summary: Summary | None) -> str:
    """Return the only topic of joint states."""
    if summary is None:
        raise DataError(f"{path}: has no summary; `ros2 bag reindex` or `mcap recover` writes one")
    topics = sorted(
        channel.topic
        for channel in summary.channels.values()
        if channel.schema_id in summary.schemas and summary.schemas[channel.schema_id].name == _TYPE
    )
    if not topics:
        have = ", ".join(sorted(channel.topic for channel in summary.channels.values())) or "nothing"
        raise DataError(f"{path}: no topic of {_TYPE}; found {have}")
    if len(topics) > 1:
        raise DataError(f"{path}: joint states of several robots: {', '.join(topics)}")
    return topics[0]


def _order(path: Path, robot: RobotConfig, names: list[str]) -> list[int]:
    """Return the index of each joint of a robot among the names."""
    wanted = [joint.name for joint in robot.joints]
    if set(wanted) <= set(names):
        return [names.index(name) for name in wanted]
    if not set(wanted) & set(names) and len(names) == robot.n:
        return list(range(robot.n))
    missing = ", ".join(name for name in wanted if name not in names)
    raise DataError(f"{path}: no joint {missing} of {robot.name} among {', '.join(names)}")


def write_joint_states(
    path: Path,
    joints: list[str],
    t_ns: NDArray[np.int64],
    columns: dict[str, NDArray[np.float64]],
) -> None:
    """Write positions and efforts as joint states.

    Parameters
    ----------
    path
        The rosbag2 file.
    joints
        Names of the n joints.
    t_ns
        Times, ns UTC, (N,).
    columns
        Positions ``q1..qn`` and efforts ``tau1..taun``, (N,) each; either may be absent.
    """
    q, tau = (
        np.stack([columns[f"{base}{j + 1}"] for j in range(len(joints))], axis=1) if f"{base}1" in columns else None
        for base in ("q", "tau")
    )
    with path.open("wb") as file:
        writer = Writer(file)
        schema = writer.register_msgdef(_TYPE, DEFINITION)
        for k, at in enumerate(t_ns.tolist()):
            message = {
                "header": {"stamp": {"sec": at // _NS, "nanosec": at % _NS}, "frame_id": ""},
                "name": joints,
                "position": [] if q is None else q[k].tolist(),
                "velocity": [],
                "effort": [] if tau is None else tau[k].tolist(),
            }
            writer.write_message(TOPIC, schema, message, at, at, k)
        writer.finish()  # type: ignore[no-untyped-call]
