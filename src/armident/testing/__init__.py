"""Plug-in for pytest: a virtual CAN bus, a virtual arm on it, and a capture, for integration tests of a robot cell.

pytest loads it by itself where armident is installed. Fixtures: `virtual_bus`, `virtual_arm`, `capture`. Where the
kernel has no SocketCAN, tests with these fixtures run in a guest kernel (`armident.drivers.vcan`), all of them in one.
Nothing is imported and no process is started before a test asks for a fixture.
"""

import itertools
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from armident.testing.guest import GuestRun
    from armident.testing.virtual_arm import Captures, VirtualArms

REPORTS_VARIABLE = "ARMIDENT_TEST_REPORTS"
"""Environment variable with the file to which a pytest run in a guest writes its reports."""
REQUIRE_VARIABLE = "ARMIDENT_REQUIRE_VCAN"
"""Environment variable: with the value 1 a test fails, and is not skipped, where there can be no bus."""

_run = pytest.StashKey["GuestRun | None"]()
_numbers = itertools.count()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option that chooses the kernel of the virtual buses."""
    parser.getgroup("armident").addoption(
        "--virtual-bus",
        choices=("auto", "native", "guest"),
        default="auto",
        help="Kernel of the virtual CAN buses of armident.testing: this one, a guest, or this one if it can (auto).",
    )


@pytest.hookimpl(tryfirst=True)
def pytest_configure(config: pytest.Config) -> None:
    """In a guest, hand the reports to the run that started it."""
    file = os.environ.get(REPORTS_VARIABLE)
    if file:
        from armident.testing.guest import ReportWriter

        config.option.xmlpath = None  # the other run writes it
        config.pluginmanager.register(ReportWriter(config, Path(file)), "armident-reports")


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool | None:
    """Run a test that needs a bus in the guest, if there is one, and report it here."""
    if not needs_bus(item):
        return None
    if _run not in item.config.stash:
        item.config.stash[_run] = _guest(item.config)
    run = item.config.stash[_run]
    if run is None:
        return None
    run.report(item, nextitem)
    return True


def needs_bus(item: pytest.Item) -> bool:
    """Return True if a test uses a virtual bus."""
    return virtual_bus.__name__ in getattr(item, "fixturenames", ())


def _guest(config: pytest.Config) -> "GuestRun | None":
    """Run of the tests in a guest; ``None`` if they run here, or nowhere."""
    choice = config.getoption("--virtual-bus")
    if choice == "native" or os.environ.get(REPORTS_VARIABLE):
        return None
    from armident.drivers.vcan import launcher_obstacle
    from armident.testing.guest import GuestRun, can_make_buses

    if choice == "auto" and can_make_buses():
        return None
    return None if launcher_obstacle() is not None else GuestRun()


@pytest.fixture
def virtual_bus() -> Iterator[str]:
    """Name of a virtual CAN bus that is up and that nothing else uses; it is gone after the test.

    Yields
    ------
    str
        Name of the vcan interface.
    """
    from armident.configs import ConfigError
    from armident.drivers.vcan import ensure_vcan, launcher_obstacle, remove_vcan

    # The kernel takes 15 characters.
    name = f"vb{os.getpid() % 1_000_000}n{next(_numbers)}"
    try:
        ensure_vcan(name)
    except ConfigError as error:
        reason = f"{error}; and no guest: {launcher_obstacle() or 'pytest runs with --virtual-bus native'}"
        if os.environ.get(REQUIRE_VARIABLE) == "1":
            pytest.fail(reason, pytrace=False)
        pytest.skip(reason)
    yield name
    remove_vcan(name)


@pytest.fixture
def virtual_arm(virtual_bus: str, tmp_path: Path) -> "Iterator[VirtualArms]":
    """Start virtual arms: ``arm = virtual_arm("cell.yaml", scenario="worn.yaml")``; they end with the test.

    Yields
    ------
    VirtualArms
        Called with a session or robot configuration, see `armident.testing.virtual_arm.VirtualArms`.
    """
    from armident.extras import require

    require("armident.testing", "virtual")
    from armident.testing.virtual_arm import VirtualArms

    arms = VirtualArms(virtual_bus, tmp_path)
    try:
        yield arms
    finally:
        arms.stop()


@pytest.fixture
def capture(tmp_path: Path) -> "Captures":
    """Record a virtual arm: ``recording = capture(arm)``.

    Returns
    -------
    Captures
        Called with a virtual arm, see `armident.testing.virtual_arm.Captures`.
    """
    from armident.testing.virtual_arm import Captures

    return Captures(tmp_path)
