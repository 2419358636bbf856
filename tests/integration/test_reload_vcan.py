"""Reload during a capture on vcan: one change is applied, one is refused, and no SYNC is lost."""

import json
import os
import signal
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from armident.daq.recording import join_parts, read_recording
from tests.fixtures.processes import ForkedProcess, armident
from tests.integration.test_capture_vcan import robot, session_file, wait_for_file

__all__ = ["robot"]
pytestmark = [pytest.mark.vcan, pytest.mark.nightly]

COUNTED = ("samples.expected", "samples.rows", "samples.in_gaps", "kernel_drops")


def lines_until(process: ForkedProcess, word: str) -> Iterator[str]:
    """Yield the lines of stderr up to the first with a word."""
    assert process.stderr is not None
    for line in process.stderr:
        yield line
        if word in line:
            return


@pytest.mark.usefixtures("robot")
def test_no_sync_is_lost_during_a_reload(vcan_bus: str, tmp_path: Path) -> None:
    plain: dict[str, Any] = {"setpoints": None, "sync": {"role": "producer", "period_us": 1000, "counter": 240}}
    data = yaml.safe_load(session_file(tmp_path, vcan_bus, "reloaded", **plain).read_text())
    # The virtual drives have no temperature: 6061h (mode of operation) stands for it, 8 in units of 5 degrees is 40.
    warm = {"index": 0x6061, "type": "int8", "scale": 5.0, "every_s": 1.0}
    plain["drives"] = [drive | {"temperature": warm} for drive in data["drives"]]
    session_file(tmp_path, vcan_bus, "reloaded", **plain)
    arguments = "--config", tmp_path / "reloaded.yaml", "--out", tmp_path / "out", "--json"
    process = armident("capture", *arguments)
    wait_for_file(tmp_path / "out", 50_000, process)

    session_file(tmp_path, vcan_bus, "reloaded", **plain, recording={"rotate_minutes": 0.01}, metrics={"port": 0})
    os.kill(process.pid, signal.SIGHUP)
    lines = list(lines_until(process, "reloaded"))
    assert lines[-1].endswith("reloaded.yaml: metrics.port, recording.rotate_minutes\n")
    (address,) = [line.split()[-1] for line in lines if line.startswith("metrics on")]

    session_file(tmp_path, vcan_bus, "reloaded", **(plain | {"heartbeat_ms": 77}))
    os.kill(process.pid, signal.SIGHUP)
    *_, refusal = lines_until(process, "not reloaded")
    assert refusal.endswith("reloaded.yaml: heartbeat_ms: cannot change during a capture; restart the capture\n")

    wait_for_file(tmp_path / "out", 50_000, process)
    directly = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    deadline = 100
    while deadline and b'joint="joint_6"' not in (page := directly.open(address, timeout=10).read()):
        deadline -= 1
        time.sleep(0.1)
    labels = b'{cell="reloaded",joint="joint_1",robot="tx40"}'
    assert b"armident_capture_drive_temperature_celsius%s 40.0" % labels in page
    assert b"armident_capture_clock_synchronised" in page
    process.send_signal(signal.SIGTERM)
    out, err = process.communicate(timeout=200)
    assert process.returncode == 0, err
    document = json.loads(out)
    recording = join_parts([read_recording(path) for path in document["recordings"]])
    expected, rows, gaps, drops = (document["counters"][name] for name in COUNTED)
    assert expected == rows == document["counters"]["sync_sent"]
    assert gaps == drops == 0
    assert len(document["recordings"]) > 1
    assert np.array_equal(recording.samples.sync, np.arange(rows))
