"""The capture daemon: starts the drives, moves them if asked to, and records every SYNC of it."""

import datetime
import json
import signal
import sys
import threading
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path

from armident.configs import ArmidentError, SessionConfig
from armident.configs.schema.session import Bus
from armident.daq.capture.files import (
    RecordingRetention,
    capture_stamp,
    chunk_duration_ns,
    kept_around,
    limits,
    open_series,
)
from armident.daq.capture.host_metadata import host_metadata
from armident.daq.capture.journal import Line, Voice
from armident.daq.capture.plan import CapturePlan, load_plan
from armident.daq.capture.publisher import Publisher
from armident.daq.capture.recorder import Recorder
from armident.daq.capture.reload import Change, Reloader
from armident.daq.capture.sink import Sink
from armident.daq.capture.systemd import Notifier
from armident.daq.recording import Mark, QueuedSeries
from armident.daq.streaming import Keys
from armident.drivers.can.frames import FrameBus
from armident.drivers.can.receiver import Receiver
from armident.drivers.can.udp import NOTE, open_bus
from armident.drivers.canopen.emcy_listener import Eavesdropper

__all__ = ["CapturePlan", "Captured", "capture", "load_plan", "run_capture"]


@dataclass(frozen=True)
class Captured:
    """What a capture left: the finished files in order, its counters and marks, and what ended it early."""

    paths: tuple[Path, ...]
    counters: dict[str, int]
    marks: tuple[Mark, ...]
    trouble: ArmidentError | None


def capture(
    order: CapturePlan,
    stop: threading.Event,
    say: Callable[[str], None],
    save: threading.Event | None = None,
    reload: threading.Event | None = None,
) -> Captured:
    """Run one capture from the first SDO to the finished file.

    Parameters
    ----------
    order
        What to capture.
    stop
        Set it to end the capture; the file is finished all the same.
    say
        Takes lines that tell how it goes.
    save
        Set it to have the last seconds written, where only events are.
    reload
        Set it to have the configuration read again, where the order has a file.

    Returns
    -------
    Captured
        With ``trouble`` if the bus or a drive failed on the way; the recording is finished then too.

    Raises
    ------
    ConfigError
        If it could not start: bus, drives, mapping, disk, Zenoh. Nothing is left behind then.
    """
    session, robot = order.session, order.robot
    now = datetime.datetime.now(datetime.UTC)
    name = f"{robot.name}-{capture_stamp(now)}"
    with ExitStack() as stack:
        receiver = stack.enter_context(Receiver([_opener(bus, k, order) for k, bus in enumerate(session.all_buses)]))
        # Nothing that drives report is missed while the rest is made ready.
        eavesdropper = stack.enter_context(Eavesdropper(session)) if order.listen_only else None
        stamps = {
            f"timestamps.{channel}": kind for channel, kind in zip(receiver.channels, receiver.stamps, strict=True)
        }
        metadata = host_metadata(now) | {"capture": name, "cell": session.cell} | stamps
        rate = 1.0 / session.sync_period
        notifier = stack.enter_context(closing(Notifier()))
        writer = open_series(session, robot, order.streams, order.directory, name, metadata)
        stack.callback(writer.__exit__, None, None, None)
        tidiness = stack.enter_context(RecordingRetention(session.recording, order.directory, robot.name, say))
        try:
            if session.all_buses[0].interface == "udp_multicast":
                say(NOTE)
            publisher = Publisher(session, Keys(session.cell, robot.name))
            stack.callback(publisher.close)
            run = Recorder(
                order,
                receiver,
                eavesdropper,
                Sink(writer, publisher, order.streams, name),
                publisher,
                notifier,
                stop,
                save or threading.Event(),
                say,
            )
            run.start(stack)
        except BaseException:
            writer.abort()
            raise
        if order.config is not None:
            changes = (run.health.change, run.change, publisher.change, _exchange_limits(writer, tidiness))
            reloader = stack.enter_context(closing(Reloader(order.config, order, changes, say)))
            _connect(run, reloader, reload or threading.Event(), notifier, session.cell)
        run.sink.announce(robot, session, rate, metadata)
        trigger = session.recording.trigger
        if trigger is None:
            say(Line(f"recording to {writer.path}", event="capture_start", file=writer.path))
        else:
            say(f"keeping the last {trigger.before_s:g} s; written on {', '.join(trigger.events)}")
        notifier.ready(f"{session.cell}: recording")
        trouble = run.record()
        notifier.stopping()
        counters = run.counters()
        run.sink.finish(counters)
        if writer.problem is not None:
            say(f"warning: {writer.lost_rows} rows not written: {writer.problem}")
        return Captured(tuple(writer.paths), counters, tuple(run.sink.marks), trouble)


def _exchange_limits(writer: QueuedSeries, tidiness: RecordingRetention) -> Change:
    """Changes how often rows are written, when files are full, how long they are kept, and how much around an event."""

    def change(session: SessionConfig) -> None:
        writer.gather(chunk_duration_ns(session.recording))
        writer.limit(*limits(session.recording))
        if session.recording.trigger is not None:
            writer.keep(*kept_around(session.recording.trigger))
        tidiness.options = session.recording

    return change


def _connect(run: Recorder, reloader: Reloader, asked: threading.Event, notifier: Notifier, cell: str) -> None:
    """Have a capture read its configuration again when it is asked to, by signal or by command."""

    def ask() -> None:
        notifier.reloading()
        reloader.ask()
        notifier.ready(f"{cell}: recording")

    def between() -> None:
        if asked.is_set():
            asked.clear()
            ask()
        reloader.apply()

    run.reload, run.between = ask, between


def _opener(bus: Bus, number: int, order: CapturePlan) -> Callable[[], FrameBus]:
    """Opens one bus for what the capture wants of it, and for what its controller reports."""
    return lambda: open_bus(bus, filters=order.filters(number), errors=True, hardware=True)


def run_capture(
    config: str,
    out: Path | None,
    duration: float | None,
    listen_only: bool,
    as_json: bool,
    sniff_s: float | None = None,
) -> None:
    """``armident capture``: runs until it is over, SIGINT or SIGTERM, and tells how it went.

    Raises
    ------
    ConfigError
        If it could not start.
    ArmidentError
        If the bus or a drive failed on the way; the file is finished then too.
    """
    say = Voice({})
    order = load_plan(config, out, duration, listen_only, sniff_s, say)
    say.fields = {"cell": order.session.cell, "robot": order.robot.name}
    stop, save, reload = threading.Event(), threading.Event(), threading.Event()
    signal.signal(signal.SIGUSR1, lambda *_: save.set())
    # A terminal that is closed says the same as a service manager that wants a reload.
    hung_up = stop if sys.stdin is not None and sys.stdin.isatty() else reload
    signal.signal(signal.SIGHUP, lambda *_: hung_up.set())
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())

    done = capture(order, stop, say, save, reload)
    rows, gaps = done.counters["samples.rows"], done.counters["samples.in_gaps"]
    drops = done.counters["kernel_drops"]
    text = f"recorded {rows} samples, {gaps} in gaps, {drops} frames dropped by the kernel"
    say(Line(text, event="capture_end", rows=rows, rows_in_gaps=gaps, kernel_drops=drops))
    if as_json:
        files = [str(path) for path in done.paths]
        print(json.dumps({"recording": files[-1], "recordings": files, "counters": done.counters}))
    else:
        print(*done.paths, sep="\n")
    sys.stdout.flush()
    if done.trouble is not None:
        raise done.trouble
