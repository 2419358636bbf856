"""State machine of a drive (CiA 402 part 2): statusword by state, and next state by controlword."""

from armident.drivers.canopen.objects import STATE_CODES, Control, DriveState

VOLTAGE_ENABLED = 0x0010
REMOTE = 0x0200
FOLLOWS_COMMAND = 0x1000
MOVING = (DriveState.ENABLED, DriveState.QUICK_STOP_ACTIVE)
"""States in which the motor is controlled and its brake open."""


def statusword(state: DriveState) -> int:
    """Statusword (6041h) of a drive in cyclic synchronous position mode."""
    word = STATE_CODES[state][1] | REMOTE
    if state is not DriveState.SWITCH_ON_DISABLED:
        word |= VOLTAGE_ENABLED
    if state is DriveState.ENABLED:
        word |= FOLLOWS_COMMAND
    if state in (DriveState.READY, DriveState.SWITCHED_ON, DriveState.ENABLED):
        word |= 0x20
    return word


def next_state(state: DriveState, control: int, before: int) -> DriveState:
    """State of a drive after a controlword (6040h) that follows another."""
    if state is DriveState.FAULT:
        rising = control & Control.FAULT_RESET and not before & Control.FAULT_RESET
        return DriveState.SWITCH_ON_DISABLED if rising else state
    voltage, no_quick_stop, switch_on, enable = (control & bit for bit in (0x02, 0x04, 0x01, 0x08))
    stopping = state is DriveState.QUICK_STOP_ACTIVE
    if not voltage:
        return DriveState.SWITCH_ON_DISABLED
    if not no_quick_stop:
        return DriveState.QUICK_STOP_ACTIVE if state in MOVING else DriveState.SWITCH_ON_DISABLED
    if not switch_on:
        return state if stopping else DriveState.READY
    if state is DriveState.SWITCH_ON_DISABLED:
        return state
    if enable:
        return DriveState.ENABLED
    return state if stopping else DriveState.SWITCHED_ON
