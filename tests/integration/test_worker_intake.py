"""Files that a worker finds: one that ends its workers, too large, replaced, being copied, deleted, in parts."""

import logging
import os
import shutil
import signal
import threading
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
import zstandard

from armident.configs import SessionConfig
from armident.daq.recording import (
    Recording,
    RecordingSeries,
    RecordingWriter,
    StreamLayout,
    mcap_records,
    read_recording,
    write_recording,
)
from armident.daq.recording.reader import unpacked_bytes
from armident.identify.documents.files import load_document
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.monitoring.worker import intake
from armident.identify.monitoring.worker import recorded as recorded_module
from armident.identify.monitoring.worker.ledger import FILE, MOST_ATTEMPTS, Ledger, LedgerEntry
from armident.identify.monitoring.worker.recorded import MOST_BYTES, Captured
from armident.identify.monitoring.worker.stream_buffer import StreamBuffer
from armident.identify.monitoring.worker.worker import Worker
from tests.faults.service import Audience, cell_of
from tests.fixtures import arms
from tests.fixtures.processes import start
from tests.integration.test_worker import LONGEST_S
from tests.integration.test_worker_failures import recorded

pytestmark = pytest.mark.slow

ROBOT = arms.recording("emps", "emps_excitation", 1).robot


@pytest.fixture
def session(tmp_path: Path) -> SessionConfig:
    """A cell whose recordings are in the folder of the test."""
    return cell_of(tmp_path)


def entries(folder: Path) -> dict[str, LedgerEntry]:
    return {entry.name: entry for entry in Ledger(folder / FILE, "test").entries()}


def wait_for(condition: Callable[[], bool]) -> None:
    until = time.monotonic() + LONGEST_S
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.05)


def work_until_poisoned(folder: Path) -> None:
    """Run a worker that the kernel ends while it reads one of the files, as it does if the memory is full."""
    read = Captured.read

    def poisoned(captured: Captured) -> Recording:
        if captured.name == "emps-poison":
            os.kill(os.getpid(), signal.SIGKILL)
        return read(captured)

    # In a process of its own, which ends as if for want of memory: types forbid to replace a method.
    Captured.read = poisoned  # type: ignore[method-assign, assignment]
    with Worker(cell_of(folder), ROBOT, folder) as worker:
        worker.result()
        worker.result()


def test_a_file_that_ends_its_workers_is_counted_before_it_is_read_and_holds_up_no_other(
    session: SessionConfig, tmp_path: Path
) -> None:
    recorded(session, "good", 1)
    recorded(session, "poison", 2)
    for attempts in (1, 2):
        process = start(work_until_poisoned, tmp_path)
        assert process.wait(LONGEST_S) == -signal.SIGKILL
        assert entries(tmp_path)["emps-poison"].attempts == attempts
    assert entries(tmp_path)["emps-good"].state == "done"
    poison = entries(tmp_path)["emps-poison"].sha256
    killed = Ledger(tmp_path / FILE, "killed", lease_s=0.0, clock=lambda: time.monotonic() + 60.0)
    for _ in range(2, MOST_ATTEMPTS):
        assert killed.claim(poison) is not None
    with Ledger(tmp_path / FILE, "killed")._transaction() as db:
        db.execute("UPDATE experiments SET owner = NULL")
    with closing(Audience(session, "emps")), Worker(session, ROBOT, tmp_path) as worker:
        assert worker.result(LONGEST_S) == 1
    failed = entries(tmp_path)["emps-poison"]
    assert (failed.state, failed.announced, failed.digest) == ("failed", True, None)
    assert f"{MOST_ATTEMPTS} workers have ended" in (failed.message or "")


def test_a_file_whose_chunks_unpack_to_more_than_the_memory_is_refused_without_unpacking_one(
    session: SessionConfig, tmp_path: Path
) -> None:
    recorded(session, "bomb", 1)
    path = tmp_path / "emps-bomb.mcap"
    raw = bytes(1 << 28)
    chunk = mcap_records.chunk(0, 1, raw, zstandard.compress(raw))
    data = path.read_bytes()
    records = mcap_records.records(memoryview(data), len(mcap_records.MAGIC))
    first = next(at for opcode, at, _ in records if opcode == 6)
    path.write_bytes(data[:first] + 40 * chunk + mcap_records.MAGIC)
    assert path.stat().st_size < 400_000
    assert unpacked_bytes(path) > 40 << 28 > MOST_BYTES
    with Worker(session, ROBOT, tmp_path) as worker:
        assert worker.result(LONGEST_S) == 3
    assert "unpacks to 10.7 GB, a worker reads 3.5 GB; let captures begin new files" in (
        entries(tmp_path)["emps-bomb"].message or ""
    )


