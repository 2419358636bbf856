"""Announced results of a worker: answers to listeners that were away, and deletion of old ones."""

import datetime
import json
import re
import shutil
import time
from contextlib import suppress

from armident.configs import ConfigError
from armident.daq.recording.clock import clock_is_right
from armident.daq.recording.retention import KEEP
from armident.identify.monitoring.worker.ledger import Ledger, LedgerEntry

LARGEST_ANSWER = 64 << 20
"""Size of the documents after which an answer ends, bytes; a document of six axes has 0.1 MB."""


def results_since(ledger: Ledger, since: str, largest: int = LARGEST_ANSWER) -> bytes:
    """Return what was announced after a time (ISO 8601) or after a recording (its hash), oldest first, as JSON.

    After a hash that the ledger does not know, that is all. ``more`` is true if the answer was ended at ``largest``
    bytes: the rest follows the last hash. Raises ConfigError if ``since`` is neither.
    """
    entries = ledger.announced()
    if re.fullmatch("[0-9a-f]{64}", since):
        known = [entry.sha256 for _, entry in entries]
        entries = entries[known.index(since) + 1 :] if since in known else entries
    else:
        try:
            after = datetime.datetime.fromisoformat(since)
        except ValueError as error:
            raise ConfigError(f"since={since}: expected a time (ISO 8601) or the sha256 of a recording") from error
        after_ms = round((after if after.tzinfo else after.replace(tzinfo=datetime.UTC)).timestamp() * 1e3)
        entries = [(ms, entry) for ms, entry in entries if ms > after_ms]
    found, size = list[dict[str, object]](), 0
    for ms, entry in entries:
        text, document = _document_of(entry)
        size += len(text)
        if found and size > largest:
            break
        moment = datetime.datetime.fromtimestamp(ms / 1e3, datetime.UTC).isoformat(timespec="milliseconds")
        what = {"sha256": entry.sha256, "capture": entry.name, "announced": moment, "state": entry.state}
        found.append(what | {"message": entry.message, "document": document})
    return json.dumps({"results": found, "more": len(found) < len(entries)}).encode()


def _document_of(entry: LedgerEntry) -> tuple[str, object]:
    """Return the text of a result and what it holds; empty and ``None`` if it is not there, or damaged."""
    with suppress(OSError, ValueError, RecursionError):
        text = entry.result.read_text(encoding="utf-8") if entry.result else ""
        return text, json.loads(text)
    return "", None


def prune_results(ledger: Ledger, days: float | None) -> None:
    """Delete results announced more than some days ago, and forget recordings among them that are deleted.

    The newest stays, and one beside a file ``NAME.identification.keep``. Nothing is deleted while the clock is not
    synchronised. Raises OSError if a folder cannot be deleted, ArmidentError if the ledger cannot be used.
    """
    if days is None or not clock_is_right():
        return
    forgotten, refused = [], None
    for ms, entry in ledger.announced()[:-1]:
        folder = None if entry.result is None else entry.result.parent
        if ms / 1e3 > time.time() - 86_400 * days:
            break
        if folder is not None:
            if folder.with_name(folder.name + KEEP).exists():
                continue
            try:
                if folder.is_dir():
                    shutil.rmtree(folder)
            except OSError as error:
                refused = error
                continue
        if not any(path.exists() for path in entry.paths):
            forgotten.append(entry.sha256)
    ledger.remove(forgotten)
    if refused is not None:
        raise refused
