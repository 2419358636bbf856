"""``armident service``: user, folders, permissions and units of a cell in a system image, and their removal."""

import os
import re
import stat
import subprocess
import sys
from collections.abc import Iterator
from configparser import ConfigParser
from pathlib import Path

import pytest
from typer.testing import CliRunner

from armident.configs import ArmidentError, ConfigError
from armident.configs.loading import HERE
from armident.daq import service
from armident.daq.cli import application
from armident.daq.service import (
    ACCOUNT,
    CACHE,
    HEADER,
    SETTINGS,
    STATE,
    UNITS,
    System,
    install,
    status,
    steps,
    uninstall,
)

needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="owners of files are set by root only")


@pytest.fixture
def image(tmp_path: Path) -> Path:
    """Root folder of a system without the account."""
    (tmp_path / "etc").mkdir()
    for name in ("passwd", "group", "shadow", "gshadow"):
        (tmp_path / "etc" / name).touch()
    (tmp_path / "etc" / "passwd").write_text("root:x:0:0:root:/root:/bin/bash\n")
    (tmp_path / "etc" / "group").write_text("root:x:0:\n")
    return tmp_path


def contents(root: Path) -> Iterator[tuple[str, int, int, int, int]]:
    for path in sorted(root.rglob("*")):
        found = path.lstat()
        yield str(path), found.st_mode, found.st_uid, found.st_gid, found.st_mtime_ns


def test_a_dry_run_prints_every_part_and_changes_nothing(image: Path) -> None:
    before = list(contents(image))
    lines = install("line3", image, dry_run=True)
    assert list(contents(image)) == before
    parts = [line for line in lines if line.startswith("to do: ")]
    units = {file.name for file in (HERE / "systemd").glob("*@.*")}
    assert units <= {line.rpartition("/")[2] for line in parts if "unit" in line}
    for part in ("group armident", "user armident", "/etc/armident ", "/var/lib/armident/line3 "):
        assert any(part in line for line in parts), part


@needs_root
def test_a_second_run_finds_nothing_to_do(image: Path) -> None:
    install("line3", image)
    before = list(contents(image))
    assert install("line3", image)[0] == "nothing to do: the service of cell line3 is installed"
    assert list(contents(image)) == before


@needs_root
def test_the_recordings_belong_to_the_user_of_the_units_and_the_settings_to_root(image: Path) -> None:
    install("line3", image)
    system = System(image, Path("/opt/armident/bin/armident"))
    user, group = system.id_of(ACCOUNT, "passwd"), system.id_of(ACCOUNT, "group")
    assert user is not None
    assert group is not None
    assert f"{ACCOUNT}:x:{user}:{group}::/var/lib/armident:/usr/sbin/nologin" in (image / "etc/passwd").read_text()
    owners = {"var/lib/armident/line3": (user, group), "var/lib/armident": (0, 0), "etc/armident": (0, group)}
    for folder, owner in owners.items():
        found = (image / folder).stat()
        assert (found.st_uid, found.st_gid) == owner, folder
    assert not stat.S_IMODE((image / "etc/armident").stat().st_mode) & stat.S_IRWXO


@needs_root
def test_permissions_that_were_changed_are_mended_and_nothing_else_is_touched(image: Path) -> None:
    install("line3", image)
    session = image / "etc/armident/line3.yaml"
    session.write_text("schema: armident/session/1\n")
    session.chmod(0o600)
    (image / STATE / "line3").chmod(0o700)
    lines = install("line3", image)
    assert [line.split(" (")[0] for line in lines if line.startswith("done")] == [
        "done: folder /var/lib/armident/line3",
        "done: /etc/armident/line3.yaml",
    ]
    assert session.read_text() == "schema: armident/session/1\n"
    assert stat.S_IMODE(session.stat().st_mode) == 0o640


@needs_root
def test_a_second_cell_adds_its_folder_only(image: Path) -> None:
    install("line3", image)
    lines = install("line4", image)
    assert [line for line in lines if line.startswith("done")] == [
        "done: folders /etc/tmpfiles.d/armident-line4.conf",
        "done: folder /var/lib/armident/line4 (armident:armident, 0755)",
    ]


@needs_root
def test_units_start_the_installed_command(image: Path) -> None:
    install("line3", image, executable=Path("/srv/robots/bin/armident"))
    for file in (image / UNITS).iterdir():
        text = file.read_text()
        assert text.startswith(HEADER)
        assert "/opt/armident/bin" not in text
        shipped = (HERE / "systemd" / file.name).read_text()
        assert text.count("/srv/robots/bin/armident") == shipped.count("/opt/armident/bin/armident")
        assert stat.S_IMODE(file.stat().st_mode) == 0o644


@needs_root
def test_an_older_unit_of_ours_is_replaced_and_a_copy_of_the_shipped_one_too(image: Path) -> None:
    (image / UNITS).mkdir(parents=True)
    capture, worker = (image / UNITS / f"armident-{name}@.service" for name in ("capture", "worker"))
    capture.write_text(f"{HEADER}[Service]\nExecStart=/old/armident capture\n")
    worker.write_text((HERE / "systemd" / worker.name).read_text())
    install("line3", image)
    assert "/old/armident" not in capture.read_text()
    assert worker.read_text().startswith(HEADER)


