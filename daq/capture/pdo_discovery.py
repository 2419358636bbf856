"""Finds out by listening alone what the drives of a session send: which TPDOs, how often, and what is in them.

Frames that come in step with SYNC, once every so many of them and always with the same length, are TPDOs of the drives
whose EDS gives them their COB-ID. What they hold no frame says; it is what the session says if that has this
length and interval, or else what the EDS has mapped by default if that has. Anything else is refused.
"""

import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import canopen
import numpy as np
from numpy.typing import NDArray

from armident.configs import ConfigError, SessionConfig
from armident.configs.schema.session import Bus, DriveNode, Stream
from armident.drivers.can.frames import FD_FRAME, STANDARD_ID_MASK, Frames, fd_length
from armident.drivers.can.receiver import Receiver
from armident.drivers.can.udp import open_bus
from armident.drivers.canopen import objects as od
from armident.drivers.canopen.objects import COB_SYNC, OBJECTS, TpdoLayout

SYNC_WAIT_S = 10.0
"""How long a bus may be silent before we give up."""
FEWEST_FRAMES = 3
IN_STEP = 0.95
"""Share of a TPDO's frames that must come at its interval; a busy machine may delay the others past the next SYNC."""
PERIOD_TOLERANCE = 0.05
"""Relative difference allowed between the SYNC period heard and the session's."""


@dataclass(frozen=True)
class Heard:
    """What one identifier did: ``every`` how many SYNCs it came (``None``: not in step), and its lengths."""

    can_id: int
    frames: int
    every: int | None
    lengths: tuple[int, ...]

    def __str__(self) -> str:
        lengths = " or ".join(str(n) for n in self.lengths)
        pace = "not in step with SYNC" if self.every is None else f"every {self.every} SYNC"
        return f"{self.can_id:X}h with {lengths} bytes, {pace}"


@dataclass(frozen=True)
class Survey:
    """What was heard on one bus: the SYNC period (us) and every identifier that PDOs may have."""

    channel: str
    period_us: float
    heard: dict[int, Heard]


def survey(channel: str, frames: Frames) -> Survey:
    """What the frames of one bus are, SYNC by SYNC.

    Raises
    ------
    ConfigError
        If there are too few SYNCs among them to tell.
    """
    is_sync = frames["can_id"] == COB_SYNC
    if np.count_nonzero(is_sync) < FEWEST_FRAMES:
        raise ConfigError(f"bus {channel}: no SYNC heard; without SYNC nothing can be told from listening")
    period_us = float(np.median(np.diff(frames["t_ns"][is_sync]))) / 1000
    number = np.cumsum(is_sync)
    heard = {}
    for can_id in np.unique(frames["can_id"]):
        if 0x180 <= can_id < 0x580:
            mine = frames["can_id"] == can_id
            lengths = tuple(int(n) for n in np.unique(frames["length"][mine]))
            heard[int(can_id)] = Heard(int(can_id), int(mine.sum()), _interval(number[mine]), lengths)
    return Survey(channel, period_us, heard)


def _interval(number: NDArray[np.int64]) -> int | None:
    """Every how many SYNCs frames came, given the number of the SYNC before each; ``None`` if they are not in step."""
    if number.size < FEWEST_FRAMES:
        return None
    steps = np.diff(number)
    every = int(np.median(steps))
    # A frame that came late makes one long and one short step.
    if not 1 <= every <= 240 or np.mean(steps == every) < 2 * IN_STEP - 1:
        return None
    return every


def sniffed(session: SessionConfig, surveys: list[Survey], say: Callable[[str], None]) -> SessionConfig:
    """The session with the streams that the drives turn out to send.

    Raises
    ------
    ConfigError
        If SYNC has another period, drives differ, or it cannot be told what a TPDO holds.
    """
    for heard in surveys:
        if abs(heard.period_us / session.sync.period_us - 1) > PERIOD_TOLERANCE:
            raise ConfigError(
                f"bus {heard.channel}: SYNC comes every {heard.period_us:.0f} us, "
                f"the session says sync.period_us {session.sync.period_us}"
            )
    by_channel = {s.channel: s for s in surveys}
    streams: dict[str, Stream] = {}
    for tpdo in range(1, 5):
        found = [_stream(session, drive, tpdo, by_channel[session.bus_of(drive).channel]) for drive in session.drives]
        present = [drive for drive, stream in zip(session.drives, found, strict=True) if stream is not None]
        if not present:
            continue
        silent = [drive.joint for drive, stream in zip(session.drives, found, strict=True) if stream is None]
        if silent:
            raise ConfigError(f"TPDO{tpdo}: {present[0].joint} sends it, {', '.join(silent)} not; all drives have to")
        first = found[0]
        for drive, stream in zip(session.drives, found, strict=True):
            if stream != first:
                raise ConfigError(f"TPDO{tpdo}: {drive.joint} sends something else than {session.drives[0].joint}")
        assert first is not None
        name = next((n for n, s in session.streams.items() if s.tpdo == tpdo), None)
        if name is None:
            name = "samples" if first.every == 1 and "samples" not in streams else f"tpdo{tpdo}"
        streams[name] = first
        how = "as the session says" if session.streams.get(name) == first else "as the EDS says"
        say(f"TPDO{tpdo} is {name}: {', '.join(first.objects)} on every {max(first.every, first.pack)}. SYNC, {how}")
    if "samples" not in streams or streams["samples"].every != 1:
        raise ConfigError("no TPDO comes on every SYNC: there is nothing to record as samples")
    return session.model_copy(update={"streams": streams})