def test_no_array_of_a_recording_is_larger_than_its_unpacked_records(tmp_path: Path) -> None:
    made = arms.recording("emps", "emps_excitation", 1)
    write_recording(made, tmp_path / "emps-a.mcap")
    streams = read_recording(tmp_path / "emps-a.mcap").streams.values()
    arrays = sum(s.sync.nbytes + s.t_ns.nbytes + sum(raw.nbytes for raw in s.raw.values()) for s in streams)
    assert arrays < unpacked_bytes(tmp_path / "emps-a.mcap")


def in_parts(session: SessionConfig, name: str, parts: int) -> RecordingSeries:
    """Write a recording of the cell in files of equal length, of which the last one is still open."""
    made = arms.recording("emps", "emps_excitation", 1)
    layouts = [StreamLayout.of(stream, [joint.name for joint in made.robot.joints]) for stream in made.streams.values()]

    def begin(path: Path, _: int) -> RecordingWriter:
        return RecordingWriter(path, made.robot, session, made.sample_rate_hz, layouts, {"cell": session.cell})

    length = made.samples.sync.size // parts + 1
    series = RecordingSeries(begin, session.recording.directory, f"emps-{name}", max_bytes=1)
    for part in range(parts):
        first, last = part * length, (part + 1) * length
        if part > 0:
            series.rotate(int(made.samples.t_ns[first]))
        for stream in made.streams.values():
            rows = (stream.sync >= made.samples.sync[0] + first) & (stream.sync < made.samples.sync[0] + last)
            raw = {field: values[rows] for field, values in stream.raw.items()}
            series.append(stream.name, stream.sync[rows], stream.t_ns[rows], raw)
        series.flush()
    return series


