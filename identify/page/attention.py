"""State of a cell in words, what is wrong in it, and what to do."""

import math
import shlex
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

from armident.identify.documents.identification import IdentificationDocument
from armident.identify.page.cells import Cell, CellFiles, Drift, ResultFolder
from armident.identify.page.live import Live, Message

Level = Literal["act", "look", "good", "idle"]
ORDER: tuple[Level, ...] = ("act", "look", "good", "idle")
"""Levels in the order of the overview: somebody has to act, should look, need not, and nothing is known."""

SILENT_S = 180.0
"""Time without a message after which a cell counts as not heard, s."""
LATE_S = 10.0
"""Age of a health message from which it is no state of now, s: ten messages are missing."""
FREE_BYTES = 10e9
"""Free space below which somebody has to act: three hours of six axes at 5 kHz (190 bytes a row), uncompressed."""
GAP_SHARE = 1e-3
"""Share of the samples in gaps from which somebody should look."""
BACKLOG = 10
"""Number of waiting recordings from which somebody should look, as a worker warns."""
STEPS = {
    "not configured": "The session cannot be used: correct it, and start the page again",
    "not connected": "The page has no Zenoh session: check the options zenoh of the session",
    "bus down": "Check cable, termination and power of the drives",
}
"""Next steps by the state."""
SETTINGS = Path("/etc/armident")
"""Folder of the sessions of services."""


@dataclass(frozen=True)
class Problem:
    """Something wrong in a cell: a sentence, the next step, and the command of it."""

    level: Level
    text: str
    step: str
    command: str = ""


