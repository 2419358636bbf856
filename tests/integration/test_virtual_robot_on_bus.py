"""Virtual arm on a bus, driven by the project's master and SYNC producer."""

import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import canopen
import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

from armident.configs import SessionConfig, Trajectory, load_robot, load_session
from armident.configs.schema.session import Bus
from armident.configs.schema.trajectory import Move
from armident.daq.recording import write_recording
from armident.drivers.can.frames import STANDARD_ID_MASK, FrameBus, frames
from armident.drivers.can.socketcan import RawSocket
from armident.drivers.can.udp import open_bus, open_python_can
from armident.drivers.canopen.master import DriveMaster
from armident.drivers.canopen.objects import COB_SYNC, Control, DriveState, NmtCommand, drive_state
from armident.drivers.canopen.sync_producer import SetpointPlan, SyncProducer
from armident.virtual_robot.offline import simulate_recording
from tests.fixtures.processes import armident

REPOSITORY = Path(__file__).resolve().parents[2]


@dataclass
class Output:
    """Stderr and exit code of the robot process."""

    process_id: int
    text: str = ""
    code: int | None = None


@contextmanager
def robot_process(config: Path, *options: object) -> Iterator[Output]:
    """Run the virtual arm in a separate process during the block, then stop it with SIGTERM."""
    process = armident("robot", "--config", config, *(options or ("--noise", 0)))
    output = Output(process.pid)
    try:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("ready:")
        yield output
    finally:
        process.send_signal(signal.SIGTERM)
        _, output.text = process.communicate(timeout=20)
        output.code = process.returncode


def demonstration_cell(folder: Path, bus: Bus) -> Path:
    """The session file of the demonstration cell, on a bus."""
    text = (REPOSITORY / "configs" / "cells" / "tx40_cell.yaml").read_text()
    path = folder / "cell.yaml"
    data = yaml.safe_load(text) | {"bus": {"interface": bus.interface, "channel": bus.channel}}
    path.write_text(yaml.safe_dump(data))
    return path


@pytest.fixture
def config(vcan_bus: str, tmp_path: Path) -> Path:
    """The demonstration cell on vcan."""
    return demonstration_cell(tmp_path, Bus(channel=vcan_bus))


@pytest.fixture
def slow_config(udp_bus: Bus, tmp_path: Path) -> Path:
    """The demonstration cell on UDP, for tests without SYNC."""
    return demonstration_cell(tmp_path, udp_bus)


def collect(bus: FrameBus, seconds: float, sync: SyncProducer | None = None) -> NDArray[np.void]:
    """All frames of the next seconds."""
    batch, out, end = frames(4096), [], time.monotonic() + seconds
    while time.monotonic() < end:
        bus.poll(0.02)
        while count := bus.receive(batch):
            out.append(batch[:count].copy())
        if sync is not None:
            sync.check()
    return np.concatenate(out) if out else frames(0)


def collect_answers(bus: RawSocket, sync: SyncProducer, syncs: int) -> NDArray[np.void]:
    """All frames until ``syncs`` SYNC are sent and the bus is silent: a busy machine may be late but loses nothing."""
    out = []
    while sync.sent < syncs:
        out.append(collect(bus, 0.1, sync))
    sync.stop()
    while (more := collect(bus, 1.0)).size:
        out.append(more)
    return np.concatenate(out)


def column(log: NDArray[np.void], can_id: int, offset: int, kind: str) -> NDArray[np.int64]:
    """One object of all frames with this identifier."""
    data = np.ascontiguousarray(log[log["can_id"] == can_id]["data"])
    size = np.dtype(kind).itemsize
    return np.ascontiguousarray(data[:, offset : offset + size]).view(kind)[:, 0].astype(np.int64)


def setpoint_rows(session: SessionConfig, start: list[int], seconds: float) -> NDArray[np.int32]:
    """Slow sinusoidal motion of all motors about their position, one row per millisecond."""
    t = np.arange(round(seconds * 1000)) * 1e-3
    amplitude = np.full(len(start), 20_000.0)
    rows: NDArray[np.int32] = np.rint(
        np.array(start) + np.outer(np.sin(2 * np.pi * t / seconds) ** 3, amplitude)
    ).astype(np.int32)
    return rows


