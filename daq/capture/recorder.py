"""Main loop of a capture: reads the buses, writes and publishes rows, supervises drives, disk and commands."""

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass

import numpy as np

from armident.configs import ArmidentError, SessionConfig
from armident.daq.capture.events import EventHandler
from armident.daq.capture.health import Health
from armident.daq.capture.jitter import SyncJitter, worst
from armident.daq.capture.plan import CapturePlan
from armident.daq.capture.publisher import Publisher
from armident.daq.capture.remote_commands import Command
from armident.daq.capture.setpoint_source import SetpointSchedule, StandstillDetector, plan_setpoints
from armident.daq.capture.sink import Sink
from armident.daq.matching.assembler import LATE_S, Assembler
from armident.drivers.can.frames import BusDown
from armident.drivers.can.receiver import Receiver
from armident.drivers.can.scheduling import raised_priority
from armident.drivers.canopen.emcy_listener import EmcyListener
from armident.drivers.canopen.kernel_sync import KernelSync
from armident.drivers.canopen.master import DriveEvent, DriveMaster
from armident.drivers.canopen.sync_producer import SyncProducer
from armident.drivers.canopen.temperature import TemperaturePoll
from armident.systemd import Notifier

HEALTH_S = 1.0
"""Interval of health reports, s."""
REST_S = 0.01
"""Interval of reads of the buses at the end of a capture, s."""
LAG_LOGGED_S = 0.5
"""Lag of the drives at the end of a capture from which on it is logged, s."""
QUICK_STOP_S = 0.3
"""Time for which the drives stay enabled after a quick stop when no position is received, s."""
STARVED_S = 20.0
"""Longest wait without any frame at the end for drives that all lag, s; less than the time of the watchdog."""
BRAKING_S = 5.0
"""Time for which the drives stay enabled after a quick stop while the arm still moves, s."""
NICENESS_STEPS = 10
"""Steps of niceness by which the thread that reads the buses precedes those that write and publish."""
OUTAGE_S = 5.0
"""Time without a working bus after which a capture ends, s."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Outputs:
    """Destinations of a capture: files, messages with the commands of others, and progress for systemd's watchdog."""

    sink: Sink
    publisher: Publisher
    notifier: Notifier


