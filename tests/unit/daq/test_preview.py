"""Preview channels: SI units at the joints, at a low rate, shown by viewers and ignored by our reader."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from armident.configs.loading import HERE
from armident.daq.recording import RecordingWriter, StreamLayout, read_recording, recover_recording
from tests.unit.daq.test_recording import make_recording

ROWS = 5000


def written(path: Path, preview_hz: float, close: bool = True) -> None:
    recording = make_recording(ROWS)
    layouts = [StreamLayout.of(s, [j.name for j in recording.robot.joints]) for s in recording.streams.values()]
    writer = RecordingWriter(path, recording.robot, None, 5000.0, layouts, {}, 20_000_000, preview_hz)
    for first in range(0, ROWS + 3, 50):
        for stream in recording.streams.values():
            part = (stream.sync >= first) & (stream.sync < first + 50)
            raw = {name: values[part] for name, values in stream.raw.items()}
            writer.append(stream.name, stream.sync[part], stream.t_ns[part], raw)
    if close:
        writer.close({})
    else:
        writer.__exit__(None, None, None)


def test_a_stock_reader_shows_joints_in_si_units(tmp_path: Path) -> None:
    written(tmp_path / "r.mcap", 50.0)
    recording = make_recording(ROWS)
    samples, demand = recording.samples, recording.streams["demand"]
    inverse = np.linalg.inv(recording.robot.transmission_matrix)
    with (tmp_path / "r.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        found = [(channel, message) for _, channel, _, message in reader.iter_decoded_messages(["/si_samples"])]
        shown = [m for *_, m in reader.iter_decoded_messages(["/si_demand"])]
    assert len(found) == len(shown) == ROWS // 100
    assert found[0][0].metadata["position"] == "rad, joint side"
    for _, message in found:
        row = int(np.flatnonzero(samples.sync == message.sync)[0])
        assert message.t_ns == samples.t_ns[row]
        q = inverse @ samples.si("position")[row]
        current = samples.si("current")[row]
        for j, joint in enumerate(recording.robot.joints):
            assert getattr(message, joint.name).position == pytest.approx(q[j], rel=1e-12, abs=1e-9)
            assert getattr(message, joint.name).current == pytest.approx(current[j], rel=1e-12)
    row = int(np.flatnonzero(demand.sync == shown[3].sync)[0])
    assert shown[3].joint_1.demand == pytest.approx((inverse @ demand.si("demand")[row])[0], rel=1e-12, abs=1e-9)


def test_our_reader_ignores_previews_and_they_add_little_size(tmp_path: Path) -> None:
    written(tmp_path / "with.mcap", 50.0)
    written(tmp_path / "without.mcap", 0.0)
    plain, shown = read_recording(tmp_path / "without.mcap"), read_recording(tmp_path / "with.mcap")
    assert shown.missing is None
    assert shown.sha256 == plain.sha256
    assert shown.streams.keys() == plain.streams.keys()
    sizes = [(tmp_path / name).stat().st_size for name in ("with.mcap", "without.mcap")]
    # Two channels of doubles at a hundredth of the rate.
    assert sizes[0] < 1.1 * sizes[1]


def test_a_truncated_file_with_previews_is_recovered(tmp_path: Path) -> None:
    written(tmp_path / "r.mcap", 50.0, close=False)
    before = read_recording(tmp_path / "r.mcap")
    healed = recover_recording(tmp_path / "r.mcap")
    assert healed.missing == before.missing
    after = read_recording(tmp_path / "r.mcap")
    assert after.sha256 == before.sha256
    with (tmp_path / "r.mcap").open("rb") as file:
        topics = {channel.topic for _, channel, _ in make_reader(file).iter_messages()}
    assert {"/samples", "/demand", "/si_samples", "/si_demand"} <= topics


def test_viewers_see_the_joint_torque_that_follows_from_the_currents(tmp_path: Path) -> None:
    written(tmp_path / "r.mcap", 50.0)
    recording = make_recording(ROWS)
    robot, samples = recording.robot, recording.samples
    gains = np.array([joint.drive.gain for joint in robot.joints])
    with (tmp_path / "r.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        _, channel, _, message = next(reader.iter_decoded_messages(["/si_samples"]))
    row = int(np.flatnonzero(samples.sync == message.sync)[0])
    expected = robot.transmission_matrix.T @ (gains * samples.si("current")[row])
    assert channel.metadata["joint_torque"] == "N m, joint side"
    for joint, torque in zip(robot.joints, expected, strict=True):
        assert getattr(message, joint.name).joint_torque == pytest.approx(torque, rel=1e-12)


def test_channels_say_the_scale_factors_of_their_raw_values(tmp_path: Path) -> None:
    written(tmp_path / "r.mcap", 0.0)
    with (tmp_path / "r.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    (channel,) = (c for c in summary.channels.values() if c.topic == "/samples")
    scale = make_recording(10).samples.fields["current"].scale
    assert channel.metadata["current"].startswith(f"A, motor side = raw int16 times: joint_1 {scale[0]:.9g}, joint_2 ")


def test_the_layout_of_plotjuggler_shows_fields_that_recordings_have(tmp_path: Path) -> None:
    written(tmp_path / "r.mcap", 50.0)
    with (tmp_path / "r.mcap").open("rb") as file:
        known: set[str] = set()
        for _, channel, _, message in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            if channel.topic.startswith("/si_"):
                joints = [(f.name, getattr(message, f.name)) for f in message.DESCRIPTOR.fields if f.message_type]
                known |= {f"{channel.topic}/{name}/{f.name}" for name, one in joints for f in one.DESCRIPTOR.fields}
    curves = [curve.attrib["name"] for curve in ElementTree.parse(HERE / "viewers" / "plotjuggler.xml").iter("curve")]
    assert len(curves) == 24
    assert known == set(curves)