def test_files_of_a_capture_that_is_too_long_to_be_joined_are_identified_one_by_one_while_it_runs(
    session: SessionConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    series = in_parts(session, "x", 3)
    assert [path.name for path in series.paths] == ["emps-x.mcap", "emps-x.0002.mcap", "emps-x.0003.mcap"]
    size = unpacked_bytes(series.paths[0])
    for module in (recorded_module, intake):
        monkeypatch.setattr(module, "MOST_BYTES", int(1.5 * size))
    with Worker(session, ROBOT, tmp_path) as worker:
        assert worker.result(LONGEST_S) is not None
        assert worker.result(LONGEST_S) is not None
        series.paths[0].unlink()  # as retention does
        series.close({"samples.rows": 25085, "writer.files": 3})
        assert worker.result(LONGEST_S) is not None
        assert worker.result(8.0) is None
    assert {name: entry.state for name, entry in entries(tmp_path).items()} == {
        "emps-x": "done",
        "emps-x.0002": "done",
        "emps-x.0003": "done",
    }


def test_files_of_a_short_capture_are_joined_and_not_again_without_those_that_were_deleted(
    session: SessionConfig, tmp_path: Path
) -> None:
    series = in_parts(session, "x", 2)
    series.close({"samples.rows": 25085, "writer.files": 2})
    with Worker(session, ROBOT, tmp_path) as worker:
        assert worker.result(LONGEST_S) == 0
        series.paths[0].unlink()
        assert worker.result(8.0) is None
    assert list(entries(tmp_path)) == ["emps-x"]
    made = arms.recording("emps", "emps_excitation", 1)
    assert entries(tmp_path)["emps-x"].digest == made.sha256


def test_a_file_that_is_replaced_under_its_name_gets_a_result_of_its_new_content(
    session: SessionConfig, tmp_path: Path
) -> None:
    first = recorded(session, "a", 1)
    with closing(Audience(session, "emps")) as audience, Worker(session, ROBOT, tmp_path) as worker:
        assert worker.result(LONGEST_S) == 0
        second = recorded(session, "a", 2)
        assert worker.result(LONGEST_S) == 0
        time.sleep(0.5)
        assert audience.results == {first.sha256: 1, second.sha256: 1}
    results = {
        load_document(path, IdentificationDocument).recording.sha256
        for path in tmp_path.glob("*.identification/identification.json")
    }
    assert results == {first.sha256, second.sha256}


def test_a_copy_that_overwrites_an_older_file_in_place_is_read_when_it_is_complete(
    session: SessionConfig, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    made = recorded(session, "a", 1)
    path = tmp_path / "emps-a.mcap"
    data = path.read_bytes()
    middle = len(data) // 5
    path.write_bytes(data[:middle] + bytes(1000) + data[middle + 1000 :])
    with Worker(session, ROBOT, tmp_path) as worker:
        assert worker.result(8.0) is None
        assert (
            "emps-a: it is damaged, and changed in the last 60 s, as in a copy under way; trying again" in caplog.text
        )
        with path.open("r+b") as file:
            file.seek(middle)
            file.write(data[middle : middle + 1000])
        assert worker.result(LONGEST_S) == 0
    (entry,) = entries(tmp_path).values()
    assert (entry.state, entry.digest) == ("done", made.sha256)
    assert len(list(tmp_path.glob("*.identification"))) == 1


def read_and_killed(session: SessionConfig, folder: Path) -> None:
    """Read the only recording as a worker that is killed before it has a result."""
    ledger = Ledger(folder / FILE, "killed", lease_s=0.0)
    reader = intake.Intake(session.cell, "emps", lambda _: folder, StreamBuffer(), threading.Lock(), print)
    reader.scan(ledger, [folder])
    entry = ledger.claim()
    assert entry is not None
    assert reader.read(ledger, entry) is not None


def test_a_file_that_is_replaced_before_it_is_identified_has_one_result_with_the_hash_of_its_samples(
    session: SessionConfig, tmp_path: Path
) -> None:
    recorded(session, "a", 1)
    read_and_killed(session, tmp_path)
    second = recorded(session, "a", 2)
    with Worker(session, ROBOT, tmp_path) as worker:
        assert worker.result(LONGEST_S) == 0
        assert worker.result(6.0) is None
    (entry,) = entries(tmp_path).values()
    assert (entry.state, entry.digest) == ("done", second.sha256)
    (written,) = tmp_path.glob("*.identification/identification.json")
    assert load_document(written, IdentificationDocument).recording.sha256 == second.sha256


def test_copies_of_a_recording_have_one_result(
    session: SessionConfig, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    made = recorded(session, "a", 1)
    for name in "bc":
        shutil.copy(tmp_path / "emps-a.mcap", tmp_path / f"emps-{name}.mcap")
    with closing(Audience(session, "emps")) as audience, Worker(session, ROBOT, tmp_path) as worker:
        assert worker.result(LONGEST_S) == 0
        assert worker.result(6.0) is None
        assert audience.results == {made.sha256: 1}
    assert len(entries(tmp_path)) == 1
    assert len([line for line in caplog.messages if "its samples are those of emps-" in line]) == 2


def test_a_file_that_is_being_copied_is_identified_when_it_is_complete(
    session: SessionConfig, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    made = recorded(session, "a", 1)
    content = (tmp_path / "emps-a.mcap").read_bytes()
    (tmp_path / "emps-a.mcap").unlink()
    with Worker(session, ROBOT, tmp_path) as worker, (tmp_path / "emps-b.mcap").open("wb") as copy:
        for part in (content[: len(content) // 2], content[len(content) // 2 : -100]):
            copy.write(part)
            copy.flush()
            assert worker.result(6.0) is None
        copy.write(content[-100:])
        copy.flush()
        assert worker.result(LONGEST_S) == 0
    assert [(entry.name, entry.digest) for entry in entries(tmp_path).values()] == [("emps-b", made.sha256)]
    assert caplog.text.count("emps-b.mcap: it has no end, and did not stay the same for 60 s; it waits") == 1


def test_a_torn_file_that_no_longer_changes_is_identified(
    session: SessionConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(intake, "STILL_S", 1.0)
    recorded(session, "a", 1)
    os.truncate(tmp_path / "emps-a.mcap", (tmp_path / "emps-a.mcap").stat().st_size * 3 // 4)
    with Worker(session, ROBOT, tmp_path) as worker:
        assert worker.result(LONGEST_S) is not None
    assert entries(tmp_path)["emps-a"].state == "done"


def test_a_file_that_changes_while_it_is_read_is_read_again(
    session: SessionConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    recorded(session, "a", 1)
    ledger = Ledger(tmp_path / FILE, "one")
    reader = intake.Intake(session.cell, "emps", lambda _: tmp_path, StreamBuffer(), threading.Lock(), print)
    reader.scan(ledger, [tmp_path])
    entry = ledger.claim()
    assert entry is not None
    read = Captured.read

    def while_replaced(captured: Captured) -> Recording:
        recording = read(captured)
        recorded(session, "a", 2)
        return recording

    monkeypatch.setattr(Captured, "read", while_replaced)
    assert reader.read(ledger, entry) is None
    assert "emps-a: it changed while it was read; trying again" in caplog.text
    monkeypatch.setattr(Captured, "read", read)
    assert ledger.claim() is None
    reader.scan(ledger, [tmp_path])
    again = ledger.claim()
    assert again is not None
    assert reader.read(ledger, again) is not None
    entry = ledger.entries()[-1]
    assert entry.digest == read_recording(tmp_path / "emps-a.mcap").sha256


def test_a_file_that_is_deleted_is_passed_over_and_found_again_under_another_name(
    session: SessionConfig, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    recorded(session, "a", 1)
    read_and_killed(session, tmp_path)
    (tmp_path / "emps-a.mcap").rename(tmp_path / "away")
    with Worker(session, ROBOT, tmp_path) as worker:
        wait_for(lambda: entries(tmp_path)["emps-a"].state == "passed")
        assert "emps-a.mcap: no such recording; trying again" in caplog.text
        (tmp_path / "away").rename(tmp_path / "emps-b.mcap")
        assert worker.result(LONGEST_S) == 0
    assert {name: entry.state for name, entry in entries(tmp_path).items()} == {"emps-b": "done"}
