"""The command ``armident guard``: monitors the buses, and commands a quick stop of every drive on an alarm."""

import logging
import signal
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from types import FrameType

import numpy as np

from armident.configs import ArmidentError, ConfigError, RobotConfig, SessionConfig, load_robot, load_session
from armident.configs.schema.session import Bus
from armident.daq.guard.monitor import Alarm, MotionMonitor
from armident.daq.guard.motion_limits import FOLLOWING_S, motion_limits_of
from armident.daq.matching.streams import bus_numbers, node_ids
from armident.drivers.can.frames import STANDARD_ID_MASK, BusDown, FrameBus, Frames, frames
from armident.drivers.can.scheduling import set_realtime_priority
from armident.drivers.can.udp import open_bus
from armident.drivers.canopen.objects import COB_SDO_REQUEST, CONTROLWORD, Control, rpdo_cob, stop_rpdo

BATCH = 512
"""Largest number of frames that are received at once."""

POLL_S = 0.02
"""Longest wait for a frame until heartbeats and SYNC are checked, s."""

PAUSE_PERIODS = 0.5
"""Pause between two reads, in SYNC periods: a wake-up for every frame costs several times as much CPU time."""

_SDO_WRITE_TWO_BYTES = 0x2B
"""Command byte of an expedited download of two bytes (CiA 301 section 7.2.4.3.3)."""

_PRIORITY = 60
"""Real-time priority, above that of the SYNC producer."""

log = logging.getLogger(__name__)


def stop_frames(session: SessionConfig, robot: RobotConfig) -> list[Frames]:
    """Return the frames of a quick stop (CiA 402 part 2, controlword 02h) of every drive, for each bus of a session."""
    assert session.setpoints is not None
    word = int(Control.QUICK_STOP).to_bytes(2, "little")
    request = bytes([_SDO_WRITE_TWO_BYTES]) + CONTROLWORD.to_bytes(2, "little") + b"\0" + word + b"\0\0"
    rpdo = stop_rpdo(session.setpoints.rpdo)
    stops = []
    for number, bus in enumerate(session.all_buses):
        drives = zip(node_ids(session, robot), bus_numbers(session, robot), strict=True)
        nodes = [node for node, place in drives if place == number]
        orders = [(rpdo_cob(rpdo, node), word) for node in nodes]
        orders += [(COB_SDO_REQUEST + node, request) for node in nodes]
        out = frames(len(orders), fd=bus.fd)
        for k, (identifier, data) in enumerate(orders):
            out["can_id"][k], out["length"][k] = identifier, len(data)
            out["data"][k, : len(data)] = np.frombuffer(data, np.uint8)
        stops.append(out)
    return stops


class Guard:
    """Monitors the buses of one session, by sockets with the monitor's filters, and stops the drives."""

    def __init__(
        self, buses: Sequence[FrameBus], monitor: MotionMonitor, stops: Sequence[Frames], period: float
    ) -> None:
        self._buses, self._monitor, self._stops, self._pause = buses, monitor, stops, period * PAUSE_PERIODS
        self._batches = [frames(BATCH, fd=bus.fd) for bus in buses]
        self._over = False
        for number, batch in enumerate(self._batches):
            # Compile now, before the arm moves: arrays of one frame have another type (contiguous) than longer ones.
            for size in (1, 2):
                monitor.check(batch[:size], 0, number)

    def stop(self) -> None:
        """Command a quick stop on every bus that is up; may be called from a signal handler."""
        for bus, stops in zip(self._buses, self._stops, strict=True):
            with suppress(BusDown):
                bus.send(stops)
        self._over = True

    def leave(self) -> None:
        """End without a quick stop; may be called from a signal handler."""
        self._over = True

    def run(self) -> Alarm | None:
        """Monitor until an alarm, `stop` or `leave`; return the alarm, after which the drives are stopped."""
        while not self._over:
            alarm, received = None, 0
            for number, batch in enumerate(self._batches):
                # Taken before the frames: otherwise a delay of this process would count as missing heartbeats.
                now = time.monotonic_ns()
                try:
                    got = self._receive(number)
                except BusDown as error:
                    if not self._monitor.armed:
                        raise
                    alarm = Alarm(str(error), -1)
                    break
                received += got
                alarm = self._monitor.check(batch[:got], now, number)
                if alarm is not None:
                    break
            if alarm is not None:
                self.stop()
                if alarm.frame < 0:
                    return alarm
                late = (time.time_ns() - int(batch["t_ns"][alarm.frame])) * 1e-6
                return Alarm(f"{alarm.text}; stop ordered {late:.2f} ms after the frame", alarm.frame)
            if received or len(self._buses) > 1:
                time.sleep(self._pause)
        return None

    def _receive(self, number: int) -> int:
        """Receive frames of a bus; with a single bus wait for them."""
        bus = self._buses[number]
        if len(self._buses) == 1 and not bus.poll(POLL_S):
            return 0
        return bus.receive(self._batches[number])


def guard(config: str, following_s: float = FOLLOWING_S) -> None:
    """Run ``armident guard`` until a signal or an alarm; ``following_s``: time of motion at the velocity limit, s."""
    session = load_session(config)
    robot = load_robot(session.robot)
    try:
        monitor = MotionMonitor(session, robot, motion_limits_of(robot, following_s))
    except ConfigError as error:
        raise ConfigError(f"{config}: {error}") from error
    with ExitStack() as stack:
        buses = [stack.enter_context(_open_bus(bus, monitor, k)) for k, bus in enumerate(session.all_buses)]
        watcher = Guard(buses, monitor, stop_frames(session, robot), session.sync_period)

        stopped = threading.Event()

        def stop(_signal: int, _frame: FrameType | None) -> None:
            watcher.stop()
            stopped.set()

        def leave(_signal: int, _frame: FrameType | None) -> None:
            watcher.leave()

        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, stop)
        signal.signal(signal.SIGUSR1, leave)
        set_realtime_priority(_PRIORITY)
        print(f"guard: ready on {', '.join(bus.channel for bus in buses)}", flush=True)
        alarm = watcher.run()
        if stopped.is_set():
            log.info("guard: quick stop ordered on a signal")
    if alarm is not None:
        raise ArmidentError(f"guard: {alarm.text}; the drives were stopped")


def _open_bus(bus: Bus, monitor: MotionMonitor, number: int) -> FrameBus:
    return open_bus(bus, filters=[(identifier, STANDARD_ID_MASK) for identifier in monitor.identifiers(number)])
