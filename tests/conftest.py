"""What every test may ask for: the shared data, and a bus of its own."""

import itertools
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import pytest

from drivers.vcan import have_socketcan

REPOSITORY = Path(__file__).resolve().parents[1]
NO_SOCKETCAN = "no SocketCAN in this kernel; run through `make test`"

hypothesis.settings.register_profile("armident", deadline=None, print_blob=True)
hypothesis.settings.load_profile("armident")

_bus_numbers = itertools.count()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip what needs a bus where there is none; fail instead where ARMIDENT_REQUIRE_VCAN=1 (CI)."""
    if have_socketcan() or os.environ.get("ARMIDENT_REQUIRE_VCAN") == "1":
        return
    for item in items:
        if item.get_closest_marker("vcan"):
            item.add_marker(pytest.mark.skip(reason=NO_SOCKETCAN))


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of measured data, ``$ARMIDENT_SHARED_DATA`` or ``../shared/data`` beside the repository."""
    folder = Path(os.environ.get("ARMIDENT_SHARED_DATA") or REPOSITORY.parent / "shared" / "data")
    if not folder.is_dir():
        pytest.skip(f"the measured data are not here (looked in {folder}; ARMIDENT_SHARED_DATA names another folder)")
    return folder


@pytest.fixture
def vcan_bus() -> Iterator[str]:
    """Name of a vcan interface that is up and that nothing else uses; gone after the test."""
    if not have_socketcan():
        pytest.fail(NO_SOCKETCAN)
    name = f"vt{os.getpid() % 100000}x{next(_bus_numbers)}"
    subprocess.run(["ip", "link", "add", "dev", name, "type", "vcan"], check=True)
    try:
        subprocess.run(["ip", "link", "set", "dev", name, "up"], check=True)
        yield name
    finally:
        subprocess.run(["ip", "link", "delete", "dev", name], check=False)
