"""Interpretation of the error frames of a CAN controller (linux/can/error.h)."""

from typing import Any, Literal

from armident.drivers.can.frames import Frames

BusState = Literal["bus_off", "restarted", "passive", "warning", "active"]

TX_TIMEOUT, LOST_ARBITRATION, CONTROLLER, PROTOCOL = 0x001, 0x002, 0x004, 0x008
TRANSCEIVER, NO_ACKNOWLEDGE, BUS_OFF, BUS_ERROR, RESTARTED = 0x010, 0x020, 0x040, 0x080, 0x100
"""Error classes, bits of ``can_id``."""
OVERFLOW, WARNING, PASSIVE, ACTIVE = 0x03, 0x0C, 0x30, 0x40
"""Bits of data byte 1 of a controller error, of receiver and transmitter."""

_CLASSES = {
    TX_TIMEOUT: "a frame could not be sent in time",
    LOST_ARBITRATION: "arbitration lost",
    PROTOCOL: "protocol violation",
    TRANSCEIVER: "transceiver fault",
    NO_ACKNOWLEDGE: "nobody acknowledges",
    BUS_ERROR: "bus error",
}


def describe(error: Any) -> tuple[BusState | None, str]:
    """Return the state that the controller enters by one error frame (``None``: no change), and a description."""
    classes = int(error["can_id"]) & 0x1FFFFFFF
    detail = int(error["data"][1]) if classes & CONTROLLER else 0
    if classes & BUS_OFF:
        return "bus_off", "the controller is off the bus (bus-off)"
    if classes & RESTARTED:
        return "restarted", "the controller was restarted after bus-off"
    if detail & PASSIVE:
        return "passive", "the controller is error passive"
    if detail & WARNING:
        return "warning", "the controller has reached its error warning level"
    if detail & ACTIVE:
        return "active", "the controller is error active again"
    texts = [text for bit, text in _CLASSES.items() if classes & bit]
    if detail & OVERFLOW:
        texts.append("overflow in the controller: frames are lost")
    return None, ", ".join(texts) or f"error of class {classes:X}h"


def summarise(errors: Frames) -> list[tuple[BusState | None, str]]:
    """Return state and text of error frames (N,): each change of state in order, then other errors with counts."""
    changes: list[tuple[BusState | None, str]] = []
    counts: dict[str, int] = {}
    for error in errors:
        state, text = describe(error)
        if state is not None:
            changes.append((state, text))
        else:
            counts[text] = counts.get(text, 0) + 1
    return changes + [(None, text if n == 1 else f"{text} ({n} times)") for text, n in counts.items()]
