"""One capture while it runs: drains the bus, has rows written and published, and watches drives, disk and commands."""

import math
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from configs import ArmidentError, RobotConfig, SessionConfig, Trajectory
from daq.assembler import LATE_S, Assembler
from daq.metrics import Metrics, Value
from daq.motion import Motion, plan_motion
from daq.publisher import Publisher
from daq.remote import Command
from daq.sink import Sink
from daq.storage import free_space
from daq.streams import CapturedStream
from daq.systemd import Notifier
from drivers.frames import FrameBus, frames
from drivers.master import DriveMaster
from drivers.sync import SyncProducer

BATCH = 4096
DRAINS = 16
"""Batches taken in a row before anything else is looked at."""
HEALTH_S = 1.0
REST_S = 0.01
"""Time between two looks at the bus when the capture comes to its end."""
TELL_BEHIND_S = 0.5
"""Drives that are farther behind than this at the end are worth a line."""
QUICK_STOP_S = 0.3
"""How long a quick stop is given before the drives are disabled."""


@dataclass(frozen=True)
class Order:
    """What is to be captured, checked before anything is touched."""

    session: SessionConfig
    robot: RobotConfig
    streams: tuple[CapturedStream, ...]
    trajectory: Trajectory | None
    directory: Path
    duration: float | None = None
    listen_only: bool = False

    @property
    def producing(self) -> bool:
        """Whether we send SYNC."""
        return self.session.sync.role == "producer" and not self.listen_only


