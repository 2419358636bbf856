"""Conversion between recordings and logs of CAN tools: candump, BLF, ASC and other formats of python-can.

The session configuration defines the frames that hold samples. They are processed like captured frames: matched to
their SYNC, with every SYNC accounted for.
"""

import hashlib
import itertools
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import can
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn

from armident.configs import ConfigError, DataError, RobotConfig, SessionConfig
from armident.configs.yaml_loader import is_file
from armident.daq.interchange.sandbox import error_line
from armident.daq.matching.assembler import Assembler, Batch
from armident.daq.matching.streams import CapturedStream, bus_numbers, captured_streams
from armident.daq.recording import Gap, Recording, Stream
from armident.drivers.can.frames import Frames, frames
from armident.drivers.canopen.objects import COB_SYNC

SUFFIXES = (".log", ".asc", ".blf", ".trc")
"""File name suffixes of logs: candump -l, Vector ASC and BLF, PEAK TRC."""

_BATCH = 4096
_SMALLEST_OBJECT = 16
"""Size of the header of an object in a BLF file, bytes."""
_TURN_NS = 1_000_000_000
_ANSWER_NS = 20_000
"""Time between frames of a SYNC in a log written from a recording, which has only the time of the SYNC, ns."""


def recording_from_log(path: Path, session: SessionConfig, robot: RobotConfig) -> Recording:
    """Return the recording of a log: its frames, matched by the mapping of a session.

    Parameters
    ----------
    path
        Log of one bus, or of several that have the names of the session's buses.
    session, robot
        Mapping of the TPDOs, and scales of their objects.

    Raises
    ------
    ConfigError
        If there is no such file, it lacks a bus of the session, or the session's buses carry CAN FD.
    DataError
        If it cannot be read as such a log, or holds no SYNC.
    """
    _check_classic(session, str(path))
    streams = captured_streams(session, robot)
    log = _read(path)
    read = [log.of(path, bus.channel, len(session.all_buses) > 1) for bus in session.all_buses]
    for bus, frames_of_it in zip(session.all_buses, read, strict=True):
        if not np.any(frames_of_it["can_id"] == COB_SYNC):
            where = f" of {bus.channel}" if len(read) > 1 else ""
            raise DataError(
                f"{path}: no SYNC ({COB_SYNC:X}h) among its {frames_of_it.size} frames{where}: "
                "samples cannot be matched"
            )
    assembler = Assembler(
        [stream.bus for stream in streams],
        [joint.name for joint in robot.joints],
        session.sync.period_us * 1000,
        session.sync.counter,
        None,
        bus_of=bus_numbers(session, robot),
    )
    parts = [assembler.push(piece, bus=bus) for bus, piece in _in_turn(read)]
    parts.append(assembler.finish())
    found = {stream.bus.name: _stream(stream, parts) for stream in streams}
    if found["samples"].sync.size == 0:
        wanted = ", ".join(f"{cob:X}h" for cob in streams[0].bus.cob_ids)
        raise DataError(f"{path}: no SYNC was answered by all drives; the session expects TPDOs {wanted}")
    gaps: list[Gap] = [gap for part in parts for gap in part.gaps]
    return Recording(
        None,
        robot,
        session,
        1.0 / session.sync_period,
        found,
        tuple(gaps),
        counters=assembler.counters | {"log.foreign": log.foreign},
        metadata={"source": path.name, "source_sha256": _digest(path)},
    )


def _check_classic(session: SessionConfig, where: str) -> None:
    if any(bus.fd for bus in session.all_buses):
        raise ConfigError(f"{where}: the session's buses carry CAN FD; logs hold classic frames only")


