"""Discovery of the TPDOs that drives send, by listening alone.

Frames of one length on every n-th SYNC are TPDOs of the drives whose EDS gives them their COB-ID. Their mapping is that
of the session if length and interval agree, else the EDS default if its length agrees; else they are refused.
"""

import logging
import time
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armident.configs import ConfigError, SessionConfig
from armident.configs.schema.session import Bus, DriveNode, Stream
from armident.drivers.can.frames import FD_FRAME, STANDARD_ID_MASK, Frames, fd_length
from armident.drivers.can.receiver import Receiver
from armident.drivers.can.udp import open_bus
from armident.drivers.canopen import objects as od
from armident.drivers.canopen.eds import read_objects
from armident.drivers.canopen.objects import COB_SYNC, OBJECTS, TpdoLayout

SYNC_WAIT_S = 10.0
"""Longest wait for the first SYNC of a bus, s."""
FEWEST_FRAMES = 3
"""Least number of frames from which an interval is computed."""
IN_STEP = 0.95
"""Share of a TPDO's frames that must come at its interval; a busy machine may delay the others past the next SYNC."""
PERIOD_TOLERANCE = 0.05
"""Largest relative difference between the measured SYNC period and that of the session."""

DefaultMapping = tuple[int, tuple[str, ...] | str]
"""COB-ID of a TPDO and names of its objects, or a message in their place."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class IdentifierStatistics:
    """Statistics of one identifier: interval in SYNCs (``None``: frames do not follow SYNC) and lengths, bytes."""

    can_id: int
    frames: int
    every: int | None
    lengths: tuple[int, ...]

    def __str__(self) -> str:
        lengths = " or ".join(str(n) for n in self.lengths)
        pace = "not in step with SYNC" if self.every is None else f"every {self.every} SYNC"
        return f"{self.can_id:X}h with {lengths} bytes, {pace}"


@dataclass(frozen=True)
class BusStatistics:
    """Statistics of one bus: median SYNC period, us, and every received identifier of PDOs (180h to 57Fh)."""

    channel: str
    period_us: float
    identifiers: dict[int, IdentifierStatistics]


def bus_statistics(channel: str, frames: Frames) -> BusStatistics:
    """Return the statistics of frames (N,) in the order of reception; ConfigError below `FEWEST_FRAMES` SYNCs."""
    is_sync = frames["can_id"] == COB_SYNC
    if np.count_nonzero(is_sync) < FEWEST_FRAMES:
        raise ConfigError(f"bus {channel}: no SYNC received; start its SYNC producer")
    period_us = float(np.median(np.diff(frames["t_ns"][is_sync]))) / 1000
    number = np.cumsum(is_sync)
    identifiers = {}
    for can_id in np.unique(frames["can_id"]):
        if 0x180 <= can_id < 0x580:
            selected = frames["can_id"] == can_id
            lengths = tuple(int(n) for n in np.unique(frames["length"][selected]))
            interval = _interval(number[selected])
            identifiers[int(can_id)] = IdentifierStatistics(int(can_id), int(selected.sum()), interval, lengths)
    return BusStatistics(channel, period_us, identifiers)


def _interval(number: NDArray[np.int64]) -> int | None:
    """Return the interval of frames in SYNCs, given the number of the SYNC before each; ``None`` if it varies."""
    if number.size < FEWEST_FRAMES:
        return None
    steps = np.diff(number)
    every = int(np.median(steps))
    # A delayed frame makes one long and one short step.
    if not 1 <= every <= 240 or np.mean(steps == every) < 2 * IN_STEP - 1:
        return None
    return every


def with_sent_streams(session: SessionConfig, buses: list[BusStatistics]) -> SessionConfig:
    """Return the session with the streams that the drives send; ConfigError if SYNC or a TPDO does not agree."""
    for bus in buses:
        if abs(bus.period_us / session.sync.period_us - 1) > PERIOD_TOLERANCE:
            raise ConfigError(
                f"bus {bus.channel}: SYNC has a period of {bus.period_us:.0f} us, "
                f"but sync.period_us of the session is {session.sync.period_us}"
            )
    by_channel = {bus.channel: bus for bus in buses}
    known = [read_objects(drive.eds, drive.node_id) for drive in session.drives]
    streams: dict[str, Stream] = {}
    for tpdo in range(1, 5):
        found = [
            _stream(session, drive, default_mapping(drive, objects, tpdo), tpdo, by_channel)
            for drive, objects in zip(session.drives, known, strict=True)
        ]
        present = [drive for drive, stream in zip(session.drives, found, strict=True) if stream is not None]
        if not present:
            continue
        silent = [drive.joint for drive, stream in zip(session.drives, found, strict=True) if stream is None]
        if silent:
            raise ConfigError(
                f"TPDO{tpdo}: sent by {present[0].joint}, but not by {', '.join(silent)}; map it on all drives"
            )
        first = found[0]
        for drive, stream in zip(session.drives, found, strict=True):
            if stream != first:
                raise ConfigError(
                    f"TPDO{tpdo}: {drive.joint} has another mapping than {session.drives[0].joint}; map all alike"
                )
        assert first is not None
        name = next((n for n, s in session.streams.items() if s.tpdo == tpdo), None)
        if name is None:
            name = "samples" if first.every == 1 and "samples" not in streams else f"tpdo{tpdo}"
        streams[name] = first
        source = "as in the session" if session.streams.get(name) == first else "as in the EDS"
        objects, every = ", ".join(first.objects), max(first.every, first.pack)
        log.info("TPDO%d is %s: %s on every %d. SYNC, %s", tpdo, name, objects, every, source)
    if "samples" not in streams or streams["samples"].every != 1:
        raise ConfigError(
            "no drive sends a TPDO on every SYNC; a recording needs one for its samples. An inhibit time (180xh:3) "
            "longer than the period of SYNC has this effect"
        )
    return session.model_copy(update={"streams": streams})


def _stream(
    session: SessionConfig, drive: DriveNode, mapping: DefaultMapping, tpdo: int, buses: dict[str, BusStatistics]
) -> Stream | None:
    """Return the stream of a drive's TPDO; ``None`` if it is not received, or does not follow SYNC."""
    bus = buses[session.bus_of(drive).channel]
    cob_id, objects = mapping
    sent = bus.identifiers.get(cob_id)
    if sent is None or sent.every is None:
        return None
    sender = f"bus {bus.channel}: node {drive.node_id} ({drive.joint}), TPDO{tpdo} {sent}"
    if len(sent.lengths) > 1:
        raise ConfigError(f"{sender}: its length changes, so its mapping is unknown")
    (length,) = sent.lengths
    fd = session.bus_of(drive).fd
    for stream in session.streams.values():
        layout = TpdoLayout.of(stream.objects, "streams", stream.pack, fd)
        same = fd_length(layout.frame_size) == length and max(stream.every, stream.pack) == sent.every
        if stream.tpdo == tpdo and same:
            return stream
    if isinstance(objects, str):
        raise ConfigError(f"{sender}: no stream of the session matches, and {objects}")
    size = TpdoLayout.of(objects, "EDS", 1, fd).size
    if fd_length(size) != length:
        raise ConfigError(
            f"{sender}: {drive.eds.name} maps {size} bytes by default ({', '.join(objects) or 'nothing'}), "
            "and no stream has this length and interval; add the objects of the TPDO to streams"
        )
    if session.sync.counter and session.sync.counter % sent.every:
        raise ConfigError(f"{sender}: its interval does not divide sync.counter {session.sync.counter}")
    return Stream.model_validate({"tpdo": tpdo, "every": sent.every, "objects": objects})


