"""Reload of a configuration: applied if no sample is lost, else refused with one log record."""

import logging
import time
from pathlib import Path
from typing import Any

import pytest
import yaml

from armident.configs import ConfigError, SessionConfig, load_robot, load_session
from armident.configs.loading import HERE
from armident.daq.capture.plan import CapturePlan
from armident.daq.capture.recording_files import limits, open_series
from armident.daq.capture.reload import Reloader, differences
from armident.daq.logs import LineFormatter
from armident.daq.matching.streams import captured_streams
from armident.daq.recording import read_recording
from tests.unit.daq.test_recording import make_recording


def cell(path: Path, **changes: Any) -> Path:
    """Write the shipped session with changed keys of the first or second level (``recording={...}``)."""
    data = yaml.safe_load((HERE / "cells" / "tx40_cell.yaml").read_text())
    data["robot"] = str(HERE / "robots" / "tx40.yaml")
    data["setpoints"]["trajectory"] = str(HERE / "trajectories" / "tx40_excitation.yaml")
    for drive in data["drives"]:
        drive["eds"] = str(HERE / "eds" / "cia402_servo.eds")
    for key, value in changes.items():
        data[key] = {**data.get(key, {}), **value} if isinstance(value, dict) else value
    path.write_text(yaml.safe_dump(data))
    return path


class Capture:
    """A running capture, as far as a reload is concerned."""

    def __init__(self, caplog: pytest.LogCaptureFixture, path: Path) -> None:
        caplog.set_level(logging.INFO, "armident")
        self._caplog = caplog
        session = load_session(path)
        robot = load_robot(session.robot)
        plan = CapturePlan(session, robot, captured_streams(session, robot), None, path.parent, config=path)
        self.taken: list[SessionConfig] = []
        self.reloader = Reloader(path, plan, [self.take])

    def take(self, session: SessionConfig) -> None:
        if session.metrics.port == 1:
            raise ConfigError("metrics: cannot listen on 127.0.0.1:1")
        self.taken.append(session)

    def reload(self) -> str:
        """Request a reload, and return the line that is logged."""
        before = len(self._caplog.records)
        self.reloader.request()
        until = time.monotonic() + 20
        while len(self._caplog.records) == before and time.monotonic() < until:
            self.reloader.apply()
            time.sleep(0.005)
        return LineFormatter().format(self._caplog.records[-1])


def test_changeable_keys_are_applied(caplog: pytest.LogCaptureFixture, tmp_path: Path) -> None:
    capture = Capture(caplog, cell(tmp_path / "cell.yaml"))
    cell(tmp_path / "cell.yaml", recording={"rotate_mb": 7.0, "keep_days": 3.0}, zenoh={"commands": True})
    assert capture.reload().endswith("cell.yaml: recording.keep_days, recording.rotate_mb, zenoh.commands")
    assert capture.taken[-1].recording.rotate_mb == 7.0
    assert capture.reload().endswith("the session has not changed")
    capture.reloader.close()


def test_options_of_a_trigger_can_change_and_its_presence_cannot(
    caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    path = tmp_path / "cell.yaml"
    capture = Capture(caplog, cell(path, recording={"trigger": {"before_s": 5.0, "events": ["command"]}}))
    cell(path, recording={"trigger": {"before_s": 8.0, "events": ["emcy"]}, "drain_ms": 10, "chunk_ms": 50})
    line = capture.reload()
    assert line.endswith(
        ": recording.chunk_ms, recording.drain_ms, recording.trigger.before_s, recording.trigger.events"
    )
    trigger = capture.taken[-1].recording.trigger
    assert trigger is not None
    assert (trigger.before_s, trigger.events) == (8.0, ("emcy",))
    cell(path)
    assert "recording.trigger: cannot change during a capture" in capture.reload()
    capture.reloader.close()


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"sync": {"period_us": 1000}}, "sync.period_us"),
        ({"recording": {"directory": "elsewhere", "rotate_mb": 5.0}}, "recording.directory"),
        ({"recording": {"trigger": {"before_s": 5.0}}}, "recording.trigger: cannot change"),
        ({"zenoh": {"listen": ["tcp/127.0.0.1:7447"]}}, "zenoh.listen"),
        ({"streams": {"samples": {"tpdo": 1, "objects": ["position", "current"]}}}, "streams.samples.objects"),
        ({"heartbeat_ms": 50, "cell": "other"}, "cell, heartbeat_ms"),
        ({"recordings": {}}, "recordings: unknown key; did you mean 'recording'?"),
        ({"metrics": {"port": 1}}, "metrics: cannot listen on 127.0.0.1:1"),
    ],
)
def test_other_keys_are_refused_and_the_capture_goes_on(
    changes: dict[str, Any], named: str, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    capture = Capture(caplog, cell(tmp_path / "cell.yaml"))
    cell(tmp_path / "cell.yaml", **changes)
    line = capture.reload()
    assert line.startswith("warning: not reloaded, the capture continues unchanged: ")
    assert named in line
    assert "\n" not in line
    assert capture.taken == []
    # A corrected file can still be reloaded.
    cell(tmp_path / "cell.yaml", recording={"rotate_minutes": 1.0})
    assert capture.reload().endswith("recording.rotate_minutes")
    capture.reloader.close()


def test_a_changed_robot_is_refused(caplog: pytest.LogCaptureFixture, tmp_path: Path) -> None:
    robot = tmp_path / "robot.yaml"
    robot.write_text((HERE / "robots" / "tx40.yaml").read_text())
    capture = Capture(caplog, cell(tmp_path / "cell.yaml", robot=str(robot)))
    robot.write_text(robot.read_text().replace("name: tx40", "name: tx41"))
    assert "the robot cannot change during a capture" in capture.reload()
    capture.reloader.close()


def test_differences_are_named_by_their_keys() -> None:
    session = load_session("tx40_cell.yaml")
    sync = session.sync.model_copy(update={"period_us": 400})
    assert list(differences(session, session.model_copy(update={"sync": sync}))) == ["sync.period_us"]


def test_no_row_is_lost_if_rotation_is_switched_on_during_a_capture(tmp_path: Path) -> None:
    session = load_session("tx40_cell.yaml")
    robot = load_robot(session.robot)
    streams = captured_streams(session, robot)
    samples = make_recording(3000).samples
    with open_series(session, robot, streams, tmp_path, "capture", {}) as writer:
        for first in range(0, samples.sync.size, 100):
            if first == 1000:
                options = session.recording.model_copy(update={"rotate_minutes": 0.1 / 60})
                writer.limit(*limits(options))
            part = slice(first, first + 100)
            writer.rotate(int(samples.t_ns[first]))
            raw = {name: values[part] for name, values in samples.raw.items()}
            writer.append({"samples": (samples.sync[part], samples.t_ns[part], raw)})
        writer.close({})
    read = [read_recording(path) for path in writer.paths]
    assert len(read) > 3
    assert [n for part in read for n in part.samples.sync.tolist()] == samples.sync.tolist()
