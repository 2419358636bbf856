"""SDO access to one drive; errors are one line that names drive, object and reason."""

import logging
import struct
import threading
import time
from collections.abc import Callable
from typing import Any

import can
import canopen
from canopen.sdo import SdoAbortedError, SdoCommunicationError

from armident.configs.errors import ArmidentError, ConfigError
from armident.configs.schema.session import DriveNode, SessionConfig
from armident.drivers.can.frames import BusDown
from armident.drivers.can.socketcan import RawSocket
from armident.drivers.canopen.sdo_client import OtherAnswersError

for _logger in ("canopen", "can"):
    # Their warnings on stderr would repeat the text of our exceptions.
    logging.getLogger(_logger).addHandler(logging.NullHandler())

ABORT_ABSENT = frozenset((0x06020000, 0x06090011))
"""Abort codes of an object or a sub-index that does not exist (CiA 301, SDO abort codes)."""
ABORT_BUSY = frozenset((0x08000020, 0x08000021, 0x08000022))
"""Abort codes of a transfer that is impossible at present: store, local control, device state (CiA 301)."""
BUSY_S = 1.0
"""Time for which a transfer with such an abort is repeated, s."""
BUSY_RETRY_S = 0.02
"""Interval of these repetitions, s."""
SETTLE_S = 0.3
"""Longest time until a value reads back as written, s."""
_SETTLE_RETRY_S = 0.01
_EXPEDITED, _LARGEST = 4, 8
"""Maximum size (bytes) of a value in an expedited answer, and of the objects read here."""

log = logging.getLogger(__name__)


class SdoRefusedError(ConfigError):
    """A drive refuses an SDO transfer with an abort ``code`` (CiA 301, SDO abort codes)."""

    def __init__(self, message: str, code: int) -> None:
        super().__init__(message)
        self.code = code

    @property
    def absent(self) -> bool:
        """``True`` if the drive has no such object."""
        return self.code in ABORT_ABSENT


class NoAnswerError(ConfigError):
    """A drive does not answer."""


