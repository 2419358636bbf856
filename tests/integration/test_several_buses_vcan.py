"""Several buses, CAN FD and packed samples, from the virtual drives to the recording, on vcan."""

import json
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from armident.configs import config_path
from armident.daq.recording import Recording, read_recording
from armident.drivers.vcan import ensure_vcan, remove_vcan
from tests.fixtures.processes import ForkedProcess, armident

pytestmark = pytest.mark.vcan

SLOW = {"role": "producer", "period_us": 1000, "counter": 240}


@pytest.fixture
def channels(request: pytest.FixtureRequest) -> Iterator[list[str]]:
    """Names of six buses that only this test uses."""
    names = [f"w{time.monotonic_ns() % 10**9}n{k}" for k in range(6)]
    for name in names:
        ensure_vcan(name)
    yield names
    for name in names:
        remove_vcan(name)


def session_file(folder: Path, shipped: str, channels: list[str], **changes: Any) -> Path:
    """Write a shipped session with other buses; the cell has the name of the folder."""
    source = config_path(shipped)
    text = source.read_text()
    for k in range(6):
        text = text.replace(f"vcan{k}", channels[k])
    data = yaml.safe_load(text) | changes
    data |= {"cell": folder.name[:40].lower().rstrip("_"), "robot": str(config_path(data["robot"]))}
    for drive in data["drives"]:
        drive["eds"] = str(config_path(drive["eds"]))
    if data.get("setpoints"):
        data["setpoints"]["trajectory"] = str(config_path(data["setpoints"]["trajectory"]))
    path = folder / f"{len(list(folder.glob('*.yaml')))}.yaml"
    path.write_text(yaml.safe_dump(data))
    return path


@contextmanager
def robot(session: Path, *options: Any) -> Iterator[ForkedProcess]:
    """Run the virtual arm on the session's buses."""
    process = armident("robot", "--config", session, *options)
    assert process.stdout is not None
    line = process.stdout.readline()
    assert "ready" in line, process.communicate(timeout=10)
    try:
        yield process
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
        _, err = process.communicate(timeout=60)
        print(err)


def captured(session: Path, out: Path, *options: Any) -> tuple[Recording, str]:
    """Run a capture; return its recording and its stderr."""
    process = armident("capture", "--config", session, "--out", out, "--json", *options)
    stdout, err = process.communicate(timeout=200)
    assert process.returncode == 0, err
    return read_recording(json.loads(stdout)["recording"]), err


def wait_for_line(process: ForkedProcess, text: str) -> str:
    """Return the stderr of a process up to the line with a text."""
    assert process.stderr is not None
    log = ""
    while text not in log:
        line = process.stderr.readline()
        assert line, f"ended: {log}"
        log += line
    return log


def gaps_of_samples(recording: Recording) -> set[int]:
    """Return the SYNCs in gaps, after a check that rows and gaps make up all SYNCs."""
    gaps = {k for g in recording.gaps if g.stream == "samples" for k in range(g.first, g.last + 1)}
    rows = set(recording.samples.sync.tolist())
    assert not rows & gaps
    assert rows | gaps == set(range(recording.counters["samples.expected"]))
    assert recording.counters["samples.expected"] == recording.counters["sync_sent"]
    return gaps


@pytest.mark.parametrize(
    ("shipped", "pack", "seconds"),
    [
        ("tx40_two_fd.yaml", 1, 1),
        pytest.param("tx40_six_buses.yaml", 1, 3, marks=pytest.mark.nightly),
        pytest.param("tx40_one_fd.yaml", 10, 3, marks=pytest.mark.nightly),
    ],
)
def test_seconds_at_5_khz_lose_nothing(
    shipped: str, pack: int, seconds: int, channels: list[str], tmp_path: Path
) -> None:
    session = session_file(tmp_path, shipped, channels)
    with robot(session):
        recording, err = captured(session, tmp_path / "out", "--duration", seconds)
    assert recording.missing is None
    gaps = gaps_of_samples(recording)
    sent = recording.counters["sync_sent"]
    assert sent == 5000 * seconds
    # The last SYNCs do not fill a packed TPDO.
    assert gaps == set(range(sent - sent % pack, sent)), err
    assert recording.counters["kernel_drops"] == 0
    assert recording.counters["frames_unknown"] == 0
    assert recording.counters["sync_jitter_max_us"] >= recording.counters["sync_jitter_p99_us"] >= 0
    assert np.abs(recording.samples.si("current")).max() > 0
    assert {recording.metadata[k] for k in recording.metadata if k.startswith("timestamps.")} == {"software"}


