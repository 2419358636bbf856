"""Launcher: commands have vcan buses, and otherwise run as on the host."""

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from armident.configs.errors import ConfigError
from armident.drivers.vcan import (
    ensure_vcan,
    have_socketcan,
    launcher_command,
    launcher_obstacle,
    packages,
    remove_vcan,
)
from armident.drivers.vcan.guest import MAPPINGS

IN_THE_GUEST = "ARMIDENT_GUEST" in os.environ
REASON = "inside the guest already" if IN_THE_GUEST else launcher_obstacle()
needs_launcher = pytest.mark.skipif(REASON is not None, reason=f"no vcan launcher: {REASON}")

WAIT_FOR_SIGNAL = """
import signal, sys, time
def end(*_):
    print("ends cleanly", flush=True)
    sys.exit(9)
signal.signal(signal.SIGTERM, end)
print("ready", flush=True)
try:
    time.sleep(60)
except KeyboardInterrupt:
    print("interrupted", flush=True)
    sys.exit(8)
"""


def launch(
    command: list[str], buses: int = 1, cwd: Path | None = None, env: dict[str, str] | None = None
) -> "subprocess.CompletedProcess[str]":
    line = launcher_command(command, buses)
    return subprocess.run(line, capture_output=True, text=True, timeout=120, check=False, cwd=cwd, env=env)


@needs_launcher
@pytest.mark.slow
def test_outputs_status_arguments_environment_and_folder_pass_through_although_a_process_is_left_behind(
    tmp_path: Path,
) -> None:
    folder = tmp_path / "a folder"
    folder.mkdir()
    strange = 'quo\'te "$HOME" \\ ü\ttab'
    repository = Path(__file__).resolve().parents[2]
    script = "import os, sys; print(repr((os.getcwd(), sys.argv[1], os.environ['STRANGE']))); open('made here', 'w')"
    shell = f'sleep 300 & {sys.executable} -c "$1" "$2"; seq 1 200000; seq 1 100000 >&2; exit 7'
    environment = {**os.environ, "STRANGE": strange, "PYTHONPATH": str(repository)}
    start = time.monotonic()
    done = launch(["sh", "-c", shell, "sh", script, strange], cwd=folder, env=environment)
    assert time.monotonic() - start < 100
    assert done.returncode == 7
    said, *numbers = done.stdout.splitlines()
    assert said == repr((str(folder), strange, strange)), done.stderr
    assert numbers == [str(k) for k in range(1, 200001)]
    assert done.stderr.split()[-100_000:] == [str(k) for k in range(1, 100001)]
    assert (folder / "made here").exists()


@needs_launcher
@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "said", "status"),
    [
        (signal.SIGTERM, "ends cleanly", 9),
        pytest.param(signal.SIGINT, "interrupted", 8, marks=pytest.mark.nightly),
    ],
)
def test_output_arrives_at_once_and_a_signal_reaches_the_command_which_may_handle_it(
    number: signal.Signals, said: str, status: int
) -> None:
    with subprocess.Popen(
        launcher_command([sys.executable, "-c", WAIT_FOR_SIGNAL]), stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        assert process.poll() is None
        process.send_signal(number)
        assert process.stdout.read() == f"{said}\n"
        assert process.wait(60) == status


@needs_launcher
@pytest.mark.slow
@pytest.mark.nightly
def test_a_command_that_does_not_exist_is_127() -> None:
    assert launch(["no-such-command-here"]).returncode == 127


@needs_launcher
@pytest.mark.slow
@pytest.mark.nightly
def test_a_process_uses_more_memory_than_the_usual_number_of_mappings_allows() -> None:
    """300 MB of single pages in random order: each is a mapping of the host, whose usual limit is 65530."""
    if not os.access(MAPPINGS, os.W_OK) and int(MAPPINGS.read_text()) < 80_000:
        pytest.skip("vm.max_map_count is below 80000, and may not be raised here")
    fill = (
        "import random; pages = list(range(76800)); random.Random(0).shuffle(pages); data = bytearray(4096 * 76800)\n"
        "for page in pages: data[4096 * page] = 1\n"
        "print(sum(data[::4096]))"
    )
    assert launch([sys.executable, "-c", fill]).stdout == "76800\n"


@pytest.mark.slow
@needs_launcher
def test_a_memory_that_is_no_size_is_refused() -> None:
    line = [sys.executable, "-m", "armident.drivers.vcan", "--guest", "-m", "many", "--", "true"]
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    assert done.returncode == 125
    assert "'many': expected the memory of a guest as a number with K, M or G" in done.stderr


def test_missing_packages_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VCAN_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("VCAN_DEBS", str(tmp_path))
    (tmp_path / "patchelf_0.14_amd64.deb").touch()
    reason = packages.obstacle()
    assert reason is not None
    assert "lacks user-mode-linux, libc6, busybox-static, can-utils" in reason


@pytest.mark.slow
def test_a_truncated_package_is_one_error_line_and_leaves_no_files(tmp_path: Path) -> None:
    debs = tmp_path / "debs"
    debs.mkdir()
    for name in packages.GUEST_PACKAGES + packages.HOST_PACKAGES:
        (debs / f"{name}_1_amd64.deb").write_bytes(b"!<arch>\n")
    environment = {**os.environ, "VCAN_CACHE": str(tmp_path / "cache"), "VCAN_DEBS": str(debs)}
    line = [sys.executable, "-m", "armident.drivers.vcan", "--guest", "--", "true"]
    done = subprocess.run(line, capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 125
    assert done.stderr.count("\n") == 1
    assert "setup.log" in done.stderr
    assert not (tmp_path / "cache" / "root").exists()


@pytest.mark.skipif(have_socketcan(), reason="this kernel has SocketCAN")
def test_without_socketcan_a_bus_is_refused_with_the_command_to_try() -> None:
    with pytest.raises(ConfigError, match=r"vcan7: .* sudo modprobe"):
        ensure_vcan("vcan7")


@pytest.mark.vcan
def test_a_bus_is_created_once_and_removed(vcan_bus: str) -> None:
    ensure_vcan(vcan_bus)
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as raw:
        raw.bind((vcan_bus,))
    remove_vcan(vcan_bus)
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as raw, pytest.raises(OSError, match="device"):
        raw.bind((vcan_bus,))
    remove_vcan(vcan_bus)


@pytest.mark.vcan
def test_the_error_of_a_bus_that_cannot_be_created_names_the_administrators_command() -> None:
    with pytest.raises(ConfigError, match="an administrator must run: sudo modprobe vcan && sudo ip link add dev"):
        ensure_vcan("a-name-longer-than-the-kernel-takes")
