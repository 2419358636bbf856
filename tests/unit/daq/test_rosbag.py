"""Joint states of ROS 2: joints by name in every message, times by stamps, and one clear line for every error."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from typer.testing import CliRunner

from armident.configs import ConfigError, DataError
from armident.daq.cli import application
from armident.daq.interchange.exporting import export_recording, exported_columns
from armident.daq.interchange.importing import import_recording
from armident.daq.interchange.rosbag import TOPIC, JointStates, read_joint_states, write_joint_states
from armident.daq.recording import Recording, read_recording, write_recording
from tests.unit.daq.bags import NAMES, ROWS, STEP_NS, T0, TAU, TX40, Q, State, mcap_bag, motion, states

EXCHANGED = [0, 1, 3, 4, 2, 5]


def assert_motion(found: JointStates | Recording, rows: slice | np.ndarray = slice(None)) -> None:
    """The values are those of the motion, in the robot's order."""
    if isinstance(found, JointStates):
        q, tau = found.q, found.tau
    else:
        q, tau = found.samples.raw["position"], found.samples.raw["torque"]
    np.testing.assert_array_equal(q, Q[rows])
    np.testing.assert_array_equal(tau, TAU[rows])


@pytest.mark.parametrize("stamped", [True, False])
def test_joints_are_found_by_name_among_others(tmp_path: Path, stamped: bool) -> None:
    names = [*reversed(NAMES), "gripper"]
    messages = states(names, [5, 4, 3, 2, 1, 0, 0], stamped=stamped)
    recording = import_recording(mcap_bag(tmp_path / "a.mcap", messages), TX40)
    assert_motion(recording)
    assert recording.sample_rate_hz == pytest.approx(500.0, rel=1e-12)
    assert ("times are those of recording" in recording.metadata.get("source_remarks", "")) is not stamped


def test_messages_of_ros_1_in_mcap_are_read(tmp_path: Path) -> None:
    names = [*reversed(NAMES), "gripper"]
    path = mcap_bag(tmp_path / "a.mcap", states(names, [5, 4, 3, 2, 1, 0, 0]), ros_1=True)
    recording = import_recording(path, TX40)
    assert_motion(recording)
    assert "source_remarks" not in recording.metadata


def test_damaged_messages_of_ros_1_are_left_out_and_counted(tmp_path: Path) -> None:
    count = iter(range(ROWS))
    path = mcap_bag(
        tmp_path / "a.mcap", states(), ros_1=True, pack=lambda data: data[:-3] if next(count) in (50, 90) else data
    )
    found = read_joint_states(path, TX40)
    assert_motion(found, np.delete(np.arange(ROWS), [50, 90]))
    assert "message 51 on /joint_states is damaged, and 1 more" in found.remarks


def test_without_stamps_jitter_is_that_of_the_recording_and_is_not_resampled(tmp_path: Path) -> None:
    late = np.random.default_rng(1).integers(0, 300_000, ROWS)
    sent = [replace(each, delay=int(delay)) for each, delay in zip(states(stamped=False), late, strict=True)]
    path = mcap_bag(tmp_path / "a.mcap", sent)
    with pytest.raises(
        DataError, match=r"stamps on /joint_states are not set: times are those of recording; the times jitter"
    ):
        import_recording(path, TX40)
    with pytest.raises(DataError, match=r"--rate RATE, that of the publisher, if it sends evenly") as refused:
        import_recording(path, TX40)
    assert "--resample" not in str(refused.value)
    assert_motion(import_recording(path, TX40, rate_hz=500.0))
    stamped = mcap_bag(tmp_path / "b.mcap", [replace(each, at=each.at + each.delay, stamped=True) for each in sent])
    with pytest.raises(DataError, match=r"the times jitter.*; --resample 500 puts the samples"):
        import_recording(stamped, TX40)


def test_names_of_another_case_are_matched_and_said(tmp_path: Path) -> None:
    names = [NAMES[k].capitalize() for k in EXCHANGED]
    found = read_joint_states(mcap_bag(tmp_path / "a.mcap", states(names, EXCHANGED)), TX40)
    assert_motion(found)
    assert "Joint_4 as joint_4" in found.remarks[0]


def test_names_of_the_urdf_find_the_joints(tmp_path: Path) -> None:
    robot = TX40.model_copy(
        update={"joints": tuple(j.model_copy(update={"source_name": f"Axis {k}/θ"}) for k, j in enumerate(TX40.joints))}
    )
    names = [f"Axis {k}/θ" for k in reversed(range(6))]
    found = read_joint_states(mcap_bag(tmp_path / "a.mcap", states(names, range(5, -1, -1))), robot)
    assert_motion(found)
    assert found.remarks == ()


