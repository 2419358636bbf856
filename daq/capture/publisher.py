"""Publisher of a capture on Zenoh, in a thread of its own: slow subscribers never delay the capture."""

import json
import threading
from collections import deque
from collections.abc import Mapping
from typing import Any

import zenoh
import zenoh.ext

from armident.configs import SessionConfig
from armident.daq.capture.remote_commands import Commands
from armident.daq.streaming import Block, Keys, encode_block, open_session

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


class Publisher:
    """Publishes blocks, events, health and status of a capture.

    Blocks wait in a queue of ``session.zenoh.queue_blocks``. If it is full they are dropped and counted; the file
    remains complete. Subscribers detect missing blocks by sequence numbers, and can query the last
    ``cache_blocks``. Events are dropped only if thousands wait. Of health and status only the latest waits.

    Parameters
    ----------
    session
        The cell's configuration.
    keys
        The key expressions of the robot.

    Raises
    ------
    ConfigError
        If no Zenoh session can be opened.
    """

    def __init__(self, session: SessionConfig, keys: Keys) -> None:
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
        self._keys = keys
        self._session = open_session(session, "capture")
        self.commands = Commands(self._session, keys, session.zenoh.commands)
        self._token = self._session.liveliness().declare_token(keys.alive("capture"))
        self._samples = self._declare_publisher(keys.samples, session.zenoh.cache_blocks, zenoh.CongestionControl.DROP)
        self._events = self._declare_publisher(keys.events, _EVENTS_KEPT, zenoh.CongestionControl.BLOCK)
        self._thread = threading.Thread(target=self._run, name="zenoh", daemon=True)
        self._thread.start()

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
        self._thread.join(_LONGEST_CLOSE_S)
        with self._ready:
            self._ready.wait(_LINGER_S)
        self._token.undeclare()
        self._session.close()

    def _declare_publisher(
        self, key: str, kept: int, congestion: zenoh.CongestionControl
    ) -> zenoh.ext.AdvancedPublisher:
        return zenoh.ext.declare_advanced_publisher(
            self._session,
            key,
            congestion_control=congestion,
            cache=zenoh.ext.CacheConfig(max_samples=kept) if kept else None,
            sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=_HEARTBEAT_S, sporadic_heartbeat=None),
            publisher_detection=True,
        )

    def _put(self, key: str, data: bytes) -> None:
        with self._ready:
            self._latest[key] = data
            self._ready.notify()

    def _run(self) -> None:
        while True:
            with self._ready:
                while not self._queue and not self._latest and not self._closing:
                    self._ready.wait()
                latest, self._latest = self._latest, {}
                waiting = self._queue.popleft() if self._queue else None
                if waiting is None and not latest:
                    return
            for key, data in latest.items():
                self._session.put(key, data)
            if waiting is None:
                continue
            key, item = waiting
            if isinstance(item, Block):
                self._samples.put(encode_block(item))
                with self._ready:
                    self._waiting -= 1
            else:
                self._events.put(item)
                with self._ready:
                    self._events_waiting -= 1
