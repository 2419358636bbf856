"""Zenoh session of a worker: opened again after a failure, and beside other workers of the cell."""

import logging
import threading
from collections.abc import Callable
from typing import Any

import zenoh

from armident.configs import ArmidentError, ConfigError, SessionConfig
from armident.daq.identity.plant import Countdown
from armident.daq.identity.signatures import signer_for
from armident.daq.streaming import Announcer, Keys, open_session
from armident.daq.streaming.announcer import longest_retry_s
from armident.daq.streaming.zenoh_session import configuration
from armident.identify.monitoring.worker.status_messages import status_message
from armident.identify.monitoring.worker.worker_receiver import Take, WorkerReceiver

log = logging.getLogger(__name__)


class LinkDown(ArmidentError):
    """There is no Zenoh session at present; the worker tries again."""


class WorkerLink:
    """Subscriptions, answers and announcements of a worker, which works on with the files without a session.

    The first worker of a cell listens on the port of its role; others take it over when it is free. ``limits``: event
    and block, bytes; larger ones are ``None``. ``answer`` takes parameter ``since`` of a query for results if it has
    one; its ArmidentError or OSError is answered. ConfigError: wrong configuration of Zenoh, or no key.
    """

    def __init__(
        self,
        session: SessionConfig,
        keys: Keys,
        on_event: Take,
        on_block: Take,
        limits: tuple[int, int],
        answer: Callable[[str | None], bytes],
    ) -> None:
        self._retry_s = longest_retry_s(configuration(session, "worker"))
        self._config, self._keys, self._answer = session, keys, answer
        self.signer = signer_for(session, "worker")
        """Signs what the worker publishes, and its documents."""
        self.receiver = WorkerReceiver(session, keys, on_event, on_block, limits)
        """Subscriptions, in a session of their own."""
        self.backlog = 0
        self._countdown = Countdown(session)
        self._session: zenoh.Session | None = None
        self._announcer: Announcer | None = None
        self._shared = False
        self._problem: str | None = None
        self._lock = threading.Lock()

    @property
    def can_announce(self) -> bool:
        """True if there is a session that all listeners have had time to find, and a certificate that is valid."""
        announcer = self._announcer
        return announcer is not None and announcer.ready_in_s == 0.0 and self.signer.is_valid

    def check(self) -> None:
        """Open sessions that are missing, and take the port of the role if another worker has left it."""
        self._countdown.check()
        self.receiver.check()
        if self._session is not None and not self._shared:
            return
        try:
            self._use(open_session(self._config, "worker"), shared=False)
        except ConfigError as error:
            if self._session is not None:
                return
            try:
                self._use(open_session(self._config, "worker", any_port=True), shared=True)
                log.info(
                    "the worker port of cell %s is taken, as by another worker; workers share the recordings",
                    self._config.cell,
                )
            except (ConfigError, zenoh.ZError):
                if str(error) != self._problem:
                    log.warning("%s; results are announced later, trying again", error)
                self._problem = str(error)

    def announce(self, *messages: tuple[str, bytes]) -> None:
        """Publish key expressions and contents, which have left the process on return; raises LinkDown on failure."""
        with self._lock:
            if self._announcer is None or not self.can_announce:
                raise LinkDown("zenoh: no session yet")
            try:
                self._announcer.announce(*messages)
            except zenoh.ZError as error:
                raise LinkDown("zenoh: the session failed") from error

    def status(self, state: str, **more: Any) -> None:
        """Publish the state of the worker and its backlog if there is a session. ``more``: further entries."""
        content = status_message("worker", state, backlog=self.backlog, **more)
        with self._lock:
            if self._session is None:
                return
            try:
                key = self._keys.status
                self._session.put(key, content, attachment=self.signer.attachment(key, content))
            except zenoh.ZError as error:
                log.debug("status not published: %s", error)

    def close(self) -> None:
        """Close the sessions."""
        self.receiver.close()
        with self._lock:
            session, self._session, self._announcer = self._session, None, None
        if session is not None:
            session.close()

    def _use(self, session: zenoh.Session, *, shared: bool) -> None:
        """Replace the session; the new one answers before the old one is closed."""
        try:
            kept: list[Any] = [
                session.declare_queryable(self._keys.identification, self._on_query),
                session.liveliness().declare_token(self._keys.alive("worker")),
            ]
        except BaseException:
            session.close()
            raise
        with self._lock:
            old, self._session = self._session, session
            self._announcer = Announcer(session, self._keys, self._retry_s, self.signer)
            self._declared, self._shared, self._problem = kept, shared, None
        if old is not None:
            old.close()

    def _on_query(self, query: zenoh.Query) -> None:
        with query:
            try:
                self.signer.reply(query, self._keys.identification, self._answer(query.parameters.get("since")))
            except (ArmidentError, OSError) as error:
                query.reply_err(str(error).encode())