def test_joints_of_other_names_are_refused_unless_position_or_names_are_given(tmp_path: Path) -> None:
    names = [f"a{k}" for k in EXCHANGED]
    path = mcap_bag(tmp_path / "a.mcap", states(names, EXCHANGED))
    with pytest.raises(
        DataError, match=r"the file has a0, a1, a3, a4, a2, a5; the robot has joint_1.*--joints.*--by-pos"
    ):
        read_joint_states(path, TX40)
    by_position = read_joint_states(path, TX40, by_position=True)
    np.testing.assert_array_equal(by_position.q, Q[:, EXCHANGED])
    assert "taken by position: a0 as joint_1, a1 as joint_2, a3 as joint_3" in by_position.remarks[0]
    assert_motion(read_joint_states(path, TX40, joints=[f"a{k}" for k in range(6)]))


def test_messages_without_names_are_taken_by_position_only(tmp_path: Path) -> None:
    path = mcap_bag(tmp_path / "a.mcap", states(()))
    with pytest.raises(DataError, match=r"the file has \(unnamed 1\), .*--by-position"):
        read_joint_states(path, TX40)
    assert_motion(read_joint_states(path, TX40, by_position=True))


def test_an_order_that_changes_is_followed(tmp_path: Path) -> None:
    later = states([NAMES[k] for k in EXCHANGED], EXCHANGED)[50:]
    assert_motion(read_joint_states(mcap_bag(tmp_path / "a.mcap", states()[:50] + later), TX40))


