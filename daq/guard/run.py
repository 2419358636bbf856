"""``armident guard``: reads the bus, and orders a quick stop from every drive when something is wrong."""

import ctypes
import os
import signal
import sys
import time
from types import FrameType

import numpy as np

from configs import ArmidentError, ConfigError, RobotConfig, SessionConfig, load_robot, load_session
from daq.guard.limits import FOLLOWING_S, limits_of
from daq.guard.watch import Alarm, Watch
from daq.streams import node_ids
from drivers.frames import FrameBus, Frames, frames
from drivers.objects import COB_MASK, COB_SDO_REQUEST, CONTROLWORD, Control, rpdo_cob, stop_rpdo
from drivers.sync import PR_SET_TIMERSLACK
from drivers.udp import open_bus

BATCH = 512
LOOK_S = 0.02
"""How long the guard sleeps on a silent bus before it looks at the time."""

LOOKS = 0.5
"""Pause between two looks, in SYNC periods: one for every frame would cost several times as much."""

_SDO_WRITE_TWO_BYTES = 0x2B
"""Command byte of an expedited download of two bytes (CiA 301 section 7.2.4.3.3)."""

_PRIORITY = 60
"""Real-time priority, above that of SYNC: what stops an arm comes first."""


def stop_frames(session: SessionConfig, robot: RobotConfig) -> Frames:
    """Frames that order a quick stop (CiA 402 part 2, controlword 02h) from every drive of a session.

    For each drive the RPDO of its controlword, which acts when it arrives, then an SDO for those that have none.
    """
    assert session.setpoints is not None
    nodes = node_ids(session, robot)
    word = int(Control.QUICK_STOP).to_bytes(2, "little")
    request = bytes([_SDO_WRITE_TWO_BYTES]) + CONTROLWORD.to_bytes(2, "little") + b"\0" + word + b"\0\0"
    rpdo = stop_rpdo(session.setpoints.rpdo)
    orders = [(rpdo_cob(rpdo, node), word) for node in nodes] + [(COB_SDO_REQUEST + node, request) for node in nodes]
    out = frames(len(orders))
    for k, (identifier, data) in enumerate(orders):
        out["can_id"][k], out["length"][k] = identifier, len(data)
        out["data"][k, : len(data)] = np.frombuffer(data, np.uint8)
    return out


class Guard:
    """Watches one bus.

    Parameters
    ----------
    bus
        Its socket; everything that ``watch`` asks for is let through.
    watch
        What is wrong.
    orders
        What stops the drives.
    period
        SYNC period, s.
    """

    def __init__(self, bus: FrameBus, watch: Watch, orders: Frames, period: float) -> None:
        self._bus, self._watch, self._orders, self._pause = bus, watch, orders, period * LOOKS
        self._batch = frames(BATCH)
        self._over = False
        watch.look(self._batch[:0], 0)

    def stop(self) -> None:
        """Order the quick stop now; may be called from a signal handler."""
        self._bus.send(self._orders)
        self._over = True

    def leave(self) -> None:
        """End without a word to the drives; for a signal handler, too."""
        self._over = True

    def run(self) -> Alarm | None:
        """Watch until something is wrong (the drives are stopped then), or ``stop`` or ``leave`` was called.

        Raises
        ------
        BusDown
            If the bus went down.
        """
        while not self._over:
            # The time comes first: a guard that was kept waiting must not take that for a silence of the bus.
            now = time.monotonic_ns()
            got = self._bus.receive(self._batch) if self._bus.poll(LOOK_S) else 0
            alarm = self._watch.look(self._batch[:got], now)
            if alarm is not None:
                self._bus.send(self._orders)
                if alarm.frame < 0:
                    return alarm
                late = (time.time_ns() - int(self._batch["t_ns"][alarm.frame])) * 1e-6
                return Alarm(f"{alarm.text}; stop ordered {late:.2f} ms after the frame", alarm.frame)
            if got:
                time.sleep(self._pause)
        return None


def guard(config: str, following_s: float = FOLLOWING_S) -> None:
    """Carry out ``armident guard`` until a signal or an alarm.

    An alarm, SIGINT and SIGTERM stop the drives. SIGUSR1 ends it quietly: the motion is over.

    Raises
    ------
    ConfigError
        If the session moves nothing, or its bus is not there.
    ArmidentError
        If it had to stop the drives; says why.
    """
    session = load_session(config)
    robot = load_robot(session.robot)
    try:
        watch = Watch(session, robot, limits_of(robot, following_s))
    except ConfigError as error:
        raise ConfigError(f"{config}: {error}") from error
    with open_bus(session.bus, filters=[(identifier, COB_MASK) for identifier in watch.identifiers]) as bus:
        watcher = Guard(bus, watch, stop_frames(session, robot), session.sync_period)

        def stop(_signal: int, _frame: FrameType | None) -> None:
            watcher.stop()
            print("guard: quick stop ordered on a signal", file=sys.stderr, flush=True)

        def leave(_signal: int, _frame: FrameType | None) -> None:
            watcher.leave()

        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, stop)
        signal.signal(signal.SIGUSR1, leave)
        _come_first()
        print(f"guard: ready on {session.bus.channel}", flush=True)
        alarm = watcher.run()
    if alarm is not None:
        raise ArmidentError(f"guard: {alarm.text}; the drives were stopped")


def _come_first() -> None:
    """Ask for exact wake-ups and real-time priority; without the right to it the guard runs as everybody else."""
    ctypes.CDLL(None).prctl(PR_SET_TIMERSLACK, 1, 0, 0, 0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
    except OSError:
        return
