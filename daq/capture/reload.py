"""A changed configuration for a capture that goes on: what can change does, at once; what cannot is refused in a line.

The new configuration is read and checked in a thread of its own; the capture takes it over between two looks at the
bus, so that no sample waits for it.
"""

import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from armident.configs import ArmidentError, ConfigError, SessionConfig, load_robot, load_session
from armident.daq.capture.journal import Line
from armident.daq.capture.plan import CapturePlan

CHANGEABLE = (
    "recording.rotate_mb",
    "recording.rotate_minutes",
    "recording.keep_days",
    "recording.min_free_gb",
    "recording.chunk_ms",
    "recording.drain_ms",
    "recording.trigger.",
    "zenoh.queue_blocks",
    "zenoh.commands",
    "metrics.port",
    "metrics.address",
    "identification",
)
"""Keys of a session that may change while it is captured; ``identification`` is the worker's."""

Change = Callable[[SessionConfig], None]


class Reloader:
    """Reads the configuration again when it is asked to.

    Parameters
    ----------
    config
        The file of the session.
    order
        What is being captured.
    changes
        Take a session over, one part of the capture each, in this order. They are called where :meth:`apply` is; one
        that raises ConfigError keeps those behind it from changing.
    say
        Takes lines.
    """

    def __init__(
        self, config: str | Path, order: CapturePlan, changes: Sequence[Change], say: Callable[[str], None]
    ) -> None:
        self._config, self._order, self._changes, self._say = config, order, changes, say
        self._session = order.session
        self._asked: SimpleQueue[bool] = SimpleQueue()
        self._ready: SimpleQueue[SessionConfig] = SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="reload", daemon=True)
        self._thread.start()

    def ask(self) -> None:
        """Have the configuration read again; may be called from anywhere, a signal's handler included."""
        self._asked.put(True)

    def apply(self) -> None:
        """Take over what was read meanwhile; called between two looks at the bus."""
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
        what = ", ".join(changed) if changed else "nothing has changed"
        self._say(Line(f"reloaded {self._config}: {what}", event="reloaded"))

    def close(self) -> None:
        """Listen no more."""
        self._asked.put(False)
        self._thread.join()

    def _run(self) -> None:
        while self._asked.get():
            try:
                self._ready.put(self._checked())
            except ArmidentError as error:
                self._refuse(str(error))

    def _checked(self) -> SessionConfig:
        """The session as it is in the file now.

        Raises
        ------
        ConfigError
            If it cannot be read, or something has changed that cannot while it is captured.
        """
        session = load_session(self._config)
        fixed = [key for key in differences(self._session, session) if not key.startswith(CHANGEABLE)]
        if fixed:
            raise ConfigError(f"{self._config}: {', '.join(fixed)}: cannot change while it is captured")
        if load_robot(session.robot) != self._order.robot:
            raise ConfigError(f"{session.robot}: the robot cannot change while it is captured")
        return session

    def _refuse(self, why: str) -> None:
        self._say(Line(f"warning: not reloaded, the capture goes on as before: {why}", event="reload_refused"))


def differences(one: SessionConfig, other: SessionConfig) -> Iterator[str]:
    """Keys of two sessions whose values differ, as ``recording.rotate_mb``."""
    yield from _differing(one.model_dump(by_alias=True), other.model_dump(by_alias=True), "")


def _differing(one: Any, other: Any, key: str) -> Iterator[str]:
    if isinstance(one, dict) and isinstance(other, dict):
        for name in sorted(one.keys() | other.keys(), key=str):
            yield from _differing(one.get(name), other.get(name), f"{key}.{name}" if key else str(name))
    elif one != other:
        yield key
