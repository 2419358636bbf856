"""Captures on vcan: no sample is lost, gaps account for all others, and every end leaves a finished file."""

import datetime
import json
import os
import signal
import subprocess
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from armident.configs import config_path, load_robot
from armident.configs.units import counts_per_si
from armident.daq.capture.capture import capture, load_plan
from armident.daq.matching.assembler import LATE_S
from armident.daq.recording import Recording, join_parts, read_recording
from armident.daq.recording.clock import clock_state
from armident.drivers.vcan import ensure_vcan, remove_vcan
from tests.fixtures.processes import ForkedProcess, armident

pytestmark = pytest.mark.vcan

COUNTED = ("samples.expected", "samples.rows", "samples.in_gaps", "kernel_drops")


def session_file(folder: Path, bus: str, cell: str, **changes: Any) -> Path:
    """Write the shipped cell with another bus, cell name and changed keys."""
    shipped = config_path("tx40_cell.yaml")
    data = yaml.safe_load(shipped.read_text()) | changes
    data |= {"cell": cell, "robot": str(config_path(data["robot"])), "bus": {"channel": bus}}
    for drive in data["drives"]:
        drive["eds"] = str(config_path(drive["eds"]))
    if data.get("setpoints"):
        data["setpoints"]["trajectory"] = str(config_path(data["setpoints"]["trajectory"]))
    path = folder / f"{cell}.yaml"
    path.write_text(yaml.safe_dump({key: value for key, value in data.items() if value is not None}))
    return path


@contextmanager
def ready_arm(session: Path) -> Iterator[ForkedProcess]:
    """The virtual arm on the bus of a session."""
    process = armident("robot", "--config", session)
    assert process.stdout is not None
    assert "ready" in process.stdout.readline()
    yield process
    if process.poll() is None:
        process.send_signal(signal.SIGTERM)
    process.communicate(timeout=60)


@pytest.fixture
def robot(vcan_bus: str, tmp_path: Path) -> Iterator[ForkedProcess]:
    """The virtual arm on the bus, when it is ready."""
    with ready_arm(session_file(tmp_path, vcan_bus, "robot")) as process:
        yield process


def wait_for_file(folder: Path, size: int, process: ForkedProcess) -> Path:
    """Wait until a recording is larger than ``size`` bytes; return its path."""
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline and process.poll() is None:
        for path in folder.glob("*.mcap"):
            if path.stat().st_size > size:
                return path
        time.sleep(0.05)
    raise AssertionError(f"no recording: {process.communicate(timeout=10)}")


@dataclass(frozen=True)
class Captured:
    """A capture of six axes at 5 kHz: its document, files, log, and two other recordings in their folder."""

    document: dict[str, Any]
    parts: list[Recording]
    log: str
    old: Path
    young: Path


@pytest.fixture(scope="module")
def captured(tmp_path_factory: pytest.TempPathFactory) -> Captured:
    """Two seconds with set points, in several files."""
    folder, bus = tmp_path_factory.mktemp("captured"), f"vt{os.getpid() % 1_000_000}shared"
    now = datetime.datetime.now(datetime.UTC)
    old, young = (folder / f"tx40-{now - datetime.timedelta(days=days):%Y%m%dT%H%M%S}-000Z.mcap" for days in (100, 1))
    for path in (old, young):
        path.write_bytes(b"a recording")
    moves = [{"to": [angle, 0.0, 1.57, 0.0, 0.0, 0.0], "duration": 0.6} for angle in (0.1, 0.0)]
    options = {"rotate_minutes": 0.01, "keep_days": 30}
    session = moving_session(folder, bus, "two_seconds", moves, 5, sync={"period_us": 200}, recording=options)
    ensure_vcan(bus)
    try:
        with ready_arm(session):
            process = armident("capture", "--config", session, "--out", folder, "--json")
            out, err = process.communicate(timeout=200)
    finally:
        remove_vcan(bus)
    assert process.returncode == 0, err
    document = json.loads(out)
    return Captured(document, [read_recording(path) for path in document["recordings"]], err, old, young)


def test_two_seconds_at_5_khz_and_six_axes_lose_nothing(captured: Captured) -> None:
    recording, counters = join_parts(captured.parts), captured.document["counters"]
    assert recording.missing is None
    assert recording.counters == counters
    assert counters["kernel_drops"] == 0
    assert counters["sync_seen"] == counters["samples.rows"] == counters["sync_sent"] > 5000
    assert recording.gaps == ()
    assert np.array_equal(recording.samples.sync, np.arange(counters["sync_sent"]))
    assert recording.metadata["cell"] == "two_seconds"


