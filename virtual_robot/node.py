"""Virtual drive as a CANopen node: object dictionary, EMCY, and the states of CiA 402."""

# mypy: disable-error-code="no-untyped-call"
# canopen is typed in part only.

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import canopen
from canopen.objectdictionary import ODArray
from canopen.sdo.exceptions import SdoAbortedError

from armident.configs import ConfigError
from armident.configs.schema.robot import Joint
from armident.drivers.canopen.eds import read_objects
from armident.drivers.canopen.objects import (
    CONTROLWORD,
    CURRENT_ACTUAL,
    CYCLIC_SYNCHRONOUS_POSITION,
    ENCODER_RESOLUTION,
    ERROR_REGISTER,
    FD_PDO_BYTES,
    HEARTBEAT_PRODUCER,
    IDENTITY,
    INHIBIT_TIME,
    INTERPOLATION_PERIOD,
    MAPPED_OBJECTS,
    MODE_DISPLAY,
    MODE_OF_OPERATION,
    PDO_BYTES,
    PDO_NOT_VALID,
    POSITION_ACTUAL,
    POSITION_DEMAND,
    RATED_CURRENT,
    RPDO_COMMUNICATION,
    RPDO_MAPPING,
    STATUSWORD,
    TARGET_POSITION,
    TORQUE_ACTUAL,
    TPDO_COMMUNICATION,
    TPDO_MAPPING,
    DriveState,
    rated_milliamperes,
)
from armident.virtual_robot.arm import DriveBackend
from armident.virtual_robot.cia402 import MOVING, next_state, statusword
from armident.virtual_robot.node_services import Nmt, Sdo
from armident.virtual_robot.oddity import Oddity

ABORT_UNSUPPORTED = 0x06010000
ABORT_NOT_MAPPABLE = 0x06040041
ABORT_PDO_LENGTH = 0x06040042
ABORT_VALUE_RANGE = 0x06090030
ABORT_DEVICE_STATE = 0x08000022
"""SDO abort codes (CiA 301 section 7.2.4.3.17)."""

MAPPING = RPDO_MAPPING - RPDO_COMMUNICATION
"""Offset from a PDO's communication record (1400h, 1800h) to its mapping record (1600h, 1A00h)."""
ERROR_HISTORY = 0x1003
FOLLOWING_ERROR = 0x60F4
SUPPORTED_MODES = 0x6502
EVENT_DRIVEN = (254, 255)
NEEDED = (
    HEARTBEAT_PRODUCER,
    CONTROLWORD,
    STATUSWORD,
    MODE_OF_OPERATION,
    POSITION_ACTUAL,
    TARGET_POSITION,
    INTERPOLATION_PERIOD,
    RPDO_COMMUNICATION,
    RPDO_MAPPING,
    TPDO_COMMUNICATION,
    TPDO_MAPPING,
)


