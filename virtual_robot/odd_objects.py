"""Oddities of virtual drives in their object dictionary: missing, masked, rounded, read-only and late values."""

import time
from contextlib import suppress

from canopen.sdo.exceptions import SdoAbortedError

from armident.configs.schema.session import SessionConfig
from armident.drivers.canopen import objects as od
from armident.drivers.canopen.objects import DriveState, TpdoLayout
from armident.virtual_robot.node import Drive
from armident.virtual_robot.oddity import Oddity

ABORT_READ_ONLY = 0x06010002
ABORT_NO_OBJECT = 0x06020000
ABORT_VALUE_RANGE = 0x06090030
"""SDO abort codes (CiA 301)."""


class Absent(Oddity):
    """An object, or sub-index, that the drive does not have; without ``guarding`` it has no node guarding either."""

    def __init__(self, index: int, subindex: int | None = None, guarding: bool = True) -> None:
        self._index, self._subindex, self.answers_guarding = index, subindex, guarding

    def read(self, index: int, subindex: int) -> bytes | None:
        """Refuse to read the object."""
        if index == self._index and self._subindex in (None, subindex):
            raise SdoAbortedError(ABORT_NO_OBJECT)
        return None

    def write(self, index: int, subindex: int, data: bytes) -> bytes:
        """Refuse to write the object."""
        self.read(index, subindex)
        return data


