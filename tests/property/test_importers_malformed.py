"""Every importer reads a damaged file, or refuses it in one line of the program's own words."""

import tempfile
from functools import cache
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from armident.configs import ArmidentError
from armident.daq.interchange.importing import import_recording
from armident.daq.interchange.readers import RosBag
from armident.daq.recording import Recording, write_recording
from tests.fuzz.harness import FOREIGN_WORDS
from tests.unit.daq.bags import sqlite_bag, states
from tests.unit.daq.formats import EXAMPLES, example
from tests.unit.daq.tables import motion, written
from tests.unit.daq.test_bus_log import SESSION, captured
from tests.unit.daq.test_importing import TX40

FORMATS = {suffix: reader for reader, suffix in EXAMPLES} | {".db3": RosBag()}
INSERTED = (b"", b"\n", b",", b";", b"nan", b"1e999", b"-", b"\0", b"\xff\xfe", b"9" * 400, b"#", b"(", b'"', b"0,5")

FEWER = settings().max_examples // 3
"""Examples of a format: there are many formats, and `make nightly` has thousands of each."""


@cache
def valid(suffix: str) -> bytes:
    """Return a small file of a format."""
    with tempfile.TemporaryDirectory() as folder:
        if suffix == ".db3":
            return sqlite_bag(Path(folder, "a.db3"), states()[:40]).read_bytes()
        table = import_recording(written(Path(folder, "t.csv"), motion(40)), TX40)
        recording = captured(40) if FORMATS[suffix].session else table
        return example(FORMATS[suffix], suffix, Path(folder), recording).read_bytes()


def read(path: Path) -> Recording:
    return import_recording(path, SESSION if FORMATS[path.suffix].session else TX40)


def read_or_refused(path: Path) -> Recording | ArmidentError:
    try:
        return read(path)
    except ArmidentError as error:
        return error


edits = st.lists(
    st.tuples(
        st.floats(0, 1), st.integers(0, 40), st.one_of(st.sampled_from(INSERTED), st.binary(max_size=8))
    ),
    min_size=1,
    max_size=6,
)  # fmt: skip


def damaged(data: bytes, changes: list[tuple[float, int, bytes]], cut: float) -> bytes:
    """Return data with some pieces replaced, up to a share of its length."""
    made = bytearray(data)
    for share, length, piece in changes:
        at = int(share * len(made))
        made[at : at + length] = piece
    return bytes(made[: int(cut * len(made))])


def check(suffix: str, data: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, f"a{suffix}")
        path.write_bytes(data)
        found = read_or_refused(path)
        if isinstance(found, ArmidentError):
            text = str(found)
            assert "\n" not in text
            assert text.isprintable()
            assert not FOREIGN_WORDS.search(text.replace(str(path), "")), text
            assert found.exit_code in (2, 3)
            return
        samples = found.samples
        assert all(len(values) == samples.sync.size for values in samples.raw.values())
        assert (samples.sync[1:] > samples.sync[:-1]).all()
        write_recording(found, Path(folder, "out.mcap"))


@pytest.mark.slow
@pytest.mark.parametrize("suffix", list(FORMATS))
@settings(max_examples=FEWER, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large], deadline=None)
@given(changes=edits, cut=st.sampled_from([1.0, 1.0, 0.97, 0.6, 0.1]))
def test_a_damaged_file_is_read_or_refused_in_one_line(
    suffix: str, changes: list[tuple[float, int, bytes]], cut: float
) -> None:
    check(suffix, damaged(valid(suffix), changes, cut))


@pytest.mark.nightly
@pytest.mark.parametrize("suffix", list(FORMATS))
@settings(max_examples=3000, suppress_health_check=list(HealthCheck), deadline=None)
@given(changes=edits, cut=st.floats(0, 1))
def test_thousands_of_damaged_files_are_read_or_refused_in_one_line(
    suffix: str, changes: list[tuple[float, int, bytes]], cut: float
) -> None:
    check(suffix, damaged(valid(suffix), changes, cut))


@pytest.mark.parametrize("suffix", list(FORMATS))
def test_the_undamaged_file_is_read(suffix: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, f"a{suffix}")
        path.write_bytes(valid(suffix))
        assert read(path).samples.sync.size == 40