class Drive(canopen.LocalNode):
    """One virtual CiA 402 drive; raises ConfigError if the EDS cannot be read or lacks an object.

    ``joint`` gives encoder resolution (608Fh) and rated current (6075h). ``changed``: PDO configuration, NMT state or a
    mapped constant may have changed. ``fd``: TPDOs are CAN FD frames.
    """

    def __init__(
        self,
        node_id: int,
        eds: Path,
        index: int,
        joint: Joint,
        motion: DriveBackend,
        changed: Callable[[], None],
        status_changed: Callable[[], None],
        fd: bool = False,
    ) -> None:
        self.fd = fd
        super().__init__(node_id, read_objects(eds, node_id))
        for needed in NEEDED:
            if needed not in self.object_dictionary:
                raise ConfigError(f"{eds}: object {needed:04X}h is missing")
        self.node_id = node_id
        self.index, self.joint, self.motion = index, joint, motion
        self.changed, self.status_changed = changed, status_changed
        self.nmt: Nmt = Nmt(node_id, self)
        self.sdo: Sdo = Sdo(self)
        self.oddities: tuple[Oddity, ...] = ()
        """Deviations from an ordinary drive."""
        self._write_callbacks = [self._check, self.nmt.on_write]
        self.add_read_callback(self._live)
        self.state = DriveState.SWITCH_ON_DISABLED
        self.control = 0
        self._factory()

    def become_odd(self, oddities: Sequence[Oddity]) -> None:
        """Deviate from an ordinary drive from now on."""
        self.oddities = tuple(oddities)
        self._factory()

    def _factory(self) -> None:
        counts = round(self.joint.drive.counts_per_unit or 0)
        self.preset(ENCODER_RESOLUTION, 1, counts)
        self.preset(ENCODER_RESOLUTION, 2, 1)
        self.preset(RATED_CURRENT, 0, rated_milliamperes(self.joint.drive))
        self.preset(IDENTITY, 4, self.node_id)
        self.preset(MODE_OF_OPERATION, 0, CYCLIC_SYNCHRONOUS_POSITION)
        self.preset(SUPPORTED_MODES, 0, 1 << (CYCLIC_SYNCHRONOUS_POSITION - 1))
        for oddity in self.oddities:
            oddity.preset()

    def preset(self, index: int, subindex: int, value: int) -> None:
        """Set an object of the dictionary from inside the drive; objects that the EDS lacks are ignored."""
        if index in self.object_dictionary:
            entry = self._find_object(index, subindex)
            self.data_store.setdefault(index, {})[subindex] = entry.encode_raw(value)

    def reset(self, communication_only: bool) -> None:
        """Restore the power-on values of the object dictionary, or of the communication profile (1000h to 1FFFh)."""
        for index in list(self.data_store):
            if not communication_only or index < 0x2000:
                del self.data_store[index]
        self._factory()
        if not communication_only:
            self.control = 0
            self._enter(DriveState.SWITCH_ON_DISABLED)

    def get_data(self, index: int, subindex: int, check_readable: bool = False) -> bytes:
        """Read an object; a request over SDO refuses write-only ones, and oddities may answer it."""
        if check_readable:
            for oddity in self.oddities:
                answer = oddity.read(index, subindex)
                if answer is not None:
                    return answer
        return bytes(super().get_data(index, subindex, check_readable))

    def set_data(self, index: int, subindex: int, data: bytes, check_writable: bool = False) -> None:
        """Write an object; a controlword takes effect at once. ``check_writable``: refuse read-only objects."""
        if check_writable:
            for oddity in self.oddities:
                data = oddity.write(index, subindex, bytes(data))
        super().set_data(index, subindex, data, check_writable)
        if index == CONTROLWORD:
            self.apply_controlword(int.from_bytes(data, "little"))
            return
        if index == INTERPOLATION_PERIOD:
            self._set_interpolation_time()
        self.changed()

    def _set_interpolation_time(self) -> None:
        set_time = getattr(self.motion, "interpolation_time", None)
        if set_time is not None:
            value = int.from_bytes(self.get_data(INTERPOLATION_PERIOD, 1), "little")
            exponent = int.from_bytes(self.get_data(INTERPOLATION_PERIOD, 2), "little", signed=True)
            set_time(self.index, value * 10.0**exponent)

    @property
    def status(self) -> int:
        """Statusword (6041h)."""
        return statusword(self.state)

    def apply_controlword(self, control: int) -> None:
        """Apply a controlword (6040h)."""
        state = next_state(self.state, control, self.control)
        self.control = control
        self._enter(state)

    def fault(self, code: int, register: int) -> None:
        """Enter the fault state and report error code and register (EMCY, 1001h, 1003h)."""
        if self.state is DriveState.FAULT:
            return
        self._enter(DriveState.FAULT)
        self.preset(ERROR_REGISTER, 0, register)
        self.preset(ERROR_HISTORY, 1, code)
        self.emcy.send(code, register)

    def _enter(self, state: DriveState) -> None:
        before, self.state = self.state, state
        if before is DriveState.FAULT and state is not DriveState.FAULT:
            self.preset(ERROR_REGISTER, 0, 0)
            self.emcy.reset()
        if (before in MOVING) != (state in MOVING):
            self.motion.enable(self.index, state in MOVING)
        if state is not before and self.nmt.operational:
            self._send_event_driven()
        self.status_changed()

    def _send_event_driven(self) -> None:
        for cob_id, kind, mapped in self.pdos(TPDO_COMMUNICATION):
            if kind in EVENT_DRIVEN:
                self.network.send_message(cob_id, b"".join(self.get_data(i, sub) for i, sub, _ in mapped))

    def _live(self, index: int, subindex: int, od: Any) -> int | None:
        if subindex or not 0x6040 <= index <= 0x60F4:
            return None
        motion, j = self.motion, self.index
        if index == STATUSWORD:
            return self.status
        if index == MODE_DISPLAY:
            return int.from_bytes(self.get_data(MODE_OF_OPERATION, 0), "little", signed=True)
        if index == POSITION_ACTUAL:
            return int(motion.position[j])
        if index in (TORQUE_ACTUAL, CURRENT_ACTUAL):
            return int(motion.current[j])
        if index == POSITION_DEMAND:
            return int(motion.demand[j])
        if index == FOLLOWING_ERROR:
            return int(motion.demand[j]) - int(motion.position[j])
        return None

    def _number(self, index: int, subindex: int) -> int:
        return int.from_bytes(self.get_data(index, subindex), "little")

    def _check(self, index: int, subindex: int, od: Any, data: bytes) -> None:
        """Refuse values that CiA 301 (sections 7.5.2.35 to 7.5.2.38) or CiA 402 forbids, before they are stored."""
        value = int.from_bytes(data, "little")
        for base in (RPDO_COMMUNICATION, TPDO_COMMUNICATION):
            if base <= index < base + MAPPING:
                self._check_communication(base, index, subindex, value)
            elif base + MAPPING <= index < base + 2 * MAPPING:
                self._check_mapping(base, index, subindex, value)
        if index == MODE_OF_OPERATION and value != CYCLIC_SYNCHRONOUS_POSITION:
            raise SdoAbortedError(ABORT_VALUE_RANGE)

    def _check_communication(self, base: int, index: int, subindex: int, value: int) -> None:
        if subindex == 1:
            old = self._number(index, 1)
            if not old & PDO_NOT_VALID and not value & PDO_NOT_VALID and (old ^ value) & 0x1FFFFFFF:
                raise SdoAbortedError(ABORT_VALUE_RANGE)
            if value & 1 << 29 or (not value & PDO_NOT_VALID and not 0x180 <= value & 0x7FF < 0x580):
                raise SdoAbortedError(ABORT_VALUE_RANGE)
        elif subindex == 2:
            supported = 1 <= value <= 240 or value in EVENT_DRIVEN or (base == RPDO_COMMUNICATION and value == 0)
            if not supported:
                raise SdoAbortedError(ABORT_VALUE_RANGE)
        elif subindex == INHIBIT_TIME and not self._number(index, 1) & PDO_NOT_VALID:
            raise SdoAbortedError(ABORT_DEVICE_STATE)

    def _check_mapping(self, base: int, index: int, subindex: int, value: int) -> None:
        if not self._number(index - MAPPING, 1) & PDO_NOT_VALID:
            raise SdoAbortedError(ABORT_DEVICE_STATE)
        if subindex == 0:
            wide = self.fd and base == TPDO_COMMUNICATION
            if value > (MAPPED_OBJECTS if wide else 8):
                raise SdoAbortedError(ABORT_PDO_LENGTH)
            entries = [self._number(index, k) for k in range(1, value + 1)]
            for entry in entries:
                self._check_entry(base, entry)
            if sum(entry & 0xFF for entry in entries) > 8 * (FD_PDO_BYTES if wide else PDO_BYTES):
                raise SdoAbortedError(ABORT_PDO_LENGTH)
        elif self._number(index, 0):
            raise SdoAbortedError(ABORT_UNSUPPORTED)
        elif value:
            self._check_entry(base, value)

    def _check_entry(self, base: int, entry: int) -> None:
        try:
            mapped = self._find_object(entry >> 16, entry >> 8 & 0xFF)
        except SdoAbortedError:
            raise SdoAbortedError(ABORT_NOT_MAPPABLE) from None
        listed = self.object_dictionary[entry >> 16]
        if isinstance(listed, ODArray) and entry >> 8 & 0xFF:
            # All elements of a compact array are like its first one; sub-index 0 holds their number.
            if entry >> 8 & 0xFF > self._number(entry >> 16, 0):
                raise SdoAbortedError(ABORT_NOT_MAPPABLE)
            mapped = listed[1]
        allowed = mapped.readable if base == TPDO_COMMUNICATION else mapped.writable
        if not mapped.pdo_mappable or not allowed or len(mapped) != entry & 0xFF or len(mapped) % 8:
            raise SdoAbortedError(ABORT_NOT_MAPPABLE)

    def inhibit_times(self) -> dict[int, float]:
        """Inhibit time (180xh:3) of each TPDO that has this sub-index, s, by COB-ID."""
        out = {}
        for index in range(TPDO_COMMUNICATION, TPDO_COMMUNICATION + MAPPING):
            if index not in self.object_dictionary:
                break
            if self.object_dictionary.get_variable(index, INHIBIT_TIME) is not None:
                out[self._number(index, 1) & 0x7FF] = self._number(index, INHIBIT_TIME) * 1e-4
        return out

    def pdos(self, base: int) -> list[tuple[int, int, list[tuple[int, int, int]]]]:
        """Enabled PDOs from record 1400h or 1800h on: COB-ID, type, objects (index, subindex, bytes) in order."""
        out = []
        for index in range(base, base + MAPPING):
            if index not in self.object_dictionary:
                break
            cob_id = self._number(index, 1)
            if cob_id & PDO_NOT_VALID:
                continue
            count = self._number(index + MAPPING, 0)
            entries = [self._number(index + MAPPING, k) for k in range(1, count + 1)]
            mapped = [(e >> 16, e >> 8 & 0xFF, (e & 0xFF) // 8) for e in entries]
            out.append((cob_id & 0x7FF, self._number(index, 2), mapped))
        return out
