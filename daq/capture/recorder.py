"""One capture while it runs: drains the bus, has rows written and published, and watches drives, disk and commands."""

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack, suppress

import numpy as np

from armident.configs import ArmidentError, SessionConfig
from armident.daq.capture.events import EventHandler
from armident.daq.capture.health import Health
from armident.daq.capture.jitter import SyncJitter, worst
from armident.daq.capture.plan import CapturePlan
from armident.daq.capture.publisher import Publisher
from armident.daq.capture.remote_commands import Command
from armident.daq.capture.setpoints import SetpointSchedule, StandstillDetector, plan_setpoints
from armident.daq.capture.sink import Sink
from armident.daq.capture.systemd import Notifier
from armident.daq.matching.assembler import LATE_S, Assembler
from armident.drivers.can.frames import BusDown
from armident.drivers.can.receiver import Receiver
from armident.drivers.can.scheduling import ahead
from armident.drivers.canopen.emcy_listener import Eavesdropper
from armident.drivers.canopen.kernel_sync import KernelSync
from armident.drivers.canopen.master import DriveEvent, DriveMaster
from armident.drivers.canopen.sync_producer import SyncProducer
from armident.drivers.canopen.temperature import TemperaturePoll

HEALTH_S = 1.0
REST_S = 0.01
"""Time between two looks at the buses when the capture comes to its end."""
TELL_BEHIND_S = 0.5
"""Drives that are farther behind than this at the end are worth a line."""
QUICK_STOP_S = 0.3
"""How long an arm of which nothing is heard after a quick stop keeps its drives enabled."""
STARVED_S = 20.0
"""How long the end waits for drives that are all behind, though nothing at all has come; the watchdog waits longer."""
BRAKING_S = 5.0
"""How long it keeps them that is seen to move."""
AHEAD = 10
"""Steps of niceness by which whoever drains the buses comes before the threads that write and publish."""
OUTAGE_S = 5.0
"""A capture ends when no bus has worked for this long."""


