"""Last messages of the captures and workers of the cells, heard on Zenoh."""

import json
import logging
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import zenoh

from armident.configs import ArmidentError, ConfigError, DataError
from armident.daq.identity.signatures import trust_for
from armident.daq.streaming import Keys, Refusals, decode_event, open_session
from armident.identify.monitoring.worker.stream_buffer import LARGEST_EVENT
from armident.identify.page.cells import Cell

log = logging.getLogger(__name__)

LARGEST_MESSAGE = 1 << 16
"""Largest health or status message, bytes; one of six axes has 2 kB."""

AT_A_TIME = 16
"""Number of Zenoh sessions that are opened or closed at a time."""


@dataclass(frozen=True)
class Message:
    """Message with the time at which it was heard, s of the monotonic clock."""

    heard: float
    content: dict[str, Any]


@dataclass
class Live:
    """Last messages of one cell, each replaced as a whole; times in s of the monotonic clock."""

    began: float
    health: Message | None = None
    moved: float | None = None
    ended: float | None = None
    status: dict[str, Message] = field(default_factory=dict)
    alive: frozenset[str] = frozenset()
    problem: str | None = None

    def take_health(self, data: bytes) -> None:
        """Take a health message; one that is none is left out."""
        content, now = _object(data), time.monotonic()
        if content is not None:
            if self.health is None or content.get("sync") != self.health.content.get("sync"):
                self.moved = now
            self.health = Message(now, content)

    def take_status(self, data: bytes) -> None:
        """Take a status message of a capture, worker or re-identification."""
        content = _object(data)
        if content is not None and content.get("component") in ("capture", "worker", "reidentify"):
            self.status = {**self.status, content["component"]: Message(time.monotonic(), content)}

    def take_event(self, data: bytes) -> None:
        """Take an event: the regular end of a capture is no failure."""
        try:
            if decode_event(data)["kind"] == "experiment_end":
                self.ended = time.monotonic()
        except ArmidentError:
            log.debug("an event that is none")


def _object(data: bytes) -> dict[str, Any] | None:
    """Return a JSON object with its plain values."""
    try:
        found = json.loads(data)
    except (ValueError, RecursionError):
        return None
    if not isinstance(found, dict):
        return None
    return {key: value for key, value in found.items() if value is None or isinstance(value, str | int | float)}


class Listener:
    """Subscribes to health, status, ends and liveliness of cells; sessions that cannot be opened are tried again."""

    def __init__(self, cells: Sequence[Cell]) -> None:
        now = time.monotonic()
        self.live = {cell.name: Live(now) for cell in cells}
        self._missing = [cell for cell in cells if cell.session is not None]
        self._sessions: list[zenoh.Session] = []
        self._closing, self._refusals = False, Refusals(log)
        self._lock = threading.Lock()

    def check(self) -> None:
        """Open the sessions that are missing, several at a time: each takes half a second."""
        with self._lock, ThreadPoolExecutor(AT_A_TIME) as pool:
            opened = list(pool.map(self._opened, self._missing))
            self._missing = [cell for cell, done in zip(self._missing, opened, strict=True) if not done]

    def close(self) -> None:
        """Close all sessions."""
        self._closing = True
        with self._lock, ThreadPoolExecutor(AT_A_TIME) as pool:
            list(pool.map(lambda session: session.close(), self._sessions))
            self._sessions, self._missing = [], []

    def _opened(self, cell: Cell) -> bool:
        """Open the session of a cell and subscribe; False with the problem of the cell if that fails."""
        live = self.live[cell.name]
        if self._closing:
            return False
        assert cell.session is not None
        assert cell.robot is not None
        keys = Keys(cell.session.cell, cell.robot.name)
        try:
            trust = trust_for(cell.session, keys.base)
            # In a file for all roles, the port is that of the capture.
            session = open_session(cell.session, "observer", any_port=cell.session.zenoh.config is not None)
        except ConfigError as error:
            live.problem = str(error)
            return False

        def note(sample: zenoh.Sample) -> None:
            component = str(sample.key_expr).rpartition("/")[2]
            is_here = sample.kind == zenoh.SampleKind.PUT
            live.alive = live.alive | {component} if is_here else live.alive - {component}

        def taking(take: Callable[[bytes], None], most: int) -> Callable[[zenoh.Sample], None]:
            newest: dict[str, int] = {}

            def heard(sample: zenoh.Sample) -> None:
                try:
                    if (size := len(sample.payload)) > most:
                        raise DataError(f"{sample.key_expr}: a message of {size} bytes")
                    data = bytes(sample.payload)
                    found = trust.check("publish", sample.key_expr, data, sample.attachment)
                    if found.time_ns <= newest.get(found.name, 0):
                        raise DataError(f"{sample.key_expr}: an old message of {found.name}, repeated")
                    newest[found.name] = found.time_ns
                    take(data)
                except DataError as error:
                    self._refusals.refuse("page", error)

            return heard

        session.declare_subscriber(keys.health, taking(live.take_health, LARGEST_MESSAGE))
        session.declare_subscriber(keys.status, taking(live.take_status, LARGEST_MESSAGE))
        session.declare_subscriber(keys.events, taking(live.take_event, LARGEST_EVENT))
        session.liveliness().declare_subscriber(keys.alive("*"), note, history=True)
        self._sessions.append(session)
        live.problem = None
        return True