class DriveSdo:
    """Access to the object dictionary of one drive by the remote ``node`` of a connected network."""

    def __init__(self, node: canopen.RemoteNode, drive: DriveNode, session: SessionConfig) -> None:
        self.node = node
        self.drive = drive
        self.label = f"node {drive.node_id} ({drive.joint})"
        """Name of the drive in messages."""
        self.fd = session.bus_of(drive).fd
        """``True`` if the drive's TPDOs are CAN FD frames."""
        self.emcy_texts = session.emcy_texts
        self._bus = session.bus_of(drive)
        self._timeout = node.sdo.RESPONSE_TIMEOUT = session.sdo_timeout_s
        # An SDO channel carries one transfer at a time.
        self._lock = threading.RLock()
        self.heartbeat_ms: int | None = None
        """Heartbeat period that the drive reports, ms; ``None`` without heartbeat."""
        self.on_remark: Callable[[str], None] = lambda text: log.warning("%s: %s", self.label, text)
        """Takes what is unusual about the drive, but does not prevent its use."""
        self._remarks: set[str] = set()

    def remark(self, text: str) -> None:
        """Report once what is unusual about the drive, but does not prevent its use, in a text without its name."""
        if text not in self._remarks:
            self._remarks.add(text)
            self.on_remark(text)

    def read(self, index: int, sub: int, code: str) -> int:
        """Read an object of type ``code``, a format of `struct`; NoAnswerError or SdoRefusedError if that fails."""
        return self._read(index, sub, code, BUSY_S)

    def _read(self, index: int, sub: int, code: str, busy_s: float) -> int:
        size = struct.calcsize("<" + code)
        what = f"refuses to read {_name(index, sub)}"
        data: bytes = self._transfer(index, sub, what, lambda: self._upload(index, sub, size), busy_s)
        return int(struct.unpack("<" + code, data)[0])

    def read_optional(self, index: int, sub: int, code: str) -> int | None:
        """Read an object; ``None`` if the drive does not have it."""
        try:
            return self.read(index, sub, code)
        except SdoRefusedError as error:
            if error.absent:
                return None
            raise

    def _transfer(self, index: int, sub: int, what: str, transfer: Callable[[], Any], busy_s: float) -> Any:
        """Carry out a transfer, again for ``busy_s`` while the drive is busy; errors name drive and object."""
        until = time.monotonic() + busy_s
        while True:
            try:
                with self._lock:
                    return transfer()
            except SdoAbortedError as error:
                if error.code not in ABORT_BUSY or time.monotonic() >= until:
                    raise SdoRefusedError(f"{self.label}: {what}: {_abort(error)}", error.code) from error
            except OtherAnswersError as error:
                raise ConfigError(
                    f"{self.label}: answered only other requests within {self._timeout:g} s, not that for "
                    f"{_name(index, sub)}; is another program using its SDO channel?"
                ) from error
            except SdoCommunicationError as error:
                raise self.no_answer() from error
            except (struct.error, IndexError) as error:
                raise self._invalid_answer(index, sub) from error
            except (can.CanError, OSError) as error:
                raise self._bus_down(error) from error
            time.sleep(BUSY_RETRY_S)

    def poll(self, index: int, sub: int, code: str, answer_s: float) -> int | None:
        """Read an object within ``answer_s``; ``None`` if another SDO transfer is in progress."""
        if not self._lock.acquire(blocking=False):
            return None
        try:
            self.node.sdo.RESPONSE_TIMEOUT = min(answer_s, self._timeout)
            return self._read(index, sub, code, 0.0)
        finally:
            self.node.sdo.RESPONSE_TIMEOUT = self._timeout
            self._lock.release()

    def _upload(self, index: int, sub: int, size: int) -> bytes:
        """First ``size`` bytes of an object; some drives send four bytes of smaller objects."""
        data = b""
        with self.node.sdo.open(index, sub, "rb", buffering=0) as stream:
            # Bounded, because a faulty drive may never end the transfer.
            while len(data) <= _LARGEST and (part := stream.read(_LARGEST)):
                data += part
            stated = stream.size
        if not (stated == len(data) >= size or (stated is None and len(data) in (size, max(size, _EXPEDITED)))):
            raise ConfigError(
                f"{self.label}: {_name(index, sub)} has {'more than ' * (len(data) > _LARGEST)}"
                f"{min(len(data), _LARGEST)} bytes{'' if stated is None else f', states {stated}'}; expected {size}"
            )
        return data[:size]

    def command(self, index: int, sub: int, value: int, code: str) -> None:
        """Write an object without reading it back."""
        data = struct.pack("<" + code, value)
        what = f"refuses {_name(index, sub)} = {_hex(value, code)}"
        self._transfer(index, sub, what, lambda: self.node.sdo.download(index, sub, data), BUSY_S)

    def write(self, index: int, sub: int, value: int, code: str, ignored: int = 0) -> None:
        """Write an object and read it back, except ``ignored`` bits; a read-only one that has the value is right."""
        found = self.write_rounded(index, sub, value, code, ignored)
        if (found ^ value) & ~ignored:
            written = _hex(value, code)
            raise ConfigError(f"{self.label}: {_name(index, sub)} reads {_hex(found, code)} after writing {written}")

    def write_rounded(self, index: int, sub: int, value: int, code: str, ignored: int = 0) -> int:
        """Write an object and return the value that it reads back, which the drive may have rounded."""
        try:
            self.command(index, sub, value, code)
        except SdoRefusedError as refused:
            try:
                found = self.read(index, sub, code)
            except SdoRefusedError:
                raise refused from None
            if (found ^ value) & ~ignored:
                raise
            return found
        # A value may take effect late, and a repeated answer may hold the value from before.
        until = time.monotonic() + SETTLE_S
        while ((found := self.read(index, sub, code)) ^ value) & ~ignored and time.monotonic() < until:
            time.sleep(_SETTLE_RETRY_S)
        return found

    def no_answer(self, within_s: float | None = None) -> ArmidentError:
        """Error of a drive that does not answer within a time, s (the SDO timeout), or of its bus if that is down."""
        if self._bus.interface == "socketcan":
            # A bus that is down looks like a silent drive; opening it distinguishes the two.
            try:
                RawSocket(self._bus.channel, filters=(), receive_buffer=4096).close()
            except ArmidentError as error:
                return error
        waited = max(within_s or 0.0, self._timeout)
        return NoAnswerError(
            f"{self.label}: does not answer on {self._bus.channel} within {waited:g} s; "
            "check its supply and its node id"
        )

    def _invalid_answer(self, index: int, sub: int) -> ConfigError:
        return ConfigError(f"{self.label}: its answer for {_name(index, sub)} is no valid SDO response (CiA 301)")

    def _bus_down(self, error: Exception) -> BusDown:
        return BusDown(f"bus {self._bus.channel}: {error}")


def _name(index: int, sub: int) -> str:
    return f"object {index:04X}h:{sub}"


def _hex(value: int, code: str) -> str:
    """Return a value as the unsigned hexadecimal number that an object of this type shows."""
    return f"{value & (1 << 8 * struct.calcsize('<' + code)) - 1:X}h"


def _abort(error: SdoAbortedError) -> str:
    text = SdoAbortedError.CODES.get(error.code, "unknown reason")
    return f"{text[0].lower() + text[1:]} (SDO abort {error.code:08X}h)"
