"""Oddities of virtual drives in their services: SDO answers, NMT and emergency messages."""

import struct
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import can

from armident.configs.schema.session import Bus
from armident.drivers.can.udp import open_python_can
from armident.drivers.canopen import objects as od
from armident.drivers.canopen.objects import NmtCommand, NmtState
from armident.virtual_robot.node import ABORT_DEVICE_STATE, Drive
from armident.virtual_robot.oddity import Oddity

BURST = (0x8611, 0xFF05)
"""Error codes of the emergency messages of a burst, in turn."""


BUSY = (0x08000020, 0x08000021, ABORT_DEVICE_STATE)
"""Abort codes of transfers that a drive cannot carry out now (CiA 301), in turn."""


class _InBackground(Oddity):
    """Oddity with a thread of its own until its end."""

    def __init__(self) -> None:
        self._over = threading.Event()
        self._thread: threading.Thread | None = None

    def _start(self, work: Callable[..., None], *arguments: Any) -> None:
        self._thread = threading.Thread(target=work, args=arguments, daemon=True)
        self._thread.start()

    def end(self) -> None:
        """End the thread."""
        self._over.set()
        if self._thread is not None:
            self._thread.join()


def _later(delay_s: float, work: Callable[..., None], *arguments: Any) -> None:
    timer = threading.Timer(delay_s, work, arguments)
    timer.daemon = True
    timer.start()


class AbortBusy(Oddity):
    """Every 7th SDO request is aborted, with another code each time."""

    def __init__(self, drive: Drive) -> None:
        self._drive, self._count = drive, 0

    def request(self, data: bytes) -> bool:
        """Abort a request that a repetition fulfils."""
        self._count += 1
        if self._count % 7:
            return True
        code = BUSY[self._count // 7 % len(BUSY)]
        self._drive.sdo.send_response(b"\x80" + data[1:4] + struct.pack("<L", code))
        return False


class Twice(Oddity):
    """SDO answers come again. ``delay_s``: time between both, s."""

    def __init__(self, drive: Drive, delay_s: float) -> None:
        self._drive, self._delay = drive, delay_s

    def respond(self, data: bytes) -> list[bytes]:
        """Repeat the answer."""
        if not self._delay:
            return [data, data]
        _later(self._delay, self._again, data)
        return [data]

    def _again(self, data: bytes) -> None:
        with suppress(can.CanError, OSError):
            self._drive.network.send_message(self._drive.sdo.tx_cobid, data)


class SlowSdo(Oddity):
    """SDO answers take 50 ms."""

    def request(self, data: bytes) -> bool:
        """Serve the request late."""
        time.sleep(0.05)
        return True


class ShortAnswer(Oddity):
    """SDO answers to writes are as long as their contents."""

    def respond(self, data: bytes) -> list[bytes]:
        """Leave out the bytes that mean nothing."""
        return [data[:4] if data[0] & 0xE0 == 0x60 else data]


class OtherClient(_InBackground):
    """Another client on the SDO channel."""

    ANSWER_S = 0.5
    """Longest wait for an answer, s, as in the canopen library and ours."""

    def __init__(self, drive: Drive) -> None:
        super().__init__()
        self._node = drive.node_id
        self._request = can.Message(
            arbitration_id=od.COB_SDO_REQUEST + drive.node_id,
            is_extended_id=False,
            data=struct.pack("<BHBL", 0x40, od.ERROR_REGISTER, 0, 0),
        )

    def begin(self, bus: Bus) -> None:
        """Read the error register at up to 200 Hz: a client waits for the answer to its last request."""
        self._start(self._run, bus)

    def _run(self, bus: Bus) -> None:
        answers = [{"can_id": od.COB_SDO_RESPONSE + self._node, "can_mask": 0x7FF, "extended": False}]
        with open_python_can(bus, answers) as client:
            while not self._over.wait(0.005):
                with suppress(can.CanError, OSError):
                    client.send(self._request)
                    self._wait_for_answer(client)

    def _wait_for_answer(self, client: can.BusABC) -> None:
        """Wait for the answer among those to other clients."""
        until = time.monotonic() + self.ANSWER_S
        while (left := until - time.monotonic()) > 0 and not self._over.is_set():
            answer = client.recv(left)
            if answer is not None and bytes(answer.data[1:4]) == bytes(self._request.data[1:4]):
                return


class Autostart(Oddity):
    """The drive becomes operational by itself."""

    def __init__(self, drive: Drive) -> None:
        self._drive = drive

    def nmt(self, command: int) -> bool:
        """Start 30 ms after a command to pre-operational."""
        if command == NmtCommand.PRE_OPERATIONAL:
            _later(0.03, self._drive.nmt.enter, NmtState.OPERATIONAL)
        return True


class SlowBoot(Oddity):
    """The drive is silent until some time after the first NMT command."""

    def __init__(self, drive: Drive, boot_s: float) -> None:
        self._drive, self._boot_s = drive, boot_s
        self._booted: bool | None = None

    def nmt(self, command: int) -> bool:
        """Begin to boot; commands that come meanwhile are not executed."""
        if self._booted is None:
            self._booted = False
            _later(self._boot_s, self._boot)
        return self._booted

    def request(self, data: bytes) -> bool:
        """Answer nothing before the end of the boot."""
        return self._booted is not False

    def _boot(self) -> None:
        self._booted = True
        self._drive.nmt.boot()


class EmcyBurst(_InBackground):
    """Thousands of emergency messages after NMT start."""

    def __init__(self, drive: Drive) -> None:
        super().__init__()
        self._drive = drive

    def nmt(self, command: int) -> bool:
        """Begin the burst, once."""
        if command == NmtCommand.START and self._thread is None:
            self._start(self._send)
        return True

    def _send(self) -> None:
        self._over.wait(0.5)
        for k in range(3000):
            if self._over.is_set():
                return
            with suppress(can.CanError, OSError):
                self._drive.emcy.send(BURST[k % 2], 1, struct.pack("<HHB", k, 0, 7))
            time.sleep(0.0003)
