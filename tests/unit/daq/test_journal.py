"""Log records reach the journal with their fields, and stderr if it is no journal."""

import logging
import os
import socket
import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from armident.daq.capture.journal import journal_entry
from armident.daq.recording.clock import clock_state

LOG = """
import logging
import sys
from pathlib import Path
from armident.daq.capture.journal import JournalHandler
handler = JournalHandler({"cell": "press_7", "robot": "tx40"}, Path(sys.argv[1]))
log = logging.getLogger("armident.test")
log.setLevel("INFO")
log.addHandler(handler)
log.warning("the disk is %s", "full")
fields = {"event": "emcy", "axis": "joint_2", "bus": "can0", "sync": 17, "code": 0x2310, "node": None}
log.info("node 2 (joint_2): EMCY 2310h", extra=fields)
log.info("two\\nlines")
log.debug("not logged")
handler.close()
log.info("afterwards")
"""


def parsed(datagram: bytes) -> dict[str, str]:
    """Return the fields of an entry, as the journal reads them."""
    fields, at = {}, 0
    while at < len(datagram):
        end = datagram.index(b"\n", at)
        key, equals, value = datagram[at:end].partition(b"=")
        at = end + 1
        if not equals:
            (size,) = struct.unpack_from("<Q", datagram, at)
            value = datagram[at + 8 : at + 8 + size]
            assert datagram[at + 8 + size : at + 9 + size] == b"\n"
            at += 9 + size
        fields[key.decode()] = value.decode()
    return fields


@pytest.fixture
def journal(tmp_path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "journal"))
        listener.settimeout(5.0)
        yield listener


def logged(address: Path, stderr: Path, stream: str | None) -> str:
    """Return the stderr of a process that logs; ``stream`` is its ``JOURNAL_STREAM``, ``""`` for stderr itself."""
    with stderr.open("w") as file:
        found = os.fstat(file.fileno())
        environment = {key: value for key, value in os.environ.items() if key != "JOURNAL_STREAM"}
        if stream is not None:
            environment["JOURNAL_STREAM"] = stream or f"{found.st_dev}:{found.st_ino}"
        subprocess.run([sys.executable, "-c", LOG, str(address)], stderr=file, env=environment, check=True, timeout=60)
    return stderr.read_text()


def test_entries_reach_the_journal_with_their_fields(journal: socket.socket, tmp_path: Path) -> None:
    assert logged(tmp_path / "journal", tmp_path / "stderr", "") == "afterwards\n"
    disk, emcy, lines = (parsed(journal.recv(100_000)) for _ in range(3))
    common = {"SYSLOG_IDENTIFIER": "armident", "ARMIDENT_CELL": "press_7", "ARMIDENT_ROBOT": "tx40"}
    assert disk == {"MESSAGE": "warning: the disk is full", "PRIORITY": "4", **common}
    assert emcy == {
        "MESSAGE": "node 2 (joint_2): EMCY 2310h",
        "PRIORITY": "6",
        **common,
        "ARMIDENT_EVENT": "emcy",
        "ARMIDENT_AXIS": "joint_2",
        "ARMIDENT_BUS": "can0",
        "ARMIDENT_SYNC": "17",
        "ARMIDENT_CODE": "8976",
    }
    assert lines["MESSAGE"] == "two\nlines"


@pytest.mark.parametrize("stream", [None, "1:2", "nonsense"])
def test_records_are_plain_lines_if_stderr_is_no_journal(stream: str | None, tmp_path: Path) -> None:
    text = logged(tmp_path / "nobody", tmp_path / "stderr", stream)
    assert text == "warning: the disk is full\nnode 2 (joint_2): EMCY 2310h\ntwo\nlines\nafterwards\n"


def test_records_are_plain_lines_if_the_journal_does_not_answer(tmp_path: Path) -> None:
    assert "EMCY 2310h\n" in logged(tmp_path / "nobody", tmp_path / "stderr", "")


def test_a_long_message_is_cut_to_fit_into_a_datagram() -> None:
    record = logging.makeLogRecord({"levelno": logging.INFO})
    assert len(journal_entry(record, "x" * 1_000_000, {})) < 10_000


@pytest.mark.parametrize(
    ("level", "priority"),
    [(logging.DEBUG, "7"), (logging.INFO, "6"), (logging.WARNING, "4"), (logging.ERROR, "3"), (logging.CRITICAL, "2")],
)
def test_levels_become_priorities_of_syslog(level: int, priority: str) -> None:
    assert parsed(journal_entry(logging.makeLogRecord({"levelno": level}), "text", {}))["PRIORITY"] == priority


def test_fields_of_a_record_precede_those_of_the_handler() -> None:
    record = logging.makeLogRecord({"levelno": logging.INFO, "cell": "own"})
    assert parsed(journal_entry(record, "text", {"cell": "press_7"}))["ARMIDENT_CELL"] == "own"


def test_the_kernel_gives_the_state_of_its_clock() -> None:
    state = clock_state()
    assert abs(state.offset_us) < 10e6
    assert state.error_us >= 0
    assert state.largest_error_us >= 0
    assert isinstance(state.synchronised, bool)
