"""What the doctor says of a session, and what the service manager hears."""

import json
import os
import socket
import time
from pathlib import Path
from typing import Any

import pytest
import yaml
from typer.testing import CliRunner

from armident.configs.loading import HERE
from armident.daq.capture.systemd import Notifier
from armident.daq.cli import application
from armident.daq.doctor import Check, examine
from tests.integration.test_capture_vcan import session_file

SYSTEMD = HERE / "systemd"


def cell(folder: Path, **changes: Any) -> Path:
    """The shipped cell on a bus that does not exist, changed."""
    path = session_file(folder, "nobus7", "doctor", recording={"directory": str(folder / "recordings")})
    data = yaml.safe_load(path.read_text())
    for key, value in changes.items():
        data[key] = {**data[key], **value} if isinstance(data.get(key), dict) else value
    path.write_text(yaml.safe_dump(data))
    return path


def found(path: Path) -> dict[str, Check]:
    return {check.what: check for check in examine(path)}


def test_a_bus_that_is_not_there_is_named_with_what_to_do(tmp_path: Path) -> None:
    checks = found(cell(tmp_path))
    assert checks["configuration"].verdict == "ok"
    assert checks["bus"].verdict == "failed"
    assert "nobus7" in checks["bus"].found or "modprobe" in checks["bus"].found
    assert checks["zenoh"].verdict == "ok"
    assert "free, at least" in checks["recordings"].found
    assert list((tmp_path / "recordings").iterdir()) == []


def test_a_typo_is_one_check_with_its_key(tmp_path: Path) -> None:
    checks = found(cell(tmp_path, heartbet_ms=100))
    assert checks["configuration"].verdict == "failed"
    assert "heartbet_ms" in checks["configuration"].found
    assert "bus" not in checks


def test_a_bus_that_cannot_carry_it_fails(tmp_path: Path) -> None:
    checks = found(cell(tmp_path, bus={"bitrate": 1_000_000}))
    assert checks["bus load"].verdict == "failed"
    assert "would fit" in checks["bus load"].found


def test_a_folder_that_cannot_be_written_fails(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    checks = found(cell(tmp_path, recording={"directory": str(tmp_path / "file" / "in")}))
    assert checks["recordings"].verdict == "failed"
    assert "Not a directory" in checks["recordings"].found


@pytest.mark.parametrize(("takes_s", "verdict"), [(0.0, "ok"), (0.03, "warning")])
def test_a_disk_too_slow_for_chunks_is_noticed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, takes_s: float, verdict: str
) -> None:
    monkeypatch.setattr(os, "fdatasync", lambda descriptor: time.sleep(takes_s))
    # Chunks of 50 ms, of which the disk may take half.
    check = found(cell(tmp_path))["disk"]
    assert check.found.startswith("50 ms of rows are written and synced in ")
    assert check.verdict == verdict
    assert ("larger recording.chunk_ms" in check.found) == (verdict == "warning")


def test_a_capture_that_runs_already_is_noticed(tmp_path: Path) -> None:
    path = cell(tmp_path)
    port = int(found(path)["zenoh"].found.rsplit(" ", 1)[1])
    with socket.create_server(("127.0.0.1", port)):
        assert found(path)["zenoh"].verdict == "warning"


def test_the_exit_code_says_whether_a_capture_would_run(tmp_path: Path) -> None:
    shown = CliRunner().invoke(application(["doctor"]), ["doctor", "--config", str(cell(tmp_path)), "--json"])
    assert shown.exit_code == 2
    checks = json.loads(shown.stdout)
    assert {check["verdict"] for check in checks} <= {"ok", "warning", "failed"}
    assert "a capture would not run: bus" in shown.stderr


def test_the_service_manager_hears_states(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        notifier = Notifier()
        notifier.ready("cell: recording")
        notifier.progress("SYNC 5")
        notifier.stopping()
        heard = [manager.recv(200).decode() for _ in range(3)]
        os.unlink(tmp_path / "notify")
        notifier.progress("nobody listens any more")
        notifier.close()
    assert heard == ["READY=1\nSTATUS=cell: recording", "WATCHDOG=1\nSTATUS=SYNC 5", "STOPPING=1"]
    monkeypatch.delenv("NOTIFY_SOCKET")
    Notifier().ready("no manager")


@pytest.mark.parametrize("unit", sorted(SYSTEMD.glob("*.service")), ids=lambda path: path.name)
def test_units_call_commands_that_exist(unit: Path) -> None:
    lines = [line.split("=", 1)[1].split() for line in unit.read_text().splitlines() if line.startswith("ExecStart")]
    assert lines
    for words in lines:
        assert words[0] == "/opt/armident/bin/armident"
        assert "--config" in words
        help_text = CliRunner().invoke(application([words[1]]), [words[1], "--help"])
        assert help_text.exit_code == 0
        for option in (word for word in words if word.startswith("--")):
            assert option in help_text.output
