"""Objects, identifiers, states and commands of CiA 301 and CiA 402."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum, StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armident.configs.errors import ConfigError
from armident.configs.schema.robot import Drive
from armident.configs.schema.session import ObjectName

PDO_BYTES = 8
"""Maximum number of data bytes of a PDO in a classic CAN frame."""

FD_PDO_BYTES = 64
"""Maximum number of data bytes of a PDO in a CAN FD frame."""

MAPPED_OBJECTS = 64
"""Maximum number of objects mapped into a PDO (CiA 301 section 7.5.2.36)."""

ARRAY_OFFSET = 0x4000
"""Offset from an object of CiA 402 (6064h) down to the manufacturer-specific array of its values (2064h). Sub-index i
holds the value at the i-th SYNC of the last pack; the last sub-index belongs to the SYNC that triggers the TPDO."""

PDO_NOT_VALID = 1 << 31
"""Bit of a PDO's COB-ID entry (sub-index 1) that disables the PDO (CiA 301 section 7.5.2.35)."""

NO_RTR = 1 << 30
"""Bit of a TPDO's COB-ID entry (sub-index 1) that forbids RTR (CiA 301 section 7.5.2.35); some drives keep it set."""

COB_NMT = 0x000
COB_SYNC = 0x080
COB_EMCY = 0x080
COB_SDO_RESPONSE = 0x580
COB_SDO_REQUEST = 0x600
COB_HEARTBEAT = 0x700
SDO_DOWNLOAD = 1
"""Command specifier of a request that writes (CiA 301 section 7.2.4.3.3)."""

DEVICE_TYPE = 0x1000
ERROR_REGISTER = 0x1001
HEARTBEAT_PRODUCER = 0x1017
IDENTITY = 0x1018
SYNC_COUNTER_OVERFLOW = 0x1019
RPDO_COMMUNICATION = 0x1400
RPDO_MAPPING = 0x1600
TPDO_COMMUNICATION = 0x1800
TPDO_MAPPING = 0x1A00
INHIBIT_TIME, EVENT_TIMER = 3, 5
"""Sub-indices of a TPDO's communication parameters, in 100 us and in ms (CiA 301 section 7.5.2.37)."""
PDOS = 0x200
"""Maximum number of TPDOs, and of RPDOs, of a node (CiA 301 section 7.5.2.35)."""
ERROR_CODE = 0x603F
CONTROLWORD = 0x6040
STATUSWORD = 0x6041
MODE_OF_OPERATION = 0x6060
MODE_DISPLAY = 0x6061
POSITION_DEMAND = 0x6062
POSITION_ACTUAL = 0x6064
VELOCITY_ACTUAL = 0x606C
RATED_CURRENT = 0x6075
TORQUE_ACTUAL = 0x6077
CURRENT_ACTUAL = 0x6078
TARGET_POSITION = 0x607A
ENCODER_RESOLUTION = 0x608F
INTERPOLATION_PERIOD = 0x60C2

DEVICE_PROFILE_CIA402 = 402
"""Low word of the device type (1000h) of every drive that follows CiA 402."""

CYCLIC_SYNCHRONOUS_POSITION = 8
"""Mode of operation (6060h) in which the drive follows one set point per cycle (CiA 402 part 2)."""


@dataclass(frozen=True)
class MappedObject:
    """Object that can be mapped into a PDO; ``format`` is the NumPy format of its bytes."""

    name: str
    index: int
    subindex: int
    format: str

    @property
    def bits(self) -> int:
        """Length in bits."""
        return 8 * np.dtype(self.format).itemsize

    @property
    def entry(self) -> int:
        """Mapping entry: index, sub-index and length in bits (CiA 301 section 7.5.2.36)."""
        return self.index << 16 | self.subindex << 8 | self.bits

    def packed(self, sample: int) -> "MappedObject":
        """Element of the object's array that holds one sample, 1 (the oldest) to ``pack``, of a packed TPDO."""
        return MappedObject(self.name, self.index - ARRAY_OFFSET, sample, self.format)


OBJECTS: dict[str, MappedObject] = {
    o.name: o
    for o in (
        MappedObject("position", POSITION_ACTUAL, 0, "<i4"),
        MappedObject("velocity", VELOCITY_ACTUAL, 0, "<i4"),
        MappedObject("current", CURRENT_ACTUAL, 0, "<i2"),
        MappedObject("torque", TORQUE_ACTUAL, 0, "<i2"),
        MappedObject("demand", POSITION_DEMAND, 0, "<i4"),
        MappedObject("status", STATUSWORD, 0, "<u2"),
    )
}
"""Objects that a stream may contain, by their names in the session schema."""

SETPOINT = MappedObject("target", TARGET_POSITION, 0, "<i4")
"""Object in the RPDO of the set points: the target position, counts."""


CONTROL_ENTRY = CONTROLWORD << 16 | 16
"""Mapping entry of the controlword."""

EVENT_DRIVEN = 255
"""Transmission type of a PDO that takes effect on reception, without SYNC (CiA 301 section 7.5.2.35)."""