@pytest.mark.vcan
def test_every_sync_is_answered_by_every_drive_and_set_points_are_followed(config: Path) -> None:
    session = load_session(config)
    robot = load_robot(session.robot)
    with robot_process(config) as output, DriveMaster(session, robot) as master:
        master.configure()
        master.start()
        start = master.positions()
        rows = setpoint_rows(session, start, 0.3)
        cobs = tuple(0x200 + drive.node_id for drive in session.drives)
        sync = SyncProducer(session.bus, session.sync.period_us, session.sync.counter, SetpointPlan(rows, cobs, 5))
        with RawSocket(
            session.bus.channel, filters=((COB_SYNC, STANDARD_ID_MASK), (0x180, 0x780), (0x280, 0x780))
        ) as bus:
            sync.start()
            log = collect_answers(bus, sync, 2000)
            assert bus.dropped == 0
        events = master.supervise()
        master.stop()
    assert output.code == 0, output.text
    assert f"{sync.sent} SYNC answered" in output.text
    assert [event for event in events if event.kind == "emcy"] == []
    assert np.count_nonzero(log["can_id"] == COB_SYNC) == sync.sent
    for j, drive in enumerate(session.drives):
        position = column(log, 0x180 + drive.node_id, 0, "<i4")
        demand = column(log, 0x280 + drive.node_id, 0, "<i4")
        assert position.size == sync.sent
        assert demand.size == sync.sent // 5
        # Row m becomes the target at SYNC 4 + 5 m and is reached five SYNC later.
        np.testing.assert_array_equal(demand[1 : 1 + len(rows)], rows[: demand.size - 1, j])
        # The loosest loop lags a 1 s swing by far less than a tenth of it once friction is overcome.
        assert np.abs(position[4::5][: demand.size] - demand).max() < 12_000


@pytest.mark.vcan
def test_lagging_drives_act_on_a_stop_at_the_same_sync(config: Path) -> None:
    """Frames that waited while the process was stopped are read at once; the stop takes effect between them."""
    session = load_session(config)
    before, after = 30, 20
    burst = frames(before + 1 + after)
    burst["can_id"], burst["length"] = COB_SYNC, 1
    burst["data"][:, 0] = np.where(np.arange(burst.size) < before, np.arange(burst.size), np.arange(burst.size) - 1) + 1
    burst["can_id"][before], burst["length"][before] = 0x303, 2
    burst["data"][before, :2] = int(Control.QUICK_STOP), 0
    with robot_process(config) as output, DriveMaster(session, load_robot(session.robot)) as master:
        master.configure()
        master.start()
        with RawSocket(session.bus.channel, filters=((0x183, STANDARD_ID_MASK),)) as bus:
            os.kill(output.process_id, signal.SIGSTOP)
            with RawSocket(session.bus.channel, filters=()) as other:
                other.send(burst)
            os.kill(output.process_id, signal.SIGCONT)
            log = collect(bus, 3.0)
    states = [drive_state(int(word)) for word in column(log, 0x183, 6, "<u2")]
    assert len(states) == before + after
    assert set(states[:before]) == {DriveState.ENABLED}
    # The command takes effect at the SYNC after it, whose answer is already sent.
    assert set(states[before + 1 :]) == {DriveState.QUICK_STOP_ACTIVE}


