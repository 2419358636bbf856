"""Fixtures of all tests: the measured data, a bus of its own, and the folder of results shared between processes."""

import atexit
import gc
import itertools
import os
import shutil
import tempfile
from collections.abc import Generator, Iterator
from pathlib import Path

import can
import hypothesis
import pytest

# Set before numpy is imported; child processes inherit it. There is one test process per processor, so that more
# threads of OpenBLAS only wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# The keys of the tests, which their child processes inherit: not those of this user or of a plant.
os.environ["XDG_STATE_HOME"] = tempfile.mkdtemp(prefix="armident-state-")
os.environ.pop("ARMIDENT_KEYS", None)

from armident.configs.schema.session import Bus
from armident.drivers.can.udp import open_python_can
from armident.drivers.vcan import ensure_vcan, have_socketcan, remove_vcan
from tests.fixtures.store import use_folder
from tests.fixtures.undeclared import UNDECLARED

atexit.register(shutil.rmtree, os.environ["XDG_STATE_HOME"], ignore_errors=True)

REPOSITORY = Path(__file__).resolve().parents[1]
NO_SOCKETCAN = "no SocketCAN in this kernel; run through `make test`"

# Examples of each property: a few in `make test`, many in `make nightly` and by hand.
hypothesis.settings.register_profile("armident", deadline=None, print_blob=True, max_examples=30)
hypothesis.settings.register_profile("nightly", deadline=None, print_blob=True, max_examples=200)
hypothesis.settings.load_profile(os.environ.get("ARMIDENT_HYPOTHESIS_PROFILE", "armident"))

_bus_numbers = itertools.count()


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Collect without the garbage collector: it takes a fifth of the time, and what is collected stays."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()
        gc.freeze()


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip what needs a bus where there is none; fail instead where ARMIDENT_REQUIRE_VCAN=1 (CI)."""
    if item.get_closest_marker("vcan") and not have_socketcan():
        if os.environ.get("ARMIDENT_REQUIRE_VCAN") == "1":
            pytest.fail(NO_SOCKETCAN, pytrace=False)
        pytest.skip(NO_SOCKETCAN)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call() -> Generator[None, object, object]:
    """Fail if a kernel compiled at run time, for types that its module does not declare."""
    result = yield
    if found := UNDECLARED.taken():
        pytest.fail(f"compiled at run time; declare the signature: {', '.join(found)}", pytrace=False)
    return result


@pytest.fixture(scope="session", autouse=True)
def shared_results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of this run in which its processes share recordings, estimates and diagnoses."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "shared"
    use_folder(folder)
    return folder


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of measured data, ``$ARMIDENT_SHARED_DATA`` or ``../shared/data`` beside the repository."""
    folder = Path(os.environ.get("ARMIDENT_SHARED_DATA") or REPOSITORY.parent / "shared" / "data")
    if not folder.is_dir():
        pytest.skip(f"the measured data are not here (looked in {folder}; ARMIDENT_SHARED_DATA names another folder)")
    return folder


@pytest.fixture
def vcan_bus() -> Iterator[str]:
    """Name of a vcan interface that is up and that nothing else uses; gone after the test (mark the test ``vcan``)."""
    # the kernel takes 15 characters
    name = f"vt{os.getpid() % 1_000_000}n{next(_bus_numbers)}"
    ensure_vcan(name)
    yield name
    remove_vcan(name)


@pytest.fixture
def udp_bus() -> Bus:
    """A bus over UDP multicast that nothing else uses, for tests that need no SocketCAN."""
    group = f"239.{next(_bus_numbers) % 128}.{os.getpid() >> 8 & 255}.{os.getpid() & 255}"
    bus = Bus(interface="udp_multicast", channel=group)
    try:
        open_python_can(bus).shutdown()
    except can.CanError as error:
        pytest.skip(f"no multicast here: {error.__cause__ or error}")
    return bus


@pytest.fixture
def vcan_buses() -> Iterator[list[str]]:
    """Names of two vcan interfaces as :func:`vcan_bus` makes them."""
    names = [f"vt{os.getpid() % 1_000_000}n{next(_bus_numbers)}" for _ in range(2)]
    for name in names:
        ensure_vcan(name)
    yield names
    for name in names:
        remove_vcan(name)
