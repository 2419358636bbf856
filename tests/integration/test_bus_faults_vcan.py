"""Faults of buses and drives during a capture are logged and counted, and the capture recovers from them."""

import json
import signal
import subprocess
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from armident.daq.recording import read_recording
from armident.drivers.can.frames import ERROR_FLAG, frame, frames
from armident.drivers.can.receiver import BusEvent, Receiver
from armident.drivers.can.socketcan import RawSocket
from armident.drivers.canopen.objects import NmtCommand
from armident.drivers.vcan import ensure_vcan, remove_vcan
from tests.fixtures.processes import armident
from tests.integration.test_several_buses_vcan import (
    SLOW,
    gaps_of_samples,
    robot,
    session_file,
    wait_for_line,
)

pytestmark = pytest.mark.vcan


def events_until(receiver: Receiver, kind: str) -> list[BusEvent]:
    """Return the events up to the first of a kind; frames are received meanwhile."""
    found: list[BusEvent] = []
    deadline = time.monotonic() + 10
    while not any(event.kind == kind for event in found):
        assert time.monotonic() < deadline, found
        list(receiver.drain())
        found += receiver.events()
        time.sleep(0.01)
    return found


@pytest.mark.parametrize("removed", [False, True])
def test_a_bus_is_read_again_after_an_outage(vcan_buses: list[str], removed: bool) -> None:
    """An interface that was down keeps its socket; one that was removed gets a new one. The other bus works on."""
    names = vcan_buses
    with Receiver([partial(RawSocket, name) for name in names]) as receiver:
        socket = receiver._buses[1].bus
        if removed:
            remove_vcan(names[1])
        else:
            subprocess.run(["ip", "link", "set", names[1], "down"], check=True)
        (down,) = events_until(receiver, "bus_down")
        assert (down.bus, receiver.down, receiver.all_down_s) == (1, (False, True), 0.0)
        with RawSocket(names[0], filters=()) as other:
            other.send(frame(0x123))
        assert [(k, batch["can_id"].tolist()) for k, batch, _ in receiver.drain()] == [(0, [0x123])]
        ensure_vcan(names[1])
        events_until(receiver, "bus_up")
        assert receiver.down == (False, False)
        assert (receiver._buses[1].bus is socket) is not removed
        with RawSocket(names[1], filters=()) as other:
            other.send(frame(0x124))
        assert [(k, batch["can_id"].tolist()) for k, batch, _ in receiver.drain()] == [(1, [0x124])]


def test_error_frames_are_removed_counted_and_reported(vcan_bus: str) -> None:
    with (
        Receiver([lambda: RawSocket(vcan_bus, errors=True)]) as receiver,
        RawSocket(vcan_bus, filters=()) as sender,
    ):
        sent = frames(4)
        sent["can_id"], sent["length"] = [0x181, ERROR_FLAG | 0x40, 0x182, ERROR_FLAG | 0x100], 8
        sender.send(sent)
        batches = [batch for _, batch, _ in receiver.drain()]
        assert np.concatenate(batches)["can_id"].tolist() == [0x181, 0x182]
        assert receiver.error_frames == 2
        assert [event.kind for event in receiver.events()] == ["bus_off", "bus_restarted"]


@pytest.mark.nightly
def test_a_drive_that_reboots_is_configured_again_and_its_errors_are_logged(vcan_bus: str, tmp_path: Path) -> None:
    texts = {0xFF01: "encoder battery low"}
    session = session_file(tmp_path, "tx40_replay.yaml", [vcan_bus] * 6, sync=SLOW, emcy_texts=texts)
    with robot(session):
        process = armident("capture", "--config", session, "--out", tmp_path / "out", "--json")
        log = wait_for_line(process, "recording to")
        time.sleep(1.5)
        with RawSocket(vcan_bus, filters=()) as other:
            other.send(frame(0x82, bytes([0x01, 0xFF, 0x81, 1, 2, 0, 0, 0])))
            log += wait_for_line(process, "EMCY")
            error = frame(0x0)
            error["can_id"], error["length"] = ERROR_FLAG | 0x20, 8
            other.send(error)
            other.send(frame(0, bytes([NmtCommand.RESET_NODE, 2])))
        log += wait_for_line(process, "configured again")
        time.sleep(2.0)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert process.returncode == 0, log + err
    assert "node 2 (joint_2): EMCY FF01h, encoder battery low (error register 81h, manufacturer 01 02 00 00 00)" in log
    assert "node 2 (joint_2): has booted again" in log
    recording = read_recording(json.loads(out)["recording"])
    gaps = gaps_of_samples(recording)
    assert gaps
    assert {gap.joint for gap in recording.gaps} == {"joint_2"}
    assert recording.counters["rebooted"] == 1
    assert recording.counters["emcy"] >= 1
    assert recording.counters["error_frames"] == 1
    # It answers again; on a busy machine answers come in bursts, some of which are discarded as ambiguous.
    (configured,) = (mark.sync for mark in recording.marks if "configured again" in mark.text)
    assert np.count_nonzero(recording.samples.sync > configured) > 200