def test_mappings_are_refused_as_cia_301_prescribes(slow_config: Path) -> None:
    session = load_session(slow_config)
    with robot_process(slow_config):
        network = canopen.Network()
        network.bus = open_python_can(session.bus)
        network.connect()
        try:
            node = network.add_node(1, str(session.drives[0].eds))
            node.sdo.RESPONSE_TIMEOUT = 2.0

            def refused(index: int, subindex: int, value: int) -> int:
                entry = node.sdo[index] if index >= 0x6000 else node.sdo[index][subindex]
                with pytest.raises(canopen.SdoAbortedError) as caught:
                    entry.raw = value
                return int(caught.value.code)

            assert refused(0x1A00, 0, 0) == 0x08000022, "mapping while the PDO is valid"
            node.sdo[0x1800][1].raw = 0x80000181
            assert refused(0x1A00, 1, 0x60640020) == 0x06010000, "entry while the number of entries is not 0"
            node.sdo[0x1A00][0].raw = 0
            assert refused(0x1A00, 1, 0x10080020) == 0x06040041, "device name is not mappable"
            assert refused(0x1A00, 1, 0x60640010) == 0x06040041, "position has 32 bits"
            for subindex in (1, 2, 3):
                node.sdo[0x1A00][subindex].raw = 0x60640020
            assert refused(0x1A00, 0, 3) == 0x06040042, "twelve bytes"
            node.sdo[0x1A00][0].raw = 2
            assert refused(0x1800, 2, 245) == 0x06090030, "reserved transmission type"
            assert refused(0x6060, 0, 1) == 0x06090030, "profile position mode is not supported"
            assert node.sdo[0x6075].raw == 2500, "rated current, mA"
        finally:
            network.disconnect()


def test_nmt_states_govern_boot_up_heartbeat_sdo_and_pdo(slow_config: Path) -> None:
    session = load_session(slow_config)
    with open_bus(session.bus) as bus, robot_process(slow_config):
        boot = collect(bus, 0.3)
        assert {int(f["can_id"]) for f in boot if f["length"] == 1 and f["data"][0] == 0} >= set(range(0x701, 0x707))
        network = canopen.Network()
        network.bus = open_python_can(session.bus)
        network.connect()
        try:
            node = network.add_node(3, str(session.drives[0].eds))
            node.sdo.RESPONSE_TIMEOUT, node.sdo.MAX_RETRIES = 0.5, 1
            node.sdo[0x1017].raw = 50
            collect(bus, 0.05)
            beats = column(collect(bus, 0.6), 0x703, 0, "<u1")
            assert 8 <= beats.size <= 14
            assert set(beats) == {127}
            network.send_message(0, bytes([NmtCommand.STOP, 3]))
            time.sleep(0.1)
            with pytest.raises(canopen.SdoCommunicationError):
                _ = node.sdo[0x1000].raw
            assert set(column(collect(bus, 0.3), 0x703, 0, "<u1")[1:]) == {4}
            network.send_message(0, bytes([NmtCommand.RESET_NODE, 3]))
            assert 0 in column(collect(bus, 0.3), 0x703, 0, "<u1"), "boot-up message"
            assert node.sdo[0x1017].raw == 0, "back to power-on values"
        finally:
            network.disconnect()


@pytest.mark.vcan
def test_a_replayed_recording_arrives_unchanged(config: Path, tmp_path: Path) -> None:
    session = load_session(config)
    robot = load_robot(session.robot)
    trajectory = Trajectory(
        schema="armident/trajectory/1",
        start=(0.0, 0.0, 1.57, 0.0, 0.0, 0.0),
        moves=(Move(to=(0.15, 0.1, 1.45, 0.2, 0.2, -0.2), duration=0.4),),
    )
    recording = simulate_recording(robot, trajectory, seed=4, settle=0.1)
    path = tmp_path / "measured.mcap"
    write_recording(recording, path)
    with robot_process(config, "--replay", path) as output, DriveMaster(session, robot) as master:
        master.configure()
        master.start()
        sync = SyncProducer(session.bus, session.sync.period_us, session.sync.counter)
        with RawSocket(session.bus.channel, filters=((0x180, 0x780),)) as bus:
            sync.start()
            log = collect_answers(bus, sync, len(recording.samples.sync) + 500)
        master.stop()
    assert output.code == 0, output.text
    position, current = recording.samples.raw["position"], recording.samples.raw["current"]
    for j, drive in enumerate(session.drives):
        sent = column(log, 0x180 + drive.node_id, 0, "<i4")
        assert sent.size == sync.sent > len(position)
        np.testing.assert_array_equal(sent[: len(position)], position[:, j])
        np.testing.assert_array_equal(column(log, 0x180 + drive.node_id, 4, "<i2")[: len(current)], current[:, j])
        assert set(sent[len(position) :]) == {int(position[-1, j])}, "the last sample stands"