def test_a_unit_of_other_origin_is_refused(image: Path) -> None:
    unit = image / UNITS / "armident-worker@.service"
    unit.parent.mkdir(parents=True)
    unit.write_text("[Service]\nExecStart=/usr/local/bin/ours\n")
    with pytest.raises(ConfigError, match="was not written by this command"):
        install("line3", image)
    assert unit.read_text() == "[Service]\nExecStart=/usr/local/bin/ours\n"
    assert not (image / STATE).exists()


@pytest.mark.parametrize("cell", ["", ".", "..", "a/b", "a b", "-x", "line@3", "x" * 65, "größe", "a\n"])
def test_a_name_that_is_no_instance_of_a_unit_is_refused(cell: str, image: Path) -> None:
    with pytest.raises(ConfigError, match="as the name of a cell"):
        install(cell, image)


def test_a_folder_that_is_no_system_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="not the root of a Linux system"):
        install("line3", tmp_path)


def test_without_the_rights_of_root_the_command_with_sudo_is_named(
    image: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    with pytest.raises(ConfigError, match="sudo /opt/armident/bin/armident service install line3"):
        install("line3", image)


@pytest.mark.parametrize("folder", [f"{hidden}/venv" for hidden in service.HIDDEN])
def test_a_command_that_the_units_would_not_see_is_refused(folder: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", f"{folder}/bin/python")
    monkeypatch.setattr(Path, "is_file", lambda self: True)
    with pytest.raises(ConfigError, match="python3 -m venv /opt/armident"):
        service.installed_executable()


def test_the_units_agree_with_the_account_and_the_folders(image: Path) -> None:
    for file in sorted((HERE / "systemd").glob("*.service")):
        unit = ConfigParser(strict=False, interpolation=None)
        unit.read_string(file.read_text())
        keys = unit["Service"]
        assert (keys["User"], keys["Group"]) == (ACCOUNT, ACCOUNT)
        # The page is of no cell, and only reads.
        of_cell = "@" in file.name
        assert keys.get("StateDirectory") == ("armident/%i" if of_cell else None)
        assert keys.get("ReadOnlyPaths") == (None if of_cell else f"/{STATE}")
        assert keys["WorkingDirectory"] == (f"/{STATE}/%i" if of_cell else f"/{STATE}")
        assert keys["CacheDirectory"].rpartition("/")[0] == str(CACHE.relative_to("var/cache"))
        assert keys.get("StateDirectoryMode", "0755") == "0755"
    names = [step.name for step in steps(System(image, Path("/x")), "%i")]
    assert any("/var/lib/armident/%i (armident:armident, 0755)" in name for name in names)
    assert any("/var/cache/armident (armident:armident, 0755)" in name for name in names)


def test_a_command_of_the_system_that_fails_is_one_line(image: Path) -> None:
    with pytest.raises(ArmidentError, match=r"systemd-sysusers.*no-such-option") as caught:
        System(image, Path("/x")).run("systemd-sysusers", "--no-such-option")
    assert "\n" not in str(caught.value)


def test_a_reader_without_rights_is_sent_to_sudo(image: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def closed(self: Path) -> bool:
        raise PermissionError(13, "Permission denied", str(self))

    session = Path.is_file
    monkeypatch.setattr(Path, "is_file", lambda self: closed(self) if self.suffix == ".yaml" else session(self))
    with pytest.raises(ConfigError, match=r"line3\.yaml: only root may read it: sudo"):
        install("line3", image, dry_run=True)


def enable(image: Path, name: str, by: str) -> Path:
    """Enable a unit as ``systemctl enable`` does."""
    link = image / UNITS / f"{by}.wants" / name
    link.parent.mkdir(exist_ok=True)
    link.symlink_to(f"/{UNITS}/{name.partition('@')[0]}@.{name.rpartition('.')[2]}")
    return link


def session_of(image: Path, cell: str) -> Path:
    file = image / SETTINGS / f"{cell}.yaml"
    file.write_text("schema: armident/session/1\n")
    return file


@needs_root
def test_a_removed_cell_keeps_its_recordings_and_its_configuration(image: Path) -> None:
    install("line3", image)
    session = session_of(image, "line3")
    link = enable(image, "armident-capture@line3.service", "multi-user.target")
    of_page = enable(image, "armident-page.service", "multi-user.target")
    recording = image / STATE / "line3" / "monday.mcap"
    recording.write_bytes(b"1" * 2_000_000)
    before = list(contents(image))
    planned = uninstall("line3", image, dry_run=True)
    assert list(contents(image)) == before
    done = uninstall("line3", image)
    assert [line.replace("done: ", "to do: ") for line in done] == planned
    assert not link.is_symlink()
    assert not of_page.is_symlink()
    assert not list((image / UNITS).glob("armident-*"))
    assert not list((image / "etc/tmpfiles.d").iterdir())
    assert not (image / CACHE).exists()
    assert recording.stat().st_size == 2_000_000
    assert session.read_text() == "schema: armident/session/1\n"
    assert "recordings and results: /var/lib/armident/line3 (1 files, 2.0 MB); never deleted" in done
    assert uninstall("line3", image)[0] == "nothing to do: the service of cell line3 is not installed"


class Unit(ConfigParser):
    """Unit of systemd, whose keys have capitals."""

    def optionxform(self, optionstr: str) -> str:
        """Return a key as it is."""
        return optionstr


@needs_root
def test_a_capture_is_tied_to_the_can_interfaces_of_its_session(image: Path) -> None:
    """Without its session there is nothing to tie it to; a second run does it, and a removal undoes it."""
    drop_in = image / UNITS / "armident-capture@line3.service.d" / "bus.conf"
    install("line3", image)
    assert not drop_in.parent.exists()
    cell = (HERE / "cells" / "emps_cell.yaml").read_text()
    for line, devices in (
        ("bus: {interface: udp_multicast, channel: 239.74.163.2}", None),
        ("bus: {channel: can-0}", [r"sys-subsystem-net-devices-can\x2d0.device"]),
    ):
        (image / SETTINGS / "line3.yaml").write_text(re.sub("(?m)^bus: .*", line, cell))
        install("line3", image)
        assert drop_in.exists() == (devices is not None)
    unit = Unit(interpolation=None)
    unit.read_string(drop_in.read_text())
    found = [unit["Unit"]["BindsTo"], unit["Unit"]["After"], unit["Install"]["WantedBy"]]
    assert [value.split() for value in found] == 3 * [devices]
    assert install("line3", image)[0] == "nothing to do: the service of cell line3 is installed"
    system = ["systemctl", f"--root={image}", "enable", "armident-capture@line3"]
    subprocess.run(system, check=True, capture_output=True)
    wanted = image / UNITS / f"{found[0]}.wants" / "armident-capture@line3.service"
    assert wanted.is_symlink()
    uninstall("line3", image)
    assert not wanted.is_symlink()
    assert not drop_in.parent.exists()


@needs_root
def test_units_stay_while_another_cell_uses_them(image: Path) -> None:
    for cell in ("line3", "line4"):
        install(cell, image)
        session_of(image, cell)
    (image / SETTINGS / "arm.yaml").write_text("schema: armident/robot/1\n")
    enable(image, "armident-worker@line3.service", "multi-user.target")
    of_page = enable(image, "armident-page.service", "multi-user.target")
    lines = uninstall("line3", image)
    assert of_page.is_symlink()
    assert lines[0] == "done: disable armident-worker@line3.service (multi-user.target.wants)"
    assert (image / "etc/tmpfiles.d/armident-line4.conf").is_file()
    shipped = {path.name for path in (HERE / "systemd").iterdir() if path.suffix in (".service", ".timer")}
    assert {path.name for path in (image / UNITS).glob("armident-*")} == shipped
    assert any(line.startswith("kept: unit files, for line4 ") for line in lines)


@needs_root
def test_a_unit_of_other_origin_is_not_removed(image: Path) -> None:
    install("line3", image)
    unit = image / UNITS / "armident-worker@.service"
    unit.write_text("[Service]\nExecStart=/usr/local/bin/ours\n")
    lines = uninstall("line3", image)
    assert [path.name for path in (image / UNITS).iterdir()] == [unit.name]
    assert f"kept: unit /{UNITS / unit.name}, which this command did not write" in lines


@needs_root
def test_the_status_names_every_part_with_its_state(image: Path) -> None:
    lines, complete = status("line3", image)
    assert not complete
    assert "missing or different: system group armident and user armident, without login" in lines
    install("line3", image)
    session_of(image, "line3")
    install("line3", image)
    enable(image, "armident-reidentify@line3.timer", "timers.target")
    lines, complete = status("line3", image)
    assert complete
    assert "enabled: armident-reidentify@line3.timer" in lines
    assert "not enabled: armident-capture@line3.service" in lines
    (image / UNITS / "armident-worker@.service").write_text("[Service]\n")
    lines, complete = status("line3", image)
    assert not complete
    assert "written by another program or person: unit /etc/systemd/system/armident-worker@.service" in lines


@pytest.mark.parametrize("action", ["status", "uninstall", "remove"])
def test_the_command_ends_with_the_exit_code_of_the_action(action: str, image: Path) -> None:
    words = ["service", action, "line3", "--root", str(image), "--dry-run"]
    result = CliRunner().invoke(application(words), words)
    assert result.exit_code == {"status": 4, "uninstall": 0, "remove": 2}[action]
    if action == "remove":
        assert "expected: armident service install, status or uninstall CELL" in result.stderr


def test_only_root_removes_a_service(image: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (image / UNITS).mkdir(parents=True)
    (image / UNITS / "armident-worker@.service").write_text(HEADER)
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    with pytest.raises(ConfigError, match="sudo armident service uninstall line3"):
        uninstall("line3", image)
