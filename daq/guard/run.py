"""``armident guard``: reads the buses, and orders a quick stop from every drive when something is wrong."""

import signal
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from types import FrameType

import numpy as np

from armident.configs import ArmidentError, ConfigError, RobotConfig, SessionConfig, load_robot, load_session
from armident.configs.schema.session import Bus
from armident.daq.guard.limits import FOLLOWING_S, limits_of
from armident.daq.guard.monitor import Alarm, Watch
from armident.daq.matching.streams import bus_numbers, node_ids
from armident.drivers.can.frames import STANDARD_ID_MASK, BusDown, FrameBus, Frames, frames
from armident.drivers.can.scheduling import set_realtime_priority
from armident.drivers.can.udp import open_bus
from armident.drivers.canopen.objects import COB_SDO_REQUEST, CONTROLWORD, Control, rpdo_cob, stop_rpdo

BATCH = 512
LOOK_S = 0.02
"""How long the guard sleeps on a silent bus before it looks at the time."""

LOOKS = 0.5
"""Pause between two looks, in SYNC periods: one for every frame would cost several times as much."""

_SDO_WRITE_TWO_BYTES = 0x2B
"""Command byte of an expedited download of two bytes (CiA 301 section 7.2.4.3.3)."""

_PRIORITY = 60
"""Real-time priority, above that of SYNC: what stops an arm comes first."""


def stop_frames(session: SessionConfig, robot: RobotConfig) -> list[Frames]:
    """Frames that order a quick stop (CiA 402 part 2, controlword 02h) from every drive, for each bus of a session.

    For each drive the RPDO of its controlword, which acts when it arrives, then an SDO for those that have none.
    """
    assert session.setpoints is not None
    word = int(Control.QUICK_STOP).to_bytes(2, "little")
    request = bytes([_SDO_WRITE_TWO_BYTES]) + CONTROLWORD.to_bytes(2, "little") + b"\0" + word + b"\0\0"
    rpdo = stop_rpdo(session.setpoints.rpdo)
    found = []
    for number, bus in enumerate(session.all_buses):
        on_it = zip(node_ids(session, robot), bus_numbers(session, robot), strict=True)
        nodes = [node for node, place in on_it if place == number]
        orders = [(rpdo_cob(rpdo, node), word) for node in nodes]
        orders += [(COB_SDO_REQUEST + node, request) for node in nodes]
        out = frames(len(orders), fd=bus.fd)
        for k, (identifier, data) in enumerate(orders):
            out["can_id"][k], out["length"][k] = identifier, len(data)
            out["data"][k, : len(data)] = np.frombuffer(data, np.uint8)
        found.append(out)
    return found


class Guard:
    """Watches the buses of one session.

    Parameters
    ----------
    buses
        Their sockets; everything that ``watch`` asks for is let through.
    watch
        What is wrong.
    orders
        What stops the drives of each bus.
    period
        SYNC period, s.
    """

    def __init__(self, buses: Sequence[FrameBus], watch: Watch, orders: Sequence[Frames], period: float) -> None:
        self._buses, self._watch, self._orders, self._pause = buses, watch, orders, period * LOOKS
        self._batches = [frames(BATCH, fd=bus.fd) for bus in buses]
        self._over = False
        for number, batch in enumerate(self._batches):
            # Compiled before anything moves; arrays of one frame count as contiguous, those of more do not.
            for size in (1, 2):
                watch.look(batch[:size], 0, number)

    def stop(self) -> None:
        """Order the quick stop now, on every bus that is up; may be called from a signal handler."""
        for bus, orders in zip(self._buses, self._orders, strict=True):
            with suppress(BusDown):
                bus.send(orders)
        self._over = True

    def leave(self) -> None:
        """End without a word to the drives; for a signal handler, too."""
        self._over = True

    def run(self) -> Alarm | None:
        """Watch until something is wrong (the drives are stopped then), or ``stop`` or ``leave`` was called.

        Raises
        ------
        BusDown
            If a bus went down while nothing moved.
        """
        while not self._over:
            alarm, heard = None, 0
            for number, batch in enumerate(self._batches):
                # The time comes first: a guard that was kept waiting must not take that for a silence of the bus.
                now = time.monotonic_ns()
                try:
                    got = self._receive(number)
                except BusDown as error:
                    if not self._watch.armed:
                        raise
                    alarm = Alarm(str(error), -1)
                    break
                heard += got
                alarm = self._watch.look(batch[:got], now, number)
                if alarm is not None:
                    break
            if alarm is not None:
                self.stop()
                if alarm.frame < 0:
                    return alarm
                late = (time.time_ns() - int(batch["t_ns"][alarm.frame])) * 1e-6
                return Alarm(f"{alarm.text}; stop ordered {late:.2f} ms after the frame", alarm.frame)
            if heard or len(self._buses) > 1:
                time.sleep(self._pause)
        return None

    def _receive(self, number: int) -> int:
        """Frames of a bus; only where there is but one may the guard wait for them."""
        bus = self._buses[number]
        if len(self._buses) == 1 and not bus.poll(LOOK_S):
            return 0
        return bus.receive(self._batches[number])


def guard(config: str, following_s: float = FOLLOWING_S) -> None:
    """Carry out ``armident guard`` until a signal or an alarm.

    An alarm, SIGINT and SIGTERM stop the drives. SIGUSR1 ends it quietly: the motion is over.

    Raises
    ------
    ConfigError
        If the session moves nothing, or a bus is not there.
    ArmidentError
        If it had to stop the drives; says why.
    """
    session = load_session(config)
    robot = load_robot(session.robot)
    try:
        watch = Watch(session, robot, limits_of(robot, following_s))
    except ConfigError as error:
        raise ConfigError(f"{config}: {error}") from error
    with ExitStack() as stack:
        buses = [stack.enter_context(_opened(bus, watch, k)) for k, bus in enumerate(session.all_buses)]
        watcher = Guard(buses, watch, stop_frames(session, robot), session.sync_period)

        def stop(_signal: int, _frame: FrameType | None) -> None:
            watcher.stop()
            print("guard: quick stop ordered on a signal", file=sys.stderr, flush=True)

        def leave(_signal: int, _frame: FrameType | None) -> None:
            watcher.leave()

        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, stop)
        signal.signal(signal.SIGUSR1, leave)
        set_realtime_priority(_PRIORITY)
        print(f"guard: ready on {', '.join(bus.channel for bus in buses)}", flush=True)
        alarm = watcher.run()
    if alarm is not None:
        raise ArmidentError(f"guard: {alarm.text}; the drives were stopped")


def _opened(bus: Bus, watch: Watch, number: int) -> FrameBus:
    return open_bus(bus, filters=[(identifier, STANDARD_ID_MASK) for identifier in watch.identifiers(number)])
