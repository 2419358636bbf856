"""SDO access to one drive; errors are one line that names drive, object and reason."""

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
    # Their warnings on stderr would repeat the text of our exceptions.
    logging.getLogger(_logger).addHandler(logging.NullHandler())

_EXPEDITED, _LARGEST = 4, 8
"""Maximum size (bytes) of a value in an expedited answer, and of the objects read here."""


class DriveSdo:
    """Access to the object dictionary of one drive.

    Parameters
    ----------
    node
        Remote node of a connected network.
    drive
        Drive of the session.
    session
        Bus and SDO timeout.
    """

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

    def read(self, index: int, sub: int, code: str) -> int:
        """Read an object.

        Parameters
        ----------
        index, sub
            Index and sub-index.
        code
            Type as a format of `struct` (``B``, ``h``, ``I``).

        Raises
        ------
        ConfigError
            If the drive does not answer or refuses.
        BusDown
            If the bus is down.
        """
        try:
            with self._lock:
                data = self._upload(index, sub, struct.calcsize("<" + code))
        except SdoAbortedError as error:
            raise ConfigError(f"{self.label}: refuses to read {_name(index, sub)}: {_abort(error)}") from error
        except SdoCommunicationError as error:
            raise self._no_answer() from error
        except (struct.error, IndexError) as error:
            raise self._invalid_answer(index, sub) from error
        except (can.CanError, OSError) as error:
            raise self._bus_down(error) from error
        return int(struct.unpack("<" + code, data)[0])

    def poll(self, index: int, sub: int, code: str, answer_s: float) -> int | None:
        """Read an object unless another SDO transfer is in progress; ``None`` in that case.

        Parameters
        ----------
        index, sub, code
            As in `read`.
        answer_s
            Longest wait for the answer, s.

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
                f"{min(len(data), _LARGEST)} bytes{'' if stated is None else f', says {stated}'}; expected {size}"
            )
        return data[:size]

    def command(self, index: int, sub: int, value: int, code: str) -> None:
        """Write an object without reading it back.

        Parameters
        ----------
        index, sub, code
            As in `read`.
        value
            Value to write.

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
            raise ConfigError(f"{self.label}: refuses {_name(index, sub)} = {value:X}h: {_abort(error)}") from error
        except SdoCommunicationError as error:
            raise self._no_answer() from error
        except (struct.error, IndexError) as error:
            raise self._invalid_answer(index, sub) from error
        except (can.CanError, OSError) as error:
            raise self._bus_down(error) from error

    def write(self, index: int, sub: int, value: int, code: str) -> None:
        """Write an object and read it back.

        Parameters
        ----------
        index, sub, code
            As in `read`.
        value
            Value to write.

        Raises
        ------
        ConfigError
            If the drive does not answer, refuses the value, or holds another one afterwards.
        BusDown
            If the bus is down.
        """
        self.command(index, sub, value, code)
        found = self.read(index, sub, code)
        if found != value:
            raise ConfigError(f"{self.label}: {_name(index, sub)} reads {found:X}h after writing {value:X}h")

    def _no_answer(self) -> ArmidentError:
        if self._bus.interface == "socketcan":
            # A bus that is down looks like a silent drive; opening it distinguishes the two.
            try:
                RawSocket(self._bus.channel, filters=(), receive_buffer=4096).close()
            except ArmidentError as error:
                return error
        return ConfigError(
            f"{self.label}: does not answer on {self._bus.channel} within {self._timeout:g} s; "
            "check its supply and its node id"
        )

    def _invalid_answer(self, index: int, sub: int) -> ConfigError:
        return ConfigError(f"{self.label}: its answer for {_name(index, sub)} is no valid SDO response (CiA 301)")

    def _bus_down(self, error: Exception) -> BusDown:
        return BusDown(f"bus {self._bus.channel}: {error}")


def _name(index: int, sub: int) -> str:
    return f"object {index:04X}h:{sub}"


def _abort(error: SdoAbortedError) -> str:
    text = SdoAbortedError.CODES.get(error.code, "unknown reason")
    return f"{text[0].lower() + text[1:]} (SDO abort {error.code:08X}h)"
