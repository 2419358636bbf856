"""Heartbeats are judged by their receive times, independently of the time of the update."""

import pytest

from armident.drivers.canopen.heartbeat_monitor import HeartbeatMonitor

BEATS = 0.05


def beats(drive: str, first: float, last: float) -> list[tuple[str, float]]:
    """A heartbeat every 50 ms from ``first`` to ``last``."""
    return [(drive, first + BEATS * k) for k in range(round((last - first) / BEATS) + 1)]


def update_regularly(monitor: HeartbeatMonitor, until: float, since: float = 0.0, step: float = 0.02) -> None:
    """Update regularly without any heartbeat."""
    for k in range(1, round((until - since) / step) + 1):
        monitor.update([], since + step * k)


def test_heartbeats_that_arrive_between_updates_are_no_silence() -> None:
    monitor = HeartbeatMonitor("ab", 0.0)
    monitor.update([*beats("a", 0.1, 1.9), *beats("b", 0.05, 1.95)], 2.0)
    assert monitor.ended_silence("a") == pytest.approx(0.1, abs=0.01)
    assert monitor.silence("b") == pytest.approx(0.05)


def test_a_drive_that_is_silent_while_others_send_is_detected_even_after_a_long_update_interval() -> None:
    monitor = HeartbeatMonitor("ab", 0.0)
    monitor.update([("a", 0.1), ("a", 0.9), *beats("b", 0.05, 1.05)], 1.1)
    assert monitor.ended_silence("a") == pytest.approx(0.8)
    monitor.update(beats("b", 1.15, 2.05), 2.1)
    assert monitor.ended_silence("a") == 0.0
    assert monitor.silence("a") == pytest.approx(1.2, abs=0.01)


def test_a_silent_drive_is_detected_in_time() -> None:
    monitor = HeartbeatMonitor("a", 0.0)
    update_regularly(monitor, 0.44)
    assert monitor.silence("a") == pytest.approx(0.44)


@pytest.mark.parametrize("heard", [[], [("a", 1.0), ("b", 1.0)]])
def test_a_delayed_machine_reports_no_silence(heard: list[tuple[str, float]]) -> None:
    """In two cases: heartbeats of that time are stamped late, or have not been received yet."""
    monitor = HeartbeatMonitor("ab", 0.0)
    monitor.update([("a", 0.15), ("b", 0.2)], 0.22)
    monitor.update(heard, 1.01)
    for drive in "ab":
        assert max(monitor.ended_silence(drive), monitor.silence(drive)) < 0.2
    # A drive without further heartbeats is still detected.
    update_regularly(monitor, 1.45, since=1.01)
    assert monitor.silence("a") > 0.4


def test_a_repeatedly_delayed_machine_still_detects_a_silent_drive() -> None:
    monitor = HeartbeatMonitor("a", 0.0)
    for k in range(1, 5):
        monitor.update([], 0.3 * k)
    assert monitor.silence("a") == pytest.approx(0.9)
