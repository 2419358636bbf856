"""Publisher of status and results on Zenoh, with the keys of the worker."""

import logging
import time
from contextlib import AbstractContextManager
from types import TracebackType
from typing import Any

import zenoh

from armident.configs import ConfigError, RobotConfig, SessionConfig
from armident.daq.identity.signatures import signer_for
from armident.daq.streaming import Announcer, Keys, open_session
from armident.daq.streaming.announcer import longest_retry_s
from armident.daq.streaming.zenoh_session import configuration
from armident.identify.monitoring.worker.status_messages import failure_status, status_message

log = logging.getLogger(__name__)

LINGER_S = 1.0
"""Time for which queries for a result are answered after it was published, s."""


class StatusPublisher(AbstractContextManager["StatusPublisher", None]):
    """Publishes status and results of one job, on the port of the worker if no worker runs, else on a free port."""

    def __init__(self, session: SessionConfig, robot: RobotConfig) -> None:
        self._keys = Keys(session.cell, robot.name)
        self.signer = signer_for(session, "worker")
        """Signs what the job publishes, and its documents."""
        try:
            self._session = open_session(session, "worker")
        except ConfigError:
            self._session = open_session(session, "worker", any_port=True)
        retry_s = longest_retry_s(configuration(session, "worker"))
        self._announcer = Announcer(self._session, self._keys, retry_s, self.signer)
        self._last: bytes | None = None
        self._queryable = self._session.declare_queryable(self._keys.identification, self._answer)

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            if query.parameters.get("since") is not None:
                query.reply_err(b"a job knows its own result only; the worker of the cell knows those since a time")
            elif self._last is None:
                query.reply_err(b"no identification yet")
            else:
                self.signer.reply(query, self._keys.identification, self._last)

    def wait_for_listeners(self) -> None:
        """Wait until all listeners have had time to connect."""
        time.sleep(self._announcer.ready_in_s)

    def status(self, state: str, **more: Any) -> None:
        """Publish the state of the job, with further keys."""
        self._put(self._keys.status, status_message("reidentify", state, **more))

    def failure(self, message: str, name: str, sha256: str) -> None:
        """Publish why a recording cannot be identified. ``name``, ``sha256``: name of the recording and its hash."""
        self._put(self._keys.status, failure_status("reidentify", message, name, sha256))

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
            self._announcer.announce((key, data))
        except zenoh.ZError:
            log.warning("zenoh: the session failed; %s was not published", key)
            return False
        return True

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the session, after `LINGER_S` if a result was published."""
        if self._last is not None and kind is None:
            time.sleep(LINGER_S)
        self._session.close()