def test_marks_are_at_both_ends_of_the_motion(captured: Captured) -> None:
    recording = join_parts(captured.parts)
    ((first, last),) = recording.experiments()
    assert (first + 1) % 5 == (last + 1) % 5 == 0
    # The motion begins and ends in the same posture, so the demands at both marks are equal.
    demand = recording.streams["demand"]
    ends = demand.raw["demand"][np.isin(demand.sync, [first, last])]
    assert np.array_equal(ends[0], ends[1])
    assert np.ptp(demand.raw["demand"][:, 0]) > 1000


def test_no_sample_is_lost_between_files(captured: Captured) -> None:
    """Every SYNC is in exactly one file."""
    # A file for every 0.6 s of recorded time, even if answers of a longer time came at once.
    assert len(captured.parts) >= 3
    assert all(part.missing is None for part in captured.parts)
    for part in captured.parts:
        demand = part.streams["demand"].sync
        assert part.samples.sync[0] <= demand[0]
        assert demand[-1] <= part.samples.sync[-1]
    sync = np.concatenate([part.samples.sync for part in captured.parts])
    assert np.array_equal(sync, np.arange(captured.document["counters"]["sync_sent"]))


def test_an_old_recording_is_deleted_meanwhile_if_the_clock_is_right(captured: Captured) -> None:
    right = clock_state().synchronised
    assert captured.old.exists() != right
    assert captured.young.exists()
    assert (f"deleted {captured.old} (retention)" in captured.log) == right
    assert ("none is deleted by age, because the clock is not synchronised" in captured.log) != right


@pytest.mark.nightly
@pytest.mark.usefixtures("robot")
def test_sixty_seconds_at_5_khz_and_six_axes_lose_nothing(vcan_bus: str, tmp_path: Path) -> None:
    """On a busy machine the capture waits for drives that lag."""
    session = session_file(tmp_path, vcan_bus, "minute", setpoints=None)
    process = armident("capture", "--config", session, "--duration", "60", "--out", tmp_path / "out", "--json")
    out, err = process.communicate(timeout=230)
    assert process.returncode == 0, err
    recording = read_recording(json.loads(out)["recording"])
    expected, rows, gaps, drops = (recording.counters[name] for name in COUNTED)
    context = f"{recording.counters}\n{recording.gaps[:20]}\n{err}"
    assert gaps == drops == 0, context
    assert recording.gaps == (), context
    assert expected == rows == recording.counters["sync_sent"] >= 300_000, context


@pytest.mark.nightly
def test_the_end_waits_for_drives_that_are_stopped_for_seconds(
    vcan_bus: str, robot: ForkedProcess, tmp_path: Path
) -> None:
    """All drives answer the last SYNCs later than the limit for a single lost answer: there are no gaps."""
    session = session_file(tmp_path, vcan_bus, "starved", sync={"period_us": 1000}, setpoints=None)
    process = armident("capture", "--config", session, "--duration", "3", "--out", tmp_path / "out", "--json")
    wait_for_file(tmp_path / "out", 20_000, process)
    robot.send_signal(signal.SIGSTOP)
    try:
        assert process.stderr is not None
        lag = next(line for line in process.stderr if "behind: waiting for their answers" in line)
        time.sleep(LATE_S + 2.0)
        assert process.poll() is None, lag
    finally:
        robot.send_signal(signal.SIGCONT)
    out, err = process.communicate(timeout=200)
    assert process.returncode == 0, err
    recording = read_recording(json.loads(out)["recording"])
    expected, rows, gaps, drops = (recording.counters[name] for name in COUNTED)
    assert gaps == drops == 0, (lag, err)
    assert expected == rows == 3000


@pytest.mark.nightly
def test_the_end_does_not_wait_for_dead_drives(vcan_bus: str, robot: ForkedProcess, tmp_path: Path) -> None:
    session = session_file(tmp_path, vcan_bus, "died", sync={"period_us": 1000}, setpoints=None)
    process = armident("capture", "--config", session, "--duration", "3", "--out", tmp_path / "out", "--json")
    wait_for_file(tmp_path / "out", 20_000, process)
    robot.kill()
    assert process.stderr is not None
    lines = list(process.stderr)
    begin = next(k for k, line in enumerate(lines) if "behind: waiting for their answers" in line)
    assert process.wait(timeout=200) == 0, lines
    recording = read_recording(next((tmp_path / "out").glob("*.mcap")))
    assert recording.counters["heartbeat_lost"] == 6, lines[begin:]
    assert recording.counters["samples.rows"] + recording.counters["samples.in_gaps"] == 3000


