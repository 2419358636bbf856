"""What can be told from listening alone, and what is refused."""

import numpy as np
import pytest

from armident.configs import ConfigError, SessionConfig, load_session
from armident.daq.capture.pdo_discovery import default_mapping, sniffed, survey
from armident.drivers.can.frames import Frames, frames

SYNCS = 500


def heard(tpdos: dict[int, tuple[int, int]], period_us: int = 200, fd: bool = False, late: float = 0.0) -> Frames:
    """SYNC, and identifiers that come with a length on every n-th; a share of them ``late``, after the next SYNC."""
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


def told(frames_heard: Frames, session: SessionConfig) -> tuple[SessionConfig, list[str]]:
    lines: list[str] = []
    found = sniffed(session, [survey(session.all_buses[0].channel, frames_heard)], lines.append)
    return found, lines


def six(length: int, every: int, base: int = 0x180) -> dict[int, tuple[int, int]]:
    return {base + node: (length, every) for node in range(1, 7)}


@pytest.mark.parametrize("late", [0.0, 0.005])
def test_what_the_session_says_is_verified(late: float) -> None:
    """Set points on the bus and a few late answers disturb nothing."""
    session = load_session("tx40_cell.yaml")
    frames_heard = heard(six(8, 1) | six(4, 5, 0x280) | six(4, 5, 0x200), late=late)
    found, lines = told(frames_heard, session)
    assert found.streams == session.streams
    assert lines == [
        "TPDO1 is samples: position, current, status on every 1. SYNC, as the session says",
        "TPDO2 is demand: demand on every 5. SYNC, as the session says",
    ]


def test_a_stream_that_nobody_sends_is_left_out() -> None:
    found, _ = told(heard(six(8, 1)), load_session("tx40_cell.yaml"))
    assert list(found.streams) == ["samples"]


def test_packed_samples_are_told_by_length_and_interval() -> None:
    session = load_session("tx40_one_fd.yaml")
    found, (line,) = told(heard(six(64, 10), fd=True), session)
    assert found.streams == session.streams
    assert "position, current on every 10. SYNC" in line


@pytest.mark.parametrize(
    ("tpdos", "period_us", "message"),
    [
        (six(8, 1), 1000, "SYNC comes every 1000 us, the session says sync.period_us 200"),
        ({0x181: (8, 1)}, 200, "TPDO1: joint_1 sends it, joint_2, .* not"),
        (six(8, 2), 200, "181h with 8 bytes, every 2 SYNC: .* maps 2 bytes by default"),
        (six(4, 5, 0x280), 200, "no TPDO comes on every SYNC"),
        ({}, 200, "no TPDO comes on every SYNC"),
    ],
)
def test_what_cannot_be_told_is_refused(tpdos: dict[int, tuple[int, int]], period_us: int, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        told(heard(tpdos, period_us), load_session("tx40_cell.yaml"))


def test_a_length_that_changes_is_refused() -> None:
    frames_heard = heard(six(8, 1))
    frames_heard["length"][np.flatnonzero(frames_heard["can_id"] == 0x183)[50:]] = 6
    with pytest.raises(ConfigError, match=r"node 3 \(joint_3\), TPDO1 183h with 6 or 8 bytes.*its length changes"):
        told(frames_heard, load_session("tx40_cell.yaml"))


def test_a_bus_without_sync_tells_nothing() -> None:
    with pytest.raises(ConfigError, match="no SYNC heard"):
        survey("can0", heard({})[:2])


def test_the_defaults_of_an_eds_are_names_of_streams() -> None:
    drive = load_session("tx40_cell.yaml").drives[2]
    assert default_mapping(drive, 1) == (0x183, ("status",))