class Recorder:
    """The state of one capture while it runs."""

    def __init__(
        self,
        order: CapturePlan,
        receiver: Receiver,
        eavesdropper: Eavesdropper | None,
        sink: Sink,
        publisher: Publisher,
        notifier: Notifier,
        stop: threading.Event,
        save: threading.Event,
        say: Callable[[str], None],
    ) -> None:
        self.sink = sink
        self._order, self._receiver, self._publisher, self._stop, self._say = order, receiver, publisher, stop, say
        self._notifier = notifier
        session = order.session
        period_ns, overflow = session.sync.period_us * 1000, session.sync.counter
        self._assembler = Assembler(
            [stream.bus for stream in order.streams],
            [joint.name for joint in order.robot.joints],
            period_ns,
            overflow,
            1 if order.producing else None,
            bus_of=order.bus_of,
            nodes=order.overheard,
        )
        self._assembler.warm_up(receiver.warm_up())
        self._jitters = [SyncJitter(period_ns, overflow) for _ in receiver.channels]
        self._happenings = EventHandler(order, self._assembler, sink, say)
        self.health = Health(order, self._assembler, receiver, self._jitters, sink, publisher, say)
        self._producer: SyncProducer | KernelSync | None = None
        self._master: DriveMaster | None = None
        self._reports: DriveMaster | Eavesdropper | None = eavesdropper
        self._temperatures: TemperaturePoll | None = None
        self._motion: SetpointSchedule | None = None
        self._span: tuple[int, int] | None = None
        self._save = save
        self.between: Callable[[], None] = lambda: None
        """Called between two looks at the bus."""
        self.reload: Callable[[], None] = lambda: None
        """Called when somebody asks for the configuration to be read again."""
        self._heard: deque[DriveEvent] = deque()
        self._fed = -math.inf
        self._refused: float | None = None
        self._suspect: dict[str, tuple[int, int]] = {}
        self._unseen = 0
        self._drain_s = session.recording.drain_ms * 1e-3

    def start(self, stack: ExitStack) -> None:
        """Configure and enable the drives, and start SYNC; whatever was started is stopped when the stack unwinds."""
        order, session = self._order, self._order.session
        self.health.serve(stack)
        if order.listen_only:
            return
        self._master = self._reports = stack.enter_context(DriveMaster(session, order.robot))
        self._say(f"configuring {len(session.drives)} drives on {', '.join(self._receiver.channels)}")
        self._master.configure()
        # Whoever else produces SYNC also moves the arm.
        now = time.time_ns()
        for joint in order.robot.joints:
            self._assembler.suspect(joint.name, now, now)
        self._master.start(enable=order.producing)
        self._temperatures = stack.enter_context(TemperaturePoll(self._master.drives))
        self.health.temperatures = self._temperatures.celsius
        if order.trajectory is not None:
            by_joint = dict(zip((d.joint for d in session.drives), self._master.positions(), strict=True))
            actual = np.array([by_joint[joint.name] for joint in order.robot.joints], dtype=np.int64)
            self._motion = plan_setpoints(session, order.robot, order.trajectory, actual)
            self._happenings.moving = True
        if order.producing:
            timing = session.sync.period_us, session.sync.counter
            if session.sync.source == "kernel":
                self._producer = KernelSync(session.all_buses[0], *timing)
            else:
                self._producer = SyncProducer(session.all_buses, *timing)
                self._assembler.when_sent = self._producer.sent_at
            self._producer.start()
            stack.callback(self._producer.stop)

    def change(self, session: SessionConfig) -> None:
        """Take over how often the buses are looked at, and what writes a recording."""
        self._drain_s = session.recording.drain_ms * 1e-3
        self._happenings.change(session)

    def record(self) -> ArmidentError | None:
        """Drain, match, write and publish until it is over; what ended it early, if something did."""
        trouble: ArmidentError | None = None
        with ahead(AHEAD):
            try:
                self._play()
                self._loop()
            except ArmidentError as error:
                trouble = error
            self._come_to_rest(trouble is not None or self._stop.is_set() or self._cut_short())
            self._mark_end(trouble)
        return trouble

    def counters(self) -> dict[str, int]:
        """All counts of the capture."""
        counters = self._assembler.counters | self._happenings.counts
        counters["kernel_drops"] = self._receiver.dropped
        counters["error_frames"] = self._receiver.error_frames
        counters["sync_unseen"] = self._unseen
        for name, value in worst(self._jitters).items():
            counters[f"sync_jitter_{name.replace('.', '_')}_us"] = round(value)
        if isinstance(self._producer, SyncProducer):
            stats = self._producer.stats()
            counters |= {
                "sync_sent": stats.sent,
                "sync_not_sent": sum(stats.unsent),
                "sync_late_p99_us": round(stats.late_p99_us),
                "sync_late_max_us": round(stats.late_max_us),
                "sync_overruns": stats.overruns,
                "sync_skipped_periods": stats.skipped,
            }
        return counters

    def _play(self) -> None:
        if isinstance(self._producer, SyncProducer) and self._motion is not None:
            self._span = self._motion.span(self._producer.play(self._motion.plan))
            self.sink.mark("experiment_start", self._span[0])
            self.sink.mark("experiment_end", self._span[1])
            self._say(f"moving: {len(self._motion.plan.rows) * self._motion.plan.every * self._period:.1f} s")

    @property
    def _period(self) -> float:
        return self._order.session.sync_period

    def _last_wanted(self) -> float:
        """Number of the SYNC after which the capture is over by itself."""
        wanted = float("inf")
        if self._order.duration is not None:
            wanted = round(self._order.duration / self._period) - 1
        if self._producer is not None and self._motion is not None and self._span is not None:
            plan = self._motion.plan
            wanted = min(wanted, self._span[1] + (len(plan.rows) - 1 - self._motion.last) * plan.every)
        return wanted

    def _cut_short(self) -> bool:
        """Whether the capture ends in the middle of the motion."""
        return self._motion is not None and self._span is not None and self._assembler.last_sync < self._span[1]

    def _loop(self) -> None:
        last = self._last_wanted()
        if isinstance(self._producer, SyncProducer) and self._motion is None and math.isfinite(last):
            # Who counts SYNCs here may be late; drives that are behind would be so by ever more. Not where an arm
            # moves: enabled drives, and who guards them, take silence for the death of their master.
            self._producer.end_after(round(last) + 1)
        due = reported = time.monotonic()
        deadline = None if self._order.duration is None else due + self._order.duration
        while not self._stop.is_set() and self._assembler.last_sync < last:
            due = max(due + self._drain_s, time.monotonic())
            time.sleep(max(0.0, due - time.monotonic()))
            sent = self._producer.sent if self._producer is not None else None
            self._drain()
            self._watch()
            if sent is not None and sent > last:
                # There are no more, even if the kernel dropped the last ones on their way back.
                break
            now = time.monotonic()
            if now - reported >= HEALTH_S:
                self._happenings.look_for_other_mappings()
                self.health.report(now - reported, self._happenings.counts)
                reported = now
            if deadline is not None and now > deadline and self._assembler.last_sync < 0:
                names = ", ".join(self._receiver.channels)
                raise ArmidentError(f"bus {names}: no SYNC within {self._order.duration:g} s")

    def _drain(self) -> int:
        total = 0
        self._pass_on_suspicions()
        for bus, frames, dropped in self._receiver.drain():
            if dropped and self._master is not None:
                # Whether a mapping was changed meanwhile cannot be seen in these frames.
                self._master.listen()
                self._pass_on_suspicions()
            sent = self._producer.sent if self._producer is not None else None
            self._jitters[bus].take(frames)
            self.sink.take(self._assembler.push(frames, sent, dropped, bus))
            self._mark_start()
            total += frames.size
        # Our own SYNCs come back to us: without any, the bus is dead or we are. A foreign SYNC may rest.
        if (total or self._producer is None) and time.monotonic() - self._fed >= HEALTH_S:
            self._fed = time.monotonic()
            self._notifier.progress(f"SYNC {self._assembler.last_sync}")
        return total

    def _pass_on_suspicions(self) -> None:
        """Tell the assembler whose TPDOs are not to be trusted, where the master says something new."""
        if self._master is None or self._master.suspect is self._suspect:
            return
        before, self._suspect = self._suspect, self._master.suspect
        for joint, span in self._suspect.items():
            if before.get(joint) != span:
                self._assembler.suspect(joint, *span)

    def _watch(self) -> None:
        """Look after buses, SYNC and drives; what fails while we move the arm ends the capture."""
        for happened in self._receiver.events():
            self._happenings.of_bus(happened)
        if not self._order.producing:
            self._happenings.look_for_sync(time.monotonic())
        self._obey()
        try:
            if self._producer is not None:
                self._producer.check()
            self._hear_drives()
            if self._receiver.all_down_s:
                raise BusDown(f"bus {', '.join(self._receiver.channels)}: the interface went down and stays down")
            self._refused = None
        except BusDown:
            now = time.monotonic()
            self._refused = now if self._refused is None else self._refused
            if self._happenings.moving or now - self._refused > OUTAGE_S:
                raise

    def _hear_drives(self) -> None:
        """Take what drives have reported, each once, though one of them may end the capture."""
        if self._reports is not None:
            self._heard += self._reports.supervise()
        while self._heard:
            self._happenings.of_drive(self._heard.popleft())

    def _obey(self) -> None:
        """Do what was asked over Zenoh or by SIGUSR1."""
        asked = self._publisher.commands.pending()
        if self._save.is_set():
            self._save.clear()
            asked.append(Command("save", "SIGUSR1"))
        self.between()
        for command in asked:
            if command.name == "reload":
                self.reload()
                continue
            if command.name == "stop":
                self._say("stopped by a command")
                self._stop.set()
                continue
            text = command.text if command.name == "mark" else f"save: {command.text}".rstrip(": ")
            self.sink.mark("note", max(self._assembler.last_sync, 0), text)
            if command.name == "save" and "command" in self._happenings.triggers:
                self.sink.trigger()

    def _mark_start(self) -> None:
        if self._span is None and self._motion is None and self.sink.first_sync is not None:
            self._span = self.sink.first_sync, -1
            self.sink.mark("experiment_start", self.sink.first_sync)

    def _come_to_rest(self, early: bool) -> None:
        """Stop the arm, then SYNC, take the last answers and disable the drives; never raises."""
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
        self._happenings.moving = False
        for happened in self._receiver.events(last=True):
            self._happenings.of_bus(happened)
        with suppress(ArmidentError):
            self._hear_drives()
        if self._master is not None:
            self._master.stop()
        self.sink.take(self._assembler.finish(self._sent_in_all()))
        self._happenings.look_for_other_mappings()

    def _sent_in_all(self) -> int | None:
        """How many SYNCs there were: ours; of another master at most, where the kernel dropped the last frames."""
        if self._producer is not None:
            return self._producer.sent
        dropped = self._receiver.dropped_behind
        self._unseen = self._assembler.unseen(dropped, time.time_ns())
        if self._unseen:
            self._happenings.of_the_end(sum(dropped), self._unseen)
        return self._assembler.last_sync + 1 + self._unseen

    def _await_standstill(self) -> None:
        """Go on recording until the arm is seen to rest; not for long where nothing is seen of it."""
        standstill = StandstillDetector(self._order.session, self._order.robot)
        begin = heard = time.monotonic()
        seen = self.sink.last_sync
        # What drives that are behind tell of earlier says nothing.
        since = (self._producer.sent if self._producer is not None else None) or 0
        while time.monotonic() < min(heard + QUICK_STOP_S, begin + BRAKING_S):
            time.sleep(REST_S)
            self._drain()
            if self.sink.last_sync > seen and "position" in self.sink.last_raw:
                seen, heard = self.sink.last_sync, time.monotonic()
                if seen >= since and standstill.look(seen, self.sink.last_raw["position"]):
                    return
        self._say("the arm was not seen to come to rest; its drives are disabled all the same")

    def _await_answers(self) -> None:
        """Go on recording until no drive owes an answer, or none has come for ``LATE_S``.

        Where all owe some they are behind together, on a host that is too busy for them: they get ``STARVED_S``, unless
        a heartbeat is missing or no bus works.
        """
        told = False
        heard, lost = time.monotonic(), self._happenings.counts["heartbeat_lost"]
        while True:
            if self._drain():
                heard = time.monotonic()
            owed, silent = self._assembler.owed, time.monotonic() - heard
            if owed <= 0 or silent > STARVED_S:
                return
            if silent > LATE_S:
                self._hear_drives()
                alive = self._happenings.counts["heartbeat_lost"] == lost and not self._receiver.all_down_s
                if not (alive and self._assembler.owed_by_all):
                    return
            if not told and owed * self._period > TELL_BEHIND_S:
                self._say(f"the drives are {owed * self._period:.1f} s behind: waiting for their answers")
                told = True
            time.sleep(REST_S)

    def _mark_end(self, trouble: ArmidentError | None) -> None:
        if self._span is None:
            return
        if self._motion is None:
            self.sink.mark("experiment_end", self.sink.last_sync)
        elif self._span[0] <= self.sink.last_sync < self._span[1]:
            why = str(trouble) if trouble is not None else "stopped"
            self.sink.move_mark("experiment_end", self.sink.last_sync, f"before its end: {why}")
