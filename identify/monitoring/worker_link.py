"""Zenoh session of a worker: opened again after a failure, and beside other workers of the cell."""

import hashlib
import json
import logging
import threading
from collections import deque
from collections.abc import Callable
from typing import Any

import zenoh
import zenoh.ext

from armident.configs import ArmidentError, ConfigError, SessionConfig
from armident.daq.streaming import Announcer, Keys, open_session
from armident.daq.streaming.announcer import longest_retry_s
from armident.daq.streaming.session import configuration

log = logging.getLogger(__name__)

HISTORY_BLOCKS = 100_000
"""Number of blocks that a worker requests from the capture's cache when it starts: all of it."""


MOST_HEARD = 1000
"""Number of messages of other workers that are noted between two looks at the ledger."""


class LinkDown(ArmidentError):
    """There is no Zenoh session at present; the worker tries again."""


class WorkerLink:
    """Subscriptions, answers and announcements of a worker.

    It notes the announcements of other workers by the hash of their content, so that one which a killed worker has
    made, but not entered in the ledger, is known.

    The first worker of a cell listens on the port of its role. Others listen on a free port, and one of them takes the
    port of the role when it is free again. Without a session the worker continues with the files.

    Parameters
    ----------
    session
        Configuration of the cell.
    keys
        Keys of its robot.
    on_event, on_block
        Take an encoded message (``None`` if it is larger than the limit) and its size, bytes.
    limits
        Largest event and block that are passed on, bytes.
    answer
        Returns the last result, or ``None``.

    Raises
    ------
    ConfigError
        If Zenoh's configuration is wrong.
    """

    def __init__(
        self,
        session: SessionConfig,
        keys: Keys,
        on_event: Callable[[bytes | None, int], None],
        on_block: Callable[[bytes | None, int], None],
        limits: tuple[int, int],
        answer: Callable[[], bytes | None],
    ) -> None:
        self._retry_s = longest_retry_s(configuration(session, "worker"))
        self._config, self._keys, self._answer = session, keys, answer
        self._handlers = ((keys.events, on_event, limits[0]), (keys.samples, on_block, limits[1]))
        self._session: zenoh.Session | None = None
        self._announcer: Announcer | None = None
        self._heard: deque[bytes] = deque(maxlen=MOST_HEARD)
        self._beside = False
        self._problem: str | None = None
        self._lock = threading.Lock()

    @property
    def can_announce(self) -> bool:
        """True if there is a session that all listeners have had time to find."""
        announcer = self._announcer
        return announcer is not None and announcer.ready_in_s == 0.0

    def take_heard(self) -> set[bytes]:
        """Return the hashes of what others have published on the keys of announcements since the last call."""
        return {self._heard.popleft() for _ in range(len(self._heard))}

    def check(self) -> None:
        """Open the session if there is none, and take the port of the role if another worker has left it."""
        if self._session is not None and not self._beside:
            return
        try:
            self._use(open_session(self._config, "worker"), beside=False)
        except ConfigError as error:
            if self._session is not None:
                return
            try:
                self._use(open_session(self._config, "worker", any_port=True), beside=True)
                log.info(
                    "the worker port of cell %s is taken, as by another worker; workers share the recordings",
                    self._config.cell,
                )
            except (ConfigError, zenoh.ZError):
                if str(error) != self._problem:
                    log.warning("%s; recordings are identified from their files, trying again", error)
                self._problem = str(error)

    def announce(self, *messages: tuple[str, bytes]) -> None:
        """Publish a result or a failure; it has left the process when this returns.

        Parameters
        ----------
        messages
            Key expressions and contents.

        Raises
        ------
        LinkDown
            If there is no session, it is too new, or it fails.
        """
        with self._lock:
            if self._announcer is None or not self.can_announce:
                raise LinkDown("zenoh: no session yet")
            try:
                self._announcer.announce(*messages)
            except zenoh.ZError as error:
                raise LinkDown("zenoh: the session failed") from error

    def status(self, state: str, **more: Any) -> None:
        """Publish the state of the worker if there is a session.

        Parameters
        ----------
        state
            Name of the state.
        more
            Further entries.
        """
        content = json.dumps({"component": "worker", "state": state, **more}).encode()
        with self._lock:
            if self._session is None:
                return
            try:
                self._session.put(self._keys.status, content)
            except zenoh.ZError as error:
                log.debug("status not published: %s", error)

    def close(self) -> None:
        """Close the session."""
        with self._lock:
            session, self._session, self._announcer = self._session, None, None
        if session is not None:
            session.close()

    def _use(self, session: zenoh.Session, *, beside: bool) -> None:
        """Replace the session; the new one is subscribed before the old one is closed."""
        try:
            history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=HISTORY_BLOCKS)
            recovery = zenoh.ext.RecoveryConfig(heartbeat=True, periodic_queries=None)
            kept: list[Any] = [
                zenoh.ext.declare_advanced_subscriber(
                    session, key, _limited(take, limit), history=history, recovery=recovery, subscriber_detection=True
                )
                for key, take, limit in self._handlers
            ]
            kept += [
                session.declare_subscriber(key, self._hear, allowed_origin=zenoh.Locality.REMOTE)
                for key in (self._keys.identification, self._keys.status)
            ]
            kept.append(session.declare_queryable(self._keys.identification, self._on_query))
            kept.append(session.liveliness().declare_token(self._keys.alive("worker")))
        except BaseException:
            session.close()
            raise
        with self._lock:
            old, self._session = self._session, session
            self._announcer = Announcer(session, self._keys, self._retry_s)
            self._declared, self._beside, self._problem = kept, beside, None
        if old is not None:
            old.close()

    def _hear(self, sample: zenoh.Sample) -> None:
        self._heard.append(content_hash(bytes(sample.payload)))

    def _on_query(self, query: zenoh.Query) -> None:
        with query:
            last = self._answer()
            if last is None:
                query.reply_err(b"no identification yet")
            else:
                query.reply(self._keys.identification, last)


def _limited(take: Callable[[bytes | None, int], None], limit: int) -> Callable[[zenoh.Sample], None]:
    def on_sample(sample: zenoh.Sample) -> None:
        size = len(sample.payload)
        take(bytes(sample.payload) if size <= limit else None, size)

    return on_sample


def content_hash(content: bytes) -> bytes:
    """Return the hash by which an announcement is known.

    Parameters
    ----------
    content
        The message.
    """
    return hashlib.sha256(content).digest()