def default_mapping(drive: DriveNode, known: Any, tpdo: int) -> DefaultMapping:
    """Return COB-ID and object names of TPDO 1 to 4 by the EDS; a message in place of names if an object is unknown."""
    cob_id = _default(known, od.TPDO_COMMUNICATION + tpdo - 1, 1)
    cob_id = od.tpdo_cob(tpdo, drive.node_id) if cob_id is None else cob_id & STANDARD_ID_MASK
    mapping = od.TPDO_MAPPING + tpdo - 1
    entries = [_default(known, mapping, k) or 0 for k in range(1, (_default(known, mapping, 0) or 0) + 1)]
    names = {entry.entry: name for name, entry in OBJECTS.items()}
    unknown = [f"{entry:08X}h" for entry in entries if entry not in names]
    if unknown:
        return cob_id, f"{drive.eds.name} maps {', '.join(unknown)}, which streams do not support"
    return cob_id, tuple(names[entry] for entry in entries)


def _default(known: Any, index: int, subindex: int) -> int | None:
    variable = known.get_variable(index, subindex)
    return None if variable is None or variable.default is None else int(variable.default)


def receive_frames(buses: tuple[Bus, ...], seconds: float) -> list[Frames]:
    """Return each bus's frames in ``seconds`` after all had a SYNC (ConfigError after `SYNC_WAIT_S`); sends nothing."""
    parts: list[list[Frames]] = [[] for _ in buses]
    openers = [lambda bus=bus: open_bus(bus) for bus in buses]
    with closing(Receiver(openers)) as receiver:
        begin, since = time.monotonic(), float("inf")
        has_sync = [False] * len(buses)
        while time.monotonic() < since + seconds:
            time.sleep(0.02)
            for k, frames, _ in receiver.drain():
                parts[k].append(frames.copy())
                has_sync[k] = has_sync[k] or bool((frames["can_id"] == COB_SYNC).any())
            if all(has_sync) and since == float("inf"):
                since = time.monotonic()
            if not all(has_sync) and time.monotonic() - begin > SYNC_WAIT_S:
                silent = ", ".join(bus.channel for bus, has in zip(buses, has_sync, strict=True) if not has)
                raise ConfigError(f"bus {silent}: no SYNC within {SYNC_WAIT_S:g} s; start its SYNC producer")
    return [np.concatenate(part) if part else np.zeros(0, FD_FRAME) for part in parts]


def discover_pdos(session: SessionConfig, seconds: float) -> SessionConfig:
    """Return the session with the streams that its drives send already, from listening for some seconds."""
    log.info("listening for %g s on %s", seconds, ", ".join(bus.channel for bus in session.all_buses))
    received = receive_frames(session.all_buses, seconds)
    buses = [bus_statistics(bus.channel, frames) for bus, frames in zip(session.all_buses, received, strict=True)]
    return with_sent_streams(session, buses)
