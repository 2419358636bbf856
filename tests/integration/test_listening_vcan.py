"""Captures with --listen-only: nothing is sent, and TPDOs are recorded, discovered or refused."""

import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armident.configs import config_path
from armident.daq.recording import read_recording
from armident.drivers.can.frames import Frames, frame, frames
from armident.drivers.can.socketcan import RawSocket
from armident.drivers.canopen.objects import COB_EMCY
from tests.fixtures.processes import armident
from tests.integration.test_several_buses_vcan import session_file

pytestmark = pytest.mark.vcan

PERIOD_S = 0.005
SYNC = {"role": "producer", "period_us": 5000, "counter": 240}


class UnknownDrives:
    """Six drives and their master: SYNC, a TPDO of each drive, and EMCY of node 3 every second.

    ``foreign`` holds the frames that others send on the bus. They stop after a number of ``syncs``, if it is given.
    """

    def __init__(
        self, channel: str, length: int, every: int = 1, syncs: int | None = None, counter: bool = True
    ) -> None:
        self.foreign: list[Frames] = []
        self._length, self._every, self._syncs, self._counter = length, every, syncs, counter
        self._bus = RawSocket(channel)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def _run(self) -> None:
        k, batch, begin = 0, frames(256), time.monotonic()
        while not self._stop.wait(max(0.0, begin + k * PERIOD_S - time.monotonic())) and k != self._syncs:
            counter = k % 240 + 1
            due = counter % self._every == 0
            out = frames(7 if due else 1)
            out["can_id"][0] = 0x80
            if self._counter:
                out["length"][0], out["data"][0, 0] = 1, counter
            if due:
                out["can_id"][1:], out["length"][1:] = 0x180 + np.arange(1, 7), self._length
                out["data"][1:, :4] = np.full((6, 1), k, "<i4").view(np.uint8)
            self._bus.send(out)
            if k % 200 == 100:
                self._bus.send(frame(COB_EMCY + 3, b"\x11\x86\x20\0\0\0\0\0"))
            # A socket does not receive its own frames: these are from another sender.
            if got := self._bus.receive(batch):
                self.foreign.append(batch[:got].copy())
            k += 1

    def __enter__(self) -> "UnknownDrives":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self._bus.close()


@contextmanager
def checked_silence(channel: str, length: int, every: int = 1) -> Iterator[None]:
    """Put the drives on the bus, and check at the end that no other sender was on it."""
    with UnknownDrives(channel, length, every) as drives:
        yield
    assert drives.foreign == []


def listening(channel: str, folder: Path, *options: Any, **changes: Any) -> tuple[int | None, str, str]:
    """Return exit code, stdout and stderr of a capture of 2 s with --listen-only."""
    session = session_file(folder, "tx40_replay.yaml", [channel] * 6, sync=SYNC, **changes)
    process = armident(
        "capture", "--config", session, "--out", folder / "out", "--listen-only", "--duration", "2", "--json", *options
    )
    out, err = process.communicate(timeout=100)
    return process.returncode, out, err


def test_streams_of_the_session_are_recorded_and_nothing_is_sent(vcan_bus: str, tmp_path: Path) -> None:
    with checked_silence(vcan_bus, 8):
        code, out, err = listening(vcan_bus, tmp_path)
    assert code == 0, err
    recording = read_recording(json.loads(out)["recording"])
    assert recording.counters["samples.rows"] >= 300
    assert recording.gaps == ()
    assert np.all(np.diff(recording.samples.raw["position"][:, 0]) == 1)
    assert "node 3 (joint_3): EMCY 8611h, following error (error register 20h)" in err
    assert recording.counters["emcy"] == len([mark for mark in recording.marks if mark.kind == "emcy"]) >= 1


@pytest.mark.nightly
def test_a_capture_ends_after_its_duration_although_sync_has_stopped(vcan_bus: str, tmp_path: Path) -> None:
    with UnknownDrives(vcan_bus, 8, syncs=1500):
        code, out, err = listening(vcan_bus, tmp_path, "--duration", "9")
    assert code == 0, err
    assert "the duration is over, and SYNC has stopped" in err
    recording = read_recording(json.loads(out)["recording"])
    assert "has no counter" not in err
    assert recording.counters["sync_stopped"] == 1
    assert 200 <= recording.counters["samples.rows"] <= 1500


@pytest.mark.nightly
def test_sync_without_a_counter_is_noted_where_streams_are_slower(vcan_bus: str, tmp_path: Path) -> None:
    """The session expects a counter; all streams but one are sent on every SYNC."""
    streams = {
        "samples": {"tpdo": 1, "objects": ["position", "current", "status"]},
        "demand": {"tpdo": 2, "every": 5, "objects": ["demand"]},
    }
    with UnknownDrives(vcan_bus, 8, counter=False):
        code, out, err = listening(vcan_bus, tmp_path, streams=streams)
    assert code == 0, err
    assert "demand: SYNC has no counter, so it is unknown which SYNCs are answered" in err
    recording = read_recording(json.loads(out)["recording"])
    assert recording.counters["samples.rows"] >= 300
    assert recording.counters["demand.rows"] == 0


def test_the_default_mapping_of_an_eds_is_discovered_and_nothing_is_sent(vcan_bus: str, tmp_path: Path) -> None:
    """The session maps eight bytes; the drives send six, as their EDS maps by default."""
    text = config_path("eds/cia402_servo.eds").read_text()
    begin, end = text.index("[1A00sub0]"), text.index("[1A00sub3]")
    mapped = text[begin:end].replace("DefaultValue=1\n", "DefaultValue=2\n")
    mapped = mapped.replace("0x60410010", "0x60640020").replace("DefaultValue=0\n", "DefaultValue=0x60780010\n")
    eds = tmp_path / "drive.eds"
    eds.write_text(text[:begin] + mapped + text[end:])
    drives = [{"joint": f"joint_{k}", "node_id": k, "eds": str(eds)} for k in range(1, 7)]
    with checked_silence(vcan_bus, 6):
        code, out, err = listening(vcan_bus, tmp_path, "--sniff", "1", drives=drives)
    assert code == 0, err
    assert "TPDO1 is samples: position, current on every 1. SYNC, as in the EDS" in err
    recording = read_recording(json.loads(out)["recording"])
    assert sorted(recording.samples.raw) == ["current", "position"]
    assert recording.counters["samples.rows"] >= 300


@pytest.mark.nightly
def test_an_unknown_mapping_is_refused_and_nothing_is_sent(vcan_bus: str, tmp_path: Path) -> None:
    with checked_silence(vcan_bus, 5):
        code, _, err = listening(vcan_bus, tmp_path, "--sniff", "1")
    assert code == 2
    assert "181h with 5 bytes, every 1 SYNC" in err
    assert "add the objects of the TPDO to streams" in err
    assert not list((tmp_path / "out").glob("*"))


@pytest.mark.nightly
def test_a_tpdo_of_another_length_than_mapped_is_detected(vcan_bus: str, tmp_path: Path) -> None:
    with checked_silence(vcan_bus, 6):
        code, out, err = listening(vcan_bus, tmp_path)
    assert code == 0, err
    assert "joint_1: TPDO of samples has another length than mapped; check its PDO mapping" in err
    recording = read_recording(json.loads(out)["recording"])
    assert recording.counters["samples.rows"] == 0
    assert recording.counters["tpdo_wrong_length"] > 1000
    assert {gap.reason for gap in recording.gaps} == {"wrong length"}
