"""Files of other tools: tables, and logs of a bus."""

import hashlib
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import can
import numpy as np

from armident.configs import RobotConfig, SessionConfig, load_robot, load_session
from armident.daq.interchange.importing import import_recording
from armident.daq.interchange.readers import Reader
from armident.daq.recording import Recording, read_recording, write_recording
from tests.fuzz.harness import FOREIGN_WORDS, MisreadError, Target
from tests.fuzz.mutate import Mutator, either, forge_blf, forge_parquet, forge_zip, spoil_bytes, spoil_text
from tests.unit.daq.formats import EXAMPLES, example
from tests.unit.daq.test_log_files import messages
from tests.unit.daq.test_log_tables import SAVVYCAN, busmaster, savvycan, table
from tests.unit.daq.test_recording import make_recording

ROWS = 60
SHORT = 300
"""Frames of a log."""
OPTIONS: tuple[dict[str, Any], ...] = (
    {}, {}, {"rate_hz": 5000.0}, {"resample_hz": 5000.0}, {"rate_hz": 2500.0, "polled": True}, {"by_position": True},
    {"motor_side": True, "time_unit": "ms"},
)  # fmt: skip
"""Options of imports; the content chooses one, so that a kept input is tried in the same way again."""


@cache
def _recording() -> Recording:
    """A recording whose values are within the limits of the robot."""
    made = make_recording(ROWS)
    samples = made.samples
    rng = np.random.default_rng(3)
    raw = samples.raw | {
        "position": np.cumsum(rng.integers(-50, 50, (ROWS, made.robot.n)), axis=0).astype(np.int32),
        "current": rng.integers(-300, 300, (ROWS, made.robot.n)).astype(np.int16),
    }
    sync = np.arange(ROWS, dtype=np.int64)
    samples = replace(samples, raw=raw, sync=sync, t_ns=samples.t_ns[0] + sync * 200_000)
    demand = made.streams["demand"]
    slow = raw["position"][4::5].copy()
    sync = sync[4::5]
    demand = replace(demand, raw={"demand": slow}, sync=sync, t_ns=samples.t_ns[4::5])
    session = load_session("tx40_cell.yaml")
    return replace(made, session=session, streams={"samples": samples, "demand": demand}, gaps=(), marks=())


def _seeds(reader: Reader, suffix: str) -> Callable[[], list[bytes]]:
    @cache  # once: a MAT file holds the second in which it was written
    def seeds() -> list[bytes]:
        recording = _recording()
        if not reader.session:
            recording = replace(recording, streams={"samples": recording.samples})
        with tempfile.TemporaryDirectory() as folder:
            return [example(reader, suffix, Path(folder), recording).read_bytes()]

    return seeds


def check_consistent(recording: Recording, folder: Path) -> None:
    """Refuse a recording that cannot be written and read, or has not one row of numbers for every sample.

    ``recording``: what was imported; ``folder``: takes the file. Raises MisreadError if it is inconsistent.
    """
    for stream in recording.streams.values():
        for name, values in stream.raw.items():
            if values.shape != (stream.sync.size, recording.robot.n):
                raise MisreadError(f"{name} has shape {values.shape} for {stream.sync.size} samples")
            if not np.isfinite(values).all():
                raise MisreadError(f"{name} is not finite")
    if FOREIGN_WORDS.search(remarks := " ".join(recording.metadata.values())):
        raise MisreadError(f"words of Python: {remarks[:200]}")
    if not 0.0 < recording.sample_rate_hz < np.inf:
        raise MisreadError(f"a rate of {recording.sample_rate_hz}")
    path = folder / "imported.mcap"
    path.unlink(missing_ok=True)
    write_recording(recording, path)
    if read_recording(path).sha256 != recording.sha256:
        raise MisreadError("what was imported is not what is read")


@cache
def _cell() -> tuple[SessionConfig, RobotConfig]:
    session = load_session("tx40_cell.yaml")
    return session, load_robot("tx40.yaml")


def _target(name: str, suffix: str, seeds: Callable[[], list[bytes]], *, session: bool) -> Target:
    def check(data: bytes, folder: Path) -> bool:
        path = folder / f"x{suffix}"
        path.write_bytes(data)
        choice = hashlib.sha256(data).digest()[0] % len(OPTIONS) if data not in seeds() else 0
        options = {} if session else OPTIONS[choice]
        check_consistent(import_recording(path, _cell()[0 if session else 1], **options), folder)
        return True

    return Target(name, seeds, MUTATORS.get(suffix, spoil_bytes), check)


def _csv_logs() -> list[bytes]:
    """Bus logs in CSV of SavvyCAN and of python-can."""
    with tempfile.TemporaryDirectory() as folder:
        written = Path(folder, "a.csv")
        with can.CSVWriter(written) as writer:
            for message in messages()[:SHORT]:
                writer.on_message_received(message)
        ours = table(Path(folder, "b.csv"), SAVVYCAN, map(savvycan, messages()[:SHORT]))
        return [ours.read_bytes(), written.read_bytes()]


def _busmaster_logs() -> list[bytes]:
    with tempfile.TemporaryDirectory() as folder:
        modes = ("SYSTEM", "HEX"), ("RELATIVE", "DEC")
        return [busmaster(Path(folder, "a.log"), mode, base).read_bytes() for mode, base in modes]


MUTATORS: dict[str, Mutator] = {
    ".npz": either(spoil_bytes, forge_zip, forge_zip),
    ".parquet": either(spoil_bytes, forge_parquet, forge_parquet),
    ".blf": either(spoil_bytes, forge_blf, forge_blf),
    **dict.fromkeys((".csv", ".log", ".asc", ".trc"), either(spoil_text, spoil_bytes)),
}
"""Ways to spoil a format by its suffix; others are spoiled byte by byte."""

TARGETS = (
    *(
        _target(f"import{suffix.replace('.', '-')}", suffix, _seeds(reader, suffix), session=reader.session)
        for reader, suffix in EXAMPLES
    ),
    _target("import-log-csv", ".csv", _csv_logs, session=True),
    _target("import-log-busmaster", ".log", _busmaster_logs, session=True),
)
