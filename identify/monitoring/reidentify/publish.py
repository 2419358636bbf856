"""Publisher of status and results on Zenoh, with the keys of the worker."""

import json
import logging
import time
from types import TracebackType
from typing import Any, Self

import zenoh

from armident.configs import ConfigError, RobotConfig, SessionConfig
from armident.daq.streaming import Keys, open_session

log = logging.getLogger(__name__)

LINGER_S = 1.0
"""Time for which queries for a result are answered after it was published, s."""


class StatusPublisher:
    """Publishes status and results of one job.

    It listens on the port of the worker if no worker runs, and on a free port otherwise.

    Parameters
    ----------
    session
        Configuration of the cell.
    robot
        Configuration of its robot.
    """

    def __init__(self, session: SessionConfig, robot: RobotConfig) -> None:
        self._keys = Keys(session.cell, robot.name)
        try:
            self._session = open_session(session, "worker")
        except ConfigError:
            self._session = open_session(session, "worker", any_port=True)
        self._last: bytes | None = None
        self._queryable = self._session.declare_queryable(self._keys.identification, self._answer)

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            if self._last is None:
                query.reply_err(b"no identification yet")
            else:
                query.reply(self._keys.identification, self._last)

    def status(self, state: str, **more: Any) -> None:
        """Publish the state of the job, with further keys."""
        content = {"component": "reidentify", "state": state, **more}
        self._put(self._keys.status, json.dumps(content).encode())

    def result(self, text: str) -> bool:
        """Publish an identification document and answer queries with it; return False if Zenoh did not take it."""
        self._last = text.encode()
        return self._put(self._keys.identification, self._last)

    def diagnosis(self, text: str) -> None:
        """Publish a diagnosis document."""
        self._put(self._keys.diagnosis, text.encode())

    def _put(self, key: str, data: bytes) -> bool:
        """Publish a message; the job does not depend on it, because the result is in its file."""
        try:
            # As the worker's announcements: dropped by no full queue.
            self._session.put(key, data, express=True, congestion_control=zenoh.CongestionControl.BLOCK)
        except zenoh.ZError:
            log.warning("zenoh: the session failed; %s was not published", key)
            return False
        return True

    def __enter__(self) -> Self:
        """Return the publisher."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the session, after `LINGER_S` if a result was published."""
        if self._last is not None and kind is None:
            time.sleep(LINGER_S)
        self._session.close()
