"""Health of a capture, once a second: a Zenoh message, Prometheus metrics, and warnings about the disk."""

import logging
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Protocol

from armident.configs import SessionConfig
from armident.configs.schema.session import MetricsOptions
from armident.daq.capture.capture_metrics import CAPTURE
from armident.daq.capture.jitter import SyncJitter, worst
from armident.daq.capture.plan import CapturePlan
from armident.daq.capture.publisher import Publisher
from armident.daq.capture.recording_files import free_space
from armident.daq.capture.sink import Sink
from armident.daq.identity.plant import certificate_ends
from armident.daq.matching.assembler import Assembler
from armident.daq.recording.clock import clock_state
from armident.drivers.can.receiver import Receiver
from armident.drivers.canopen.bus_load import busy_seconds, worst_load
from armident.metrics import MetricsExporter, Value

WARNED_SHARE = 0.1
"""Share of the memory for waiting rows from which a warning is logged; nothing is lost before the memory is full.

At 0.1 of the default memory, a disk that writes nothing has stalled for half a minute; five minutes remain to act.
"""

log = logging.getLogger(__name__)


class _Writer(Protocol):
    """Properties of a writer of rows that :class:`DiskCheck` reads."""

    @property
    def lost_rows(self) -> int: ...

    @property
    def waiting_rows(self) -> int: ...

    @property
    def waiting_share(self) -> float: ...

    @property
    def problem(self) -> str | None: ...


class DiskCheck:
    """Logs when the disk refuses rows or leaves too many rows waiting, and when that is over."""

    def __init__(self, writer: _Writer) -> None:
        self._writer = writer
        self._lost_rows = 0
        self._refuses = self._slow = False

    def update(self) -> None:
        """Compare the state of the writer with that of the last call."""
        lost, before = self._writer.lost_rows, self._lost_rows
        if lost > before and not self._refuses:
            log.warning("rows cannot be written, streaming continues: %s", self._writer.problem)
        elif lost == before and self._refuses:
            log.info("rows are written again; %d rows were lost", lost)
        self._lost_rows, self._refuses = lost, lost > before
        share = self._writer.waiting_share
        if share > WARNED_SHARE and not self._slow:
            log.warning(
                "%d rows wait for the disk, %.0f %% of the memory for them: rows are lost when it is full."
                " Check the disk and the load of the processor.",
                self._writer.waiting_rows,
                100 * share,
            )
        elif share <= WARNED_SHARE and self._slow:
            log.info("the disk keeps up again; %d rows wait for it", self._writer.waiting_rows)
        self._slow = share > WARNED_SHARE


