"""One drive over SDO: reads and writes that say in one line what went wrong, and with whom."""

import logging
import struct
import threading

import can
import canopen
from canopen.sdo import SdoAbortedError, SdoCommunicationError

from armident.configs.errors import ArmidentError, ConfigError
from armident.configs.schema.session import DriveNode, SessionConfig
from armident.drivers.can.frames import BusDown
from armident.drivers.can.socketcan import RawSocket

for _logger in ("canopen", "can"):
    # Their warnings repeat on stderr what our exceptions say in one line.
    logging.getLogger(_logger).addHandler(logging.NullHandler())

_EXPEDITED, _LARGEST = 4, 8
"""Bytes of a value in the answer itself, and most bytes that an object we read has."""


class DriveSdo:
    """The object dictionary of one drive.

    Parameters
    ----------
    node
        The remote node, part of a network that is connected.
    drive
        The drive as the session names it.
    session
        For the bus and the SDO timeout.
    """

    def __init__(self, node: canopen.RemoteNode, drive: DriveNode, session: SessionConfig) -> None:
        self.node = node
        self.drive = drive
        self.who = f"node {drive.node_id} ({drive.joint})"
        """How messages name the drive."""
        self.fd = session.bus_of(drive).fd
        """Whether the drive's TPDOs are frames of CAN FD."""
        self.emcy_texts = session.emcy_texts
        self._bus = session.bus_of(drive)
        self._timeout = node.sdo.RESPONSE_TIMEOUT = session.sdo_timeout_s
        # An SDO channel has one transfer at a time.
        self._lock = threading.RLock()

    def read(self, index: int, sub: int, code: str) -> int:
        """Read an object; ``code`` is its type as ``struct`` names it (``B``, ``h``, ``I``).

        Raises
        ------
        ConfigError
            If the drive does not answer, or refuses.
        BusDown
            If the bus is down.
        """
        try:
            with self._lock:
                data = self._upload(index, sub, struct.calcsize("<" + code))
        except SdoAbortedError as error:
            raise ConfigError(f"{self.who}: refuses to read {_name(index, sub)}: {_abort(error)}") from error
        except SdoCommunicationError as error:
            raise self._silent() from error
        except (struct.error, IndexError) as error:
            raise self._garbled(index, sub) from error
        except (can.CanError, OSError) as error:
            raise self._down(error) from error
        return int(struct.unpack("<" + code, data)[0])

    def poll(self, index: int, sub: int, code: str, answer_s: float) -> int | None:
        """Read an object where nobody else is at it, and wait for so long at most; ``None`` where somebody is.

        Raises
        ------
        ConfigError, BusDown
            As `read` does.
        """
        if not self._lock.acquire(blocking=False):
            return None
        try:
            self.node.sdo.RESPONSE_TIMEOUT = min(answer_s, self._timeout)
            return self.read(index, sub, code)
        finally:
            self.node.sdo.RESPONSE_TIMEOUT = self._timeout
            self._lock.release()

    def _upload(self, index: int, sub: int, size: int) -> bytes:
        """The first ``size`` bytes of an object; some drives send four of smaller ones."""
        data = b""
        with self.node.sdo.open(index, sub, "rb", buffering=0) as stream:
            # A drive that never says that it has ended is not listened to for ever.
            while len(data) <= _LARGEST and (part := stream.read(_LARGEST)):
                data += part
            said = stream.size
        if not (said == len(data) >= size or (said is None and len(data) in (size, max(size, _EXPEDITED)))):
            raise ConfigError(
                f"{self.who}: {_name(index, sub)} has {'more than ' * (len(data) > _LARGEST)}"
                f"{min(len(data), _LARGEST)} bytes{'' if said is None else f', says {said}'}; expected {size}"
            )
        return data[:size]

    def order(self, index: int, sub: int, value: int, code: str) -> None:
        """Write an object that acts at once and need not read back the same.

        Raises
        ------
        ConfigError
            If the drive does not answer, or refuses the value.
        BusDown
            If the bus is down.
        """
        try:
            with self._lock:
                self.node.sdo.download(index, sub, struct.pack("<" + code, value))
        except SdoAbortedError as error:
            raise ConfigError(f"{self.who}: refuses {_name(index, sub)} = {value:X}h: {_abort(error)}") from error
        except SdoCommunicationError as error:
            raise self._silent() from error
        except (struct.error, IndexError) as error:
            raise self._garbled(index, sub) from error
        except (can.CanError, OSError) as error:
            raise self._down(error) from error

    def write(self, index: int, sub: int, value: int, code: str) -> None:
        """Write an object and read it back.

        Raises
        ------
        ConfigError
            If the drive does not answer, refuses the value, or holds another one afterwards.
        BusDown
            If the bus is down.
        """
        self.order(index, sub, value, code)
        found = self.read(index, sub, code)
        if found != value:
            raise ConfigError(f"{self.who}: {_name(index, sub)} reads {found:X}h after writing {value:X}h")

    def _silent(self) -> ArmidentError:
        if self._bus.interface == "socketcan":
            # A bus that is down looks like a silent drive from here; opening it tells them apart.
            try:
                RawSocket(self._bus.channel, filters=(), receive_buffer=4096).close()
            except ArmidentError as error:
                return error
        return ConfigError(
            f"{self.who}: does not answer on {self._bus.channel} within {self._timeout:g} s; "
            "is the drive on, and the node id right?"
        )

    def _garbled(self, index: int, sub: int) -> ConfigError:
        return ConfigError(f"{self.who}: its answer about {_name(index, sub)} is no SDO answer (CiA 301)")

    def _down(self, error: Exception) -> BusDown:
        return BusDown(f"bus {self._bus.channel}: {error}")


def _name(index: int, sub: int) -> str:
    return f"object {index:04X}h:{sub}"


def _abort(error: SdoAbortedError) -> str:
    text = SdoAbortedError.CODES.get(error.code, "unknown reason")
    return f"{text[0].lower() + text[1:]} (SDO abort {error.code:08X}h)"