def test_messages_of_a_gripper_and_of_another_arm_are_passed_over(tmp_path: Path) -> None:
    fingers = [State(T0 + k * STEP_NS + 700, ["left", "right"], [0.01, 0.01], [1, 1]) for k in range(0, ROWS, 9)]
    other = [replace(m, at=m.at + STEP_NS // 2) for m in states([f"right_{n}" for n in NAMES], EXCHANGED)]
    recording = import_recording(mcap_bag(tmp_path / "a.mcap", states() + fingers + other), TX40)
    assert_motion(recording)
    assert recording.sample_rate_hz == pytest.approx(500.0)
    remark = recording.metadata["source_remarks"]
    assert f"{ROWS + len(fingers)} messages of other joints ignored: left, right, right_joint_1" in remark


def test_a_recording_of_a_bag_and_its_exports_have_the_date_of_the_stamps(tmp_path: Path) -> None:
    recording = import_recording(mcap_bag(tmp_path / "a.mcap", states()), TX40)
    assert recording.samples.t_ns[0] == T0
    export_recording(recording, tmp_path / "a.csv")
    assert "t [s since 2023-11-14T22:13:20" in (tmp_path / "a.csv").read_text().splitlines()[0]
    assert import_recording(tmp_path / "a.csv", TX40).samples.t_ns[0] == T0


def test_two_sources_that_alternate_on_one_topic_are_said(tmp_path: Path) -> None:
    other = [replace(m, at=m.at + STEP_NS // 2, q=np.asarray(m.q) + 0.5) for m in states()]
    recording = import_recording(mcap_bag(tmp_path / "a.mcap", [*states(), *other]), TX40)
    assert "times the limit" in recording.metadata["source_remarks"]
    assert "two sources of one joint" in recording.metadata["source_remarks"]


def test_two_arms_need_a_choice(tmp_path: Path) -> None:
    left, right = ([f"{side}_{name}" for name in NAMES] for side in ("left", "right"))
    messages = states(left) + [replace(m, at=m.at + 300) for m in states(right, EXCHANGED)]
    path = mcap_bag(tmp_path / "a.mcap", messages)
    with pytest.raises(DataError, match=r"several arms: prefixes 'left', 'right'; the file has left_joint_1.*--joints"):
        read_joint_states(path, TX40)
    assert_motion(read_joint_states(path, TX40, joints=left))


def test_joints_of_one_stamp_in_two_messages_are_one_sample(tmp_path: Path) -> None:
    first, second = states(NAMES[:2], [0, 1]), states(NAMES[2:], [2, 3, 4, 5], delay=3 * STEP_NS)
    assert_motion(read_joint_states(mcap_bag(tmp_path / "a.mcap", first + second), TX40))
    positions = [replace(m, tau=()) for m in states()]
    efforts = [replace(m, q=(), delay=40) for m in states()]
    assert_motion(read_joint_states(mcap_bag(tmp_path / "b.mcap", positions + efforts), TX40))
    recording = import_recording(mcap_bag(tmp_path / "c.mcap", first + second[:30] + second[34:]), TX40)
    assert_motion(recording, np.delete(np.arange(ROWS), [30, 31, 32, 33]))
    assert [(gap.first, gap.last) for gap in recording.gaps] == [(30, 33)]
    assert "4 stamps without all joints are left out, the first 0.06 s" in recording.metadata["source_remarks"]
    apart = [replace(m, at=m.at + 50_000) for m in second]
    with pytest.raises(DataError, match="messages of different stamps are not joined"):
        read_joint_states(mcap_bag(tmp_path / "d.mcap", first + apart), TX40)


def test_a_topic_is_chosen(tmp_path: Path) -> None:
    wished = [replace(m, q=m.q[::-1], topic="/wished") for m in states()]
    path = mcap_bag(tmp_path / "a.mcap", states() + wished)
    with pytest.raises(
        DataError, match=r"--topic NAME chooses one of /joint_states: 120 messages of joint_1.*; /wished"
    ):
        read_joint_states(path, TX40)
    assert_motion(read_joint_states(path, TX40, topic="/joint_states"))
    np.testing.assert_array_equal(read_joint_states(path, TX40, topic="wished").q, Q[:, ::-1])
    with pytest.raises(DataError, match=r"--topic: no joint states on /other; the bag has /joint_states, /wished"):
        read_joint_states(path, TX40, topic="/other")
    gripper = [replace(m, names=["left"], q=[0.1], tau=[1.0], topic="/gripper/joint_states") for m in states()]
    found = read_joint_states(mcap_bag(tmp_path / "b.mcap", states() + gripper), TX40)
    assert_motion(found)
    assert "/joint_states is read, as only it has the joints of the robot" in found.remarks[0]


def test_dropped_messages_are_a_gap(tmp_path: Path) -> None:
    path = mcap_bag(tmp_path / "a.mcap", states()[:40] + states()[57:])
    for rate in (None, 500.0):
        recording = import_recording(path, TX40, rate_hz=rate)
        assert_motion(recording, recording.samples.sync)
        assert [(gap.first, gap.last, gap.joint) for gap in recording.gaps] == [(40, 56, None)]
        assert recording.counters["samples.in_gaps"] == 17
        assert recording.sample_rate_hz == pytest.approx(500.0, rel=1e-12)
    with pytest.raises(DataError, match=r"--rate 1000 contradicts the times: steps of 0\.002 s, 500 Hz"):
        import_recording(path, TX40, rate_hz=1000.0)
    holed = mcap_bag(tmp_path / "b.mcap", states()[:40] + states()[70:])
    with pytest.raises(DataError, match=r"no sample for 0\.062 s: --polled does not fill holes"):
        import_recording(holed, TX40, rate_hz=500.0, polled=True)


def test_times_that_contradict_each_other_are_refused(tmp_path: Path) -> None:
    moved = [replace(m, at=m.at - 500_000_000, delay=500_001_000) for m in states()[60:]]
    with pytest.raises(
        DataError, match=r"message 61 on /joint_states has a stamp 0\.498 s before .* clock was set back"
    ):
        read_joint_states(mcap_bag(tmp_path / "a.mcap", states()[:60] + moved), TX40)
    moved = [replace(m, at=m.at + 900_000_000, delay=1000 - 900_000_000) for m in states()[60:]]
    with pytest.raises(
        DataError, match=r"stamp 0\.902 s after that of the one before, and was recorded 0\.002 s after"
    ):
        read_joint_states(mcap_bag(tmp_path / "b.mcap", states()[:60] + moved), TX40)
    unset = [replace(m, stamped=False) for m in states()[:3]]
    with pytest.raises(DataError, match=r"3 of 120 messages on /joint_states have no stamp"):
        read_joint_states(mcap_bag(tmp_path / "c.mcap", unset + states()[3:]), TX40)
    twice = [replace(m, q=np.add(m.q, 0.01), delay=2000) for m in states()]
    with pytest.raises(DataError, match=r"another value of joint_1: two nodes send the same joint"):
        read_joint_states(mcap_bag(tmp_path / "d.mcap", states() + twice), TX40)
    jitter = np.random.default_rng(1).integers(-300_000, 300_000, ROWS)
    uneven = [replace(m, at=m.at + int(d)) for m, d in zip(states(), jitter, strict=True)]
    with pytest.raises(DataError, match="the times jitter"):
        import_recording(mcap_bag(tmp_path / "e.mcap", uneven), TX40)


@pytest.mark.parametrize("factor", [500, 500_000, 1e-4])
def test_stamps_in_another_unit_than_the_times_of_recording_are_refused_with_both(
    tmp_path: Path, factor: float
) -> None:
    step = int(STEP_NS * factor)
    messages = [State(T0 + k * step, NAMES, Q[k], TAU[k], delay=k * (STEP_NS - step)) for k in range(ROWS)]
    path = mcap_bag(tmp_path / "a.mcap", messages)
    with pytest.raises(DataError, match=rf"are {step / 1e9:g} s apart .* recorded every 0.002 s \(500 Hz\)"):
        read_joint_states(path, TX40)


def test_a_slow_simulation_keeps_its_stamps(tmp_path: Path) -> None:
    messages = [State(k * STEP_NS + 1, NAMES, Q[k], TAU[k], delay=T0 + 20 * k * STEP_NS) for k in range(ROWS)]
    assert import_recording(mcap_bag(tmp_path / "a.mcap", messages), TX40).sample_rate_hz == pytest.approx(500)


def test_stamps_that_jitter_name_the_option_that_resamples_them(tmp_path: Path) -> None:
    late = np.random.default_rng(1).integers(0, STEP_NS // 8, ROWS).tolist()
    messages = [State(T0 + k * STEP_NS + late[k], NAMES, Q[k], TAU[k]) for k in range(ROWS)]
    path = mcap_bag(tmp_path / "a.mcap", messages)
    with pytest.raises(DataError, match=r"the times jitter: .*; --resample 500 puts the samples on an even clock"):
        import_recording(path, TX40)
    assert import_recording(path, TX40, resample_hz=500.0).sample_rate_hz == 500.0
    lost = import_recording(mcap_bag(tmp_path / "b.mcap", messages[:40] + messages[41:]), TX40, rate_hz=500.0)
    assert [(gap.first, gap.last) for gap in lost.gaps] == [(40, 40)]


def test_efforts_that_are_not_measured_are_named(tmp_path: Path) -> None:
    tau = TAU.copy()
    tau[:, 3] = 0.0
    path = mcap_bag(tmp_path / "a.mcap", [replace(m, tau=tau[k]) for k, m in enumerate(states())])
    assert "all zero: probably not measured: tau4" in import_recording(path, TX40).metadata["source_remarks"]
    tau[:, [1, 3]] = np.nan
    path = mcap_bag(tmp_path / "b.mcap", [replace(m, tau=tau[k]) for k, m in enumerate(states())])
    with pytest.raises(DataError, match=r"no number in any row of tau2, tau4$"):
        import_recording(path, TX40)


def test_a_unit_of_times_is_no_option_of_a_bag(tmp_path: Path) -> None:
    path = mcap_bag(tmp_path / "a.mcap", states())
    with pytest.raises(ConfigError, match=r"--time-unit is an option of CSV, .*; not of a ROS 2 bag"):
        import_recording(path, TX40, time_unit="ms")


def test_repeated_messages_are_passed_over(tmp_path: Path) -> None:
    found = read_joint_states(mcap_bag(tmp_path / "a.mcap", states() + states()[7:9]), TX40)
    assert_motion(found)
    assert "2 messages on /joint_states repeat the one before" in found.remarks[0]


def test_one_odd_message_is_left_out_and_said(tmp_path: Path) -> None:
    messages = states()
    messages[20] = replace(messages[20], tau=messages[20].tau[:5])
    messages[70] = replace(messages[70], names=[*NAMES[:5], NAMES[0]])
    recording = import_recording(mcap_bag(tmp_path / "a.mcap", messages), TX40)
    assert_motion(recording, np.delete(np.arange(ROWS), [20, 70]))
    assert [gap.first for gap in recording.gaps] == [20, 70]
    remarks = recording.metadata["source_remarks"]
    assert "message 21 on /joint_states has 5 efforts of 6 joints" in remarks
    assert "message 71 on /joint_states has a duplicate joint" in remarks


def test_ros_reads_the_written_values(tmp_path: Path) -> None:
    q, tau = motion()
    table = {f"q{j + 1}": q[:, j] for j in range(6)} | {f"tau{j + 1}": tau[:, j] for j in range(6)}
    write_joint_states(tmp_path / "a.mcap", NAMES, T0 + np.arange(ROWS) * 1_000_000, table)
    with (tmp_path / "a.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        decoded = [message for *_, message in reader.iter_decoded_messages(topics=[TOPIC])]
    assert [list(m.position) for m in decoded] == q.tolist()
    assert [list(m.effort) for m in decoded] == tau.tolist()
    assert decoded[3].header.stamp.nanosec == 3_000_000


def test_an_exported_capture_comes_back_with_the_same_numbers(tmp_path: Path) -> None:
    source = [f"Axis-{k}" for k in range(6)]
    robot = TX40.model_copy(
        update={
            "joints": tuple(j.model_copy(update={"source_name": s}) for j, s in zip(TX40.joints, source, strict=True))
        }
    )
    made = import_recording(mcap_bag(tmp_path / "a.mcap", states(source)[:50] + states(source)[53:]), robot)
    jitter = np.random.default_rng(2).integers(0, 60_000, ROWS - 3)
    received = replace(made.samples, t_ns=made.samples.t_ns + jitter)
    capture = replace(made, streams={"samples": received})
    export_recording(capture, tmp_path / "b.mcap")
    back = import_recording(tmp_path / "b.mcap", robot)
    assert back.sample_rate_hz == pytest.approx(made.sample_rate_hz, rel=1e-9)
    np.testing.assert_array_equal(back.samples.sync, made.samples.sync)
    assert [(gap.first, gap.last) for gap in back.gaps] == [(50, 52)]
    assert back.metadata["source_remarks"] == "3 samples are missing between the rows: recorded as gaps"
    before, after = exported_columns(capture), exported_columns(back)
    for name in before:
        np.testing.assert_allclose(after[name], before[name], rtol=1e-12)


def test_an_invalid_bag_is_reported_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"no joint joint_6; the file has .*tool; the robot has .*joint_6"):
        read_joint_states(mcap_bag(tmp_path / "a.mcap", states([*NAMES[:5], "tool"])), TX40)
    with pytest.raises(DataError, match=r"message 1 on /joint_states has 5 efforts of 6 joints, and 119 more"):
        read_joint_states(mcap_bag(tmp_path / "b.mcap", [replace(m, tau=m.tau[:5]) for m in states()]), TX40)
    with pytest.raises(DataError, match=r"/joint_states have no efforts of joint_1, joint_2"):
        read_joint_states(mcap_bag(tmp_path / "f.mcap", [replace(m, tau=()) for m in states()]), TX40)
    (tmp_path / "c.mcap").write_bytes(b"not one")
    with pytest.raises(DataError, match=r"c\.mcap: not an MCAP file"):
        read_joint_states(tmp_path / "c.mcap", TX40)
    ours = import_recording(mcap_bag(tmp_path / "d.mcap", states()), TX40)
    write_recording(ours, tmp_path / "ours.mcap")
    with pytest.raises(DataError, match=r"no topic of sensor_msgs/msg/JointState in CDR; found .*/samples"):
        read_joint_states(tmp_path / "ours.mcap", TX40)
    with pytest.raises(DataError, match=r"no topic .*; found /joint_states \(sensor_msgs/msg/Imu\)"):
        read_joint_states(mcap_bag(tmp_path / "e.mcap", states(), message_type="sensor_msgs/msg/Imu"), TX40)
    with pytest.raises(DataError, match=r"found /a b \(a b\); record a topic of this type"):
        read_joint_states(mcap_bag(tmp_path / "g.mcap", states(topic="/a\x00\nb"), message_type="a\x07b"), TX40)
    (tmp_path / "a.csv").touch()
    with pytest.raises(ConfigError, match=r"--topic is an option of ROS 2 bag; not of a CSV"):
        import_recording(tmp_path / "a.csv", TX40, topic="/a")


def test_the_command_has_the_options_and_says_what_was_assumed(tmp_path: Path) -> None:
    names = [f"a{k}" for k in range(6)]
    path = mcap_bag(tmp_path / "a.mcap", states(names)[:40] + states(names, topic="/other") + states(names)[50:])
    command = ["import", str(path), "--config", "tx40.yaml", "--out", str(tmp_path / "out.mcap")]
    run = CliRunner().invoke
    refused = run(application(["import"]), command)
    assert refused.exit_code == 3
    assert "--topic" in refused.output
    done = run(application(["import"]), [*command, "--topic", TOPIC, "--joints", ", ".join(names)])
    assert done.exit_code == 0, done.output
    assert "110 samples at 500 Hz, 10 in gaps, position, torque" in done.output
    assert read_recording(tmp_path / "out.mcap").gaps[0].first == 40
    done = run(application(["import"]), [*command, "--topic", "/other", "--by-position"])
    assert done.exit_code == 0, done.output
    assert "joints taken by position: a0 as joint_1" in done.output
