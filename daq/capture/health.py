"""How a capture does, once a second: on Zenoh, for Prometheus, and in words where the disk refuses."""

import threading
from collections.abc import Callable
from contextlib import ExitStack

from armident.configs import SessionConfig
from armident.configs.schema.session import MetricsOptions
from armident.daq.capture.clock import clock_state
from armident.daq.capture.files import free_space
from armident.daq.capture.jitter import SyncJitter, worst
from armident.daq.capture.metrics import Metrics, Value
from armident.daq.capture.plan import CapturePlan
from armident.daq.capture.publisher import Publisher
from armident.daq.capture.sink import Sink
from armident.daq.matching.assembler import Assembler
from armident.drivers.can.receiver import Receiver

SLOW_DISK_S = 1.0
"""Rows of so long that wait for the disk are worth a line."""


class Health:
    """Reports on one capture.

    Parameters
    ----------
    order
        What is captured.
    assembler, receiver, jitters, sink, publisher
        What is reported on, and where to.
    say
        Takes lines.
    """

    def __init__(
        self,
        order: CapturePlan,
        assembler: Assembler,
        receiver: Receiver,
        jitters: list[SyncJitter],
        sink: Sink,
        publisher: Publisher,
        say: Callable[[str], None],
    ) -> None:
        self._order, self._assembler, self._receiver, self._jitters = order, assembler, receiver, jitters
        self._sink, self._publisher, self._say = sink, publisher, say
        self._metrics: Metrics | None = None
        self._served = order.session.metrics
        self.temperatures: Callable[[], dict[str, float]] = dict
        """Gives the temperature of each joint's drive, degrees Celsius, where it is known."""
        self._frames_before = self._lost_rows = 0
        self._writing, self._slow = True, False

    def serve(self, stack: ExitStack) -> None:
        """Serve metrics where the session asks for it, until the stack unwinds."""
        stack.callback(self._exchange, None)
        self._exchange(self._opened(self._served))

    def change(self, session: SessionConfig) -> None:
        """Serve metrics where a changed session asks for it.

        Raises
        ------
        ConfigError
            If the port cannot be had; they are served where they were then.
        """
        if session.metrics != self._served:
            fresh = self._opened(session.metrics)
            # Closing waits for the server's thread.
            threading.Thread(target=self._exchange, args=(fresh,), name="metrics", daemon=True).start()
            self._served = session.metrics

    def _opened(self, options: MetricsOptions) -> Metrics | None:
        if options.port is None:
            return None
        labels = {"cell": self._order.session.cell, "robot": self._order.robot.name}
        metrics = Metrics(options.address, options.port, labels)
        self._say(f"metrics on http://{options.address}:{metrics.port}/metrics")
        return metrics

    def _exchange(self, fresh: Metrics | None) -> None:
        old, self._metrics = self._metrics, fresh
        if old is not None:
            old.close()

    def report(self, seconds: float, events: dict[str, int]) -> None:
        """Say how the last ``seconds`` were; ``events`` are counts since the start."""
        counters = self._assembler.counters
        rate = (counters["frames"] - self._frames_before) / seconds
        self._frames_before = counters["frames"]
        self._tell_of_disk()
        health: dict[str, Value] = {
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
            "answers_owed": self._assembler.owed,
            "queue_depth": self._publisher.depth,
            "disk_free_bytes": free_space(self._order.directory),
            "blocks_dropped": self._publisher.dropped,
            "events_dropped": self._publisher.events_dropped,
            **_clock(),
            **{f"temperature_{joint}_c": round(celsius, 2) for joint, celsius in self.temperatures().items()},
            **events,
        }
        for name, value in worst(self._jitters).items():
            health[f"sync_jitter_{name.replace('.', '_')}_us"] = round(value, 1)
        self._publisher.health(health)
        metrics = self._metrics
        if metrics is not None:
            metrics.update(health)
        self._publisher.status({"state": "recording", "sync": self._assembler.last_sync})

    def _tell_of_disk(self) -> None:
        """Say it when the disk begins to refuse rows, and when it takes them again."""
        lost, before = self._sink.lost_rows, self._lost_rows
        self._lost_rows = lost
        if lost > before and self._writing:
            self._say(f"warning: rows are not being written, streaming goes on: {self._sink.problem}")
        elif lost == before and not self._writing:
            self._say(f"writing again; {lost} rows were not written")
        self._writing = lost == before
        waits_s = self._sink.waiting_rows * self._order.session.sync_period
        if waits_s > SLOW_DISK_S and not self._slow:
            self._say(f"warning: the disk is slow: {waits_s:.1f} s of rows wait for it")
        elif self._slow and waits_s <= SLOW_DISK_S:
            self._say("the disk has caught up")
        self._slow = waits_s > SLOW_DISK_S


def _clock() -> dict[str, Value]:
    """The state of the system clock, which stamps the frames where their hardware does not."""
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
