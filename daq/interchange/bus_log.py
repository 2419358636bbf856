"""Conversion of recordings and logs of CAN tools by a session's mapping."""

import logging
from collections.abc import Iterator, Sequence
from pathlib import Path

import can
import numpy as np
from numpy.typing import NDArray

from armident.configs import ConfigError, DataError, RobotConfig, SessionConfig
from armident.daq.interchange.clocks import check_sync_period, clock_steps, continuous
from armident.daq.interchange.log_file import read_log
from armident.daq.interchange.log_frames import LogFrames
from armident.daq.interchange.text_files import NOTES, sha256_of
from armident.daq.matching.assembler import Assembler, Batch
from armident.daq.matching.streams import CapturedStream, bus_numbers, captured_streams, unknown_phase
from armident.daq.recording import Gap, Recording, Stream
from armident.drivers.can.frames import Frames
from armident.drivers.canopen.objects import COB_SYNC

_BATCH = 4096
_TURN_NS = 1_000_000_000
_ANSWER_NS = 20_000
"""Time between frames of a SYNC in a log written from a recording, which has only the time of the SYNC, ns."""


def recording_from_log(
    path: Path, session: SessionConfig, robot: RobotConfig, rate_hz: float | None = None
) -> Recording:
    """Return the recording of a log: its frames, matched by the mapping of a session.

    With several buses the log has the names of the session's. ``rate_hz``: of SYNC, stated for a log whose times do not
    tell it.
    """
    _check_classic(session, str(path))
    streams = captured_streams(session, robot)
    log = read_log(path)
    names, chosen = _buses(log, session, streams)
    masks = [log.of(path, name, len(session.all_buses) > 1) for name in names]
    read = [log.frames[mask] for mask in masks]
    clock: list[str] = []
    for bus, frames_of_it, mask in zip(session.all_buses, read, masks, strict=True):
        if not np.any(frames_of_it["can_id"] == COB_SYNC):
            where = f" of {bus.channel}" if len(read) > 1 else ""
            found_128 = np.any(frames_of_it["can_id"] == int(str(COB_SYNC), 16))
            decimal = "; 128 is SYNC in decimal: name the column 'ID (dec)'" if found_128 else ""
            raise DataError(
                f"{path}: no SYNC ({COB_SYNC:X}h) among its {frames_of_it.size} frames{where}: "
                f"samples cannot be matched{decimal}"
            )
        clock += continuous(path, frames_of_it, log.lines[mask], session)
        clock += check_sync_period(path, frames_of_it, session, rate_hz)
    wrong = _wrong_lengths(path, read, streams, robot)
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
        silent = _silent(read, streams, robot)
        raise DataError(f"{path}: no SYNC was answered by all drives; the session expects TPDOs {wanted}{silent}")
    phase = None if assembler.has_counter else unknown_phase(session)
    rows = found["samples"]
    stepped = clock_steps(rows.sync, rows.t_ns, session, counted=assembler.has_counter)
    notes = (*log.notes, *chosen, *dict.fromkeys(clock), *wrong, *stepped, *([phase] if phase else []))
    for note in notes:
        logging.getLogger(__name__).warning("%s: %s", path, note)
    gaps: list[Gap] = [gap for part in parts for gap in part.gaps]
    return Recording(
        None,
        robot,
        session,
        1.0 / session.sync_period,
        found,
        tuple(gaps),
        counters=assembler.counters | {"log.foreign": log.foreign, "log.skipped": log.skipped},
        metadata={"source": path.name, "source_sha256": sha256_of(path)} | ({NOTES: "; ".join(notes)} if notes else {}),
    )


def _buses(log: LogFrames, session: SessionConfig, streams: Sequence[CapturedStream]) -> tuple[list[str], list[str]]:
    """Return the names in the log of the session's buses, and a note if the frames tell the only one.

    Logs of Vector and PEAK number the buses, so that their names tell nothing.
    """
    names = [bus.channel for bus in session.all_buses]
    if len(names) > 1 or len(log.buses) < 2 or names[0] in log.buses:
        return names, []
    found = log.buses_with([COB_SYNC, *streams[0].bus.cob_ids])
    if len(found) != 1:
        return names, []
    return found, [f"bus {found[0]} of {', '.join(log.buses)} is read: only it has SYNC and the TPDOs of the session"]


def _wrong_lengths(
    path: Path, read: Sequence[Frames], streams: Sequence[CapturedStream], robot: RobotConfig
) -> tuple[str, ...]:
    """Return a sentence for every TPDO some of whose frames have another length; refuse if all of them have."""
    notes = []
    for stream in streams:
        for joint, cob_id in zip(robot.joints, stream.bus.cob_ids, strict=True):
            lengths = np.concatenate([frames["length"][frames["can_id"] == cob_id] for frames in read])
            others = lengths[lengths != stream.bus.length]
            if not others.size:
                continue
            found = "/".join(str(length) for length in np.unique(others))
            mapped = ", ".join(stream.tpdo.dtype.names or ())
            what = (
                f"TPDO {cob_id:X}h of {joint.name} has {found} bytes, "
                f"the session maps {stream.bus.length} ({mapped}; streams.{stream.bus.name})"
            )
            if others.size == lengths.size:
                raise DataError(f"{path}: {what}")
            notes.append(f"{what}: {others.size} of {lengths.size} frames left out")
    return tuple(notes)


def _silent(read: Sequence[Frames], streams: Sequence[CapturedStream], robot: RobotConfig) -> str:
    """Return the joints whose TPDOs are not in the log, for messages."""
    seen = np.unique(np.concatenate([frames["can_id"] for frames in read]))
    silent = [j.name for j, cob_id in zip(robot.joints, streams[0].bus.cob_ids, strict=True) if cob_id not in seen]
    return f"; there is none of {', '.join(silent)}" if silent else ""


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
    """Write the SYNCs and TPDOs of a recording as a log, in the format of its suffix.

    Answers follow their SYNC at intervals of 20 us. SYNCs that were not received or not answered by all drives are left
    out, which the SYNC counter shows. Raises DataError if the recording does not come from a bus.
    """
    session = recording.session
    if session is None:
        raise DataError(f"{recording.path}: was not captured from a bus; there are no frames to write")
    _check_classic(session, str(recording.path or path))
    streams = captured_streams(session, recording.robot)
    with can.Logger(path) as logger:
        for message in _messages(recording, session, streams):
            logger.on_message_received(message)


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