@pytest.mark.nightly
@pytest.mark.usefixtures("robot")
def test_a_trigger_writes_only_the_time_around_events(vcan_bus: str, tmp_path: Path) -> None:
    """SIGUSR1 saves the seconds before it; mark, save and stop are commands over Zenoh."""
    changes = {
        "recording": {"trigger": {"before_s": 20.0, "after_s": 1.0}},
        "metrics": {"port": 0},
        "zenoh": {"commands": True},
        "sync": {"period_us": 1000},
    }
    session = session_file(tmp_path, vcan_bus, "events", setpoints=None, **changes)
    process = armident("capture", "--config", session, "--out", tmp_path / "out")
    assert process.stderr is not None
    log = ""
    while "keeping the last 20 s" not in log:
        line = process.stderr.readline()
        assert line, "capture ended"
        log += line
    time.sleep(5.0)
    (address,) = (word for word in log.split() if word.startswith("http://127.0.0.1:"))
    with urllib.request.build_opener(urllib.request.ProxyHandler({})).open(address, timeout=10) as answer:
        assert 'armident_capture_rows_total{cell="events",robot="tx40"}' in answer.read().decode()
    for words in (["mark", "gripper changed"], ["save"]):
        command = armident("command", *words, "--config", session)
        out, err = command.communicate(timeout=60)
        assert command.returncode == 0, err
        assert out == f"{words[0]}: accepted\n"
    path = wait_for_file(tmp_path / "out", 20_000, process)
    time.sleep(3.0)
    process.send_signal(signal.SIGUSR1)
    time.sleep(1.0)
    armident("command", "stop", "--config", session).communicate(timeout=60)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    files = [Path(name) for name in out.split()]
    assert files[0] == path
    assert len(files) == 2
    first, second = (read_recording(file) for file in files)
    assert first.missing is second.missing is None
    assert "gripper changed" in [mark.text for mark in first.marks]
    assert second.samples.sync[0] > first.samples.sync[-1]
    assert first.samples.sync.size / 1000 >= 4.0
    assert np.array_equal(np.diff(second.samples.sync), np.ones(second.samples.sync.size - 1))


@pytest.mark.usefixtures("robot")
@pytest.mark.parametrize("number", [pytest.param(signal.SIGINT, marks=pytest.mark.nightly), signal.SIGTERM])
def test_a_signal_ends_the_capture_with_a_finished_file(vcan_bus: str, tmp_path: Path, number: signal.Signals) -> None:
    session = session_file(tmp_path, vcan_bus, "signal", sync={"period_us": 1000}, setpoints=None)
    process = armident("capture", "--config", session, "--out", tmp_path / "out")
    path = wait_for_file(tmp_path / "out", 20_000, process)
    process.send_signal(number)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    recording = read_recording(path)
    assert recording.missing is None
    assert [mark.kind for mark in recording.marks] == ["experiment_start", "experiment_end"]
    expected, rows, gaps, drops = (recording.counters[name] for name in COUNTED)
    assert expected == rows + gaps == recording.counters["sync_sent"]
    assert drops == 0


def moving_session(
    folder: Path, bus: str, cell: str, moves: list[dict[str, Any]], every: int = 1, **changes: Any
) -> Path:
    """Write a session that moves joint 1 from 0, at 500 Hz."""
    motion = folder / f"{cell}_motion.yaml"
    start = [0.0, 0.0, 1.57, 0.0, 0.0, 0.0]
    motion.write_text(yaml.safe_dump({"schema": "armident/trajectory/1", "start": start, "moves": moves}))
    setpoints = {"rpdo": 1, "every": every, "trajectory": str(motion), "settle_s": 0.1}
    return session_file(folder, bus, cell, **{"sync": {"period_us": 2000}, "setpoints": setpoints} | changes)


class SlowEvent(threading.Event):
    """An event that is never set, and delays every query, as on a machine that is too slow."""

    def is_set(self) -> bool:
        time.sleep(0.4)
        return super().is_set()


@pytest.mark.usefixtures("robot")
def test_sync_continues_until_the_drives_are_disabled_after_a_motion(vcan_bus: str, tmp_path: Path) -> None:
    """To enabled drives and to the guard, a missing SYNC is a failure of the master."""
    there = {"to": [0.1, 0.0, 1.57, 0.0, 0.0, 0.0], "duration": 0.6}
    session = moving_session(tmp_path, vcan_bus, "ends_late", [there])
    done = capture(load_plan(session, tmp_path / "out", None, False), SlowEvent())
    assert done.failure is None
    end = next(mark.sync for mark in done.marks if mark.kind == "experiment_end")
    settled = end + 0.1 / 0.002
    assert done.counters["sync_sent"] > settled + 100
    assert done.counters["samples.rows"] == done.counters["sync_sent"]


