"""The plug-in for pytest where the kernel has no SocketCAN: tests with a bus run in a guest and are reported here."""

import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from armident.drivers.vcan import have_socketcan, launcher_obstacle

TESTS = """
import socket
import pytest

@pytest.fixture(scope="module")
def of_module():
    yield "here"

def test_without_a_bus(of_module):
    assert not socket_can()

@pytest.mark.parametrize("word", ["a b", "c"])
def test_with_a_bus(virtual_bus, word, pytestconfig):
    assert socket_can()
    assert pytestconfig.getoption("--colour-of-cell") == "red"
    print("bus", virtual_bus)

def test_that_fails(virtual_bus):
    assert virtual_bus == "can0"

def test_that_is_skipped(virtual_bus):
    pytest.skip("no reason")

def test_afterwards(of_module):
    assert of_module == "here"

def socket_can():
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError:
        return False
    return True
"""
OTHER = """
def test_in_another_folder():
    pass
"""
CONFTEST = """
def pytest_addoption(parser):
    parser.addoption("--colour-of-cell", default="none")
"""


def run_pytest(folder: Path, *words: str) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-m", "pytest", "-p", "armident.testing", "-rA", "-p", "no:cacheprovider", *words]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


@pytest.mark.slow
def test_a_run_without_the_fixtures_imports_and_starts_nothing(tmp_path: Path) -> None:
    (tmp_path / "test_nothing.py").write_text(
        "import sys\n\n\ndef test_nothing():\n"
        "    heavy = ('numpy', 'numba', 'pydantic', 'can', 'armident.configs', 'armident.drivers')\n"
        "    assert not [name for name in heavy if name in sys.modules]\n"
    )
    done = run_pytest(tmp_path)
    assert done.returncode == 0, done.stdout


@pytest.mark.slow
@pytest.mark.skipif(have_socketcan(), reason="this kernel has SocketCAN: no guest is booted")
def test_tests_with_a_bus_run_in_a_guest_and_are_reported_here(tmp_path: Path) -> None:
    if launcher_obstacle() is not None:
        pytest.skip(f"no guest: {launcher_obstacle()}")
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
    (tmp_path / "conftest.py").write_text(CONFTEST)
    (tmp_path / "one" / "test_bus.py").write_text(TESTS)
    (tmp_path / "two" / "test_other.py").write_text(OTHER)
    junit = tmp_path / "junit.xml"
    done = run_pytest(tmp_path, "--colour-of-cell=red", f"--junitxml={junit}", "one", "two")
    assert done.returncode == 1, done.stdout
    assert "1 failed, 5 passed, 1 skipped" in done.stdout, done.stdout
    assert "a guest kernel runs 4 test(s)" in done.stdout
    assert 'assert virtual_bus == "can0"' in done.stdout, "the failure is shown with its source"
    cases = ET.parse(junit).getroot().iter("testcase")
    assert len(list(cases)) == 7


@pytest.mark.slow
def test_a_bus_that_cannot_be_is_a_skip_or_a_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if have_socketcan():
        pytest.skip("this kernel has SocketCAN")
    (tmp_path / "test_bus.py").write_text("def test_bus(virtual_bus):\n    pass\n")
    monkeypatch.delenv("ARMIDENT_REQUIRE_VCAN", raising=False)
    done = run_pytest(tmp_path, "--virtual-bus", "native")
    assert "1 skipped" in done.stdout
    assert "no SocketCAN" in done.stdout
    monkeypatch.setenv("ARMIDENT_REQUIRE_VCAN", "1")
    assert "1 error" in run_pytest(tmp_path, "--virtual-bus", "native").stdout
