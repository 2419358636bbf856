"""Checks of ``armident doctor``, and notifications to systemd."""

import json
import os
import re
import shutil
import socket
import time
from pathlib import Path
from typing import Any

import pytest
import yaml
from typer.testing import CliRunner

from armident.configs import load_robot
from armident.configs.implausible import implausible_values
from armident.configs.loading import HERE
from armident.daq.cli import application
from armident.daq.doctor import Check, checks_for, run_checks
from armident.daq.identity.plant import enrol, make_authority
from armident.systemd import Notifier
from tests.integration.test_capture_vcan import session_file

SYSTEMD = HERE / "systemd"
EDS = HERE / "eds" / "cia402_servo.eds"


def cell(folder: Path, **changes: Any) -> Path:
    """Write the shipped cell, on a bus that does not exist and with changed keys."""
    path = session_file(folder, "nobus7", "doctor", recording={"directory": str(folder / "recordings")})
    data = yaml.safe_load(path.read_text())
    for key, value in changes.items():
        data[key] = {**data[key], **value} if isinstance(data.get(key), dict) else value
    path.write_text(yaml.safe_dump(data))
    return path


def checks_of(path: Path) -> dict[str, Check]:
    return {check.name: check for check in run_checks(path)}


def test_a_missing_bus_is_named_with_the_remedy(tmp_path: Path) -> None:
    checks = checks_of(cell(tmp_path))
    assert checks["configuration"].verdict == "ok"
    assert checks["bus"].verdict == "failed"
    assert "nobus7" in checks["bus"].message or "modprobe" in checks["bus"].message
    assert checks["zenoh"].verdict == "ok"
    assert "free, at least" in checks["recordings"].message
    assert list((tmp_path / "recordings").iterdir()) == []


def test_an_unknown_key_is_one_check(tmp_path: Path) -> None:
    checks = checks_of(cell(tmp_path, heartbet_ms=100))
    assert checks["configuration"].verdict == "failed"
    assert "heartbet_ms" in checks["configuration"].message
    assert "bus" not in checks


def with_sheet(folder: Path, content: bytes) -> Path:
    """Write the shipped cell, with a data sheet of its own for the third drive."""
    (folder / "third.eds").write_bytes(content)
    path = cell(folder)
    data = yaml.safe_load(path.read_text())
    data["drives"][2]["eds"] = "third.eds"
    path.write_text(yaml.safe_dump(data))
    return path


@pytest.mark.parametrize(
    ("content", "verdict", "said"),
    [
        (b"[1000]\nDataType=7\n", "ok", "third.eds: 1 objects"),
        (b"[1000]\nDataType=7\n[2000]\nObjectType=8\nCompactSubObj=4\n", "warning", "left out: 2000h"),
        (b"", "failed", "no object in it"),
        (b"\0\1\2", "failed", "binary"),
    ],
)
def test_every_data_sheet_is_opened(tmp_path: Path, content: bytes, verdict: str, said: str) -> None:
    path = with_sheet(tmp_path, content)
    first, second = (check for check in run_checks(path) if check.name == "eds")
    assert first == Check("eds", "ok", "cia402_servo.eds: 54 objects")
    assert second.verdict == verdict
    assert said in second.message
    shown = CliRunner().invoke(application(["doctor"]), ["doctor", "--config", str(path)])
    assert ("a capture would not run: eds" in shown.stderr) == (verdict == "failed")


def test_data_sheets_are_opened_though_the_robot_is_wrong(tmp_path: Path) -> None:
    path = with_sheet(tmp_path, b"")
    data = yaml.safe_load(path.read_text())
    data["setpoints"] = {"trajectory": str(HERE / "robots" / "tx40.yaml")}
    path.write_text(yaml.safe_dump(data))
    verdicts = [(check.name, check.verdict) for check in run_checks(path)]
    assert verdicts[:3] == [("configuration", "failed"), ("eds", "ok"), ("eds", "failed")]


