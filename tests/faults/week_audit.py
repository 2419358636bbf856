"""Listener beside the plant of `tests.faults.week`, and the audit of files, results, messages and logs."""

import json
import re
from collections import Counter, defaultdict
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import zenoh

from armident.configs import ArmidentError, DataError
from armident.daq.identity.certificates import read_certificates
from armident.daq.identity.signatures import new_nonce, trust_for
from armident.daq.streaming import Keys, open_session
from armident.identify.documents.files import read_json
from armident.identify.documents.signing import _verified
from armident.identify.monitoring.change.history import History
from armident.identify.monitoring.worker.ledger import FILE, Ledger, LedgerEntry
from armident.identify.monitoring.worker.recorded import captured_in
from tests.faults.week_plant import Cell, Fed, Service, WeekPlant
from tests.integration.test_attacks_on_wire import FORGED

FAULTY = re.compile(r"Traceback|panicked|internal error")
"""Text that no log may have."""


class Listener:
    """Viewer of all cells, who counts announcements that are rightly signed, by cell, and hash or name.

    ``contents``: the announced documents. ``refused``: reasons of messages without a valid signature. ``forged``: keys
    of the attackers' messages that arrived. ``heard``: announcements and blocks of samples, by cell.
    """

    def __init__(self, cells: list[Cell]) -> None:
        self.announced: Counter[tuple[str, str]] = Counter()
        self.contents: defaultdict[tuple[str, str], set[bytes]] = defaultdict(set)
        self.refused: Counter[str] = Counter()
        self.forged: list[str] = []
        self.heard: Counter[tuple[str, str]] = Counter()
        self._trust = {cell.name: trust_for(cell.session, Keys(cell.name, "emps").base) for cell in cells}
        self._session = open_session(cells[0].session, "observer")
        keys = ("samples", "events", "health", "status", "result/*")
        self._kept = [self._session.declare_subscriber(f"armident/*/*/{key}", self._hear) for key in keys]

    def close(self) -> None:
        self._session.close()

    def since(self, cell: str) -> list[dict[str, Any]]:
        """Return all announcements of a cell, as a listener that was away asks for them; DataError if none answers."""
        found: list[dict[str, Any]] = []
        key, since, more = Keys(cell, "emps").identification, "1970-01-01T00:00:00Z", True
        while more:
            nonce = new_nonce()
            replies = self._session.get(f"{key}?since={since}", attachment=nonce, timeout=60.0)
            answers = [reply.ok for reply in replies if reply.ok is not None]
            if len(answers) != 1:
                raise DataError(f"{cell}: {len(answers)} answers to a query for all results")
            payload = bytes(answers[0].payload)
            self._trust[cell].check("answer", key, payload, answers[0].attachment, nonce=nonce)
            answer = json.loads(payload)
            found, more = found + answer["results"], answer["more"]
            since = found[-1]["sha256"] if found else since
        return found

    def _hear(self, sample: zenoh.Sample) -> None:
        key, content = str(sample.key_expr), bytes(sample.payload)
        cell, kind = key.split("/")[1], key.split("/")[3]
        if content == FORGED:
            self.forged.append(key)
        elif kind != "health":  # It is not signed, and has no consequence.
            try:
                self._trust[cell].check("publish", key, content, sample.attachment)
            except DataError as error:
                self.refused[str(error)] += 1
                return
            status = json.loads(content) if kind == "status" else {}
            if kind == "result":
                name = cell, json.loads(content)["recording"]["sha256"]
                self.contents[name].add(content)
            else:
                name = cell, status.get("capture", "")
            if kind == "result" or status.get("state") == "failed":
                self.announced[name] += 1
                kind = "result"
            self.heard[cell, kind] += 1