@pytest.mark.usefixtures("robot")
def test_a_capture_that_ends_during_a_motion_stops_the_arm(vcan_bus: str, tmp_path: Path) -> None:
    away = {"to": [1.5, 0.0, 1.57, 0.0, 0.0, 0.0], "duration": 4.0}
    session = moving_session(tmp_path, vcan_bus, "cut_short", [away])
    done = capture(load_plan(session, tmp_path / "out", 2.5, False), threading.Event())
    assert done.failure is None
    end = next(mark for mark in done.marks if mark.kind == "experiment_end")
    assert "before its end" in end.text
    robot, recording = load_robot("tx40.yaml"), read_recording(done.paths[-1])
    raw = recording.samples.raw["position"], recording.streams["demand"].raw["demand"]
    position, held = (np.linalg.solve(robot.transmission_matrix, (r / counts_per_si(robot)).T)[0] for r in raw)
    assert 0.2 < position[-1] < 1.3
    # The arm overshoots and returns to the position that the drives hold.
    assert abs(position[-1] - held[-1]) < 0.01
    assert position.max() < 1.3
    velocity = np.diff(position) / 0.002
    assert velocity.max() > 0.3
    assert np.abs(velocity[-20:]).max() < 0.05


def refused(process: ForkedProcess, out: Path, code: int) -> str:
    """Return the error line of a command, after a check that it left no files."""
    _, err = process.communicate(timeout=120)
    lines = [line for line in err.splitlines() if line.startswith("armident:")]
    assert process.returncode == code, err
    assert len(lines) == 1, err
    assert "Traceback" not in err
    assert not list(out.glob("*")) if out.exists() else True
    return lines[0]


def test_a_missing_drive_is_one_error_line_and_leaves_no_files(vcan_bus: str, tmp_path: Path) -> None:
    session = session_file(tmp_path, vcan_bus, "nobody", sdo_timeout_s=0.2)
    line = refused(armident("capture", "--config", session, "--out", tmp_path / "out"), tmp_path / "out", 2)
    assert "node 1" in line
    assert "joint_1" in line


def test_a_missing_bus_is_one_error_line_and_leaves_no_files(tmp_path: Path) -> None:
    session = session_file(tmp_path, "vcan77", "nobus")
    line = refused(armident("capture", "--config", session, "--out", tmp_path / "out"), tmp_path / "out", 2)
    assert "vcan77" in line
    assert "ip link" in line


@pytest.mark.usefixtures("robot")
def test_a_bus_that_goes_down_ends_the_capture_with_a_finished_file_and_one_error_line(
    vcan_bus: str, tmp_path: Path
) -> None:
    session = session_file(tmp_path, vcan_bus, "down", sync={"period_us": 1000}, setpoints=None)
    process = armident("capture", "--config", session, "--out", tmp_path / "out")
    path = wait_for_file(tmp_path / "out", 20_000, process)
    subprocess.run(["ip", "link", "set", vcan_bus, "down"], check=True)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 1, err
    lines = [line for line in err.splitlines() if line.startswith("armident:")]
    assert len(lines) == 1
    assert vcan_bus in lines[0]
    assert read_recording(path).missing is None


@pytest.mark.nightly
@pytest.mark.usefixtures("robot")
def test_listen_only_records_the_same_and_sends_nothing(vcan_bus: str, tmp_path: Path) -> None:
    one = session_file(tmp_path, vcan_bus, "active", sync={"period_us": 1000}, setpoints=None)
    two = session_file(tmp_path, vcan_bus, "silent", sync={"period_us": 1000}, setpoints=None)
    silent = armident("capture", "--config", two, "--out", tmp_path / "two", "--listen-only", "--json")
    wait_for_file(tmp_path / "two", 1000, silent)
    sent_before = int(Path(f"/sys/class/net/{vcan_bus}/statistics/tx_packets").read_text())
    time.sleep(1.0)
    heartbeats = int(Path(f"/sys/class/net/{vcan_bus}/statistics/tx_packets").read_text()) - sent_before
    assert heartbeats <= 6 * 12, "without another master, only the drives' heartbeats are on the bus"
    active = armident("capture", "--config", one, "--out", tmp_path / "one", "--duration", "3", "--json")
    out, err = active.communicate(timeout=120)
    assert active.returncode == 0, err
    os.kill(silent.pid, signal.SIGINT)
    silent_out, silent_err = silent.communicate(timeout=60)
    assert silent.returncode == 0, silent_err
    a, b = (read_recording(json.loads(text)["recording"]) for text in (out, silent_out))
    assert np.array_equal(a.samples.sync, b.samples.sync)
    assert np.array_equal(a.samples.raw["position"], b.samples.raw["position"])
