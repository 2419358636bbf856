"""The recursive estimator on the live stream of a cell; its results are published."""

import json
import logging
import queue
import threading
import time
from collections.abc import Callable
from typing import Self

import zenoh
import zenoh.ext

from armident.configs import DataError, RobotConfig, SessionConfig
from armident.daq.identity.signatures import signer_for, trust_for
from armident.daq.streaming import Block, Keys, Refusals, decode_block, open_session
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.monitoring.recursive.block_order import BlockOrder
from armident.identify.monitoring.recursive.estimator import RecursiveEstimator, RecursiveResult
from armident.identify.monitoring.recursive.report import document
from armident.identify.monitoring.recursive.rows import SampleBlock
from armident.identify.monitoring.worker.stream_buffer import LARGEST_BLOCK

log = logging.getLogger(__name__)

SHOWN_S = 1.0
"""Time of the stream between two results, s."""
SAVED_S = 60.0
"""Time between two saved states, s."""
HISTORY_BLOCKS = 2000
"""Blocks that a watch requests from the capture's cache when it starts."""
WAITING_BLOCKS = 4000
"""Blocks that wait while the estimator is busy; further ones are dropped and counted."""
WAITING_BYTES = 256 << 20
"""Largest size of the waiting blocks, bytes: minutes of six axes at 5 kHz."""


class Watch:
    """Hands blocks to the estimator, and results to a listener every `SHOWN_S` of the stream; rate of SYNC, 1/s."""

    def __init__(self, estimator: RecursiveEstimator, rate_hz: float, show: Callable[[RecursiveResult], None]) -> None:
        self._estimator, self._show = estimator, show
        self._every = max(1, round(SHOWN_S * rate_hz))
        self._shown = -1

    def handle(self, block: SampleBlock) -> None:
        """Process a block; show a result where a further second of the stream is complete."""
        self._estimator.handle(block)
        second = self._estimator.matcher.last_sync // self._every
        if second != self._shown:
            self._shown = second
            self._show(self._estimator.result())


class LiveWatch:
    """Subscribes to the stream of a cell and publishes the results of the estimator."""

    def __init__(self, session: SessionConfig, robot: RobotConfig, estimator: RecursiveEstimator) -> None:
        self._robot = robot
        self._keys = Keys(session.cell, robot.name)
        self._waiting: queue.Queue[tuple[bytes, int]] = queue.Queue(WAITING_BLOCKS)
        self._capture, self._newest_ns = "", 0
        self._last: bytes | None = None
        self.dropped = self.lost = 0
        self._signer, self._trust = signer_for(session, "worker"), trust_for(session, self._keys.base)
        self.refusals = Refusals(log)
        # Bytes; each is changed by one thread only.
        self._received = self._taken = 0
        self.estimator = estimator
        self._rate = 1.0 / session.sync_period
        self._session = open_session(session, "observer", identity="worker")

    def __enter__(self) -> Self:
        """Subscribe, answer queries, and declare the liveliness token."""
        # Blocks that were missed are fetched again from the cache of the capture; repeated ones are skipped.
        self._subscriber = zenoh.ext.declare_advanced_subscriber(
            self._session,
            self._keys.samples,
            self._on_block,
            history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=HISTORY_BLOCKS),
            recovery=zenoh.ext.RecoveryConfig(heartbeat=True, periodic_queries=None),
            subscriber_detection=True,
        )
        self._queryable = self._session.declare_queryable(self._keys.recursive, self._on_query)
        self._token = self._session.liveliness().declare_token(self._keys.alive("watch"))
        return self

    def __exit__(self, *_: object) -> None:
        """Close the session."""
        self._token.undeclare()
        self._session.close()

    def run(
        self, stop: threading.Event, show: Callable[[RecursiveResult], None], save: Callable[[], None],
        duration: float | None = None,
    ) -> None:  # fmt: skip
        """Process blocks until a stop or the end of ``duration``, s; ``save`` is called every `SAVED_S`."""

        def publish(result: RecursiveResult) -> None:
            self._last = json.dumps(document(result, self._robot)).encode()
            try:
                key = self._keys.recursive
                self._session.put(key, self._last, attachment=self._signer.attachment(key, self._last))
            except zenoh.ZError:
                log.debug("result not published")
            show(result)

        watch, order = Watch(self.estimator, self._rate, publish), BlockOrder()
        began = saved = time.monotonic()
        while not stop.is_set() and (duration is None or time.monotonic() - began < duration):
            try:
                ready = order.add(self._decoded(*self._waiting.get(timeout=0.2)), time.monotonic())
            except queue.Empty:
                ready = order.overdue(time.monotonic())
            except DataError as error:
                self.refusals.refuse("samples", error)
                continue
            for block in ready:
                try:
                    watch.handle(block)
                except DataError as error:
                    self.refusals.refuse("samples", error)
            self._count_lost(order.lost)
            if time.monotonic() - saved > SAVED_S:
                saved = time.monotonic()
                save()

    def _decoded(self, data: bytes, time_ns: int) -> Block:
        """Return the block of this robot in a message; others must not disturb the order of its blocks."""
        self._taken += len(data)
        block = decode_block(data)
        if block.layout.joints != tuple(joint.name for joint in self._robot.joints):
            raise DataError(f"a block of capture {block.capture}: of other joints than those of {self._robot.name}")
        if block.capture != self._capture and time_ns < self._newest_ns:
            raise DataError(
                f"a block of capture {block.capture}: older than those of {self._capture}, late or repeated"
            )
        self._capture, self._newest_ns = block.capture, max(time_ns, self._newest_ns)
        return block

    def _on_block(self, sample: zenoh.Sample) -> None:
        # A message that is too large for a block is refused for its signature, without its memory.
        data = bytes(sample.payload) if len(sample.payload) <= LARGEST_BLOCK else b""
        if self._received - self._taken + len(data) > WAITING_BYTES:
            self.dropped += 1
            return
        try:
            signed = self._trust.check("publish", sample.key_expr, data, sample.attachment)
            self._waiting.put_nowait((data, signed.time_ns))
        except DataError as error:
            self.refusals.refuse("unsigned", error)
        except queue.Full:
            self.dropped += 1
        else:
            self._received += len(data)

    def _on_query(self, query: zenoh.Query) -> None:
        if self._last is None:
            query.reply_err(b"no result yet")
        else:
            self._signer.reply(query, self._keys.recursive, self._last)

    def _count_lost(self, lost: int) -> None:
        """Report blocks that never arrived: the first ones, and all at the end."""
        if lost and not self.lost:
            log.warning("%d blocks did not arrive: the capture began before the watch, or was found late", lost)
        self.lost = lost


def live_estimator(session: SessionConfig, robot: RobotConfig, reference: IdentificationDocument) -> RecursiveEstimator:
    """Return the estimator for the streams of a cell. ``reference``: identification of the healthy arm."""
    with_reference = any("demand" in stream.objects for stream in session.streams.values())
    return RecursiveEstimator(robot, reference, 1.0 / session.sync_period, with_reference=with_reference)
