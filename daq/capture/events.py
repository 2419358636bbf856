"""Handler of the events of drives and buses: counts, marks, log records and triggers."""

import logging

from armident.configs import ArmidentError, SessionConfig
from armident.daq.capture.plan import CapturePlan
from armident.daq.capture.sink import Sink
from armident.daq.matching.assembler import Assembler
from armident.daq.matching.streams import unknown_phase
from armident.drivers.can.receiver import BusEvent
from armident.drivers.canopen.master import DriveEvent

COUNTED = ("emcy", "heartbeat_lost", "rebooted", "mapping_changed", "bus_down", "bus_off", "sync_stopped")
"""Kinds of events that have a counter."""
SYNC_STOPPED_S = 0.2
"""Least time without SYNC of another master after which SYNC has stopped, s, besides `SYNC_STOPPED` periods."""
SYNC_STOPPED = 20

log = logging.getLogger(__name__)


class EventHandler:
    """Handles events in the order in which they are detected; some of them trigger a recording."""

    def __init__(self, plan: CapturePlan, assembler: Assembler, sink: Sink) -> None:
        self.counts = dict.fromkeys(COUNTED, 0)
        self.moving = False
        """True while the capture moves the arm: a failing drive or bus ends the capture then."""
        self.triggers: tuple[str, ...] = ()
        self.change(plan.session)
        self._plan, self._assembler, self._sink = plan, assembler, sink
        self._reported: set[tuple[str, str]] = set()
        self._timeout_s = max(SYNC_STOPPED_S, SYNC_STOPPED * plan.session.sync_period)
        self._last_sync, self._last_sync_s = -1, 0.0
        self.sync_stopped = False
        """True while SYNC of another master has stopped."""

    def change(self, session: SessionConfig) -> None:
        """Apply the triggers of a reloaded session."""
        trigger = session.recording.trigger
        self.triggers = () if trigger is None else trigger.events

    def on_drive_event(self, event: DriveEvent) -> None:
        """Handle the event of a drive. Raises ArmidentError if the drive failed while it moves the arm."""
        kind = event.kind
        if kind in self.counts:
            self.counts[kind] += 1
        self._sink.mark(kind if kind in ("emcy", "heartbeat_lost") else "note", self._sync, event.text)
        fields = {"event": kind, "axis": event.joint, "node": event.node_id, "sync": self._sync}
        log.info("%s", event.text, extra=fields | {"code": event.code or None})
        if kind in self.triggers:
            self._sink.trigger()
        if kind in ("heartbeat_lost", "rebooted", "mapping_changed") or (kind == "emcy" and event.code != 0):
            self._stop_moving(event.text)

    def on_bus_event(self, event: BusEvent) -> None:
        """Handle the event of a bus, whose samples are gaps while it is down; ArmidentError if the arm moves."""
        if event.kind in self.counts:
            self.counts[event.kind] += 1
        if event.kind in ("bus_down", "bus_up"):
            self._assembler.set_bus_down(event.bus, event.kind == "bus_down")
        if event.kind == "bus_off":
            self._assembler.mark_incomplete(event.bus)
        self._sink.mark("note", self._sync, event.text)
        channel = self._plan.session.all_buses[event.bus].channel
        log.info("%s", event.text, extra={"event": event.kind, "bus": channel, "sync": self._sync})
        if "bus" in self.triggers:
            self._sink.trigger()
        if event.kind in ("bus_down", "bus_off"):
            self._stop_moving(event.text)

    def on_frames_dropped_at_end(self, dropped: int, syncs: int) -> None:
        """Note that the kernel dropped frames after the last received one, at most ``syncs`` SYNCs among them."""
        self._note(f"{dropped} frames were dropped by the kernel at the end: up to {syncs} SYNCs may be missing there")

    def check_sync(self, now: float) -> None:
        """Note that SYNC of another master has stopped or is back. ``now``: monotonic time, s."""
        last, silent = self._assembler.last_sync, now - self._last_sync_s
        if last == self._last_sync:
            if last >= 0 and not self.sync_stopped and silent > self._timeout_s:
                self.sync_stopped = True
                self.counts["sync_stopped"] += 1
                self._note(f"no SYNC for {silent:.1f} s")
            return
        if self._last_sync < 0 and not self._assembler.has_counter:
            phase = unknown_phase(self._plan.session)
            if phase is not None:
                self._note(phase)
        if self.sync_stopped:
            self._note(f"SYNC is back after {silent:.1f} s")
        self._last_sync, self._last_sync_s, self.sync_stopped = last, now, False

    def check_mappings(self) -> None:
        """Warn once of every TPDO whose length differs from its mapping."""
        for stream, joint in sorted(set(self._assembler.wrong_lengths) - self._reported):
            self._reported.add((stream, joint))
            text = f"{joint}: TPDO of {stream} has another length than mapped; check its PDO mapping"
            self._sink.mark("note", self._sync, text)
            log.warning("%s", text, extra={"event": "mapping", "axis": joint, "stream": stream, "sync": self._sync})

    @property
    def _sync(self) -> int:
        return max(self._assembler.last_sync, 0)

    def _note(self, text: str) -> None:
        self._sink.mark("note", self._sync, text)
        log.info("%s", text)

    def _stop_moving(self, text: str) -> None:
        if self.moving:
            raise ArmidentError(f"{text}; the arm was stopped")
