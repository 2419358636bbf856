"""What happens beside the samples: reports of drives and buses become counts, marks, lines and triggers."""

from collections.abc import Callable

from armident.configs import ArmidentError, SessionConfig
from armident.daq.capture.journal import Line
from armident.daq.capture.plan import CapturePlan
from armident.daq.capture.sink import Sink
from armident.daq.matching.assembler import Assembler
from armident.drivers.can.receiver import BusEvent
from armident.drivers.canopen.master import DriveEvent

COUNTED = ("emcy", "heartbeat_lost", "rebooted", "mapping_changed", "bus_down", "bus_off", "sync_stopped")
SYNC_STOPPED_S = 0.2
"""A master whose SYNC does not come for so long, and ``SYNC_STOPPED`` periods, has stopped."""
SYNC_STOPPED = 20


class EventHandler:
    """Takes events in the order they are noticed.

    Parameters
    ----------
    order
        Says which events write a recording, and which end a capture: those of drives and buses that move the arm.
    assembler
        Knows the SYNC at which something happened, and is told which bus is down.
    sink
        Gets the marks.
    say
        Gets the lines.
    """

    def __init__(self, order: CapturePlan, assembler: Assembler, sink: Sink, say: Callable[[str], None]) -> None:
        self.counts = dict.fromkeys(COUNTED, 0)
        self.moving = False
        """Whether the arm is moved: what fails then ends the capture."""
        self.triggers: tuple[str, ...] = ()
        self.change(order.session)
        self._order, self._assembler, self._sink, self._say = order, assembler, sink, say
        self._told: set[tuple[str, str]] = set()
        self._patience = max(SYNC_STOPPED_S, SYNC_STOPPED * order.session.sync_period)
        self._sync_before, self._sync_came, self._stopped = -1, 0.0, False

    def change(self, session: SessionConfig) -> None:
        """Take over which events write a recording."""
        trigger = session.recording.trigger
        self.triggers = () if trigger is None else trigger.events

    def of_drive(self, event: DriveEvent) -> None:
        """A drive reported something.

        Raises
        ------
        ArmidentError
            If the drive failed while it moves the arm.
        """
        kind = event.kind
        if kind in self.counts:
            self.counts[kind] += 1
        self._sink.mark(kind if kind in ("emcy", "heartbeat_lost") else "note", self._sync, event.text)
        about = {"event": kind, "axis": event.joint, "node": event.node_id, "sync": self._sync}
        self._say(Line(event.text, **about, code=event.code or None))
        if kind in self.triggers:
            self._sink.trigger()
        if kind in ("heartbeat_lost", "rebooted", "mapping_changed") or (kind == "emcy" and event.code != 0):
            self._stop_moving(event.text)

    def of_bus(self, event: BusEvent) -> None:
        """Something happened to a bus; its axes are gaps while it is down.

        Raises
        ------
        ArmidentError
            If the bus was lost while the arm is moved.
        """
        if event.kind in self.counts:
            self.counts[event.kind] += 1
        if event.kind in ("bus_down", "bus_up"):
            self._assembler.silence(event.bus, event.kind == "bus_down")
        if event.kind == "bus_off":
            self._assembler.torn(event.bus)
        self._sink.mark("note", self._sync, event.text)
        channel = self._order.session.all_buses[event.bus].channel
        self._say(Line(event.text, event=event.kind, bus=channel, sync=self._sync))
        if "bus" in self.triggers:
            self._sink.trigger()
        if event.kind in ("bus_down", "bus_off"):
            self._stop_moving(event.text)

    def look_for_sync(self, now: float) -> None:
        """Tell when SYNC of another master stops, and when it is back; ``now`` in seconds."""
        last, silent = self._assembler.last_sync, now - self._sync_came
        if last == self._sync_before:
            if last >= 0 and not self._stopped and silent > self._patience:
                self._stopped = True
                self.counts["sync_stopped"] += 1
                self._note(f"no SYNC for {silent:.1f} s")
            return
        if self._stopped:
            self._note(f"SYNC is back after {silent:.1f} s")
        self._sync_before, self._sync_came, self._stopped = last, now, False

    def _note(self, text: str) -> None:
        self._sink.mark("note", self._sync, text)
        self._say(text)

    def of_the_end(self, dropped: int, syncs: int) -> None:
        """The kernel dropped frames behind the last one that was received, at most ``syncs`` SYNCs with them."""
        self._note(f"{dropped} frames were dropped by the kernel at the end: up to {syncs} SYNCs may be missing there")

    def look_for_other_mappings(self) -> None:
        """Tell once of every TPDO that has another length than its mapping says."""
        for stream, joint in sorted(set(self._assembler.wrong_lengths) - self._told):
            self._told.add((stream, joint))
            text = f"{joint}: TPDO of {stream} has another length than mapped; was its mapping changed?"
            self._sink.mark("note", self._sync, text)
            self._say(Line(f"warning: {text}", event="mapping", axis=joint, stream=stream, sync=self._sync))

    @property
    def _sync(self) -> int:
        return max(self._assembler.last_sync, 0)

    def _stop_moving(self, text: str) -> None:
        if self.moving:
            raise ArmidentError(f"{text}; the arm was stopped")
