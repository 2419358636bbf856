"""Zenoh session on which a worker receives: samples and events of captures, and announcements of other workers."""

import hashlib
import logging
from collections import deque
from collections.abc import Callable
from typing import Any

import zenoh
import zenoh.ext

from armident.configs import ConfigError, DataError, SessionConfig
from armident.daq.identity.signatures import trust_for
from armident.daq.streaming import Keys, Refusals, open_session

log = logging.getLogger(__name__)

HISTORY_BLOCKS = 100_000
"""Number of blocks that a worker requests from the capture's cache when it starts: all of it."""
MOST_HEARD = 1000
"""Number of messages of other workers that are noted between two looks at the ledger."""

Take = Callable[[bytes | None, int], None]
"""Takes a message that is rightly signed (``None`` if it is larger than the limit) and its size, bytes."""


class WorkerReceiver:
    """Subscriptions of a worker, up to ``limits`` of event and block, bytes; announcements of others by their hash.

    Messages that are not rightly signed are counted and reported. Their session is their own: one that announces sends
    in a single queue, and more bursts of blocks would be lost.
    """

    def __init__(
        self, session: SessionConfig, keys: Keys, on_event: Take, on_block: Take, limits: tuple[int, int]
    ) -> None:
        self._config, self._keys = session, keys
        self._handlers = ((keys.events, on_event, limits[0]), (keys.samples, on_block, limits[1]))
        self._heard: deque[bytes] = deque(maxlen=MOST_HEARD)
        self._trust, self._refusals = trust_for(session, keys.base), Refusals(log)
        self._session: zenoh.Session | None = None
        self._problem: str | None = None

    def check(self) -> None:
        """Open the session if there is none."""
        if self._session is not None:
            return
        try:
            session = open_session(self._config, "observer", any_port=True)
            try:
                self._declared = self._subscribed(session)
            except BaseException:
                session.close()
                raise
        except (ConfigError, zenoh.ZError) as error:
            if str(error) != self._problem:
                log.warning("%s; recordings are identified from their files, trying again", error)
            self._problem = str(error)
        else:
            self._session, self._problem = session, None

    def take_heard(self) -> set[bytes]:
        """Return the hashes of what was published on the keys of announcements since the last call."""
        return {self._heard.popleft() for _ in range(len(self._heard))}

    def close(self) -> None:
        """Close the session."""
        session, self._session = self._session, None
        if session is not None:
            session.close()

    def _subscribed(self, session: zenoh.Session) -> list[Any]:
        history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=HISTORY_BLOCKS)
        recovery = zenoh.ext.RecoveryConfig(heartbeat=True, periodic_queries=None)
        declared: list[Any] = [
            zenoh.ext.declare_advanced_subscriber(
                session, key, self._limited(take, limit), history=history, recovery=recovery, subscriber_detection=True
            )
            for key, take, limit in self._handlers
        ]
        for key in (self._keys.identification, self._keys.status):
            declared.append(session.declare_subscriber(key, self._hear))
        return declared

    def _hear(self, sample: zenoh.Sample) -> None:
        if (content := self._trusted(sample)) is not None:
            self._heard.append(content_hash(content))

    def _trusted(self, sample: zenoh.Sample) -> bytes | None:
        """Return the content of a message; ``None`` if it is not signed by somebody who may publish it."""
        content = bytes(sample.payload)
        try:
            self._trust.check("publish", sample.key_expr, content, sample.attachment)
        except DataError as error:
            self._refusals.refuse(str(sample.key_expr), error)
            return None
        return content

    def _limited(self, take: Take, limit: int) -> Callable[[zenoh.Sample], None]:
        def on_sample(sample: zenoh.Sample) -> None:
            size = len(sample.payload)
            if size > limit:
                take(None, size)
            elif (content := self._trusted(sample)) is not None:
                take(content, size)

        return on_sample


def content_hash(content: bytes) -> bytes:
    """Return the hash by which an announcement is known."""
    return hashlib.sha256(content).digest()
