"""What comes over a bus: frames of any kind in any order, and drives that answer SDO as no drive should."""

import struct
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, cast

import can
import canopen
import numpy as np
from numpy.typing import NDArray

from armident.configs import ArmidentError, ConfigError, load_session
from armident.configs.schema.session import Temperature
from armident.daq.capture.pdo_discovery import bus_statistics
from armident.daq.matching.assembler import Assembler, TpdoStream
from armident.drivers.can.error_frames import summarise
from armident.drivers.can.frames import FRAME
from armident.drivers.canopen import objects as od
from armident.drivers.canopen.sdo import DriveSdo
from armident.drivers.canopen.sdo_client import SdoNode
from tests.fuzz.harness import MisreadError, Target
from tests.fuzz.mutate import spoil_bytes
from tests.property.test_daq_assembler import JOINTS, PERIOD_NS, STREAMS, Faults, bus

PACKED = (TpdoStream("samples", 1, (0x181, 0x182, 0x183), 8, 4, 2),)
EXPEDITED = 0x02
"""Bit of an answer that says that its last bytes are the value, and not its size."""
SILENCE_S = 0.002
"""How long an answer over SDO is waited for here, s."""
MOST_REQUESTS = 200
"""A drive that has us ask so often for one object keeps us busy for ever."""


def _frame_seeds() -> list[bytes]:
    faults = Faults(tpdo={(5, 1)}, sync={9}, twice={(12, 0)}, late={20: 2}, short={(30, 2)})
    made = [bus(60, faults), bus(40, Faults())]
    return [_as_frames(frames).tobytes() for frames in made]


def _as_frames(frames: NDArray[np.void]) -> NDArray[Any]:
    out = np.zeros(len(frames), FRAME)
    for name in ("t_ns", "can_id", "length", "data"):
        out[name] = frames[name]
    return out