def _in_turn(read: Sequence[Frames]) -> Iterator[tuple[int, Frames]]:
    """Yield frames of each bus in turn, with at most one second of one bus ahead of the others."""
    if len(read) == 1:
        yield from ((0, read[0][first : first + _BATCH]) for first in range(0, read[0].size, _BATCH))
        return
    # Running maximum: frames stay in the order of reception when a clock is set back.
    seconds = [np.maximum.accumulate(f["t_ns"]) // _TURN_NS for f in read]
    for second in np.unique(np.concatenate(seconds)):
        for bus, frames_of_it in enumerate(read):
            first, last = np.searchsorted(seconds[bus], [second, second + 1])
            yield bus, frames_of_it[first:last]


def write_log(recording: Recording, path: Path) -> None:
    """Write the SYNCs and TPDOs of a recording as a log; the file appears when it is complete.

    A recording has the time of every SYNC; its answers follow at intervals of 20 us. SYNCs that were not received or
    not answered by all drives are not in the log, which its SYNC counter shows.

    Parameters
    ----------
    recording
        A recording that comes from a bus.
    path
        The file; its suffix selects the format.

    Raises
    ------
    ConfigError
        If the file cannot be written, or the session's buses carry CAN FD.
    DataError
        If the recording does not come from a bus.
    """
    session = recording.session
    if session is None:
        raise DataError(f"{recording.path}: was not captured from a bus; there are no frames to write")
    _check_classic(session, str(path))
    streams = captured_streams(session, recording.robot)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with can.Logger(temporary) as logger:
            for message in _messages(recording, session, streams):
                logger.on_message_received(message)
        temporary.replace(path)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from error
    finally:
        temporary.unlink(missing_ok=True)


@dataclass(frozen=True)
class _Log:
    """Classic data frames with 11-bit identifiers, the number of each one's bus, and the number of other frames."""

    frames: Frames
    bus: NDArray[np.int64]
    buses: tuple[str, ...]
    foreign: int

    def of(self, path: Path, bus: str, several: bool) -> Frames:
        """Return the frames of one bus.

        Parameters
        ----------
        path
            The log, for messages.
        bus
            Name of the bus.
        several
            The session has several buses; otherwise the frames of the only bus in the log are returned.
        """
        if len(self.buses) < 2 and not (self.buses and several):
            return self.frames
        if bus not in self.buses:
            raise ConfigError(f"{path}: holds the buses {', '.join(self.buses)}; the session's is {bus}")
        chosen: Frames = self.frames[self.bus == self.buses.index(bus)]
        return chosen


def _read(path: Path) -> _Log:
    if not is_file(path):
        raise ConfigError(f"{path}: no such file")
    numbers: dict[str, int] = {}
    parts: list[tuple[Frames, NDArray[np.int64]]] = []
    foreign = done = 0
    try:
        with _progress(path) as advance:
            for messages in _batches(path):
                batch, bus = frames(len(messages)), np.zeros(len(messages), np.int64)
                count = 0
                for message in messages:
                    done += 1
                    if message.is_error_frame or message.is_remote_frame or message.is_extended_id or message.is_fd:
                        foreign += 1
                        continue
                    row = batch[count]
                    row["t_ns"] = round(message.timestamp * 1e9)
                    row["can_id"], row["length"] = message.arbitration_id, message.dlc
                    row["data"][: message.dlc] = np.frombuffer(bytes(message.data), np.uint8)
                    bus[count] = numbers.setdefault(str(message.channel), len(numbers))
                    count += 1
                parts.append((batch[:count], bus[:count]))
                advance(done)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror or error}") from error
    except Exception as error:  # python-can's readers raise various errors for malformed files
        raise DataError(
            f"{path}: not a readable {path.suffix[1:]} log (after {done} frames): {error_line(error)}"
        ) from error
    if not parts:
        raise DataError(f"{path}: no frames in it")
    read = np.concatenate([part[0] for part in parts])
    early = np.flatnonzero(read["t_ns"] < 0)
    if early.size:
        raise DataError(f"{path}: frame {early[0] + 1} has a time of {read['t_ns'][early[0]] * 1e-9:.6g} s")
    return _Log(read, np.concatenate([p[1] for p in parts]), tuple(numbers), foreign)