@dataclass
class Audit:
    """Figures of a run by name, and all that is wrong."""

    figures: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)
    growth: dict[str, str] = field(default_factory=dict)

    def add(self, cell: Cell, listener: Listener, plant: WeekPlant, history: str) -> None:
        """Audit the files of a cell, their results, announcements, signatures, and entries in the history."""
        ledger = Ledger(cell.results / FILE, "witness")
        entries = ledger.entries()
        results: Counter[str] = Counter()
        for path in cell.results.glob("*.identification/identification.json"):
            content = read_json(path)
            results[content["recording"]["sha256"]] += 1
            try:
                signer = _verified(content, read_certificates(plant.folder / "authority.pem"))["name"]
            except ArmidentError as error:
                signer = str(error)
            self.figures["documents"] += 1
            if signer != f"worker.{cell.name}":
                self.wrong.append(f"{path.parent.name}: {signer}")
        of_files = {
            key for fed in [*cell.fed, *_captures(cell)] for key in self._file(cell.name, fed, ledger, entries, results)
        }
        self.wrong += [f"{cell.name}: {entry.name} is of no file" for entry in entries if entry.sha256 not in of_files]
        self._announcements(cell.name, entries, listener)
        done = Counter(entry.sha256 for entry in entries if entry.state == "done")
        known = Counter(run.document.recording.sha256 for run in History(history).runs("emps"))
        runs = Counter({digest: count for digest, count in known.items() if digest in done})
        self.figures["entries in the history"] += runs.total()
        for name, found in (("documents", results), ("entries in the history", runs)):
            if found != done:
                self.wrong.append(f"{cell.name}: {found.total()} {name} of {len(found)}, {len(done)} results")

    def add_logs(self, folder: Path) -> None:
        """Look for tracebacks in all logs."""
        for path in sorted(folder.glob("*.log")):
            lines = path.read_text(errors="replace").splitlines()
            self.wrong += [f"{path.name}: {line}" for line in lines if FAULTY.search(line)][:3]

    def add_life(self, name: str, service: Service) -> None:
        """Compare memory and open files of the longest-lived process in the last two thirds of its life."""
        life = max(service.lives, key=len)
        third = len(life) // 3
        if third < 20:
            return
        parts = life[third : 2 * third], life[-third:]
        (memory, files), (memory_then, files_then) = (tuple(map(max, zip(*part, strict=True))) for part in parts)
        text = f"{memory:.0f}, then {memory_then:.0f} MB; {files}, then {files_then} open files; {len(life)} s"
        self.growth[name] = text
        if memory_then > 1.2 * memory + 20 or files_then > files + 8:
            self.wrong.append(f"{name}: {text}")

    def _file(
        self, cell: str, fed: Fed, ledger: Ledger, entries: list[LedgerEntry], results: Counter[str]
    ) -> list[str]:
        """Find the one result or the one reason of a file, by its content, or by its name if that was never read.

        Captures of an arm at rest may have the same samples. Returns the keys of its entries.
        """
        path = fed.path.resolve()
        found = [entry for entry in entries if fed.sha256 and entry.digest == fed.sha256] or [
            entry for entry in entries if path in _paths(entry) and not (fed.sha256 and entry.digest)
        ]
        if not found and fed.kind == "capture" and fed.path in ledger.files():
            found = [entry for entry in entries if entry.sha256 == ledger.key_of(fed.path)]
        self.figures["files"] += 1
        if not found and fed.withdrawn:
            self.figures["deleted or replaced before they were read"] += 1
        elif [entry.state for entry in found] == ["done"] and results[found[0].sha256] == 1:
            self.figures["files with one result"] += 1
        elif len(found) == 1 and found[0].state in ("failed", "passed") and found[0].message:
            self.figures["files with one reason"] += 1
        else:
            states = [(entry.state, entry.message, results[entry.sha256]) for entry in found]
            self.wrong.append(f"{cell}: {path.name} ({fed.kind}): {states}")
        return [entry.sha256 for entry in found]

    def _announcements(self, cell: str, entries: list[LedgerEntry], listener: Listener) -> None:
        try:
            told = Counter(each["sha256"] for each in listener.since(cell))
        except (ArmidentError, zenoh.ZError) as error:
            self.wrong.append(str(error))
            return
        for entry in entries:
            if entry.state in ("done", "failed"):
                heard = listener.announced[cell, entry.sha256 if entry.state == "done" else entry.name]
                self.figures["results and failures"] += 1
                self.figures[f"heard {('not, told when asked', 'once')[heard] if heard < 2 else 'again'}"] += 1
                if told[entry.sha256] != 1 or len(listener.contents[cell, entry.sha256]) > 1:
                    self.wrong.append(f"{cell}: {entry.name}: told {told[entry.sha256]} times, heard {heard} times")
        for name in {name for of, name in listener.contents if of == cell} - {*told}:
            self.wrong.append(f"{cell}: {name[:8]} was announced, and is no result")


def settled(cell: Cell) -> tuple[bool, int]:
    """Return True if all files of a cell are known and announced, and the number of entries that are."""
    with suppress(ArmidentError, OSError):
        ledger = Ledger(cell.results / FILE, "witness")
        entries, known = ledger.entries(), {path.resolve() for path in ledger.files()}
        done = sum(entry.announced for entry in entries)
        return known >= {each.path.resolve() for each in _captures(cell, ())} and done == len(entries), done
    return False, -1


def _paths(entry: LedgerEntry) -> list[Path]:
    return [path.resolve() for path in entry.paths]


def _captures(cell: Cell, but: Any = None) -> list[Fed]:
    """Return what is in the folder beside the files that were put there."""
    fed = {each.path.resolve() for each in cell.fed} if but is None else but
    found = [each.paths[0] for each in captured_in([cell.recordings], "emps")]
    return [Fed("capture", path, None) for path in found if path.resolve() not in fed]
