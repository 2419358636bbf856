"""Announcements of a worker: each result and failure in the ledger is announced once, also if workers are killed."""

import logging
from contextlib import suppress

from armident.configs import ArmidentError
from armident.daq.streaming import Keys
from armident.identify.documents.signing import is_signed_in_time, sign_file
from armident.identify.monitoring.worker.ledger import Ledger, LedgerEntry
from armident.identify.monitoring.worker.recorded import result_of
from armident.identify.monitoring.worker.results import prune_results
from armident.identify.monitoring.worker.status_messages import failure_status, status_message
from armident.identify.monitoring.worker.worker_link import LinkDown, WorkerLink
from armident.identify.monitoring.worker.worker_receiver import content_hash

log = logging.getLogger(__name__)

COMPONENTS = ("worker", "reidentify")
"""Programs that announce the entries of a ledger."""


class Announcements:
    """Announces the entries of a ledger; an entry and its announcement are one transaction.

    A worker killed between both leaves an entry not announced, which others that heard the announcement enter.
    ``keep_days``: time after which results are deleted; ``None``: never.
    """

    def __init__(self, keys: Keys, link: WorkerLink, keep_days: float | None = None) -> None:
        self._keys, self._link, self._keep_days = keys, link, keep_days
        self._heard: set[bytes] = set()
        self._sent: set[str] = set()

    def make(self, ledger: Ledger, sha256: str) -> bytes | None:
        """Announce the result or the failure of a claimed recording, and return the document that was announced.

        Raises LinkDown, or LedgerError: then the next call does not repeat the announcement.
        """
        entry = ledger.entry(sha256)
        if entry is None or entry.announced or entry.state == "waiting":
            return None
        if not self._link.can_announce:
            raise LinkDown("zenoh: no session yet")
        document, message = _outcome(entry)
        if document is not None and entry.result is not None and not is_signed_in_time(document):
            document = sign_file(entry.result, self._link.signer.identity).encode()
        with ledger.announcement(sha256) as mine:
            if mine and sha256 not in self._sent:
                if document is None:
                    failed = failure_status("worker", message, entry.name, entry.digest)
                    self._link.announce((self._keys.status, failed))
                else:
                    done = status_message(
                        "worker", "done", result=str(entry.result), verdict=message, capture=entry.name, sha256=sha256
                    )
                    self._link.announce((self._keys.identification, document), (self._keys.status, done))
                self._sent.add(sha256)
        self._sent.discard(sha256)
        try:
            prune_results(ledger, self._keep_days)
        except (ArmidentError, OSError) as error:
            log.warning("old results stay: %s", error)
        return document if mine else None

    def enter_heard(self, ledger: Ledger) -> None:
        """Enter announcements of other workers that they did not enter; on LedgerError they are kept."""
        self._heard |= self._link.receiver.take_heard()
        if not self._heard:
            return
        for entry in ledger.unannounced():
            if any(content_hash(content) in self._heard for content in _contents(entry)):
                ledger.enter_announced(entry.sha256)
        self._heard.clear()


def _outcome(entry: LedgerEntry) -> tuple[bytes | None, str]:
    """Return the document of a result and its verdict; ``None`` and the reason if there is none."""
    if entry.result is None:
        return None, entry.message or ""
    with suppress(OSError, ValueError, KeyError):
        if result_of(entry.sha256, entry.result.parent) is not None:
            is_signed_in_time(document := entry.result.read_bytes())
            return document, entry.message or ""
    return None, f"{entry.result}: the result was removed or changed before it was announced"


def _contents(entry: LedgerEntry) -> list[bytes]:
    """Return the messages that announce an entry, by whichever program."""
    document, message = _outcome(entry)
    if document is not None:
        return [document]
    return [failure_status(component, message, entry.name, entry.digest) for component in COMPONENTS]
