"""Publisher of a capture on Zenoh, in a thread of its own: slow subscribers never delay the capture."""

import json
import logging
import threading
import time
from collections import deque
from collections.abc import Mapping
from typing import Any

import zenoh
import zenoh.ext

from armident.configs import ConfigError, SessionConfig
from armident.daq.capture.remote_commands import Commands
from armident.daq.identity.signatures import signer_for, trust_for
from armident.daq.streaming import Block, Keys, encode_block, open_session
from armident.daq.streaming.zenoh_session import configuration

_EVENTS_KEPT = 64
"""Events that late subscribers can query."""
_MOST_EVENTS = 4096
"""Largest number of waiting events."""
_HEARTBEAT_S = 0.2
"""Interval at which sequence numbers are repeated, so that subscribers detect a miss, s."""
_LINGER_S = 0.5
"""Time for subscribers to query missed samples at the end, s."""
_LONGEST_CLOSE_S = 5.0
"""Longest wait for the queue at the end, s."""
RETRY_S = 2.0
"""Time until the next attempt to open a Zenoh session, s."""
FIND_S = 1.0
"""Longest wait for the liveliness token of another capture, s."""

log = logging.getLogger(__name__)


class Publisher:
    """Publishes blocks, events, health and status of a capture, which does not depend on it: its thread tries again.

    If the queue of blocks (``session.zenoh.queue_blocks``) is full, they are dropped and counted; the file remains
    complete. Sequence numbers show missing blocks; the last ``cache_blocks`` can be queried. Of health and status only
    the latest waits. ``exclusive``: refuse to run beside another capture, whose master would command the same drives.
    """

    def __init__(self, session: SessionConfig, keys: Keys, *, exclusive: bool = True) -> None:
        configuration(session, "capture")
        self.offered = 0
        self.dropped = 0
        self.events_dropped = 0
        self._limit = session.zenoh.queue_blocks
        self._waiting = 0
        self._queue: deque[tuple[str, Block | bytes]] = deque()
        self._events_waiting = 0
        self._latest: dict[str, bytes] = {}
        self._ready = threading.Condition()
        self._closing = False
        self._over = threading.Event()
        self._keys, self._config = keys, session
        self._session: zenoh.Session | None = None
        self.problem: str | None = None
        """Reason why there is no Zenoh session, or ``None``."""
        self.commands = Commands(keys, session.zenoh.commands)
        if not self._try_open() and exclusive and _capture_runs(session, keys):
            raise ConfigError(f"another capture of cell {session.cell}, robot {keys.robot}, is running")
        self._thread = threading.Thread(target=self._run, name="zenoh", daemon=True)
        self._thread.start()

    @property
    def is_open(self) -> bool:
        """True if there is a Zenoh session."""
        return self._session is not None

    @property
    def depth(self) -> int:
        """Number of waiting blocks."""
        return self._waiting

    def change(self, session: SessionConfig) -> None:
        """Apply the ``zenoh`` options of a reloaded session: length of the queue, and permission of commands."""
        self._limit = session.zenoh.queue_blocks
        self.commands.allowed = session.zenoh.commands

    def offer(self, block: Block) -> None:
        """Queue a block, or drop it if the queue is full; never blocks."""
        with self._ready:
            self.offered += 1
            if self._waiting >= self._limit:
                self.dropped += 1
                return
            self._waiting += 1
            self._queue.append((self._keys.samples, block))
            self._ready.notify()

    def event(self, data: bytes) -> None:
        """Queue an encoded event, or drop it if the queue is full; never blocks."""
        with self._ready:
            if self._events_waiting >= _MOST_EVENTS:
                self.events_dropped += 1
                return
            self._events_waiting += 1
            self._queue.append((self._keys.events, data))
            self._ready.notify()

    def health(self, content: Mapping[str, Any]) -> None:
        """Queue a health message; it replaces one that still waits."""
        self._put(self._keys.health, json.dumps(content).encode())

    def status(self, content: Mapping[str, Any]) -> None:
        """Queue a status message; it replaces one that still waits."""
        self._put(self._keys.status, json.dumps({"component": "capture", **content}).encode())

    def close(self) -> None:
        """Send the queue, wait a moment for queries of missed samples, and close the Zenoh session."""
        with self._ready:
            self._closing = True
            self._ready.notify()
        self._over.set()
        self._thread.join(_LONGEST_CLOSE_S)
        if self._session is None:
            return
        with self._ready:
            self._ready.wait(_LINGER_S)
        self._close_session(self._session)

    def _try_open(self) -> bool:
        """Open a session and declare all that is published; log a failure once."""
        opened = None
        try:
            self._signer = signer_for(self._config, "capture")
            trust = trust_for(self._config, self._keys.base)
            opened = open_session(self._config, "capture")
            self.commands.declare(opened, self._signer, trust)
            cached = self._config.zenoh.cache_blocks
            self._samples = _declared(opened, self._keys.samples, cached, zenoh.CongestionControl.DROP)
            self._events = _declared(opened, self._keys.events, _EVENTS_KEPT, zenoh.CongestionControl.BLOCK)
            self._token = opened.liveliness().declare_token(self._keys.alive("capture"))
        except (ConfigError, zenoh.ZError) as error:
            if opened is not None:
                self._close_session(opened)
            self._fail(error)
            return False
        if self.problem is not None:
            log.info("zenoh: the session is open; %d blocks were not published", self.dropped)
        self._session, self.problem = opened, None
        return True

    def _fail(self, error: Exception) -> None:
        self._session = None
        text = str(error) if isinstance(error, ConfigError) else "zenoh: the session failed"
        if text != self.problem:
            log.warning("%s; recording continues, publishing is tried again every %g s", text, RETRY_S)
        self.problem = text

    def _close_session(self, session: zenoh.Session) -> None:
        try:
            session.close()
        except zenoh.ZError as error:
            log.debug("zenoh: %s", error)

    def _put(self, key: str, data: bytes) -> None:
        with self._ready:
            self._latest[key] = data
            self._ready.notify()

    def _run(self) -> None:
        while True:
            if self._session is None and not self._try_open():
                if self._over.wait(RETRY_S):
                    return
                continue
            with self._ready:
                while not self._queue and not self._latest and not self._closing:
                    self._ready.wait()
                latest, self._latest = self._latest, {}
                waiting = self._queue.popleft() if self._queue else None
                if waiting is None and not latest:
                    return
            try:
                self._send(latest, None if waiting is None else waiting[1])
            except zenoh.ZError as error:
                self._fail(error)
                with self._ready:
                    self.dropped += waiting is not None and isinstance(waiting[1], Block)
            if waiting is not None:
                with self._ready:
                    if isinstance(waiting[1], Block):
                        self._waiting -= 1
                    else:
                        self._events_waiting -= 1

    def _send(self, latest: Mapping[str, bytes], waiting: Block | bytes | None) -> None:
        assert self._session is not None
        for key, data in latest.items():
            self._session.put(key, data, attachment=self._signer.attachment(key, data))
        if isinstance(waiting, Block):
            block = encode_block(waiting)
            self._samples.put(block, attachment=self._signer.attachment(self._keys.samples, block))
        elif waiting is not None:
            self._events.put(waiting, attachment=self._signer.attachment(self._keys.events, waiting))


def _declared(
    session: zenoh.Session, key: str, kept: int, congestion: zenoh.CongestionControl
) -> zenoh.ext.AdvancedPublisher:
    return zenoh.ext.declare_advanced_publisher(
        session,
        key,
        congestion_control=congestion,
        cache=zenoh.ext.CacheConfig(max_samples=kept) if kept else None,
        sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=_HEARTBEAT_S, sporadic_heartbeat=None),
        publisher_detection=True,
    )


def _capture_runs(session: SessionConfig, keys: Keys) -> bool:
    """Return True if the token of another capture of this robot is found."""
    until = time.monotonic() + FIND_S
    try:
        with open_session(session, "observer") as observer:
            while time.monotonic() < until:
                if any(reply.ok is not None for reply in observer.liveliness().get(keys.alive("capture"), timeout=0.3)):
                    return True
                time.sleep(0.1)
    except (ConfigError, zenoh.ZError):
        return False
    return False
