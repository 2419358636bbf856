"""Reload of the configuration by a thread; the capture applies keys of `CHANGEABLE` between two reads of the buses."""

import logging
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from armident.configs import ArmidentError, ConfigError, SessionConfig, load_robot, load_session
from armident.daq.capture.plan import CapturePlan

CHANGEABLE = (
    "recording.rotate_mb",
    "recording.rotate_minutes",
    "recording.keep_days",
    "recording.min_free_gb",
    "recording.copied_to",
    "recording.keep_results_days",
    "recording.chunk_ms",
    "recording.drain_ms",
    "recording.trigger.",
    "zenoh.queue_blocks",
    "zenoh.commands",
    "metrics.port",
    "metrics.worker_port",
    "metrics.address",
    "identification",
)
"""Keys of a session that may change during its capture; the worker takes some of them at its next start."""

Change = Callable[[SessionConfig], None]
"""Applies a changed session to one part of the capture; may raise ConfigError."""

log = logging.getLogger(__name__)


class Reloader:
    """Reads the session's file again on request; :meth:`apply` calls ``changes`` up to the first ConfigError."""

    def __init__(self, config: str | Path, plan: CapturePlan, changes: Sequence[Change]) -> None:
        self._config, self._plan, self._changes = config, plan, changes
        self._session = plan.session
        self._requests: SimpleQueue[bool] = SimpleQueue()
        self._ready: SimpleQueue[SessionConfig] = SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="reload", daemon=True)
        self._thread.start()

    def request(self) -> None:
        """Have the configuration read again; may be called from any thread and from a signal handler."""
        self._requests.put(True)

    def apply(self) -> None:
        """Apply the configuration if one was read meanwhile; called between two reads of the buses."""
        try:
            session = self._ready.get_nowait()
        except Empty:
            return
        changed = list(differences(self._session, session))
        try:
            for change in self._changes:
                change(session)
        except ConfigError as error:
            self._refuse(str(error))
            return
        self._session = session
        what = ", ".join(changed) if changed else "the session has not changed"
        log.info("reloaded %s: %s", self._config, what, extra={"event": "reloaded"})

    def close(self) -> None:
        """End the thread."""
        self._requests.put(False)
        self._thread.join()

    def _run(self) -> None:
        while self._requests.get():
            try:
                self._ready.put(self._checked())
            except ArmidentError as error:
                self._refuse(str(error))

    def _checked(self) -> SessionConfig:
        """Return the session as it is in the file now; ConfigError if a key has changed that may not."""
        session = load_session(self._config, "capture")
        fixed = [key for key in differences(self._session, session) if not key.startswith(CHANGEABLE)]
        if fixed:
            raise ConfigError(
                f"{self._config}: {', '.join(fixed)}: cannot change during a capture; restart the capture"
            )
        if load_robot(session.robot, "capture") != self._plan.robot:
            raise ConfigError(f"{session.robot}: the robot cannot change during a capture; restart the capture")
        return session

    def _refuse(self, why: str) -> None:
        log.warning("not reloaded, the capture continues unchanged: %s", why, extra={"event": "reload_refused"})


def differences(one: SessionConfig, other: SessionConfig) -> Iterator[str]:
    """Yield the keys whose values differ between two sessions, as ``recording.rotate_mb``."""
    yield from _differing(one.model_dump(by_alias=True), other.model_dump(by_alias=True), "")


def _differing(one: Any, other: Any, key: str) -> Iterator[str]:
    if isinstance(one, dict) and isinstance(other, dict):
        for name in sorted(one.keys() | other.keys(), key=str):
            yield from _differing(one.get(name), other.get(name), f"{key}.{name}" if key else str(name))
    elif one != other:
        yield key