class HeartbeatRounds(Oddity):
    """Heartbeat period in steps of 64 ms."""

    def write(self, index: int, subindex: int, data: bytes) -> bytes:
        """Round the period up."""
        if index != od.HEARTBEAT_PRODUCER:
            return data
        return (-(-int.from_bytes(data, "little") // 64) * 64).to_bytes(2, "little")


class InterpolationRounds(Oddity):
    """Interpolation time in steps of 3 of its units."""

    def write(self, index: int, subindex: int, data: bytes) -> bytes:
        """Round the value up."""
        if (index, subindex) != (od.INTERPOLATION_PERIOD, 1):
            return data
        return bytes([-(-data[0] // 3) * 3])


class Bit30(Oddity):
    """Bit 30 of the COB-IDs of TPDOs: it is set, or ``demanded``: COB-IDs without it are refused."""

    def __init__(self, demanded: bool) -> None:
        self._demanded = demanded

    def write(self, index: int, subindex: int, data: bytes) -> bytes:
        """Set or demand the bit."""
        cob = int.from_bytes(data, "little")
        if not od.TPDO_COMMUNICATION <= index < od.TPDO_MAPPING or subindex != 1 or cob & od.NO_RTR:
            return data
        if self._demanded:
            raise SdoAbortedError(ABORT_VALUE_RANGE)
        return (cob | od.NO_RTR).to_bytes(4, "little")


class PdoFixed(Oddity):
    """Read-only PDO mapping: of the streams and set points of a session, or of the EDS."""

    def __init__(self, drive: Drive, session: SessionConfig | None) -> None:
        self._drive = drive
        self._mapped: dict[int, tuple[int, ...]] = {}
        for name, stream in () if session is None else session.streams.items():
            layout = TpdoLayout.of(stream.objects, name, stream.pack, drive.fd)
            self._mapped[od.TPDO_MAPPING + stream.tpdo - 1] = layout.entries
        if session is not None and session.setpoints is not None:
            self._mapped[od.RPDO_MAPPING + session.setpoints.rpdo - 1] = (od.SETPOINT.entry,)

    def preset(self) -> None:
        """Map the streams of the session."""
        for index, entries in self._mapped.items():
            self._drive.preset(index, 0, len(entries))
            for k, entry in enumerate(entries):
                self._drive.preset(index, k + 1, entry)

    def write(self, index: int, subindex: int, data: bytes) -> bytes:
        """Refuse to change a mapping."""
        if od.RPDO_MAPPING <= index < od.TPDO_COMMUNICATION or od.TPDO_MAPPING <= index < od.TPDO_MAPPING + od.PDOS:
            raise SdoAbortedError(ABORT_READ_ONLY)
        return data


class TimersSet(Oddity):
    """Inhibit time (100 us) and event timer (ms) of all TPDOs at power-on; ``fixed``: read-only."""

    def __init__(self, drive: Drive, inhibit: int, event_ms: int, fixed: bool) -> None:
        self._drive, self._values, self._fixed = drive, {od.INHIBIT_TIME: inhibit, od.EVENT_TIMER: event_ms}, fixed

    def preset(self) -> None:
        """Set both timers of all TPDOs."""
        for index in range(od.TPDO_COMMUNICATION, od.TPDO_COMMUNICATION + 4):
            for sub, value in self._values.items():
                self._drive.preset(index, sub, value)

    def write(self, index: int, subindex: int, data: bytes) -> bytes:
        """Refuse to change a timer that is read-only."""
        if self._fixed and od.TPDO_COMMUNICATION <= index < od.TPDO_MAPPING and subindex in self._values:
            raise SdoAbortedError(ABORT_READ_ONLY)
        return data


class CobFixed(Oddity):
    """Read-only COB-IDs of PDOs. ``session``: session whose streams and set points have the COB-IDs."""

    def __init__(self, drive: Drive, session: SessionConfig) -> None:
        self._drive, node = drive, drive.node_id
        tpdos = [stream.tpdo for stream in session.streams.values()]
        self._cobs = {od.TPDO_COMMUNICATION + tpdo - 1: od.tpdo_cob(tpdo, node) for tpdo in tpdos}
        if session.setpoints is not None:
            rpdo = session.setpoints.rpdo
            self._cobs[od.RPDO_COMMUNICATION + rpdo - 1] = od.rpdo_cob(rpdo, node)

    def preset(self) -> None:
        """Enable the PDOs of the session."""
        for index, cob in self._cobs.items():
            self._drive.preset(index, 1, cob)

    def write(self, index: int, subindex: int, data: bytes) -> bytes:
        """Refuse to change a COB-ID."""
        tpdo = od.TPDO_COMMUNICATION <= index < od.TPDO_MAPPING
        if subindex == 1 and (tpdo or od.RPDO_COMMUNICATION <= index < od.RPDO_MAPPING):
            raise SdoAbortedError(ABORT_READ_ONLY)
        return data


class WriteLate(Oddity):
    """Written values read back late. ``delay_s``: time until a value reads back as written, s."""

    def __init__(self, drive: Drive, delay_s: float) -> None:
        self._drive, self._delay = drive, delay_s
        self._before: dict[tuple[int, int], tuple[float, bytes]] = {}

    def read(self, index: int, subindex: int) -> bytes | None:
        """Return the value from before."""
        until, value = self._before.get((index, subindex), (0.0, b""))
        return value if time.monotonic() < until else None

    def write(self, index: int, subindex: int, data: bytes) -> bytes:
        """Keep the value from before."""
        with suppress(SdoAbortedError):
            value = self._drive.get_data(index, subindex)
            self._before[index, subindex] = time.monotonic() + self._delay, value
        return data


class ModeLate(Oddity):
    """Mode of operation that is reported some time, s, after enabling; ``before``: reported until then."""

    def __init__(self, drive: Drive, before: int, delay_s: float) -> None:
        self._drive, self._before, self._delay = drive, before.to_bytes(1, "little", signed=True), delay_s
        self._enabled_at: float | None = None

    def read(self, index: int, subindex: int) -> bytes | None:
        """Report the mode late."""
        if index != od.MODE_DISPLAY:
            return None
        if self._drive.state is not DriveState.ENABLED:
            self._enabled_at = None
            return self._before
        self._enabled_at = self._enabled_at or time.monotonic()
        return self._before if time.monotonic() - self._enabled_at < self._delay else None


class TargetFollows(Oddity):
    """Target position that follows the position until the drive is enabled."""

    def __init__(self, drive: Drive) -> None:
        self._drive = drive

    def read(self, index: int, subindex: int) -> bytes | None:
        """Return another position than was written: the arm never stands perfectly still."""
        if index != od.TARGET_POSITION or self._drive.state is DriveState.ENABLED:
            return None
        position = int.from_bytes(self._drive.get_data(od.POSITION_ACTUAL, 0), "little", signed=True)
        return (position + 3).to_bytes(4, "little", signed=True)