class Health:
    """Reports on one capture: counters of its parts and the state of its files."""

    def __init__(
        self,
        plan: CapturePlan,
        assembler: Assembler,
        receiver: Receiver,
        jitters: list[SyncJitter],
        sink: Sink,
        publisher: Publisher,
    ) -> None:
        self._plan, self._assembler, self._receiver, self._jitters = plan, assembler, receiver, jitters
        self._sink, self._publisher = sink, publisher
        self._metrics: MetricsExporter | None = None
        self._options = plan.session.metrics
        self.temperatures: Callable[[], dict[str, float]] = dict
        """Returns the temperature of each joint's drive (degrees Celsius) where it is known."""
        self.punctuality: Callable[[], dict[str, int]] = dict
        """Returns the counters of the own SYNC producer, if there is one."""
        self._frames_before = 0
        # Not every second: the bits of all SYNCs are counted.
        self._planned: Value = {
            (bus.channel,): worst_load(plan.session, bus) for bus in plan.session.all_buses if bus.bitrate
        }
        self._busy: tuple[float, dict[str, float]] = time.monotonic(), {}
        self._disk = DiskCheck(sink)

    def serve(self, stack: ExitStack) -> None:
        """Serve metrics if the session configures a port, until the stack unwinds."""
        stack.callback(self._exchange, None)
        self._exchange(self._opened(self._options))

    def change(self, session: SessionConfig) -> None:
        """Apply port and address of a reloaded session; if the port cannot be opened, the former one stays."""
        options, before = session.metrics, self._options
        if (options.address, options.port) != (before.address, before.port):
            fresh = self._opened(options)
            # Not here: closing the former server waits for its thread.
            threading.Thread(target=self._exchange, args=(fresh,), name="metrics", daemon=True).start()
        self._options = options

    def _opened(self, options: MetricsOptions) -> MetricsExporter | None:
        exporter = MetricsExporter(CAPTURE, (self._plan.session.cell, self._plan.robot.name))
        return None if options.port is None else exporter.serve(options.address, options.port)

    def _exchange(self, fresh: MetricsExporter | None) -> None:
        old, self._metrics = self._metrics, fresh
        if old is not None:
            old.close()

    def report(self, seconds: float, events: dict[str, int]) -> None:
        """Publish the state of the capture, with rates over the ``seconds`` since the last report."""
        counters = self._assembler.counters
        rate = (counters["frames"] - self._frames_before) / seconds
        self._frames_before = counters["frames"]
        self._disk.update()
        health: dict[str, float | str | None] = {
            "file": None if self._sink.path is None else self._sink.path.name,
            "rows_not_written": self._sink.lost_rows,
            "rows_waiting": self._sink.waiting_rows,
            "sync": self._assembler.last_sync,
            "frames": counters["frames"],
            "frames_per_s": round(rate, 1),
            "rows": counters["samples.rows"],
            "rows_in_gaps": counters["samples.in_gaps"],
            "kernel_drops": self._receiver.dropped,
            "error_frames": self._receiver.error_frames,
            "buses_down": sum(self._receiver.down),
            "tpdo_late": counters["tpdo_late"],
            "answers_owed": self._assembler.outstanding,
            "queue_depth": self._publisher.depth,
            "disk_free_bytes": free_space(self._plan.directory),
            "blocks_dropped": self._publisher.dropped,
            "events_dropped": self._publisher.events_dropped,
            "zenoh_open": int(self._publisher.is_open),
            "zenoh_problem": self._publisher.problem,
            **_clock(),
            **{f"temperature_{joint}_c": round(celsius, 2) for joint, celsius in self.temperatures().items()},
            **self.punctuality(),
            **events,
        }
        for name, value in worst(self._jitters).items():
            health[f"sync_jitter_{name.replace('.', '_')}_us"] = round(value, 1)
        self._publisher.health(health)
        metrics = self._metrics
        if metrics is not None:
            metrics.values = health | self._measured(events)
        self._publisher.status({"state": "recording", "sync": self._assembler.last_sync})

    def _measured(self, events: dict[str, int]) -> dict[str, Value]:
        """Return the values of metrics with labels of their own, which the health message has not."""
        received = dict(zip(self._plan.session.all_buses, self._receiver.traffic, strict=True))
        busy = {bus.channel: busy_seconds(bus, frames) for bus, frames in received.items()}
        (since, before), self._busy = self._busy, (now := time.monotonic(), busy)
        return {
            "time_s": time.time(),
            "buffer_share": self._sink.waiting_share,
            "frames_of": {(bus.channel,): float(frames.sum()) for bus, frames in received.items()},
            "load_of": {(bus,): (value - before.get(bus, 0.0)) / (now - since) for bus, value in busy.items()},
            "plan_of": self._planned,
            "events_of": {(kind,): number for kind, number in events.items()},
            "jitter_of": {
                (bus.channel, statistic): value
                for bus, jitter in zip(received, self._jitters, strict=True)
                for statistic, value in jitter.statistics().items()
            },
            "certificate_ends": certificate_ends(self._plan.session, "capture"),
            "celsius_of": {(joint,): celsius for joint, celsius in self.temperatures().items()},
        }


def _clock() -> dict[str, float | str | None]:
    """Return the state of the system clock, which stamps the frames where the hardware does not."""
    try:
        state = clock_state()
    except OSError:
        return {}
    return {
        "clock_synchronised": int(state.synchronised),
        "clock_offset_us": round(state.offset_us, 3),
        "clock_error_us": round(state.error_us, 1),
        "clock_largest_error_us": round(state.largest_error_us, 1),
    }