@pytest.mark.nightly
@pytest.mark.parametrize("shipped", ["tx40_two_fd.yaml", "tx40_one_fd.yaml"])
def test_replayed_samples_arrive_unchanged_on_all_buses(shipped: str, channels: list[str], tmp_path: Path) -> None:
    """Drives on CAN FD replay a recording of the classic CAN cell."""
    classic = session_file(tmp_path, "tx40_replay.yaml", channels, sync=SLOW)
    with robot(classic):
        first, _ = captured(classic, tmp_path / "first", "--duration", "2")
    (path,) = (tmp_path / "first").glob("*.mcap")
    session = session_file(tmp_path, shipped, channels, sync=SLOW)
    with robot(session, "--replay", path):
        second, _ = captured(session, tmp_path / "second", "--duration", "3")
    played, got = first.samples.raw, second.samples.raw
    # The replay begins when the last drive is enabled, before SYNC 0; its last sample is repeated.
    assert np.unique(played["current"], axis=0).shape[0] > 100
    n = min(len(played["current"]), len(got["current"])) - 1
    starts = [k for k in range(5) if np.array_equal(got["current"][: n - 5], played["current"][k : k + n - 5])]
    assert len(starts) == 1
    k = starts[0]
    assert np.array_equal(got["position"][: n - 5], played["position"][k : k + n - 5])


@pytest.mark.nightly
def test_a_bus_outage_is_a_gap_of_its_axes(channels: list[str], tmp_path: Path) -> None:
    session = session_file(tmp_path, "tx40_two_fd.yaml", channels, sync=SLOW)
    with robot(session):
        process = armident("capture", "--config", session, "--out", tmp_path / "out", "--json")
        log = wait_for_line(process, "recording to")
        time.sleep(2.0)
        subprocess.run(["ip", "link", "set", channels[1], "down"], check=True)
        log += wait_for_line(process, "went down")
        time.sleep(1.0)
        subprocess.run(["ip", "link", "set", channels[1], "up"], check=True)
        log += wait_for_line(process, "is back")
        time.sleep(2.0)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert process.returncode == 0, log + err
    recording = read_recording(json.loads(out)["recording"])
    gaps = gaps_of_samples(recording)
    print(recording.gaps, recording.counters)
    assert 500 <= len(gaps) <= recording.counters["sync_sent"] - 2000
    # No gap is of an axis on the other bus, and there are none long before and long after.
    assert {g.joint for g in recording.gaps} <= {"joint_4", "joint_5", "joint_6"}
    assert recording.counters["bus_down"] == 1
    assert recording.samples.sync[0] == 0
    assert recording.samples.sync[-1] == recording.counters["sync_sent"] - 1
    assert any("went down" in mark.text for mark in recording.marks)
    assert any("is back" in mark.text for mark in recording.marks)


@pytest.mark.nightly
def test_the_arm_moves_by_set_points_on_several_buses(channels: list[str], tmp_path: Path) -> None:
    moved = {"rpdo": 1, "every": 5, "trajectory": "trajectories/tx40_1.yaml", "settle_s": 0.2}
    session = session_file(tmp_path, "tx40_two_fd.yaml", channels, sync=SLOW, setpoints=moved)
    with robot(session):
        recording, err = captured(session, tmp_path / "out")
    gaps_of_samples(recording)
    ((first, last),) = recording.experiments()
    inside = (recording.samples.sync >= first) & (recording.samples.sync <= last)
    position = recording.samples.si("position")[inside]
    assert np.all(np.ptp(position, axis=0) > 0.1), err


@pytest.mark.nightly
def test_sync_from_the_kernel_records_every_sample(channels: list[str], tmp_path: Path) -> None:
    session = session_file(tmp_path, "tx40_replay.yaml", channels, sync=SLOW | {"source": "kernel"}, heartbeat_ms=500)
    with robot(session):
        recording, _ = captured(session, tmp_path / "out", "--duration", "2")
    assert recording.gaps == ()
    assert recording.counters["samples.rows"] == recording.counters["sync_seen"] >= 1900
    assert recording.counters["sync_repeated"] == recording.counters["sync_missing"] == 0
    assert recording.counters["sync_jitter_std_us"] > 0
