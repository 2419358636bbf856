"""Captures of drives with each oddity that CiA 301 and CiA 402 allow: nothing is lost, and deviations are named."""

import logging
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from armident.configs import ConfigError, load_robot, load_session
from armident.daq.capture.capture import CaptureResult, capture, load_plan
from armident.daq.recording import read_recording
from armident.drivers.canopen.master import DriveMaster
from armident.virtual_robot.oddities import ODDITIES
from tests.fixtures.processes import ForkedProcess, armident
from tests.integration.test_capture_vcan import session_file

pytestmark = [pytest.mark.vcan, pytest.mark.nightly]

ODD = "node 3 (joint_3): "
PERIOD_US = 4000
REST = [0.0, 0.0, 1.57, 0.0, 0.0, 0.0]
AWAY = [0.05, 0.0, 1.57, 0.0, 0.0, 0.0]

SAID: dict[str, str | None] = {
    "no1019": "has no SYNC counter (1019h): SYNC is sent without one",
    "no60c0": None,
    "no60c2": "has no interpolation time (60C2h)",
    "interpolation_rounds": "interpolates set points over 21000 us (60C2h) instead of 20000 us",
    "no608f": "has no encoder resolution (608Fh)",
    "no6075": "has no rated current (6075h)",
    "no_product_code": "has no product code (1018h:2)",
    "no1017": "has no heartbeat (1017h): supervised by node guarding every 100 ms",
    "no_supervision": "has no heartbeat (1017h) and does not answer node guarding",
    "heartbeat_rounds": "sends its heartbeat (1017h) every 128 ms instead of 100 ms",
    "bit30_kept": None,
    "bit30_demanded": None,
    "pdo_fixed": "is stopped by SDO, not by RPDO2",
    "tpdo_timers": "had an inhibit time of 50 ms in TPDO1: 0 is written",
    "no_inhibit_time": None,
    "write_late": None,
    "mode_when_enabled": None,
    "mode_unknown": None,
    "target_follows": None,
    "abort_busy": None,
    "twice": None,
    "twice_late": None,
    "slow_sdo": None,
    "short_answer": None,
    "other_client": None,
    "autostart": None,
    "slow_boot": None,
}
"""Remark of the capture about each oddity with which it moves the arm; ``None``: none."""


def odd_session(folder: Path, bus: str, cell: str, **changes: Any) -> Path:
    """Write a session that moves joint 1 there and back, within 0.6 s."""
    moves = [{"to": AWAY, "duration": 0.2}, {"to": REST, "duration": 0.2}]
    motion = folder / "motion.yaml"
    motion.write_text(yaml.safe_dump({"schema": "armident/trajectory/1", "start": REST, "moves": moves}))
    setpoints = {"rpdo": 1, "every": 5, "trajectory": str(motion), "settle_s": 0.1}
    timing = {"sync": {"period_us": PERIOD_US}, "setpoints": setpoints}
    return session_file(folder, bus, cell, **timing | changes)


@contextmanager
def robot(session: Path, *oddities: str) -> Iterator[ForkedProcess]:
    """Run the virtual arm with oddities of the drive of joint 3."""
    scenario = session.with_suffix(".scenario.yaml")
    drives = {"joint_3": {"oddities": list(oddities)}}
    scenario.write_text(yaml.safe_dump({"schema": "armident/scenario/1", "drives": drives}))
    process = armident("robot", "--config", session, "--scenario", scenario, "--noise", 0)
    assert process.stdout is not None
    assert "ready" in process.stdout.readline(), process.communicate(timeout=10)
    try:
        yield process
    finally:
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=60)


def recorded(session: Path, duration: float | None = None) -> CaptureResult:
    """Capture, and check that every SYNC has been answered by all drives."""
    done = capture(load_plan(session, session.parent / "out", duration, False), threading.Event())
    assert done.failure is None
    assert done.counters["samples.rows"] == done.counters["sync_sent"] == done.counters["sync_seen"] > 100
    assert done.counters["samples.in_gaps"] == done.counters["kernel_drops"] == 0
    assert done.counters["heartbeat_lost"] == 0
    return done


def events_within(master: DriveMaster, seconds: float, text: str) -> list[str]:
    """Return the first events that contain a text, within a time."""
    told: list[str] = []
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline and not told:
        told += [event.text for event in master.supervise() if text in event.text]
        time.sleep(0.01)
    return told


def remarks(done: CaptureResult) -> list[str]:
    """Return the remarks about drives that the recording holds."""
    return [mark.text for mark in done.marks if mark.kind == "note"]