def test_certificates_of_zenoh_are_opened(tmp_path: Path) -> None:
    for name in ("authority.pem", "viewer.anna.pem", "viewer.anna.key"):
        (tmp_path / name).write_text("PEM")
    text = (HERE / "zenoh" / "client.json5").read_text().replace("/etc/armident/keys", str(tmp_path))
    (tmp_path / "client.json5").write_text(text)
    path = cell(tmp_path, zenoh={"config": "client.json5"})
    assert checks_of(path)["zenoh"].verdict == "ok"
    (tmp_path / "authority.pem").unlink()
    check = checks_of(path)["zenoh"]
    assert check.verdict == "failed"
    assert f"root_ca_certificate {tmp_path}/authority.pem (No such file or directory)" in check.message


def test_the_end_of_certificates_is_counted_down_and_does_not_stop_a_capture(tmp_path: Path) -> None:
    make_authority(tmp_path / "keys", "plant")
    for role, days in (("capture", 5), ("worker", 20), ("viewer", 1)):
        enrol(tmp_path / "keys", role, "other" if role == "viewer" else "doctor", None, [], days)
    path = cell(tmp_path, cell="doctor", zenoh={"keys": "keys", "connect": ["tls/192.0.2.1:7447"]})
    assert checks_of(path)["zenoh"] == Check("zenoh", "ok", "client of tls/192.0.2.1:7447 by mutual TLS")
    found = [check for check in run_checks(path) if check.name == "keys"]
    assert [check.verdict for check in found] == ["ok", "warning", "warning"]
    assert found[1].message.endswith(", in 4 days; run where the authority is: armident keys renew capture.doctor")
    assert "worker.doctor: valid until" in found[2].message


def test_slow_streams_of_another_master_without_sync_counter_are_a_warning(tmp_path: Path) -> None:
    sync = {"role": "consumer", "counter": 0}
    check = checks_of(cell(tmp_path, sync=sync))["sync"]
    assert check.verdict == "warning"
    assert check.message.startswith("demand: SYNC has no counter")
    assert "sync" not in checks_of(cell(tmp_path, sync={"counter": 0}))


@pytest.mark.slow
def test_an_overloaded_bus_fails(tmp_path: Path) -> None:
    checks = checks_of(cell(tmp_path, bus={"bitrate": 1_000_000}))
    assert checks["bus load"].verdict == "failed"
    assert "would fit" in checks["bus load"].message


def test_a_read_only_directory_fails(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    checks = checks_of(cell(tmp_path, recording={"directory": str(tmp_path / "file" / "in")}))
    assert checks["recordings"].verdict == "failed"
    assert "Not a directory" in checks["recordings"].message


@pytest.mark.parametrize(("takes_s", "verdict"), [(0.0, "ok"), (0.03, "warning")])
def test_a_disk_too_slow_for_chunks_is_detected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, takes_s: float, verdict: str
) -> None:
    monkeypatch.setattr(os, "fdatasync", lambda descriptor: time.sleep(takes_s))
    # Chunks span 50 ms; the disk may take half of that.
    check = checks_of(cell(tmp_path))["disk"]
    assert check.message.startswith("50 ms of rows are written and synced in ")
    assert check.verdict == verdict
    assert ("larger recording.chunk_ms" in check.message) == (verdict == "warning")


def test_a_running_capture_is_detected(tmp_path: Path) -> None:
    path = cell(tmp_path)
    port = int(checks_of(path)["zenoh"].message.rsplit(" ", 1)[1])
    with socket.create_server(("127.0.0.1", port)):
        assert checks_of(path)["zenoh"].verdict == "warning"


