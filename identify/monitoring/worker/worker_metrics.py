"""Metrics of a worker: the state of its ledger, and the newest identification in it."""

import logging
import time
from contextlib import suppress
from pathlib import Path

from armident.configs import ArmidentError, ConfigError, SessionConfig
from armident.daq.identity.plant import certificate_ends
from armident.identify.documents.files import load_document
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.monitoring.model_metrics import IDENTIFICATION, VERDICTS, identification_values, one_of
from armident.identify.monitoring.worker.ledger import Ledger
from armident.metrics import CERTIFICATES, INFO, UPDATED, Family, Metrics, MetricsExporter, Value

log = logging.getLogger(__name__)

WORKER = Metrics(
    "worker",
    (
        INFO,
        UPDATED,
        Family("states", "recordings", "Recordings in the ledger; those waiting are the backlog.", ("state",)),
        Family("waits_s", "oldest_waiting_seconds", "Time that the oldest recording has waited; 0 if none does."),
        Family("attempts", "attempts_total", "Recordings that this worker began to read."),
        Family("failures", "failures_total", "Recordings that this worker could not identify."),
        Family("zenoh_open", "zenoh_open", "1 if results can be announced, otherwise 0."),
        Family("ended_s", "last_result_timestamp_seconds", "Time of the newest result or failure."),
        Family("verdict", "last_verdict", "1 for the verdict of the newest result or failure.", ("verdict",)),
        CERTIFICATES,
        *IDENTIFICATION,
    ),
)
"""Metrics of a worker. Those of an identification are of the newest result; workers of one ledger have the same."""


class WorkerMetrics:
    """Serves the metrics of a worker at the port of its session, as soon as no other worker has it."""

    def __init__(self, session: SessionConfig, robot: str) -> None:
        self._session, self._common = session, (session.cell, robot)
        self._exporter: MetricsExporter | None = None
        self._refused = False
        self._read: tuple[Path | None, dict[str, Value]] = None, {}

    def open(self) -> None:
        """Take the port of the session, if there is one and it is free."""
        options = self._session.metrics
        if options.worker_port is None or self._exporter is not None:
            return
        try:
            exporter = MetricsExporter(WORKER, self._common)
            self._exporter = exporter.serve(options.address, options.worker_port)
        except ConfigError as error:
            if not self._refused:
                log.warning("%s; trying again, another worker of the cell may serve them", error)
            self._refused = True

    def update(self, ledger: Ledger, counters: dict[str, Value]) -> None:
        """Serve the present state; ``counters``: values that the ledger has not. Raises ArmidentError as the ledger."""
        if self._exporter is None:
            return
        found, now = ledger.summary(), time.time()
        if found.result is not None and found.result != self._read[0]:
            self._read = found.result, {}
            with suppress(ArmidentError):
                self._read = found.result, identification_values(load_document(found.result, IdentificationDocument))
        values: dict[str, Value] = {
            "time_s": now,
            "states": {(state,): number for state, number in found.states.items()},
            "waits_s": 0.0 if found.waits_since is None else max(0.0, now - found.waits_since),
            "ended_s": found.ended,
            "certificate_ends": certificate_ends(self._session, "worker"),
            "verdict": one_of(found.verdict, (*VERDICTS, "failed")),
        }
        self._exporter.values = {**values, **self._read[1], **counters}

    def close(self) -> None:
        """Stop the server."""
        if self._exporter is not None:
            self._exporter.close()