@pytest.mark.parametrize("oddity", SAID)
def test_an_arm_with_an_odd_drive_is_moved_and_recorded(
    vcan_bus: str, tmp_path: Path, oddity: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "armident")
    session = odd_session(tmp_path, vcan_bus, "odd")
    with robot(session, oddity):
        done = recorded(session)
    said = SAID[oddity]
    if said is None:
        assert remarks(done) == []
    else:
        assert any(text.startswith(ODD + said) for text in remarks(done)), remarks(done)
        assert ODD + said in caplog.text
    # Set points and demands keep their SYNCs: the demand is the same at both ends of the motion, and differs between.
    recording = read_recording(done.paths[0])
    ((first, last),) = recording.experiments()
    demand = recording.streams["demand"]
    assert np.array_equal(demand.sync, np.arange(4, recording.counters["sync_sent"], 5))
    ends = demand.raw["demand"][np.isin(demand.sync, [first, last])]
    assert np.array_equal(ends[0], ends[1])
    assert np.ptp(demand.raw["demand"][:, 0]) > 1000


COMBINED = [
    ("no1019", "mode_unknown", "abort_busy"),
    ("slow_boot", "no1017"),
    ("pdo_fixed", "target_follows"),
    ("no60c0", "no60c2", "no608f", "no6075", "no_product_code", "no_supervision"),
    ("bit30_kept", "write_late", "heartbeat_rounds"),
    ("bit30_demanded", "autostart", "short_answer", "slow_sdo"),
    ("pdo_fixed", "cob_fixed", "mode_when_enabled", "twice_late", "abort_busy"),
    ("twice", "other_client", "no6075"),
    ("twice_late", "other_client"),
]
"""Oddities of one drive that meet in the same steps of its configuration."""


@pytest.mark.parametrize("oddities", COMBINED, ids="-".join)
def test_an_arm_with_a_drive_of_several_oddities_is_moved_and_recorded(
    vcan_bus: str, tmp_path: Path, oddities: tuple[str, ...]
) -> None:
    session = odd_session(tmp_path, vcan_bus, "combined")
    with robot(session, *oddities):
        done = recorded(session)
    expected = [ODD + said for oddity in oddities if (said := SAID.get(oddity)) is not None]
    assert all(any(text.startswith(said) for text in remarks(done)) for said in expected), remarks(done)
    assert len(remarks(done)) == len(expected)


def test_thousands_of_emergency_messages_cost_no_sample(vcan_bus: str, tmp_path: Path) -> None:
    session = odd_session(tmp_path, vcan_bus, "burst", setpoints=None)
    with robot(session, "emcy_burst"):
        done = recorded(session, 2.0)
    assert done.counters["emcy"] > 500
    assert f"{ODD}EMCY 8611h, following error" in next(mark.text for mark in done.marks if mark.kind == "emcy")


def test_a_read_only_mapping_that_differs_is_refused_with_the_difference(vcan_bus: str, tmp_path: Path) -> None:
    session = odd_session(tmp_path, vcan_bus, "fixed")
    difference = (
        r"node 3 \(joint_3\): refuses object 1A00h:.*read.only.*; 1A00h maps .*60410010h \(status\), the session"
    )
    with robot(session, "pdo_fixed_other"), pytest.raises(ConfigError, match=difference):
        recorded(session)


def test_a_read_only_pdo_that_is_right_is_not_written(vcan_bus: str, tmp_path: Path) -> None:
    """Only the transmission type differs from that of the session."""
    session = odd_session(tmp_path, vcan_bus, "fixed")
    with robot(session, "pdo_fixed", "cob_fixed"):
        recorded(session)


def test_a_drive_that_needs_longer_than_its_time_to_boot_is_named(vcan_bus: str, tmp_path: Path) -> None:
    session = odd_session(tmp_path, vcan_bus, "boots", boot_timeout_s=0.5, sdo_timeout_s=0.2)
    silent = rf"node 3 \(joint_3\): does not answer on {vcan_bus} within 0.5 s"
    with robot(session, "slow_boot"), pytest.raises(ConfigError, match=silent):
        recorded(session)


def test_the_loss_of_a_drive_with_node_guarding_is_detected(vcan_bus: str, tmp_path: Path) -> None:
    path = odd_session(tmp_path, vcan_bus, "guarded", setpoints=None)
    session = load_session(path)
    with robot(path, "no1017") as process, DriveMaster(session, load_robot(session.robot)) as master:
        master.configure()
        master.start(enable=False)
        process.send_signal(signal.SIGSTOP)
        try:
            told = events_within(master, 10.0, "no answer to node guarding")
        finally:
            process.send_signal(signal.SIGCONT)
        assert any(text.startswith(ODD) for text in told), told
        assert any(text.startswith(ODD) for text in events_within(master, 10.0, ODD + "heartbeat is back"))


def test_sync_without_a_counter_needs_no_odd_drive(vcan_bus: str, tmp_path: Path) -> None:
    session = odd_session(tmp_path, vcan_bus, "plain", sync={"period_us": PERIOD_US, "counter": 0})
    with robot(session, "no60c0"):
        for _ in range(2):
            done = recorded(session)
            assert remarks(done) == []
            assert done.counters["demand.rows"] == done.counters["sync_sent"] // 5


def test_every_oddity_has_its_test() -> None:
    assert set(SAID) | {"emcy_burst", "pdo_fixed_other", "cob_fixed", "tpdo_timers_fixed"} == set(ODDITIES)
