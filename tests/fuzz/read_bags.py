"""Joint states in bags of ROS 2, data sets of LeRobot, and electronic data sheets of drives."""

import hashlib
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

from armident.configs.loading import HERE
from armident.daq.interchange.importing import import_recording
from armident.drivers.canopen.eds import read_eds
from tests.fuzz.folders import as_folder, folder_of, spoil_one_file
from tests.fuzz.harness import MisreadError, Target
from tests.fuzz.mutate import either, forge_database, forge_recording, spoil_bytes, spoil_text
from tests.fuzz.read_imports import check_consistent
from tests.unit.daq.bags import TX40, mcap_bag, metadata, sqlite_bag, states, zstd
from tests.unit.daq.tables import lerobot


def _written(write: Callable[[Path], Path], name: str) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        return write(Path(folder, name)).read_bytes()


def _shuffled() -> list[tuple[str, ...]]:
    names = [joint.name for joint in TX40.joints]
    return [tuple(names), tuple(reversed(names))]


def _mcap_seeds() -> list[bytes]:
    """Plain bag, one with compressed messages, one whose joints come in two orders, and one of ROS 1."""
    mixed = states()[:60] + states(_shuffled()[1], range(5, -1, -1))[60:]
    return [
        _written(lambda path: mcap_bag(path, states()), "a.mcap"),
        _written(lambda path: mcap_bag(path, states(), pack=zstd), "a.mcap"),
        _written(lambda path: mcap_bag(path, mixed), "a.mcap"),
        _written(lambda path: mcap_bag(path, states(), ros_1=True), "a.mcap"),
    ]


def _sqlite_seeds() -> list[bytes]:
    return [
        _written(lambda path: sqlite_bag(path, states()), "a.db3"),
        _written(lambda path: sqlite_bag(path, states(), pack=zstd), "a.db3"),
    ]


def _folder_seeds() -> list[bytes]:
    """Folder of two files with its metadata, and one of a compressed file."""
    made = []
    with tempfile.TemporaryDirectory() as folder:
        two, packed = Path(folder, "two"), Path(folder, "packed")
        two.mkdir()
        packed.mkdir()
        mcap_bag(two / "bag_0.mcap", states()[:50])
        mcap_bag(two / "bag_1.mcap", states()[50:])
        metadata(two, ["bag_0.mcap", "bag_1.mcap"], len(states()))
        (packed / "bag_0.db3.zstd").write_bytes(zstd(sqlite_bag(Path(folder, "b.db3"), states()).read_bytes()))
        metadata(packed, ["bag_0.db3.zstd"], len(states()))
        made += [folder_of(two), folder_of(packed)]
    return made


def _lerobot_seeds() -> list[bytes]:
    made = []
    with tempfile.TemporaryDirectory() as folder:
        for name, extra in (("a", "observation.effort"), ("b", "observation.current")):
            lerobot(Path(folder, name), [f"{joint.name}.pos" for joint in TX40.joints], extra)
            made.append(folder_of(Path(folder, name)))
    return made


def _check_bag(suffix: str) -> Callable[[bytes, Path], bool]:
    def check(data: bytes, folder: Path) -> bool:
        path = folder / f"bag{suffix}"
        path.write_bytes(data)
        return _import(path, data, folder)

    return check


def _check_folder(data: bytes, folder: Path) -> bool:
    path = folder / "bag"
    shutil.rmtree(path, ignore_errors=True)
    as_folder(data, path)
    return _import(path, data, folder)


def _import(path: Path, data: bytes, folder: Path) -> bool:
    """Import with an option that the content chooses, so that a kept input is tried in the same way again."""
    choice = hashlib.sha256(data).digest()[0] % 4
    options = ({}, {"resample_hz": 500.0}, {"by_position": True}, {"rate_hz": 500.0})[choice]
    check_consistent(import_recording(path, TX40, **options), folder)
    return True


def _eds_seeds() -> list[bytes]:
    return [path.read_bytes() for path in sorted((HERE / "eds").glob("*.eds"))]


def _check_eds(data: bytes, folder: Path) -> bool:
    """Every object of a sheet has a number that is an index."""
    path = folder / "drive.eds"
    path.write_bytes(data)
    for index in read_eds(path, 5).objects:
        if not 0 <= index <= 0xFFFF:
            raise MisreadError(f"an object of index {index}")
    return True


TARGETS = (
    Target("import-bag", _mcap_seeds, either(spoil_bytes, forge_recording, forge_recording), _check_bag(".mcap")),
    Target("import-db3", _sqlite_seeds, either(spoil_bytes, forge_database, forge_database), _check_bag(".db3")),
    Target("import-bag-folder", _folder_seeds, spoil_one_file, _check_folder),
    Target("import-lerobot", _lerobot_seeds, spoil_one_file, _check_folder),
    Target("eds", _eds_seeds, either(spoil_text, spoil_bytes), _check_eds),
)