@dataclass(frozen=True)
class TpdoLayout:
    """Data bytes of one TPDO: its objects in mapping order, little endian, without gaps.

    ``pack`` > 1: it holds several samples, the oldest first, mapped from the objects' arrays (:data:`ARRAY_OFFSET`).
    """

    objects: tuple[MappedObject, ...]
    pack: int = 1

    @classmethod
    def of(
        cls, names: Sequence[ObjectName | str], where: str = "stream", pack: int = 1, fd: bool = False
    ) -> "TpdoLayout":
        """Layout of a stream's objects in mapping order; ConfigError if one is unknown, repeated or too much."""
        for name in names:
            if name not in OBJECTS:
                raise ConfigError(f"{where}: no object named {name!r}; objects are {', '.join(OBJECTS)}")
        if len(set(names)) != len(names):
            raise ConfigError(f"{where}: an object is mapped twice: {', '.join(names)}")
        layout = cls(tuple(OBJECTS[name] for name in names), pack)
        limit = FD_PDO_BYTES if fd else PDO_BYTES
        if layout.frame_size > limit:
            sizes = ", ".join(f"{o.name} {o.bits // 8}" for o in layout.objects)
            times = f"{pack} times " if pack > 1 else ""
            raise ConfigError(
                f"{where}: {times}{layout.size} bytes ({sizes}) do not fit into the {limit} bytes of a TPDO"
                + ("" if fd else "; a bus with fd: true carries 64" if layout.frame_size <= FD_PDO_BYTES else "")
            )
        if len(names) * pack > MAPPED_OBJECTS:
            raise ConfigError(f"{where}: {len(names) * pack} objects; a TPDO maps {MAPPED_OBJECTS}")
        return layout

    @property
    def size(self) -> int:
        """Number of data bytes of one sample."""
        return sum(o.bits for o in self.objects) // 8

    @property
    def frame_size(self) -> int:
        """Number of data bytes in the frame."""
        return self.size * self.pack

    @property
    def dtype(self) -> np.dtype[Any]:
        """Structured type of a sample, one field per object, padded to a multiple of eight bytes."""
        offsets = [sum(o.bits for o in self.objects[:k]) // 8 for k in range(len(self.objects))]
        return np.dtype(
            {
                "names": [o.name for o in self.objects],
                "formats": [o.format for o in self.objects],
                "offsets": offsets,
                "itemsize": -(-self.size // 8) * 8,
            }
        )

    @property
    def entries(self) -> tuple[int, ...]:
        """Mapping entries for 1A00h and following, in order."""
        if self.pack == 1:
            return tuple(o.entry for o in self.objects)
        return tuple(o.packed(k).entry for k in range(1, self.pack + 1) for o in self.objects)

    def decode(self, data: NDArray[np.uint8]) -> NDArray[Any]:
        """Data bytes of samples, uint8 (N, itemsize of `dtype`), as records (N,); a view if ``data`` is contiguous."""
        return np.ascontiguousarray(data).view(self.dtype)[:, 0]


def tpdo_cob(tpdo: int, node: int) -> int:
    """COB-ID of TPDO 1 to 4 in the predefined connection set (CiA 301 section 7.3.5)."""
    return 0x180 + 0x100 * (tpdo - 1) + node


def rpdo_cob(rpdo: int, node: int) -> int:
    """COB-ID of RPDO 1 to 4 in the predefined connection set (CiA 301 section 7.3.5)."""
    return 0x200 + 0x100 * (rpdo - 1) + node


def stop_rpdo(setpoints: int) -> int:
    """Number of the RPDO for the controlword: 2, or 1 if the set points use 2."""
    return 1 if setpoints == 2 else 2


def rated_milliamperes(drive: Drive) -> int:
    """Rated current for 6075h, mA, so that 1000 per mille of 6078h is ``drive.rated``."""
    return round(drive.rated * 1000)


class NmtCommand(IntEnum):
    """NMT commands (CiA 301 section 7.2.8.3.1)."""

    START = 1
    STOP = 2
    PRE_OPERATIONAL = 128
    RESET_NODE = 129
    RESET_COMMUNICATION = 130


class NmtState(IntEnum):
    """NMT states in a heartbeat (CiA 301 section 7.2.8.3.2)."""

    BOOT_UP = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127


class Control(IntEnum):
    """Controlwords (6040h) of the commands of the CiA 402 state machine."""

    DISABLE_VOLTAGE = 0x00
    QUICK_STOP = 0x02
    SHUTDOWN = 0x06
    SWITCH_ON = 0x07
    ENABLE_OPERATION = 0x0F
    FAULT_RESET = 0x80


class DriveState(StrEnum):
    """States of the CiA 402 state machine, with their names in the standard."""

    NOT_READY = "not ready to switch on"
    SWITCH_ON_DISABLED = "switch on disabled"
    READY = "ready to switch on"
    SWITCHED_ON = "switched on"
    ENABLED = "operation enabled"
    QUICK_STOP_ACTIVE = "quick stop active"
    FAULT_REACTION = "fault reaction active"
    FAULT = "fault"


STATE_CODES: dict[DriveState, tuple[int, int]] = {
    DriveState.NOT_READY: (0x4F, 0x00),
    DriveState.SWITCH_ON_DISABLED: (0x4F, 0x40),
    DriveState.READY: (0x6F, 0x21),
    DriveState.SWITCHED_ON: (0x6F, 0x23),
    DriveState.ENABLED: (0x6F, 0x27),
    DriveState.QUICK_STOP_ACTIVE: (0x6F, 0x07),
    DriveState.FAULT_REACTION: (0x4F, 0x0F),
    DriveState.FAULT: (0x4F, 0x08),
}
"""Mask and value of the statusword in every state (CiA 402 part 2, table of 6041h)."""


def drive_state(statusword: int) -> DriveState | None:
    """CiA 402 state of a statusword (6041h); ``None`` for a pattern that the standard does not define."""
    for state, (mask, value) in STATE_CODES.items():
        if statusword & mask == value:
            return state
    return None
