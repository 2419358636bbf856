"""Joint states of ROS 2: order by name, times by stamps, and one clear line for every error."""

from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer
from numpy.typing import NDArray

from armident.configs import DataError, load_robot
from armident.daq.interchange.importing import import_recording
from armident.daq.interchange.rosbag import DEFINITION, TOPIC, read_joint_states, write_joint_states
from armident.daq.recording import write_recording

TX40 = load_robot("tx40.yaml")
NAMES = [joint.name for joint in TX40.joints]
T0 = 1_700_000_000_000_000_000
Floats = NDArray[np.float64]


def states(path: Path, names: list[str], q: Floats, tau: Floats, topic: str = TOPIC, stamped: bool = True) -> Path:
    """A bag of joint states at 1 kHz, written message by message."""
    with path.open("wb") as file:
        writer = Writer(file)
        schema = writer.register_msgdef("sensor_msgs/msg/JointState", DEFINITION)
        for k in range(len(q)):
            at = T0 + k * 1_000_000
            stamp = {"sec": at // 10**9, "nanosec": at % 10**9} if stamped else {"sec": 0, "nanosec": 0}
            message = {
                "header": {"stamp": stamp, "frame_id": "base"},
                "name": names,
                "position": q[k].tolist(),
                "velocity": [],
                "effort": tau[k].tolist(),
            }
            writer.write_message(topic, schema, message, at if not stamped else at + k % 7 * 1000, at, k)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def motion(joints: int) -> tuple[Floats, Floats]:
    rng = np.random.default_rng(6)
    return rng.uniform(-1, 1, (200, joints)), rng.uniform(-3, 3, (200, joints))


@pytest.mark.parametrize("stamped", [True, False])
def test_joints_are_found_by_name_among_others(tmp_path: Path, stamped: bool) -> None:
    q, tau = motion(7)
    names = ["gripper", *reversed(NAMES)]
    recording = import_recording(states(tmp_path / "a.mcap", names, q, tau, stamped=stamped), TX40)
    np.testing.assert_array_equal(recording.samples.raw["position"], q[:, :0:-1])
    np.testing.assert_array_equal(recording.samples.raw["torque"], tau[:, :0:-1])
    assert recording.sample_rate_hz == pytest.approx(1000.0, rel=1e-9)


def test_joints_of_other_names_are_taken_in_their_order(tmp_path: Path) -> None:
    q, tau = motion(6)
    found = read_joint_states(states(tmp_path / "a.mcap", [f"a{k}" for k in range(6)], q, tau), TX40)
    np.testing.assert_array_equal(found["q"], q)


def test_ros_reads_the_written_values(tmp_path: Path) -> None:
    q, tau = motion(6)
    columns = {f"q{j + 1}": q[:, j] for j in range(6)} | {f"tau{j + 1}": tau[:, j] for j in range(6)}
    write_joint_states(tmp_path / "a.mcap", NAMES, T0 + np.arange(200) * 1_000_000, columns)
    with (tmp_path / "a.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        decoded = [message for *_, message in reader.iter_decoded_messages(topics=[TOPIC])]
    assert [list(m.position) for m in decoded] == q.tolist()
    assert [list(m.effort) for m in decoded] == tau.tolist()
    assert decoded[3].header.stamp.nanosec == 3_000_000


def test_an_invalid_bag_is_reported_in_one_line(tmp_path: Path) -> None:
    q, tau = motion(6)
    with pytest.raises(DataError, match=r"no joint joint_6 of tx40 among"):
        read_joint_states(states(tmp_path / "a.mcap", [*NAMES[:5], "tool"], q, tau), TX40)
    with pytest.raises(DataError, match=r"message 1 of /joint_states has 5 efforts of 6 joints"):
        read_joint_states(states(tmp_path / "b.mcap", NAMES, q, tau[:, :5]), TX40)
    (tmp_path / "c.mcap").write_bytes(b"not one")
    with pytest.raises(DataError, match=r"c\.mcap: not a readable rosbag2 file"):
        read_joint_states(tmp_path / "c.mcap", TX40)
    ours = import_recording(states(tmp_path / "d.mcap", NAMES, q, tau), TX40)
    write_recording(ours, tmp_path / "ours.mcap")
    with pytest.raises(DataError, match=r"no topic of sensor_msgs/msg/JointState; found .*/samples"):
        read_joint_states(tmp_path / "ours.mcap", TX40)
    whole = (tmp_path / "d.mcap").read_bytes()
    (tmp_path / "e.mcap").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(DataError, match=r"e\.mcap"):
        read_joint_states(tmp_path / "e.mcap", TX40)
