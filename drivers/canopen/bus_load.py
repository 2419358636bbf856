"""Load of CAN buses: bits of frames, load of a session by bus, and alternatives that fit.

Classic frames: Davis, Burns, Bril and Lukkien (2007). CAN FD: ISO 11898-1:2015, nominal bit rate in arbitration, data
bit rate from bit rate switch to CRC delimiter.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armident.configs import ConfigError, SessionConfig
from armident.configs.schema.session import Bus
from armident.drivers.can.frames import fd_length
from armident.drivers.canopen.objects import COB_SYNC, FD_PDO_BYTES, MAPPED_OBJECTS, SETPOINT, TpdoLayout

CRC_15 = 0x4599
"""Polynomial of the CRC of classic frames (ISO 11898-1)."""
TAIL_BITS = 13
"""CRC delimiter, acknowledgement, end of frame and interframe space: never stuffed."""
HEARTBEAT_BYTES = 1
"""Data bytes of a heartbeat (CiA 301 section 7.2.8.3.2)."""
FD_ARBITRATION_BITS = 17
"""Start of frame to the bit rate switch, 11-bit identifier, at the nominal bit rate."""
FD_TAIL_BITS = 13
"""CRC delimiter, acknowledgement, end of frame and interframe space, at the nominal bit rate."""
STUFF_EVERY = 4
"""Least number of bits per stuff bit in a stuffed field, after its first bit."""
STANDARD_PERIODS_US = (100, 125, 200, 250, 400, 500, 800, 1000, 2000, 4000, 5000, 10_000, 20_000, 50_000, 100_000)
"""SYNC periods that drives commonly offer, us."""
DATA_BITRATES = (2_000_000, 5_000_000, 8_000_000)
"""Data bit rates that CAN FD controllers commonly offer, bit/s."""


def frame_bits(data_bytes: int) -> tuple[int, int]:
    """Minimum and maximum number of bits of a classic frame with n data bytes, interframe space included.

    ``47 + 8 n`` without stuff bits, ``55 + 10 n`` with all possible ones (Davis, Burns, Bril, Lukkien 2007).
    """
    return 47 + 8 * data_bytes, 55 + 10 * data_bytes


def fd_frame_bits(data_bytes: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """Minimum and maximum number of bits of a CAN FD frame at the nominal and at the data bit rate (ISO 11898-1:2015).

    From start of frame to the last data bit, stuff bits are dynamic: none to one in four. Stuff count and CRC (17 bits
    up to 16 bytes, 21 above) have 6 and 7 fixed ones.
    """
    crc, fixed = (17, 6) if data_bytes <= 16 else (21, 7)
    payload = 1 + 4 + 8 * data_bytes
    fewest = FD_ARBITRATION_BITS + FD_TAIL_BITS, payload + 4 + crc + fixed
    early = (FD_ARBITRATION_BITS - 1) // STUFF_EVERY
    late = (FD_ARBITRATION_BITS + payload - 1) // STUFF_EVERY - early
    return fewest, (fewest[0] + early, fewest[1] + late)


def exact_bits(identifier: int, data: bytes) -> int:
    """Number of bits of a classic frame of known content, stuff bits and interframe space included (ISO 11898-1)."""
    fields = [(0, 1), (identifier, 11), (0, 3), (len(data), 4), *((byte, 8) for byte in data)]
    bits = [value >> k & 1 for value, width in fields for k in reversed(range(width))]
    crc = 0
    for bit in bits:
        crc = (crc << 1) ^ (CRC_15 if bit ^ (crc >> 14) else 0)
        crc &= 0x7FFF
    bits += [crc >> k & 1 for k in reversed(range(15))]
    stuffed, run, last = 0, 0, -1
    for bit in bits:
        run = run + 1 if bit == last else 1
        last = bit
        if run == 5:
            stuffed, run, last = stuffed + 1, 1, 1 - bit
    return len(bits) + stuffed + TAIL_BITS


@dataclass(frozen=True)
class Load:
    """Load of one kind of message on one bus: ``typical`` without, ``worst`` with all stuff bits, of the bus time."""

    message: str
    frames_per_s: float
    typical: float
    worst: float
    bus: str = ""


def frame_seconds(bus: Bus, data_bytes: int, *, fd: bool) -> tuple[float, float]:
    """Minimum and maximum time of a frame on a bus, s; ``nan`` without bit rate."""
    bitrate, data_bitrate = bus.bitrate or float("nan"), bus.data_bitrate or float("nan")
    if fd:
        low, high = (nominal / bitrate + data / data_bitrate for nominal, data in fd_frame_bits(fd_length(data_bytes)))
        return low, high
    low, high = (bits / bitrate for bits in frame_bits(data_bytes))
    return low, high


def busy_seconds(bus: Bus, traffic: NDArray[np.int64]) -> float:
    """Least time for which frames (`counts_by_length`) have occupied a bus, s: no stuff bits; ``nan`` if virtual."""
    frames = ((traffic[fd, size], frame_seconds(bus, int(size), fd=bool(fd))[0]) for fd, size in np.argwhere(traffic))
    return float(sum(number * seconds for number, seconds in frames))


def loads(session: SessionConfig, period_us: int | None = None) -> list[Load]:
    """Load of a session by bus and kind of message; ``nan`` on a bus without bit rate."""
    return [row for bus in session.all_buses for row in bus_loads(session, bus, period_us)]


def bus_loads(session: SessionConfig, bus: Bus, period_us: int | None = None) -> list[Load]:
    """Load of one bus by kind of message; ``nan`` on a bus without bit rate."""
    period = (session.sync.period_us if period_us is None else period_us) * 1e-6
    nodes = len(session.drives_on(bus))

    def load(message: str, data_bytes: int, rate: float, fd: bool = False) -> Load:
        low, high = frame_seconds(bus, data_bytes, fd=fd)
        return Load(message, rate, low * rate, high * rate, bus.channel)

    contents = [bytes([k]) for k in range(1, session.sync.counter + 1)] or [b""]
    sync = [exact_bits(COB_SYNC, data) / (bus.bitrate or float("nan")) for data in contents]
    shares = sum(sync) / len(sync) / period, max(sync) / period
    rows = [Load("SYNC", 1 / period, *shares, bus.channel)]
    for name, stream in session.streams.items():
        size = TpdoLayout.of(stream.objects, f"streams.{name}", stream.pack, bus.fd).frame_size
        rate = nodes / (max(stream.every, stream.pack) * period)
        rows.append(load(f"TPDO{stream.tpdo} ({name})", size, rate, bus.fd))
    if session.setpoints is not None:
        rate = nodes / (session.setpoints.every * period)
        rows.append(load(f"RPDO{session.setpoints.rpdo} (set points)", SETPOINT.bits // 8, rate))
    rows.append(load("heartbeat", HEARTBEAT_BYTES, nodes * 1000 / session.heartbeat_ms))
    return rows


def worst_load(session: SessionConfig, bus: Bus, period_us: int | None = None) -> float:
    """Worst-case load of one bus as a fraction of its time; ``nan`` without bit rate."""
    return sum(row.worst for row in bus_loads(session, bus, period_us))


def fits(session: SessionConfig, period_us: int | None = None) -> bool:
    """Return True if every bus with a bit rate carries the session in the worst case."""
    return all(worst_load(session, bus, period_us) <= 1.0 for bus in session.all_buses if bus.bitrate is not None)


def fitting_period(session: SessionConfig) -> int | None:
    """Shortest standard SYNC period (us), at least the configured one, whose load fits all buses, or ``None``."""
    for period in STANDARD_PERIODS_US:
        if period >= session.sync.period_us and fits(session, period):
            return period
    return None


def check_fits(session: SessionConfig, where: str = "session") -> None:
    """Refuse a session that overloads a bus; the ConfigError has the nearest that fit. Virtual buses always fit."""
    for bus in session.all_buses:
        if bus.bitrate is None or worst_load(session, bus) <= 1.0:
            continue
        speed = f"{bus.bitrate / 1e6:g}" + (f"/{bus.data_bitrate / 1e6:g}" if bus.data_bitrate else "")
        found = "; ".join(f"{option.text} would fit" for option in alternatives(session))
        raise ConfigError(
            f"{where}: sync.period_us {session.sync.period_us} loads {bus.channel} at {speed} Mbit/s with "
            f"{100 * worst_load(session, bus):.0f} % in the worst case; "
            + (found or "no standard SYNC period, no number of buses and no packing would fit")
        )


@dataclass(frozen=True)
class Option:
    """Change of a session that makes it fit its buses; ``size`` is the factor of the largest change."""

    text: str
    session: SessionConfig
    kinds: int
    size: float


def alternatives(session: SessionConfig) -> list[Option]:
    """Changes that make a session fit, nearest first: fewest kinds of change, then smallest change."""
    found = sorted(_all_options(session), key=lambda option: (option.kinds, option.size))
    chosen: list[Option] = []
    for option in found:
        parts = set(_kinds(option.text))
        if not any(set(_kinds(other.text)) <= parts for other in chosen):
            chosen.append(option)
    return chosen


def _kinds(text: str) -> list[str]:
    return [part.split()[0] for part in text.split(" with ")]


def _all_options(session: SessionConfig) -> Iterator[Option]:
    slower = fitting_period(session)
    if slower is not None:
        changed = session.model_copy(update={"sync": session.sync.model_copy(update={"period_us": slower})})
        yield Option(f"sync.period_us {slower}", changed, 1, slower / session.sync.period_us)
    for fd_rate in (None, *DATA_BITRATES):
        base = session if fd_rate is None else _with_fd(session, fd_rate)
        if base is None:
            continue
        for pack in _packs(base):
            packed = _with_pack(base, pack)
            if packed is None:
                continue
            for count in range(len(session.all_buses), len(session.drives) + 1):
                spread = _spread(packed, count)
                if not fits(spread):
                    continue
                yield _option(session, spread, fd_rate, pack, count)
                break


def _option(session: SessionConfig, changed: SessionConfig, fd_rate: int | None, pack: int, count: int) -> Option:
    before = len(session.all_buses)
    parts, sizes = [], [1.0]
    if count > before:
        parts.append(f"buses {count} instead of {before}")
        sizes.append(count / before)
    if fd_rate is not None:
        parts.append(f"fd: true and data_bitrate {fd_rate}")
        sizes.append(fd_rate / (session.all_buses[0].bitrate or fd_rate))
    if pack > session.streams["samples"].pack:
        parts.append(f"pack: {pack} for samples")
        sizes.append(pack / session.streams["samples"].pack)
    return Option(" with ".join(parts), changed, len(parts), max(sizes))


def _with_fd(session: SessionConfig, data_bitrate: int) -> SessionConfig | None:
    """Session with CAN FD on every bus; ``None`` if all buses have it at this rate or a faster one already."""
    if all(bus.fd and (bus.data_bitrate or 0) >= data_bitrate for bus in session.all_buses):
        return None
    buses = tuple(bus.model_copy(update={"fd": True, "data_bitrate": data_bitrate}) for bus in session.all_buses)
    return _with_buses(session, buses)


def _packs(session: SessionConfig) -> list[int]:
    """Numbers of samples per TPDO that frame and SYNC counter allow, at least the session's own."""
    stream = session.streams["samples"]
    if not all(bus.fd for bus in session.all_buses):
        return [stream.pack]
    size = TpdoLayout.of(stream.objects).size if len(stream.objects) else 1
    most = min(FD_PDO_BYTES // size, MAPPED_OBJECTS // len(stream.objects))
    return [k for k in range(stream.pack, most + 1) if not session.sync.counter or session.sync.counter % k == 0]


def _with_pack(session: SessionConfig, pack: int) -> SessionConfig | None:
    stream = session.streams["samples"].model_copy(update={"pack": pack})
    changed = session.model_copy(update={"streams": {**session.streams, "samples": stream}})
    try:
        for name, other in changed.streams.items():
            TpdoLayout.of(other.objects, name, other.pack, all(bus.fd for bus in changed.all_buses))
    except ConfigError:
        return None
    return changed


def _spread(session: SessionConfig, count: int) -> SessionConfig:
    """Session with its drives distributed evenly over ``count`` buses like the first one."""
    if count == len(session.all_buses):
        return session
    first = session.all_buses[0]
    buses = tuple(first.model_copy(update={"channel": f"bus {k}"}) for k in range(count))
    drives = tuple(
        drive.model_copy(update={"bus": buses[k * count // len(session.drives)].channel})
        for k, drive in enumerate(session.drives)
    )
    return _with_buses(session, buses).model_copy(update={"drives": drives})


def _with_buses(session: SessionConfig, buses: tuple[Bus, ...]) -> SessionConfig:
    return session.model_copy(update={"buses": buses})