def test_ports_in_use_are_found(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        checks = checks_of(cell(tmp_path, zenoh={"listen": [f"tcp/127.0.0.1:{port}"]}))
        checks |= {"metrics": checks_of(cell(tmp_path, metrics={"port": port}))["metrics"]}
    assert checks["zenoh"].verdict == "warning"
    assert checks["zenoh"].message.startswith(f"127.0.0.1:{port}: Address already in use; ")
    # A capture does not start without its metrics.
    assert checks["metrics"].verdict == "failed"
    assert checks["metrics"].message.startswith(f"127.0.0.1:{port}: Address already in use; ")
    listen = {"listen": [f"tcp/127.0.0.1:{port}"]}
    free = checks_of(cell(tmp_path, zenoh=listen, metrics={"port": port + 1}))
    assert free["zenoh"].verdict == "ok"
    assert "metrics" not in free
    both = checks_of(cell(tmp_path, zenoh=listen, metrics={"port": port}))
    assert both["metrics"].message == f"metrics.port and zenoh.listen: both would listen at tcp/127.0.0.1:{port}"


def implausible(folder: Path, place: str, value: Any, name: str = "tx40") -> list[str]:
    """Warnings about the robot of a session with another value at a place such as ``joints.2.drive``."""
    data = yaml.safe_load((HERE / "robots" / f"{name}.yaml").read_text())
    keys = [int(key) if key.isdecimal() else key for key in place.split(".")]
    within = data
    for key in keys[:-1]:
        within = within[key]
    within[keys[-1]] = value
    (folder / "robot.yaml").write_text(yaml.safe_dump(data))
    config = cell(folder, robot="robot.yaml") if name == "tx40" else folder / "robot.yaml"
    checks = run_checks(config) if name == "tx40" else checks_for(config, "identify")
    assert checks[0].verdict == "ok"
    found = [check for check in checks if check.name == "robot"]
    assert {check.verdict for check in found} <= {"warning"}
    return [check.message for check in found]


@pytest.mark.parametrize(
    ("place", "value", "said"),
    [
        ("gravity", [0.0, 0.0, -1.0], "gravity: [0.0, 0.0, -1.0] has a size of 1 m/s^2; on Earth this direction is"),
        ("gravity", [0.0, -98.1, 0.0], "[0.0, -9.81, 0.0]"),
        ("transmission.2.2", 0.0125, "transmission[2]: the motor of joint_3 turns 0.0125 times per turn of the joint"),
        ("transmission.2.2", 0.0125, "a reducer of 80 to 1 has 80"),
        ("joints.0.limits.velocity", 3000.0, "as 1/min of the motor it is 9.817 rad/s at the joint"),
        ("joints.0.limits.velocity", 180.0, "as degrees/s it is 3.142 rad/s"),
        ("joints.1.drive.counts_per_unit", 17, "17 counts per turn of the motor; as bits of the encoder it is 131072"),
        ("joints.1.drive.counts_per_unit", 2**33, "32 bits (6064h) hold less than one turn"),
        ("joints.1.drive.rated", 2500.0, "joints[1].drive.rated: 2500 A; as mA it is 2.5 A"),
        ("joints.1.drive.gain", 400.0, "give joint_2 a rated torque of 3.2e+04, its limit is 110"),
        ("joints.1.drive.gain", 0.0, "every torque would be 0"),
        ("joints.0.limits.acceleration", 5730.0, "as degrees/s^2 it is 100 rad/s^2"),
        ("joints.1.drive.saturation", 6000.0, "joints[1].drive.saturation: 6000, of a drive that is rated"),
        ("joints.1.drive.saturation", 0.5, "joints[1].drive.saturation: 0.5, of a drive that is rated"),
    ],
)
def test_values_that_no_arm_has_are_warnings(tmp_path: Path, place: str, value: Any, said: str) -> None:
    messages = implausible(tmp_path, place, value)
    assert any(said in message for message in messages), messages
    assert all(message.startswith((place.split(".", 1)[0], "joints[")) for message in messages)


@pytest.mark.parametrize(
    ("place", "value", "said"),
    [
        ("joints.0.limits.velocity", 500.0, ["joints[0].limits.velocity: 500 m/s; as mm/s it is 0.5 m/s"]),
        ("joints.0.drive.counts_per_unit", 200.0, ["joints[0].drive.counts_per_unit: 200 counts per m; "]),
        ("joints.0.drive.rated", 10_000.0, ["joints[0].drive.rated: 10000 V; as mV it is 10 V"]),
    ],
)
def test_values_that_no_linear_axis_has_are_warnings(tmp_path: Path, place: str, value: float, said: list[str]) -> None:
    messages = implausible(tmp_path, place, value, "emps")
    assert [message[: len(text)] for message, text in zip(messages, said, strict=True)] == said


@pytest.mark.parametrize(
    ("mass", "said"),
    [
        (r"\g<1>e3", "urdf: masses of 1.52e+04 kg for a reach of 0.42 m; if they are in g, 15.2 kg"),
        (r"-\g<1>", "mass and moments of inertia must not be negative; correct them in the URDF"),
    ],
)
def test_masses_in_grams_and_negative_ones_are_a_warning(tmp_path: Path, mass: str, said: str) -> None:
    urdf = (HERE / "examples/integration_test/picker.urdf").read_text()
    (tmp_path / "picker.urdf").write_text(re.sub(r'mass value="([\d.]+)"', f'mass value="{mass}"', urdf))
    shutil.copy(HERE / "examples/integration_test/picker.yaml", tmp_path)
    (found,) = [check.message for check in checks_for(tmp_path / "picker.yaml", "identify") if check.name == "robot"]
    assert found.endswith(said)


@pytest.mark.parametrize(("gravity", "said"), [(-981.0, "cm/s^2"), (-9810.0, "mm/s^2")])
def test_gravity_in_another_unit_fails_with_its_size(tmp_path: Path, gravity: float, said: str) -> None:
    data = yaml.safe_load((HERE / "robots" / "tx40.yaml").read_text())
    (tmp_path / "robot.yaml").write_text(yaml.safe_dump({**data, "gravity": [0.0, 0.0, gravity]}))
    check = checks_for(tmp_path / "robot.yaml", "identify")[0]
    assert check.verdict == "failed"
    assert f"looks like {said} (in m/s^2: [0, 0, -9.81])" in check.message


def test_an_inhibit_time_that_a_drive_keeps_is_a_warning(tmp_path: Path) -> None:
    head, sheet, rest = re.split(r"(?s)(\[1800sub3\].*?)(?=\[1800sub5\])", EDS.read_text(), maxsplit=1)
    sheet = sheet.replace("AccessType=rw", "AccessType=ro").replace("DefaultValue=0", "DefaultValue=10")
    path = with_sheet(tmp_path, f"{head}{sheet}{rest}".encode())
    second = [check for check in run_checks(path) if check.name == "eds"][1]
    assert second.verdict == "warning"
    assert "TPDO1 keeps its inhibit time of 1 ms, which is read-only" in second.message


def test_positions_in_degrees_fail(tmp_path: Path) -> None:
    data = yaml.safe_load((HERE / "robots" / "tx40.yaml").read_text())
    data["joints"][0]["limits"]["position"] = [-180, 180]
    (tmp_path / "robot.yaml").write_text(yaml.safe_dump(data))
    check = checks_of(cell(tmp_path, robot="robot.yaml"))["configuration"]
    assert check.verdict == "failed"
    assert "looks like degrees (in rad: [-3.142, 3.142])" in check.message


@pytest.mark.parametrize("path", sorted((HERE / "robots").glob("*.yaml")), ids=lambda path: path.stem)
def test_shipped_robots_are_plausible(path: Path) -> None:
    assert list(implausible_values(load_robot(path))) == []


def test_the_exit_code_is_2_if_a_capture_would_not_run(tmp_path: Path) -> None:
    shown = CliRunner().invoke(application(["doctor"]), ["doctor", "--config", str(cell(tmp_path)), "--json"])
    assert shown.exit_code == 2
    checks = json.loads(shown.stdout)
    assert {check["verdict"] for check in checks} <= {"ok", "warning", "failed"}
    assert "a capture would not run: bus" in shown.stderr


def test_states_reach_the_service_manager(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        notifier = Notifier()
        notifier.ready("cell: recording")
        notifier.progress("SYNC 5")
        notifier.stopping()
        received = [manager.recv(200).decode() for _ in range(3)]
        for _ in range(1000):  # a manager that reads nothing: its buffer is full, and the service goes on
            notifier.progress("SYNC 6")
        os.unlink(tmp_path / "notify")
        notifier.progress("no manager receives this")
        notifier.close()
    assert received == ["READY=1\nSTATUS=cell: recording", "WATCHDOG=1\nSTATUS=SYNC 5", "STOPPING=1"]
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