class Recorder:
    """Main loop of one capture; ``listener`` has emergency messages where it only listens, without a drive master."""

    def __init__(
        self,
        plan: CapturePlan,
        receiver: Receiver,
        listener: EmcyListener | None,
        outputs: Outputs,
        stop: threading.Event,
        save: threading.Event,
    ) -> None:
        self.sink = sink = outputs.sink
        self._plan, self._receiver, self._publisher, self._stop = plan, receiver, outputs.publisher, stop
        self._notifier = outputs.notifier
        session = plan.session
        period_ns, overflow = session.sync.period_us * 1000, session.sync.counter
        self._assembler = Assembler(
            [stream.bus for stream in plan.streams],
            [joint.name for joint in plan.robot.joints],
            period_ns,
            overflow,
            1 if plan.produces_sync else None,
            bus_of=plan.bus_of,
            nodes=plan.sdo_nodes,
        )
        self._assembler.warm_up(receiver.warm_up())
        self._jitters = [SyncJitter(period_ns, overflow) for _ in receiver.channels]
        self._events = EventHandler(plan, self._assembler, sink)
        self.health = Health(plan, self._assembler, receiver, self._jitters, sink, outputs.publisher)
        self.health.punctuality = self._punctuality
        self._producer: SyncProducer | KernelSync | None = None
        self._master: DriveMaster | None = None
        self._reports: DriveMaster | EmcyListener | None = listener
        self._temperatures: TemperaturePoll | None = None
        self._motion: SetpointSchedule | None = None
        self._span: tuple[int, int] | None = None
        self._save = save
        self.between: Callable[[], None] = lambda: None
        """Called between two reads of the buses."""
        self.reload: Callable[[], None] = lambda: None
        """Called when a command requests a reload of the configuration."""
        self._drive_events: deque[DriveEvent] = deque()
        self._watchdog_fed = -math.inf
        self._outage_since: float | None = None
        self._unverified: dict[str, tuple[int, int]] = {}
        self._syncs_unreceived = 0
        self._drain_s = session.recording.drain_ms * 1e-3

    def start(self, stack: ExitStack) -> None:
        """Configure and enable the drives, and start SYNC; the stack stops them when it unwinds."""
        plan, session = self._plan, self._plan.session
        self.health.serve(stack)
        if plan.listen_only:
            return
        self._master = self._reports = stack.enter_context(DriveMaster(session, plan.robot))
        log.info("configuring %d drives on %s", len(session.drives), ", ".join(self._receiver.channels))
        self._master.configure()
        if plan.produces_sync and self._master.sync_counter == 0:
            self._assembler.ignore_counter()
        now = time.time_ns()
        for joint in plan.robot.joints:
            self._assembler.mark_unverified(joint.name, now, now)
        # Another producer of SYNC also moves the arm, and enables the drives.
        self._master.start(enable=plan.produces_sync)
        self._temperatures = stack.enter_context(TemperaturePoll(self._master.drives))
        self.health.temperatures = self._temperatures.celsius
        if plan.trajectory is not None:
            by_joint = dict(zip((d.joint for d in session.drives), self._master.positions(), strict=True))
            actual = np.array([by_joint[joint.name] for joint in plan.robot.joints], dtype=np.int64)
            self._motion = plan_setpoints(session, plan.robot, plan.trajectory, actual)
            self._events.moving = True
        if plan.produces_sync:
            timing = session.sync.period_us, self._master.sync_counter
            if session.sync.source == "kernel":
                self._producer = KernelSync(session.all_buses[0], *timing)
            else:
                self._producer = SyncProducer(session.all_buses, *timing)
                self._assembler.send_times = self._producer.sent_at
            self._producer.start()
            stack.callback(self._producer.stop)

    def change(self, session: SessionConfig) -> None:
        """Apply the read interval and the triggers of a reloaded session."""
        self._drain_s = session.recording.drain_ms * 1e-3
        self._events.change(session)

    def record(self) -> ArmidentError | None:
        """Run the capture to its end; return the error that ended it early, or ``None``."""
        failure: ArmidentError | None = None
        with raised_priority(NICENESS_STEPS):
            try:
                self._start_motion()
                self._loop()
            except ArmidentError as error:
                failure = error
            self._stop_arm(failure is not None or self._stop.is_set() or self._is_interrupted())
            self._mark_end(failure)
        return failure

    def counters(self) -> dict[str, int]:
        """Return all counters of the capture."""
        counters = self._assembler.counters | self._events.counts
        counters["kernel_drops"] = self._receiver.dropped
        counters["error_frames"] = self._receiver.error_frames
        counters["sync_unseen"] = self._syncs_unreceived
        for name, value in worst(self._jitters).items():
            counters[f"sync_jitter_{name.replace('.', '_')}_us"] = round(value)
        return counters | self._punctuality()

    def _punctuality(self) -> dict[str, int]:
        """Return the counters of the own SYNC producer, if it is the loop."""
        if not isinstance(self._producer, SyncProducer):
            return {}
        stats = self._producer.stats()
        return {
            "sync_sent": stats.sent,
            "sync_not_sent": sum(stats.unsent),
            "sync_late_p99_us": round(stats.late_p99_us),
            "sync_late_max_us": round(stats.late_max_us),
            "sync_overruns": stats.overruns,
            "sync_skipped_periods": stats.skipped,
        }

    def _start_motion(self) -> None:
        if isinstance(self._producer, SyncProducer) and self._motion is not None:
            self._span = self._motion.span(self._producer.play(self._motion.plan))
            self.sink.mark("experiment_start", self._span[0])
            self.sink.mark("experiment_end", self._span[1])
            log.info("moving: %.1f s", len(self._motion.plan.rows) * self._motion.plan.every * self._period)

    @property
    def _period(self) -> float:
        return self._plan.session.sync_period

    def _last_sync_wanted(self) -> float:
        """Return the number of the SYNC after which the capture ends by itself."""
        wanted = float("inf")
        if self._plan.duration is not None:
            wanted = round(self._plan.duration / self._period) - 1
        if self._producer is not None and self._motion is not None and self._span is not None:
            plan = self._motion.plan
            wanted = min(wanted, self._span[1] + (len(plan.rows) - 1 - self._motion.last) * plan.every)
        return wanted

    def _is_interrupted(self) -> bool:
        """Return True if the capture ends before the motion does."""
        return self._motion is not None and self._span is not None and self._assembler.last_sync < self._span[1]

    def _loop(self) -> None:
        last = self._last_sync_wanted()
        if isinstance(self._producer, SyncProducer) and self._motion is None and math.isfinite(last):
            # The producer counts the SYNCs itself: this loop may be late, and the lag of the drives would grow.
            # Not for a moving arm: to enabled drives and to the guard, a missing SYNC is a failure of the master.
            self._producer.stop_after(round(last) + 1)
        due = reported = time.monotonic()
        deadline = None if self._plan.duration is None else due + self._plan.duration
        while not self._stop.is_set() and self._assembler.last_sync < last:
            due = max(due + self._drain_s, time.monotonic())
            time.sleep(max(0.0, due - time.monotonic()))
            sent = self._producer.sent if self._producer is not None else None
            self._drain()
            self._supervise()
            if sent is not None and sent > last:
                # All SYNCs were sent, even if the kernel dropped the last ones on their way back.
                break
            now = time.monotonic()
            if now - reported >= HEALTH_S:
                self._events.check_mappings()
                self.health.report(now - reported, self._events.counts)
                reported = now
            if deadline is not None and now > deadline and self._events.sync_stopped:
                log.info("the duration is over, and SYNC has stopped: the capture ends")
                break
            if deadline is not None and now > deadline and self._assembler.last_sync < 0:
                names = ", ".join(self._receiver.channels)
                raise ArmidentError(f"bus {names}: no SYNC within {self._plan.duration:g} s")

    def _drain(self) -> int:
        total = 0
        self._update_unverified()
        for bus, frames, dropped in self._receiver.drain():
            if dropped and self._master is not None:
                # A write to a mapping may be among the dropped frames.
                self._master.collect_reports()
                self._update_unverified()
            sent = self._producer.sent if self._producer is not None else None
            self._jitters[bus].take(frames)
            self.sink.take(self._assembler.push(frames, sent, dropped, bus))
            self._mark_start()
            total += frames.size
        # Own SYNCs are received as well: without any, the bus or this process has failed. A foreign SYNC may pause.
        if (total or self._producer is None) and time.monotonic() - self._watchdog_fed >= HEALTH_S:
            self._watchdog_fed = time.monotonic()
            self._notifier.progress(f"SYNC {self._assembler.last_sync}")
        return total

    def _update_unverified(self) -> None:
        """Pass the drives whose mapping is unverified from the master to the assembler."""
        if self._master is None or self._master.unverified_mapping is self._unverified:
            return
        before, self._unverified = self._unverified, self._master.unverified_mapping
        for joint, span in self._unverified.items():
            if before.get(joint) != span:
                self._assembler.mark_unverified(joint, *span)

    def _supervise(self) -> None:
        """Check buses, SYNC and drives; a failure while the arm moves ends the capture."""
        for event in self._receiver.events():
            self._events.on_bus_event(event)
        if not self._plan.produces_sync:
            self._events.check_sync(time.monotonic())
        self._handle_requests()
        try:
            if self._producer is not None:
                self._producer.check()
            self._handle_drive_events()
            if self._receiver.all_down_s:
                raise BusDown(f"bus {', '.join(self._receiver.channels)}: the interface went down and stays down")
            self._outage_since = None
        except BusDown:
            now = time.monotonic()
            self._outage_since = now if self._outage_since is None else self._outage_since
            if self._events.moving or now - self._outage_since > OUTAGE_S:
                raise

    def _handle_drive_events(self) -> None:
        """Handle the events of drives, each once, even if one of them ends the capture."""
        if self._reports is not None:
            self._drive_events += self._reports.supervise()
        while self._drive_events:
            self._events.on_drive_event(self._drive_events.popleft())

    def _handle_requests(self) -> None:
        """Carry out commands from Zenoh and SIGUSR1."""
        commands = self._publisher.commands.pending()
        if self._save.is_set():
            self._save.clear()
            commands.append(Command("save", "SIGUSR1"))
        self.between()
        for command in commands:
            if command.name == "reload":
                self.reload()
                continue
            if command.name == "stop":
                log.info("stopped by a command")
                self._stop.set()
                continue
            text = command.text if command.name == "mark" else f"save: {command.text}".rstrip(": ")
            self.sink.mark("note", max(self._assembler.last_sync, 0), text)
            if command.name == "save" and "command" in self._events.triggers:
                self.sink.trigger()

    def _mark_start(self) -> None:
        if self._span is None and self._motion is None and self.sink.first_sync is not None:
            self._span = self.sink.first_sync, -1
            self.sink.mark("experiment_start", self.sink.first_sync)

    def _stop_arm(self, early: bool) -> None:
        """Stop the arm, then SYNC, receive the last answers and disable the drives; never raises."""
        if self._temperatures is not None:
            self._temperatures.stop()
        with suppress(ArmidentError):
            if self._master is not None and early and self._motion is not None:
                self._master.quick_stop()
                self._await_standstill()
        if self._producer is not None:
            self._producer.stop()
        with suppress(ArmidentError):
            self._await_answers()
        self._events.moving = False
        for event in self._receiver.events(last=True):
            self._events.on_bus_event(event)
        with suppress(ArmidentError):
            self._handle_drive_events()
        if self._master is not None:
            self._master.stop()
        self.sink.take(self._assembler.finish(self._total_syncs()))
        self._events.check_mappings()

    def _total_syncs(self) -> int | None:
        """Return the number of SYNCs; of another master an upper bound, if the kernel dropped the last frames."""
        if self._producer is not None:
            return self._producer.sent
        dropped = self._receiver.dropped_behind
        self._syncs_unreceived = self._assembler.most_unreceived(dropped, time.time_ns())
        if self._syncs_unreceived:
            self._events.on_frames_dropped_at_end(sum(dropped), self._syncs_unreceived)
        return self._assembler.last_sync + 1 + self._syncs_unreceived

    def _await_standstill(self) -> None:
        """Record until the arm stands still, at most `BRAKING_S`, or `QUICK_STOP_S` without positions."""
        standstill = StandstillDetector(self._plan.session, self._plan.robot)
        begin = last_s = time.monotonic()
        seen = self.sink.last_sync
        # Positions of drives that lag are from before the quick stop.
        since = (self._producer.sent if self._producer is not None else None) or 0
        while time.monotonic() < min(last_s + QUICK_STOP_S, begin + BRAKING_S):
            time.sleep(REST_S)
            self._drain()
            if self.sink.last_sync > seen and "position" in self.sink.last_raw:
                seen, last_s = self.sink.last_sync, time.monotonic()
                if seen >= since and standstill.update(seen, self.sink.last_raw["position"]):
                    return
        log.info("no standstill detected after the quick stop; the drives are disabled anyway")

    def _await_answers(self) -> None:
        """Record until no answer is outstanding, or none has come for ``LATE_S``."""
        reported = False
        begin = time.monotonic()
        last_s, lost = time.monotonic(), self._events.counts["heartbeat_lost"]
        while True:
            if self._drain():
                last_s = time.monotonic()
            outstanding, silent = self._assembler.outstanding, time.monotonic() - last_s
            if outstanding <= 0 or silent > STARVED_S:
                return
            if self._producer is None and time.monotonic() - begin > LATE_S:
                return
            if silent > LATE_S:
                self._handle_drive_events()
                alive = self._events.counts["heartbeat_lost"] == lost and not self._receiver.all_down_s
                if not (alive and self._assembler.outstanding_by_all):
                    return
            if not reported and outstanding * self._period > LAG_LOGGED_S:
                log.info("the drives are %.1f s behind: waiting for their answers", outstanding * self._period)
                reported = True
            time.sleep(REST_S)

    def _mark_end(self, failure: ArmidentError | None) -> None:
        if self._span is None:
            return
        if self._motion is None:
            self.sink.mark("experiment_end", self.sink.last_sync)
        elif self._span[0] <= self.sink.last_sync < self._span[1]:
            why = str(failure) if failure is not None else "stopped"
            self.sink.move_mark("experiment_end", self.sink.last_sync, f"before its end: {why}")
