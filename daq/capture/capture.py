"""One capture from the configuration of the drives to the finished recording, and the command ``armident capture``."""

import datetime
import json
import logging
import signal
import sys
import threading
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path

from armident.configs import ArmidentError, SessionConfig
from armident.configs.schema.session import Bus
from armident.daq.capture.host_metadata import host_metadata
from armident.daq.capture.journal import JournalHandler
from armident.daq.capture.plan import CapturePlan, load_plan
from armident.daq.capture.publisher import Publisher
from armident.daq.capture.recorder import Outputs, Recorder
from armident.daq.capture.recording_files import (
    RecordingRetention,
    capture_stamp,
    chunk_duration_ns,
    kept_around,
    limits,
    next_time,
    open_series,
)
from armident.daq.capture.reload import Change, Reloader
from armident.daq.capture.sink import Sink
from armident.daq.logs import log_to
from armident.daq.recording import Mark, QueuedSeries
from armident.daq.streaming import Keys
from armident.drivers.can.frames import FrameBus
from armident.drivers.can.receiver import Receiver
from armident.drivers.can.udp import UDP_WARNING, open_bus
from armident.drivers.canopen.emcy_listener import EmcyListener
from armident.systemd import Notifier

__all__ = ["CapturePlan", "CaptureResult", "capture", "load_plan", "run_capture"]

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class CaptureResult:
    """Result of a capture; ``failure`` is the error of a bus or drive that ended it early."""

    paths: tuple[Path, ...]
    counters: dict[str, int]
    marks: tuple[Mark, ...]
    failure: ArmidentError | None


def capture(
    plan: CapturePlan,
    stop: threading.Event,
    save: threading.Event | None = None,
    reload: threading.Event | None = None,
) -> CaptureResult:
    """Run one capture from the first SDO to the finished file; set ``stop`` to end it."""
    session, robot = plan.session, plan.robot
    now = next_time(plan.directory, robot.name, datetime.datetime.now(datetime.UTC))
    name = f"{robot.name}-{capture_stamp(now)}"
    with ExitStack() as stack:
        receiver = stack.enter_context(Receiver([_opener(bus, k, plan) for k, bus in enumerate(session.all_buses)]))
        # Opened first, so that no emergency message is missed while the rest is prepared.
        listener = stack.enter_context(EmcyListener(session)) if plan.listen_only else None
        stamps = {
            f"timestamps.{channel}": kind
            for channel, kind in zip(receiver.channels, receiver.timestamp_sources, strict=True)
        }
        metadata = host_metadata(now) | {"capture": name, "cell": session.cell} | stamps
        rate = 1.0 / session.sync_period
        notifier = stack.enter_context(closing(Notifier()))
        writer = open_series(session, robot, plan.streams, plan.directory, name, metadata)
        stack.callback(writer.__exit__, None, None, None)
        retention = stack.enter_context(RecordingRetention(session.recording, plan.directory, robot.name))
        try:
            if session.all_buses[0].interface == "udp_multicast":
                log.info(UDP_WARNING)
            publisher = Publisher(session, Keys(session.cell, robot.name), exclusive=not plan.listen_only)
            stack.callback(publisher.close)
            outputs = Outputs(Sink(writer, publisher, plan.streams, name), publisher, notifier)
            recorder = Recorder(plan, receiver, listener, outputs, stop, save or threading.Event())
            recorder.start(stack)
        except BaseException:
            writer.abort()
            raise
        if plan.config is not None:
            changes = (recorder.health.change, recorder.change, publisher.change, _change_limits(writer, retention))
            reloader = stack.enter_context(closing(Reloader(plan.config, plan, changes)))
            _connect(recorder, reloader, reload or threading.Event(), notifier, session.cell)
        recorder.sink.announce(robot, session, rate, metadata)
        trigger = session.recording.trigger
        if trigger is None:
            log.info("recording to %s", writer.path, extra={"event": "capture_start", "file": writer.path})
        else:
            log.info(
                "keeping the last %g s in memory; a file is written on: %s", trigger.before_s, ", ".join(trigger.events)
            )
        notifier.ready(f"{session.cell}: recording")
        failure = recorder.record()
        notifier.stopping()
        counters = recorder.counters()
        recorder.sink.finish(counters)
        if writer.problem is not None:
            log.warning("%d rows not written: %s", writer.lost_rows, writer.problem)
        return CaptureResult(tuple(writer.paths), counters, tuple(recorder.sink.marks), failure)


def _change_limits(writer: QueuedSeries, retention: RecordingRetention) -> Change:
    """Return the function that applies the ``recording`` options of a reloaded session."""

    def change(session: SessionConfig) -> None:
        writer.gather(chunk_duration_ns(session.recording))
        writer.limit(*limits(session.recording))
        if session.recording.trigger is not None:
            writer.keep(*kept_around(session.recording.trigger))
        retention.options = session.recording

    return change


def _connect(recorder: Recorder, reloader: Reloader, requested: threading.Event, notifier: Notifier, cell: str) -> None:
    """Connect signal and command to the reload of the configuration."""

    def reload() -> None:
        notifier.reloading()
        reloader.request()
        notifier.ready(f"{cell}: recording")

    def between() -> None:
        if requested.is_set():
            requested.clear()
            reload()
        reloader.apply()

    recorder.reload, recorder.between = reload, between


def _opener(bus: Bus, number: int, plan: CapturePlan) -> Callable[[], FrameBus]:
    """Return a function that opens a bus for the frames of the capture and the error frames of its controller."""
    return lambda: open_bus(bus, filters=plan.filters(number), errors=True, hardware=True)


def run_capture(
    config: str,
    out: Path | None,
    duration: float | None,
    listen_only: bool,
    as_json: bool,
    sniff_s: float | None = None,
) -> None:
    """Run ``armident capture`` until its end, SIGINT or SIGTERM, and print the paths; times in s."""
    handler = JournalHandler()
    with log_to(handler):
        plan = load_plan(config, out, duration, listen_only, sniff_s)
        handler.fields = {"cell": plan.session.cell, "robot": plan.robot.name}
        stop, save, reload = threading.Event(), threading.Event(), threading.Event()
        signal.signal(signal.SIGUSR1, lambda *_: save.set())
        # SIGHUP of a terminal that is closed ends the capture; that of a service manager asks for a reload.
        on_hangup = stop if sys.stdin is not None and sys.stdin.isatty() else reload
        signal.signal(signal.SIGHUP, lambda *_: on_hangup.set())
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: stop.set())

        result = capture(plan, stop, save, reload)
        rows, gaps = result.counters["samples.rows"], result.counters["samples.in_gaps"]
        drops = result.counters["kernel_drops"]
        fields = {"event": "capture_end", "rows": rows, "rows_in_gaps": gaps, "kernel_drops": drops}
        log.info("recorded %d samples, %d in gaps, %d frames dropped by the kernel", rows, gaps, drops, extra=fields)
    if as_json:
        files = [str(path) for path in result.paths]
        print(json.dumps({"recording": files[-1], "recordings": files, "counters": result.counters}))
    else:
        print(*result.paths, sep="\n")
    sys.stdout.flush()
    if result.failure is not None:
        raise result.failure
