"""Enabling of one drive through the state machine of CiA 402 (part 2), over SDO."""

import time

from armident.configs.errors import ArmidentError, ConfigError
from armident.drivers.canopen import objects as od
from armident.drivers.canopen.emcy import emcy_text
from armident.drivers.canopen.objects import Control, DriveState
from armident.drivers.canopen.sdo import DriveSdo

ENABLE_TIMEOUT = 3.0
"""Longest wait for a drive to reach the next state of CiA 402, s."""

POLL_INTERVAL = 0.005
"""Interval at which the state is read, s."""

TO_ENABLED: dict[DriveState, tuple[Control, DriveState]] = {
    DriveState.SWITCH_ON_DISABLED: (Control.SHUTDOWN, DriveState.READY),
    DriveState.READY: (Control.SWITCH_ON, DriveState.SWITCHED_ON),
    DriveState.SWITCHED_ON: (Control.ENABLE_OPERATION, DriveState.ENABLED),
    DriveState.QUICK_STOP_ACTIVE: (Control.DISABLE_VOLTAGE, DriveState.SWITCH_ON_DISABLED),
    DriveState.FAULT: (Control.FAULT_RESET, DriveState.SWITCH_ON_DISABLED),
}
"""Command and next state on the way to operation enabled (CiA 402 part 2, state machine)."""

LADDER = (DriveState.SWITCH_ON_DISABLED, DriveState.READY, DriveState.SWITCHED_ON, DriveState.ENABLED)
"""States on the way to operation enabled, in order; some drives pass several of them at one command."""


def read_drive_state(sdo: DriveSdo) -> DriveState | None:
    """State of the drive from its statusword (6041h); ``None`` for a pattern that CiA 402 does not define."""
    return od.drive_state(sdo.read(od.STATUSWORD, 0, "H"))


def hold_position(sdo: DriveSdo) -> None:
    """Command cyclic synchronous position mode and the present position as target, before the drive is enabled.

    The target is not read back: in some drives it follows the position until they are enabled.
    """
    sdo.write(od.MODE_OF_OPERATION, 0, od.CYCLIC_SYNCHRONOUS_POSITION, "b")
    sdo.command(od.TARGET_POSITION, 0, sdo.read(od.POSITION_ACTUAL, 0, "i"), "i")


def enable_drive(sdo: DriveSdo) -> None:
    """Bring one drive from any state of CiA 402 to operation enabled; an ArmidentError names a state that it keeps."""
    state = read_drive_state(sdo)
    while state != DriveState.ENABLED:
        if state not in TO_ENABLED:
            state = _await_state(sdo, DriveState.ENABLED, *TO_ENABLED)
            continue
        control, wanted = TO_ENABLED[state]
        if control == Control.FAULT_RESET:
            # The reset acts on the rising edge of its bit.
            sdo.command(od.CONTROLWORD, 0, Control.DISABLE_VOLTAGE, "H")
        sdo.command(od.CONTROLWORD, 0, control, "H")
        state = _await_state(sdo, *LADDER[LADDER.index(wanted) :])


def _await_state(sdo: DriveSdo, *wanted: DriveState) -> DriveState:
    deadline = time.monotonic() + ENABLE_TIMEOUT
    while (state := read_drive_state(sdo)) not in wanted:
        if time.monotonic() > deadline:
            raise ArmidentError(
                f"{sdo.label}: cannot be enabled: stays in state '{state or 'unknown'}'{_fault_cause(sdo)}, "
                f"expected '{wanted[0]}' within {ENABLE_TIMEOUT:g} s"
            )
        time.sleep(POLL_INTERVAL)
    assert state is not None
    return state


def _fault_cause(sdo: DriveSdo) -> str:
    try:
        code = sdo.read(od.ERROR_CODE, 0, "H")
    except ConfigError:  # optional object
        return ""
    return f" (error {code:04X}h, {emcy_text(code, sdo.emcy_texts)})" if code else ""