class _BlfReader(can.BLFReader):
    """BLF reader of python-can, which would loop forever on objects of size zero."""

    def _parse_data(self, data: bytes) -> Iterator[can.Message]:
        at = data.find(b"LOBJ")
        while 0 <= at <= len(data) - 16:
            size = int.from_bytes(data[at + 8 : at + 12], "little")
            if size < _SMALLEST_OBJECT:
                raise ValueError(f"an object of {size} bytes")
            at = data.find(b"LOBJ", at + size, at + size + 8)
        yield from super()._parse_data(data)


def _batches(path: Path) -> Iterator[list[can.Message]]:
    # Absolute times; by default those of an ASC log would begin at zero.
    options = {"relative_timestamp": False} if path.suffix.lower() == ".asc" else {}
    opened = _BlfReader(path) if path.suffix.lower() == ".blf" else can.LogReader(path, **options)
    with opened as reader:
        messages = iter(reader)
        while batch := list(itertools.islice(messages, _BATCH)):
            yield batch


@contextmanager
def _progress(path: Path) -> Iterator[Callable[[int], None]]:
    """Show the number of frames read, on a terminal."""
    columns = SpinnerColumn(), TextColumn("{task.description}: {task.completed:.0f} frames")
    with Progress(*columns, console=Console(stderr=True), transient=True, disable=not sys.stderr.isatty()) as progress:
        task = progress.add_task(path.name, total=None)
        yield lambda done: progress.update(task, completed=done)


def _stream(stream: CapturedStream, parts: Sequence[Batch]) -> Stream:
    rows = [part.rows[stream.bus.name] for part in parts]
    raw = [stream.decode(r) for r in rows]
    layout = stream.layout
    return Stream(
        layout.name,
        layout.every,
        np.concatenate([r.sync for r in rows]),
        np.concatenate([r.t_ns for r in rows]),
        {f.name: f for f in layout.fields},
        {f.name: np.concatenate([values[f.name] for values in raw]) for f in layout.fields},
    )


def _messages(recording: Recording, session: SessionConfig, streams: Sequence[CapturedStream]) -> Iterator[can.Message]:
    """Yield SYNCs in order, each followed by the TPDOs that answer it, stream by stream and joint by joint."""
    overflow, channels = session.sync.counter, [bus.channel for bus in session.all_buses]
    joint_channel = [channels[bus] for bus in bus_numbers(session, recording.robot)]
    everything = sorted({int(n) for stream in recording.streams.values() for n in stream.sync})
    rows = {stream.bus.name: _encoded(stream, recording.streams[stream.bus.name]) for stream in streams}
    places = {
        name: dict(zip(recording.streams[name].sync.tolist(), range(recording.streams[name].sync.size), strict=True))
        for name in rows
    }
    for number in everything:
        at = {name: place[number] for name, place in places.items() if number in place}
        name = next(iter(at))
        t_ns = int(recording.streams[name].t_ns[at[name]])
        counter = bytes([number % overflow + 1]) if overflow else b""
        for channel in channels:
            yield can.Message(t_ns * 1e-9, COB_SYNC, False, data=counter, channel=channel)
        for stream in streams:
            if stream.bus.name not in at:
                continue
            answers = rows[stream.bus.name][at[stream.bus.name]]
            for cob_id, octets, channel in zip(stream.bus.cob_ids, answers, joint_channel, strict=True):
                t_ns += _ANSWER_NS
                data = octets[: stream.bus.length].tobytes()
                yield can.Message(t_ns * 1e-9, cob_id, False, data=data, channel=channel)


def _encoded(stream: CapturedStream, recorded: Stream) -> NDArray[np.uint8]:
    """Return the data bytes (N, n, 8) of the TPDOs of a recorded stream."""
    dtype = stream.tpdo.dtype
    joints = len(stream.bus.cob_ids)
    records = np.zeros((recorded.sync.size, joints), dtype)
    for name in dtype.names or ():
        records[name] = recorded.raw[name]
    return records.view(np.uint8).reshape(recorded.sync.size, joints, dtype.itemsize)


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
