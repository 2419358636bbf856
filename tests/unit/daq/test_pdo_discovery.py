"""Discovery of TPDOs by listening: discovered streams and refused bus traffic."""

import logging

import numpy as np
import pytest

from armident.configs import ConfigError, SessionConfig, load_session
from armident.daq.capture.pdo_discovery import bus_statistics, default_mapping, with_sent_streams
from armident.drivers.can.frames import Frames, frames
from armident.drivers.canopen.eds import read_objects

SYNCS = 500


def bus_frames(tpdos: dict[int, tuple[int, int]], period_us: int = 200, fd: bool = False, late: float = 0.0) -> Frames:
    """Return SYNCs and frames of identifiers with length and interval; a share ``late`` follows the next SYNC."""
    rng = np.random.default_rng(4)
    rows: list[tuple[float, int, int]] = []
    for k in range(SYNCS):
        t = k * period_us
        rows.append((t, 0x80, 1))
        for can_id, (length, every) in tpdos.items():
            if (k + 1) % every == 0:
                rows.append((t + (1.1 if rng.random() < late else 0.3) * period_us, can_id, length))
    rows.sort(key=lambda row: row[0])
    out = frames(len(rows), fd=fd)
    out["t_ns"] = [1e18 + 1000 * t for t, _, _ in rows]
    out["can_id"], out["length"] = [r[1] for r in rows], [r[2] for r in rows]
    return out


def discovered(received: Frames, session: SessionConfig) -> SessionConfig:
    return with_sent_streams(session, [bus_statistics(session.all_buses[0].channel, received)])


def six(length: int, every: int, base: int = 0x180) -> dict[int, tuple[int, int]]:
    return {base + node: (length, every) for node in range(1, 7)}


@pytest.mark.parametrize("late", [0.0, 0.005])
def test_streams_of_the_session_are_verified(late: float, caplog: pytest.LogCaptureFixture) -> None:
    """Set points on the bus and some late answers do not matter."""
    session = load_session("tx40_cell.yaml")
    received = bus_frames(six(8, 1) | six(4, 5, 0x280) | six(4, 5, 0x200), late=late)
    caplog.set_level(logging.INFO, "armident")
    assert discovered(received, session).streams == session.streams
    assert caplog.messages == [
        "TPDO1 is samples: position, current, status on every 1. SYNC, as in the session",
        "TPDO2 is demand: demand on every 5. SYNC, as in the session",
    ]


def test_a_stream_that_no_drive_sends_is_left_out() -> None:
    found = discovered(bus_frames(six(8, 1)), load_session("tx40_cell.yaml"))
    assert list(found.streams) == ["samples"]


@pytest.mark.slow
def test_packed_samples_are_discovered_by_length_and_interval(caplog: pytest.LogCaptureFixture) -> None:
    session = load_session("tx40_one_fd.yaml")
    caplog.set_level(logging.INFO, "armident")
    assert discovered(bus_frames(six(64, 10), fd=True), session).streams == session.streams
    (line,) = caplog.messages
    assert "position, current on every 10. SYNC" in line


@pytest.mark.parametrize(
    ("tpdos", "period_us", "message"),
    [
        (six(8, 1), 1000, "SYNC has a period of 1000 us, but sync.period_us of the session is 200"),
        ({0x181: (8, 1)}, 200, "TPDO1: sent by joint_1, but not by joint_2, "),
        (six(8, 2), 200, "181h with 8 bytes, every 2 SYNC: .* maps 2 bytes by default"),
        (six(4, 5, 0x280), 200, "no drive sends a TPDO on every SYNC"),
        ({}, 200, "no drive sends a TPDO on every SYNC"),
    ],
)
def test_unknown_mappings_are_refused(tpdos: dict[int, tuple[int, int]], period_us: int, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        discovered(bus_frames(tpdos, period_us), load_session("tx40_cell.yaml"))


def test_a_length_that_changes_is_refused() -> None:
    received = bus_frames(six(8, 1))
    received["length"][np.flatnonzero(received["can_id"] == 0x183)[50:]] = 6
    with pytest.raises(ConfigError, match=r"node 3 \(joint_3\), TPDO1 183h with 6 or 8 bytes.*its length changes"):
        discovered(received, load_session("tx40_cell.yaml"))


def test_a_bus_without_sync_is_refused() -> None:
    with pytest.raises(ConfigError, match="no SYNC received"):
        bus_statistics("can0", bus_frames({})[:2])


def test_the_defaults_of_an_eds_are_names_of_streams() -> None:
    drive = load_session("tx40_cell.yaml").drives[2]
    assert default_mapping(drive, read_objects(drive.eds, drive.node_id), 1) == (0x183, ("status",))
