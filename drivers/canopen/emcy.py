"""Emergency messages (EMCY) and the texts of their error codes: CiA 301, CiA 402, and vendor-specific ones."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from armident.drivers.can.frames import Frames
from armident.drivers.canopen.objects import COB_EMCY

EMCY_TEXTS: dict[int, str] = {
    0x0000: "error reset or no error",
    0x1000: "generic error",
    0x2000: "current",
    0x2100: "current on the device input side",
    0x2200: "internal current",
    0x2211: "internal over-current 1",
    0x2212: "internal over-current 2",
    0x2220: "continuous over-current",
    0x2230: "short circuit or earth leakage inside the device",
    0x2300: "current on the device output side",
    0x2310: "continuous over-current on the output side",
    0x2320: "short circuit or earth leakage on the output side",
    0x2330: "earth leakage on the output side",
    0x2340: "short circuit on the output side",
    0x2350: "load level fault (I2t, thermal state)",
    0x3000: "voltage",
    0x3100: "mains voltage",
    0x3110: "mains over-voltage",
    0x3120: "mains under-voltage",
    0x3130: "mains phase failure",
    0x3200: "DC link voltage",
    0x3210: "DC link over-voltage",
    0x3220: "DC link under-voltage",
    0x3300: "output voltage",
    0x4000: "temperature",
    0x4100: "ambient temperature",
    0x4200: "device temperature",
    0x4210: "excess device temperature",
    0x4300: "drive temperature",
    0x4310: "excess drive temperature",
    0x5000: "device hardware",
    0x5100: "supply voltage",
    0x5300: "operating unit",
    0x5400: "power section",
    0x5430: "input stages",
    0x5440: "contacts",
    0x5500: "data storage",
    0x6000: "device software",
    0x6100: "internal software",
    0x6200: "user software",
    0x6300: "data set",
    0x7000: "additional modules",
    0x7100: "power",
    0x7110: "brake chopper",
    0x7120: "motor",
    0x7121: "motor blocked",
    0x7122: "motor error or commutation malfunction",
    0x7200: "measurement circuit",
    0x7300: "sensor",
    0x7305: "incremental encoder 1 fault",
    0x7310: "speed",
    0x7320: "position",
    0x7400: "computation circuit",
    0x7500: "communication",
    0x8000: "monitoring",
    0x8100: "communication",
    0x8110: "CAN overrun (objects lost)",
    0x8120: "CAN in error passive mode",
    0x8130: "life guard or heartbeat error",
    0x8140: "recovered from bus off",
    0x8150: "CAN-ID collision",
    0x8200: "protocol error",
    0x8210: "PDO not processed because of its length",
    0x8220: "PDO length exceeded",
    0x8240: "unexpected SYNC data length",
    0x8250: "RPDO timeout",
    0x8300: "torque control",
    0x8400: "velocity control",
    0x8500: "position control",
    0x8611: "following error",
    0x8612: "reference limit",
    0x8700: "sync control",
    0x9000: "external error",
    0xF000: "additional functions",
    0xFF00: "device specific",
}
"""Texts of emergency error codes (CiA 301 table of section 7.2.7.1, CiA 402 part 2 error codes)."""


def emcy_text(code: int, vendor: Mapping[int, str] | None = None) -> str:
    """Text of an emergency error code: the vendor's, else that of the code, else that of its narrowest group."""
    if vendor and code in vendor:
        return vendor[code]
    for mask in (0xFFFF, 0xFFF0, 0xFF00, 0xF000):
        if code & mask in EMCY_TEXTS:
            return EMCY_TEXTS[code & mask]
    return "unknown error"


@dataclass(frozen=True)
class Emergency:
    """Emergency message (CiA 301 section 7.2.7.1) received at ``t_ns``, ns UTC, with the error register (1001h)."""

    node: int
    t_ns: int
    code: int
    register: int
    manufacturer: bytes

    def text(self, vendor: Mapping[int, str] | None = None) -> str:
        """Text of the message. ``vendor``: vendor-specific texts by error code."""
        more = f", manufacturer {self.manufacturer.hex(' ')}" if any(self.manufacturer) else ""
        return f"EMCY {self.code:04X}h, {emcy_text(self.code, vendor)} (error register {self.register:02X}h{more})"


def read_emergencies(batch: Frames) -> Iterator[Emergency]:
    """Yield the emergency messages of frames (N,); missing bytes are zero, frames without error code ignored."""
    for one in batch[batch["length"] >= 2]:
        data = bytes(one["data"][: int(one["length"])]).ljust(8, b"\0")
        code = int.from_bytes(data[:2], "little")
        yield Emergency(int(one["can_id"]) - COB_EMCY, int(one["t_ns"]), code, data[2], data[3:8])