class Recorder:
    """The state of one capture while it runs."""

    def __init__(
        self,
        order: Order,
        bus: FrameBus,
        sink: Sink,
        publisher: Publisher,
        notifier: Notifier,
        stop: threading.Event,
        save: threading.Event,
        say: Callable[[str], None],
    ) -> None:
        self.sink = sink
        self._order, self._bus, self._publisher, self._stop, self._say = order, bus, publisher, stop, say
        self._notifier = notifier
        session = order.session
        self._assembler = Assembler(
            [stream.bus for stream in order.streams],
            [joint.name for joint in order.robot.joints],
            session.sync.period_us * 1000,
            session.sync.counter,
            1 if order.producing else None,
        )
        self._batch = frames(BATCH)
        self._assembler.warm_up(self._batch[:2])
        self._producer: SyncProducer | None = None
        self._master: DriveMaster | None = None
        self._motion: Motion | None = None
        self._metrics: Metrics | None = None
        self._span: tuple[int, int] | None = None
        self._frames_before = 0
        self._events = {"emcy": 0, "heartbeat_lost": 0}
        self._triggers = () if session.recording.trigger is None else session.recording.trigger.events
        self._save = save
        self._fed = -math.inf
        self._lost_rows = 0
        self._writing = True

    def start(self, stack: ExitStack) -> None:
        """Configure and enable the drives, and start SYNC; whatever was started is stopped when the stack unwinds."""
        order, session = self._order, self._order.session
        options = session.metrics
        if options.port is not None:
            labels = {"cell": session.cell, "robot": order.robot.name}
            self._metrics = stack.enter_context(Metrics(options.address, options.port, labels))
            self._say(f"metrics on http://{options.address}:{self._metrics.port}/metrics")
        if order.listen_only:
            return
        self._master = stack.enter_context(DriveMaster(session, order.robot))
        self._say(f"configuring {len(session.drives)} drives on {session.bus.channel}")
        self._master.configure()
        # Whoever else produces SYNC also moves the arm.
        self._master.start(enable=order.producing)
        if order.trajectory is not None:
            by_joint = dict(zip((d.joint for d in session.drives), self._master.positions(), strict=True))
            actual = np.array([by_joint[joint.name] for joint in order.robot.joints], dtype=np.int64)
            self._motion = plan_motion(session, order.robot, order.trajectory, actual)
        if order.producing:
            self._producer = SyncProducer(session.bus, session.sync.period_us, session.sync.counter)
            self._producer.start()
            stack.callback(self._producer.stop)

    def record(self) -> ArmidentError | None:
        """Drain, match, write and publish until it is over; what ended it early, if something did."""
        trouble: ArmidentError | None = None
        try:
            self._play()
            self._loop()
        except ArmidentError as error:
            trouble = error
        self._come_to_rest(trouble is not None or self._stop.is_set())
        self._mark_end(trouble)
        return trouble

    def counters(self) -> dict[str, int]:
        """All counts of the capture."""
        counters = self._assembler.counters | self._events
        counters["kernel_drops"] = self._bus.dropped
        if self._producer is not None:
            stats = self._producer.stats()
            counters |= {
                "sync_sent": stats.sent,
                "sync_late_p99_us": round(stats.late_p99_us),
                "sync_late_max_us": round(stats.late_max_us),
                "sync_overruns": stats.overruns,
                "sync_skipped_periods": stats.skipped,
            }
        return counters

    def _play(self) -> None:
        if self._producer is not None and self._motion is not None:
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

    def _loop(self) -> None:
        last, drain = self._last_wanted(), self._order.session.recording.drain_ms * 1e-3
        due = reported = time.monotonic()
        deadline = None if self._order.duration is None else due + self._order.duration
        while not self._stop.is_set() and self._assembler.last_sync < last:
            due = max(due + drain, time.monotonic())
            time.sleep(max(0.0, due - time.monotonic()))
            self._drain()
            self._watch()
            now = time.monotonic()
            if now - reported >= HEALTH_S:
                self._report_health(now - reported)
                reported = now
            if deadline is not None and now > deadline and self._assembler.last_sync < 0:
                raise ArmidentError(f"bus {self._bus.channel}: no SYNC within {self._order.duration:g} s")

    def _drain(self) -> int:
        total = 0
        # Bounded, so that a bus faster than we are cannot keep the capture from ending.
        for _ in range(DRAINS):
            before = self._bus.dropped
            got = self._bus.receive(self._batch)
            sent = self._producer.sent if self._producer is not None else None
            if got:
                self.sink.take(self._assembler.push(self._batch[:got], sent, self._bus.dropped > before))
                self._mark_start()
            total += got
            if got < BATCH:
                break
        # Our own SYNCs come back to us: without any, the bus is dead or we are. A foreign SYNC may rest.
        if (total or self._producer is None) and time.monotonic() - self._fed >= HEALTH_S:
            self._fed = time.monotonic()
            self._notifier.progress(f"SYNC {self._assembler.last_sync}")
        return total

    def _watch(self) -> None:
        """Look after SYNC and drives; a drive that fails while we move the arm ends the capture."""
        if self._producer is not None:
            self._producer.check()
        self._obey()
        for event in self._master.supervise() if self._master is not None else ():
            if event.kind in ("emcy", "heartbeat_lost"):
                self._events[event.kind] += 1
                self.sink.mark(event.kind, max(self._assembler.last_sync, 0), event.text)
            else:
                self.sink.mark("note", max(self._assembler.last_sync, 0), event.text)
            self._say(event.text)
            if event.kind in self._triggers:
                self.sink.trigger()
            failed = event.kind == "heartbeat_lost" or (event.kind == "emcy" and event.code != 0)
            if failed and self._motion is not None:
                raise ArmidentError(f"{event.text}; the arm was stopped")

    def _obey(self) -> None:
        """Do what was asked over Zenoh or by SIGUSR1."""
        asked = self._publisher.commands.pending()
        if self._save.is_set():
            self._save.clear()
            asked.append(Command("save", "SIGUSR1"))
        for command in asked:
            if command.name == "stop":
                self._say("stopped by a command")
                self._stop.set()
                continue
            text = command.text if command.name == "mark" else f"save: {command.text}".rstrip(": ")
            self.sink.mark("note", max(self._assembler.last_sync, 0), text)
            if command.name == "save" and "command" in self._triggers:
                self.sink.trigger()

    def _mark_start(self) -> None:
        if self._span is None and self._motion is None and self.sink.first_sync is not None:
            self._span = self.sink.first_sync, -1
            self.sink.mark("experiment_start", self.sink.first_sync)

    def _come_to_rest(self, early: bool) -> None:
        """Stop the arm, then SYNC, take the last answers and disable the drives; never raises."""
        with suppress(ArmidentError):
            if self._master is not None and early and self._motion is not None:
                self._master.quick_stop()
                self._rest(QUICK_STOP_S)
        if self._producer is not None:
            self._producer.stop()
        with suppress(ArmidentError):
            self._await_answers()
        if self._master is not None:
            self._master.stop()
        sent = self._producer.sent if self._producer is not None else None
        self.sink.take(self._assembler.finish(sent))

    def _rest(self, seconds: float) -> None:
        """Go on recording for so long."""
        until = time.monotonic() + seconds
        self._drain()
        while time.monotonic() < until:
            time.sleep(min(REST_S, max(0.0, until - time.monotonic())))
            self._drain()

    def _await_answers(self) -> None:
        """Go on recording until no drive owes an answer, or none has come for ``LATE_S``."""
        told = False
        until = time.monotonic() + LATE_S
        while True:
            if self._drain():
                until = time.monotonic() + LATE_S
            owed = self._assembler.owed
            if owed == 0 or time.monotonic() > until:
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

    def _tell_of_disk(self) -> None:
        """Say it when the disk begins to refuse rows, and when it takes them again."""
        lost, before = self.sink.lost_rows, self._lost_rows
        self._lost_rows = lost
        if lost > before and self._writing:
            self._say(f"warning: rows are not being written, streaming goes on: {self.sink.problem}")
        elif lost == before and not self._writing:
            self._say(f"writing again; {lost} rows were not written")
        self._writing = lost == before

    def _report_health(self, seconds: float) -> None:
        counters = self._assembler.counters
        rate = (counters["frames"] - self._frames_before) / seconds
        self._frames_before = counters["frames"]
        self._tell_of_disk()
        health: dict[str, Value] = {
            "file": None if self.sink.path is None else self.sink.path.name,
            "rows_not_written": self.sink.lost_rows,
            "sync": self._assembler.last_sync,
            "frames": counters["frames"],
            "frames_per_s": round(rate, 1),
            "rows": counters["samples.rows"],
            "rows_in_gaps": counters["samples.in_gaps"],
            "kernel_drops": self._bus.dropped,
            "answers_owed": self._assembler.owed,
            "queue_depth": self._publisher.depth,
            "disk_free_bytes": free_space(self._order.directory),
            "blocks_dropped": self._publisher.dropped,
            **self._events,
        }
        self._publisher.health(health)
        if self._metrics is not None:
            self._metrics.update(health)
        self._publisher.status({"state": "recording", "sync": self._assembler.last_sync})