@dataclass(frozen=True)
class CellView:
    """Cell as the page shows it at a time ``now``, s of the monotonic clock."""

    cell: Cell
    files: CellFiles
    drift: Drift | str | None
    live: Live
    now: float

    def age(self, message: Message | None) -> float | None:
        """Return the age of a message, s."""
        return None if message is None else self.now - message.heard

    def number(self, key: str) -> float | None:
        """Return a number of the health message; ``None`` if it has none."""
        value = None if self.live.health is None else self.live.health.content.get(key)
        if isinstance(value, bool) or not isinstance(value, int | float):
            return None
        try:
            return float(value) if math.isfinite(value) else None
        except OverflowError:
            return None

    @property
    def temperatures(self) -> dict[str, float]:
        """Temperatures of the drives by joint, degrees Celsius."""
        joints = [] if self.cell.robot is None else [joint.name for joint in self.cell.robot.joints]
        found = {joint: self.number(f"temperature_{joint}_c") for joint in joints}
        return {joint: value for joint, value in found.items() if value is not None}

    @cached_property
    def state(self) -> tuple[Level, str, str]:
        """Level, state in a few words, and a sentence on it."""
        live, silent = self.live, self.age(self.live.health)
        if self.cell.problem is not None:
            return "act", "not configured", self.cell.problem
        if live.problem is not None:
            return "act", "not connected", live.problem
        if live.ended is not None and (silent is None or live.health is None or live.ended >= live.health.heard):
            return "idle", "waiting", f"The last capture ended as planned {words(self.now - live.ended)} ago."
        if silent is not None and silent <= SILENT_S:
            return self._recording(silent)
        job = live.status.get("reidentify")
        if job is not None and self.now - job.heard <= SILENT_S:
            return "good", "re-identifying", f"A re-identification runs: {job.content.get('state')}."
        if silent is not None:
            return "act", f"not heard for {words(silent)}", "The capture was heard before, and has sent no end."
        if "worker" in live.alive:
            return "idle", "waiting", "No capture runs; the worker does."
        if self.now - live.began < SILENT_S:
            return "idle", "listening", f"Nothing heard in {words(self.now - live.began)}."
        return "act", f"not heard for {words(self.now - live.began)}", "Neither a capture nor a worker has been heard."

    def _recording(self, silent: float) -> tuple[Level, str, str]:
        down, moved = self.number("buses_down") or 0.0, self.live.moved
        if down > 0:
            return "act", "bus down", f"{down:.0f} of the buses of the capture {'is' if down == 1 else 'are'} down."
        if silent > LATE_S:
            return "look", f"silent for {words(silent)}", "The capture has sent no message for that time."
        if moved is not None and self.now - moved > LATE_S:
            return "look", "waiting for SYNC", f"No SYNC for {words(self.now - moved)}."
        return "good", "recording", "Samples arrive."

    @property
    def gap_share(self) -> float | None:
        """Share of the samples of the running capture that are in gaps."""
        rows, lost = self.number("rows"), self.number("rows_in_gaps")
        return None if rows is None or lost is None or rows + lost <= 0 else lost / (rows + lost)

    @property
    def free_bytes(self) -> float | None:
        """Free space where the capture writes or, without a capture, where the results are."""
        found = self.number("disk_free_bytes")
        return self.files.free_bytes if found is None else found

    @property
    def backlog(self) -> int | None:
        """Number of recordings that wait for a worker; ``None`` without a ledger."""
        return None if self.files.ledger is None else self.files.ledger.summary.states["waiting"]

    @property
    def identification(self) -> ResultFolder | None:
        """Last identification."""
        return next(iter(self.files.documents("identification")), None)

    @property
    def verdict(self) -> tuple[Level, str]:
        """Level and words of the verdict of the last identification."""
        last = self.identification
        if last is None:
            return "idle", "none yet"
        if not isinstance(last.document, IdentificationDocument):
            return "act", "damaged"
        verdict = last.document.verdict or "not judged"
        levels: dict[str, Level] = {"trustworthy": "good", "unusable": "act"}
        return levels.get(verdict, "look"), verdict

    @property
    def drift_state(self) -> tuple[Level, str]:
        """Level and words of the comparison with the first run."""
        if self.drift is None:
            return "idle", "no history"
        if isinstance(self.drift, str):
            return "act", "history unreadable"
        states: dict[bool | None, tuple[Level, str]] = {True: ("act", "changed"), False: ("good", "unchanged")}
        return states.get(self.drift.drifted, ("idle", "not compared"))

    @cached_property
    def problems(self) -> list[Problem]:
        """Everything wrong, the most urgent first."""
        return sorted(self._problems(), key=lambda each: ORDER.index(each.level))

    @property
    def level(self) -> Level:
        """Level of the most urgent problem or, without one, of the state."""
        return self.problems[0].level if self.problems else self.state[0]

    def _command(self, command: str) -> str:
        """Return a command of armident with the session of this cell and, where it has one, the folder of results."""
        words = f"armident {command} --config {shlex.quote(str(self.cell.file))}"
        has_folder = command.startswith(("worker", "queue")) and len(self.cell.folders) > 1
        return f"{words} --out {shlex.quote(str(self.cell.folders[0]))}" if has_folder else words

    def _service(self, command: str) -> str:
        """Return the command that starts a part again: the unit of a cell in /etc/armident, else the program."""
        unit = shlex.quote(f"armident-{command}@{self.cell.name}")
        in_service = self.cell.file.resolve().parent == SETTINGS
        return f"sudo systemctl restart {unit}" if in_service else self._command(command)

    def _problems(self) -> Iterator[Problem]:
        level, state, sentence = self.state
        doctor, queue, worker = self._command("doctor"), self._command("queue list"), self._service("worker")
        if level == "act" and state.startswith("not heard"):
            yield Problem(
                "act", f"{state.capitalize()}. {sentence}", "Start the capture again", self._service("capture")
            )
        elif level in ("act", "look"):
            yield Problem(level, sentence, STEPS.get(state, "Check the machine and the master of the bus"), doctor)
        free, wanted = self.free_bytes, self.cell.session and self.cell.session.recording.min_free_gb
        # Retention keeps as much free as the session asks for.
        if free is not None and free < (0.5e9 * wanted if wanted else FREE_BYTES):
            step = "Free space, or let the capture delete old recordings (recording.min_free_gb)"
            yield Problem("act", f"Only {free / 1e9:.1f} GB are free", step)
        if lost := self.number("rows_not_written"):
            yield Problem("act", f"{lost:.0f} samples were not written to the disk", "Check the disk of the capture")
        if (share := self.gap_share or 0.0) > GAP_SHARE:
            text, step = (
                f"{100 * share:.2g} % of the samples are in gaps",
                "Check the load of the bus and of the machine",
            )
            yield Problem("look", text, step, self._command("bus-load"))
        if self.number("clock_synchronised") == 0.0:
            yield Problem(
                "look", "The clock of the capture is not synchronised", "Set up NTP or PTP", "armident doctor"
            )
        if "ledger" in self.files.problems:
            step = "Start a worker again; it moves a damaged ledger aside"
            yield Problem("act", self.files.problems["ledger"], step, worker)
        if "results" in self.files.problems:
            yield Problem("act", self.files.problems["results"], "Check the folder and its permissions")
        waiting, since = self.backlog or 0, None if self.files.ledger is None else self.files.ledger.summary.waits_since
        text = "1 recording waits" if waiting == 1 else f"{waiting} recordings wait"
        is_left = since is not None and time.time() - since > SILENT_S and self.now - self.live.began > LATE_S
        if waiting and is_left and "worker" not in self.live.alive:
            yield Problem("act", f"{text} and no worker runs", "Start the worker", worker)
        elif waiting >= BACKLOG:
            yield Problem("look", text, "Leave out what needs no result, or start a second worker", queue)
        if failed := 0 if self.files.ledger is None else self.files.ledger.summary.states["failed"]:
            text = f"{failed} recording{'s' if failed > 1 else ''} could not be identified"
            yield Problem("look", text, "Read the reasons; retry or ignore each", queue)
        if isinstance(self.drift, str):
            yield Problem("act", f"The history cannot be read: {self.drift}", "Check the database")
        elif self.drift is not None and self.drift.drifted:
            step = "Look at the joint that is named, or diagnose the last recording against the first result"
            yield Problem("act", f"The arm has {self.drift.words}", step, self.drift.command)
        last = self.identification
        if last is not None and last.problem is not None:
            recording = shlex.quote(str(self.cell.folders[-1] / f"{last.name.rpartition('.')[0]}.mcap"))
            yield Problem("act", last.problem, "Identify the recording again", f"armident identify {recording}")
        elif last is not None and isinstance(last.document, IdentificationDocument):
            for reason in last.document.reasons[:1]:
                text = f"Last identification {last.document.verdict}: {reason.message}"
                yield Problem("act" if reason.level == "unusable" else "look", text, reason.next_step)


def words(seconds: float) -> str:
    """Return a time span in words."""
    for unit, size in (("d", 86_400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * size or (unit == "min" and seconds >= size):
            return f"{seconds / size:.0f} {unit}"
    return f"{max(seconds, 0.0):.0f} s"