def _check_frames(data: bytes, _: Path) -> bool:
    """Every SYNC is accounted for, and every value of a row came in a frame of its joint."""
    frames = np.frombuffer(data[: len(data) // FRAME.itemsize * FRAME.itemsize], FRAME).copy()
    summarise(frames)
    with suppress(ConfigError):
        bus_statistics("can0", frames)
    for streams, first in ((STREAMS, 1), (STREAMS, None), (PACKED, 1)):
        assembler = Assembler(streams, JOINTS, PERIOD_NS, 240, first)
        batches = [assembler.push(frames[at : at + 37]) for at in range(0, len(frames), 37)]
        batches.append(assembler.finish())
        for stream in streams:
            _check_stream(stream, batches, assembler.counters, frames)
    return True


def _check_stream(stream: TpdoStream, batches: list[Any], counters: dict[str, int], frames: NDArray[Any]) -> None:
    rows = [batch.rows[stream.name] for batch in batches]
    sync = np.concatenate([r.sync for r in rows])
    expected, taken, lost = (counters[f"{stream.name}.{what}"] for what in ("expected", "rows", "in_gaps"))
    if expected != taken + lost or taken != sync.size:
        raise MisreadError(f"{stream.name}: {expected} expected, {taken} rows, {lost} in gaps, {sync.size} given")
    if np.any(np.diff(sync) <= 0) or (sync.size and sync[0] < 0):
        raise MisreadError(f"{stream.name}: SYNC numbers do not increase")
    size = stream.size or stream.length
    for j, cob_id in enumerate(stream.cob_ids):
        mine = frames[(frames["can_id"] == cob_id) & (frames["length"] == stream.length)]["data"]
        sent = {sample.tobytes() for sample in mine[:, : stream.pack * size].reshape(-1, size)}
        given = {row.data[k, j, :size].tobytes() for row in rows for k in range(row.sync.size)}
        if not given <= sent:
            raise MisreadError(f"{stream.name}: a sample of {JOINTS[j]} that no drive sent")


class LyingDrive:
    """A drive that answers SDO as a script of bytes says; stands where canopen expects a bus.

    Each answer takes a step of nine bytes of the script: what to do, and eight bytes to do it with.
    """

    def __init__(self, network: canopen.Network, node_id: int, objects: dict[tuple[int, int], bytes]) -> None:
        self.network, self.node_id, self.objects = network, node_id, objects
        self.script = b""
        self.honest = True
        self.asked = self.lies = 0
        self._rest, self._toggle, self._last = b"", 0, bytes(8)

    def send(self, message: can.Message) -> None:
        """Take a request, and answer it."""
        if message.arbitration_id != od.COB_SDO_REQUEST + self.node_id:
            return
        self.asked += 1
        if self.asked > MOST_REQUESTS:
            raise MisreadError(f"asked {self.asked} times for one object")
        answer = self._answer(bytes(message.data))
        step, self.script = self.script[:9], self.script[9:]
        if answer is None:
            return
        for data in self._spoiled(answer, step):
            self.network.notify(od.COB_SDO_RESPONSE + self.node_id, bytearray(data), 0.0)
        self._last = answer

    def _spoiled(self, answer: bytes, step: bytes) -> list[bytes]:
        if len(step) < 9:
            return [answer]
        kind, more = step[0] % 12, step[1:]
        match kind:
            case 0:
                # What is changed in the value itself no protocol of a drive would show.
                segment = answer[0] & 0xE0 == 0
                self.honest = self.honest and not any(more[1:] if segment else more[4:])
                self.honest = self.honest and (segment or not more[0] & EXPEDITED)
                self.lies += segment and bool(more[0] & 0x0E)
                return [bytes(a ^ b for a, b in zip(answer, more, strict=True))]
            case 1:
                self.honest = self.honest and answer[0] & 0xE0 != 0
                return [answer[:1] + struct.pack("<H", more[0] | more[1] << 8) + answer[3:]]
            case 2:
                return [bytes([0x80]) + answer[1:4] + more[4:]]
            case 3:
                return []
            case 4:
                return [self._last]
            case 5:
                return [answer, answer]
            case 6:
                return [answer[: more[0] % 8]]
            case 7:
                return [bytes([answer[0] ^ 0x10]) + answer[1:]]
            case 8:
                # Says another size than it has; two lies of that kind can make one truth.
                self.lies += bool(more[0] & 0x0E)
                self.honest = self.honest and (answer[0] & 0xE0 == 0 or not more[0] & EXPEDITED)
                return [bytes([answer[0] ^ (more[0] & 0x0E)]) + answer[1:]]
            case 9:
                # Never comes to its end.
                return [bytes([answer[0] & ~1]) + answer[1:]]
            case 10:
                return [self._last, answer]
            case _:
                return [answer]

    def _answer(self, request: bytes) -> bytes | None:
        """What an honest drive answers (CiA 301 section 7.2.4.3)."""
        command, index, sub = struct.unpack_from("<BHB", request)
        kind = command & 0xE0
        if kind == 0x40:
            value = self.objects.get((index, sub), bytes(4))
            self._toggle, self._rest = 0, value
            if self.script[:1] and self.script[0] & 0x40:
                return struct.pack("<BHBI", 0x41, index, sub, len(value))
            return struct.pack("<BHB", 0x43 | (4 - len(value)) << 2, index, sub) + value.ljust(4, b"\0")
        if kind == 0x60:
            part, self._rest = self._rest[:2], self._rest[2:]
            head = self._toggle | (7 - len(part)) << 1 | (not self._rest)
            self._toggle ^= 0x10
            return bytes([head]) + part.ljust(7, b"\0")
        if kind == 0x20:
            size = 4 - (command >> 2 & 3)
            self.objects[index, sub] = request[4 : 4 + size]
            return struct.pack("<BHBI", 0x60, index, sub, 0)
        return None


WISHES = ((od.DEVICE_TYPE, 0, "I", 0x20192), (od.POSITION_ACTUAL, 0, "i", -123456), (od.MODE_DISPLAY, 0, "b", 8))


def new_drive(timeout_s: float = SILENCE_S, temperature: Temperature | None = None) -> tuple[LyingDrive, DriveSdo]:
    """The first drive of the shipped cell, honest for as long as it has no script, and our side of it."""
    session = load_session("tx40_cell.yaml").model_copy(update={"sdo_timeout_s": timeout_s})
    session = session.model_copy(update={"bus": session.bus.model_copy(update={"interface": "udp_multicast"})})
    network = canopen.Network()
    drive = session.drives[0].model_copy(update={"temperature": temperature})
    node = network.add_node(SdoNode(drive.node_id, str(drive.eds)))
    liar = LyingDrive(network, drive.node_id, {})
    network.bus = cast(Any, liar)
    return liar, DriveSdo(node, drive, session)


_drive = cache(new_drive)


def _check_sdo(data: bytes, _: Path) -> bool:
    """A value that is read is the drive's, where it did not lie about the value itself; the rest is refused."""
    liar, sdo = _drive()
    liar.objects = {(index, sub): struct.pack("<" + code, value) for index, sub, code, value in WISHES}
    liar.script, liar.honest, liar.lies = data, True, 0
    taken = True
    for index, sub, code, value in WISHES:
        liar.asked = 0
        try:
            found = sdo.read(index, sub, code)
        except ArmidentError as error:
            if not str(error).startswith(sdo.label):
                raise AssertionError(f"an error that does not say who: {error}") from error
            taken = False
            continue
        if liar.honest and liar.lies < 2 and found != value:
            raise MisreadError(f"{index:04X}h:{sub} read as {found}, it is {value}")
    liar.asked = 0
    try:
        sdo.write(od.HEARTBEAT_PRODUCER, 0, 100, "H")
    except ArmidentError:
        return False
    return taken


def _sdo_seeds() -> list[bytes]:
    return [bytes([kind, *range(1, 9)]) * 6 for kind in range(12)] + [
        bytes([kind | 0x40, *range(1, 9)]) * 8 for kind in range(12)
    ]


TARGETS = (
    Target("frames", _frame_seeds, spoil_bytes, _check_frames),
    Target("sdo", _sdo_seeds, spoil_bytes, _check_sdo),
)