def _stream(session: SessionConfig, drive: DriveNode, tpdo: int, bus: Survey) -> Stream | None:
    """What one TPDO of a drive is; ``None`` if it does not come, or not in step with SYNC."""
    cob_id, objects = default_mapping(drive, tpdo)
    heard = bus.heard.get(cob_id)
    if heard is None or heard.every is None:
        return None
    who = f"bus {bus.channel}: node {drive.node_id} ({drive.joint}), TPDO{tpdo} {heard}"
    if len(heard.lengths) > 1:
        raise ConfigError(f"{who}: its length changes, so its mapping cannot be told")
    (length,) = heard.lengths
    fd = session.bus_of(drive).fd
    for stream in session.streams.values():
        layout = TpdoLayout.of(stream.objects, "streams", stream.pack, fd)
        same = fd_length(layout.frame_size) == length and max(stream.every, stream.pack) == heard.every
        if stream.tpdo == tpdo and same:
            return stream
    if isinstance(objects, str):
        raise ConfigError(f"{who}: the session does not say this, and {objects}")
    size = TpdoLayout.of(objects, "EDS", 1, fd).size
    if fd_length(size) != length:
        raise ConfigError(
            f"{who}: {drive.eds.name} maps {size} bytes by default ({', '.join(objects) or 'nothing'}) and the session "
            "has no stream of this length and interval; say in streams what the TPDO holds"
        )
    if session.sync.counter % heard.every:
        raise ConfigError(f"{who}: its interval does not divide sync.counter {session.sync.counter}")
    return Stream.model_validate({"tpdo": tpdo, "every": heard.every, "objects": objects})


def default_mapping(drive: DriveNode, tpdo: int) -> tuple[int, tuple[str, ...] | str]:
    """COB-ID and objects of a TPDO by the defaults of the drive's EDS; in place of objects, why they cannot be told.

    Raises
    ------
    ConfigError
        If the EDS cannot be read.
    """
    try:
        known = canopen.import_od(str(drive.eds), drive.node_id)
    except Exception as error:
        raise ConfigError(f"{drive.eds}: not a valid EDS file: {error}") from error
    cob_id = _default(known, od.TPDO_COMMUNICATION + tpdo - 1, 1)
    cob_id = od.tpdo_cob(tpdo, drive.node_id) if cob_id is None else cob_id & STANDARD_ID_MASK
    mapping = od.TPDO_MAPPING + tpdo - 1
    entries = [_default(known, mapping, k) or 0 for k in range(1, (_default(known, mapping, 0) or 0) + 1)]
    names = {entry.entry: name for name, entry in OBJECTS.items()}
    unknown = [f"{entry:08X}h" for entry in entries if entry not in names]
    if unknown:
        return cob_id, f"{drive.eds.name} maps {', '.join(unknown)}, which no stream can hold"
    return cob_id, tuple(names[entry] for entry in entries)


def _default(known: Any, index: int, subindex: int) -> int | None:
    variable = known.get_variable(index, subindex)
    return None if variable is None or variable.default is None else int(variable.default)


def listen(buses: tuple[Bus, ...], seconds: float) -> list[Frames]:
    """The frames of each bus in the ``seconds`` after all have had a SYNC; nothing is sent.

    Raises
    ------
    ConfigError
        If there is no such bus, or one has no SYNC.
    """
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
                silent = ", ".join(bus.channel for bus, heard in zip(buses, has_sync, strict=True) if not heard)
                raise ConfigError(f"bus {silent}: no SYNC within {SYNC_WAIT_S:g} s; listening alone cannot start any")
    return [np.concatenate(part) if part else np.zeros(0, FD_FRAME) for part in parts]


def discover_pdos(session: SessionConfig, seconds: float, say: Callable[[str], None]) -> SessionConfig:
    """Listen for so long, and return the session with the streams that were heard.

    Raises
    ------
    ConfigError
        If it cannot be told what the drives send.
    """
    say(f"listening for {seconds:g} s on {', '.join(bus.channel for bus in session.all_buses)}")
    heard = listen(session.all_buses, seconds)
    surveys = [survey(bus.channel, frames) for bus, frames in zip(session.all_buses, heard, strict=True)]
    return sniffed(session, surveys, say)
