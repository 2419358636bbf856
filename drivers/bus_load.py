"""What a classic CAN bus can carry: the load of a session, and the nearest one that fits."""

from dataclasses import dataclass

from configs import ConfigError, SessionConfig
from drivers.objects import COB_SYNC, SETPOINT, TpdoLayout

CRC_15 = 0x4599
TAIL_BITS = 13
"""CRC delimiter, acknowledgement, end of frame and interframe space: never stuffed."""
HEARTBEAT_BYTES = 1
STANDARD_PERIODS_US = (100, 125, 200, 250, 400, 500, 800, 1000, 2000, 4000, 5000, 10_000, 20_000, 50_000, 100_000)
"""SYNC periods that drives commonly offer."""


def frame_bits(data_bytes: int) -> tuple[int, int]:
    """Fewest and most bits of a classic frame with an 11-bit identifier, interframe space included.

    ``47 + 8 n`` without a stuff bit, ``55 + 10 n`` with the most there can be (Davis, Burns, Bril, Lukkien 2007).
    """
    return 47 + 8 * data_bytes, 55 + 10 * data_bytes


def exact_bits(identifier: int, data: bytes) -> int:
    """Bits of a classic frame with known content, stuff bits and interframe space included (ISO 11898-1)."""
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
    """One kind of message: frames per second and its share of the bus, without and with all stuff bits."""

    message: str
    frames_per_s: float
    typical: float
    worst: float


def loads(session: SessionConfig, period_us: int | None = None) -> list[Load]:
    """Bus load of a session by kind of message, for its own SYNC period or another one.

    Shares are fractions of the bus's bit rate; ``nan`` on a bus without one.
    """
    period = (session.sync.period_us if period_us is None else period_us) * 1e-6
    bitrate = session.bus.bitrate or float("nan")
    nodes = len(session.drives)

    def load(message: str, data_bytes: int, rate: float) -> Load:
        low, high = frame_bits(data_bytes)
        return Load(message, rate, low * rate / bitrate, high * rate / bitrate)

    sync = [exact_bits(COB_SYNC, bytes([k])) for k in range(1, session.sync.counter + 1)]
    rows = [Load("SYNC", 1 / period, sum(sync) / len(sync) / period / bitrate, max(sync) / period / bitrate)]
    for name, stream in session.streams.items():
        size = TpdoLayout.of(stream.objects, f"streams.{name}").size
        rows.append(load(f"TPDO{stream.tpdo} ({name})", size, nodes / (stream.every * period)))
    if session.setpoints is not None:
        rate = nodes / (session.setpoints.every * period)
        rows.append(load(f"RPDO{session.setpoints.rpdo} (set points)", SETPOINT.bits // 8, rate))
    rows.append(load("heartbeat", HEARTBEAT_BYTES, nodes * 1000 / session.heartbeat_ms))
    return rows


def fitting_period(session: SessionConfig) -> int | None:
    """The shortest usual SYNC period (us), not below the configured one, whose worst-case load fits the bus."""
    for period in STANDARD_PERIODS_US:
        if period >= session.sync.period_us and sum(row.worst for row in loads(session, period)) <= 1.0:
            return period
    return None


def check_fits(session: SessionConfig, where: str = "session") -> None:
    """Refuse a session that its bus cannot carry even in the worst case; a virtual bus has no bit rate.

    Raises
    ------
    ConfigError
        With the load, and the nearest SYNC period or number of buses that would fit.
    """
    if session.bus.bitrate is None:
        return
    worst = sum(row.worst for row in loads(session))
    if worst <= 1.0:
        return
    period = fitting_period(session)
    slower = f"sync.period_us {period} would fit" if period else "no usual SYNC period would fit"
    raise ConfigError(
        f"{where}: sync.period_us {session.sync.period_us} loads {session.bus.channel} at "
        f"{session.bus.bitrate / 1e6:g} Mbit/s with {100 * worst:.0f} % in the worst case; {slower}"
    )
