"""Limits of the clients of the server: who signs in, that they only read, and how much they may occupy."""

import asyncio
import logging
import secrets
import socket
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any

from asyncua import Server, ua
from asyncua.common.connection import TransportLimits
from asyncua.common.utils import ServiceError
from asyncua.crypto.permission_rules import User, UserRole
from asyncua.server.binary_server_asyncio import BinaryServer, OPCUAProtocol
from asyncua.server.internal_server import InternalServer
from asyncua.server.internal_session import InternalSession
from asyncua.server.user_managers import UserManager

from armident.configs import ConfigError, DataError
from armident.daq.identity.certificates import signer_of
from armident.daq.identity.folder import KeyFolder
from armident.daq.streaming import Refusals

log = logging.getLogger(__name__)

CONNECTIONS, SESSIONS = 64, 32
"""Most connections, and most sessions, at a time."""
SUBSCRIPTIONS, ITEMS = 4, 5000
"""Most subscriptions of a session, and most monitored items of a subscription."""
FASTEST_MS, SLOWEST_MS, TIMEOUT_MS = 500.0, 60_000.0, 120_000.0
"""Shortest and longest publishing interval, and longest session without a request, ms."""
OPERATIONS = 500
"""Most nodes in a request to read."""
LARGEST, SMALLEST_BUFFER = 1 << 20, 8192
"""Largest message and largest number of bytes that wait, and smallest buffer of a client (OPC 10000-6, 7.1.2.3)."""


class Clients(UserManager):
    """Those who may sign in: on loopback anybody; with the keys of a plant, holders of a certificate of ``opcua``."""

    def __init__(self, folder: KeyFolder | None) -> None:
        self.folder, self._refusals = folder, Refusals(log)

    def check(self, certificate: bytes | None) -> None:
        """Raise ServiceError unless a certificate (DER) is one of the plant for OPC UA, and valid now."""
        if self.folder is None:
            return
        try:
            found = signer_of(certificate or b"", self.folder.authority_certificates(), datetime.now(UTC))
            if found[0] != "opcua":
                raise DataError(f"{found[2]}: a certificate for {found[0]}, not for opcua")
        except (DataError, ConfigError) as error:
            self._refusals.refuse("client", f"a client is refused: {error}")
            raise ServiceError(ua.StatusCodes.BadCertificateUntrusted) from error

    def get_user(
        self, iserver: InternalServer, username: Any = None, password: Any = None, certificate: Any = None
    ) -> User:
        """Return the user of a session; with the keys of a plant, ``certificate`` is that of the user."""
        self.check(certificate)
        return User(UserRole.User)


class Session(InternalSession):
    """Session that reads. Nobody guesses its token, and it takes nothing that belongs to another one."""

    def __init__(self, *arguments: Any, **more: Any) -> None:
        super().__init__(*arguments, **more)
        self._peer: bytes | None = None
        # asyncua counts; who knows the token of a session continues it.
        self.iserver.unregister_external_session(self)
        self.auth_token = ua.NodeId(secrets.token_bytes(32))
        self.iserver.register_external_session(self)

    async def create_session(self, params: ua.CreateSessionParameters, sockname: Any = None) -> ua.CreateSessionResult:
        """Return the answer to a request for a session, whose time without a request is limited."""
        # In this order, NaN is replaced, too: a timer of it never ends.
        params.RequestedSessionTimeout = min(TIMEOUT_MS, params.RequestedSessionTimeout)
        return await super().create_session(params, sockname)

    def activate_session(
        self, params: ua.ActivateSessionParameters, peer_certificate: bytes | None
    ) -> ua.ActivateSessionResult:
        """Return the answer to a sign-in over a channel that the holder of ``peer_certificate`` has signed."""
        clients = self.iserver.user_manager
        assert isinstance(clients, Clients)
        clients.check(peer_certificate)
        if self.is_activated() and peer_certificate != self._peer:
            raise ServiceError(ua.StatusCodes.BadSecurityChecksFailed)
        self._peer = peer_certificate
        return super().activate_session(params, peer_certificate)

    async def read(self, params: ua.ReadParameters) -> list[ua.DataValue]:
        """Return the values of nodes."""
        if len(params.NodesToRead) > OPERATIONS:
            raise ServiceError(ua.StatusCodes.BadTooManyOperations)
        return await super().read(params)

    async def create_subscription(
        self, params: ua.CreateSubscriptionParameters, callback: Callable[..., Any], request_callback: Any = None
    ) -> ua.CreateSubscriptionResult:
        """Return a new subscription."""
        service = self.subscription_service
        if sum(each.session_id == self.session_id for each in service.subscriptions.values()) >= SUBSCRIPTIONS:
            raise ServiceError(ua.StatusCodes.BadTooManySubscriptions)
        wanted = params.RequestedPublishingInterval
        params.RequestedPublishingInterval = max(FASTEST_MS, min(SLOWEST_MS, wanted))
        # Services find a subscription by its number alone: those of others are not to be guessed.
        service._sub_id_counter = secrets.randbits(31)
        return await super().create_subscription(params, callback, request_callback)

    async def create_monitored_items(
        self, params: ua.CreateMonitoredItemsParameters
    ) -> list[ua.MonitoredItemCreateResult]:
        """Return new monitored items."""
        found = self.subscription_service.subscriptions.get(params.SubscriptionId)
        if found and len(found.monitored_item_srv._monitored_items) + len(params.ItemsToCreate) > ITEMS:
            raise ServiceError(ua.StatusCodes.BadTooManyMonitoredItems)
        return await super().create_monitored_items(params)

    async def close_session(self, delete_subs: bool = True) -> None:
        """Close the session with its subscriptions, also if the client would leave them."""
        await super().close_session(True)

    async def _refuse(self, *_: Any) -> Any:
        raise ServiceError(ua.StatusCodes.BadUserAccessDenied)

    write: Any = _refuse
    call: Any = _refuse
    add_nodes: Any = _refuse
    delete_nodes: Any = _refuse
    add_references: Any = _refuse
    delete_references: Any = _refuse
    history_read: Any = _refuse
    transfer_subscriptions: Any = _refuse


class Sessions(InternalServer):
    """Address space with the sessions of its clients, one for each connection."""

    def __init__(self, clients: Clients) -> None:
        super().__init__(clients)
        self.supported_tokens = (ua.AnonymousIdentityToken if clients.folder is None else ua.X509IdentityToken,)
        self.allow_remote_admin = False
        self.max_connections, self.max_subscriptions = CONNECTIONS, SESSIONS * SUBSCRIPTIONS
        self.max_pending_messages_per_connection, self.max_pending_activation_seconds = 100, 10.0
        self.max_monitored_item_queue_size, self.max_unacked_messages_per_subscription = 100, 100
        self.max_lifetime_count, self.max_session_timeout_ms = 600, TIMEOUT_MS

    def create_session(self, name: str, user: User | None = None, external: bool = False) -> InternalSession:
        """Return a new session of a connection, whose address is its ``name``."""
        if len(self._external_sessions) >= SESSIONS or any(e.name == name for e in self._external_sessions.values()):
            raise ServiceError(ua.StatusCodes.BadTooManySessions)
        return Session(self, self.aspace, self.subscription_service, name, external=external)

    def register_server(self, server: Any, conf: Any = None) -> None:
        """Refuse to be a directory of other servers."""
        raise ServiceError(ua.StatusCodes.BadServiceUnsupported)


class _Limits(TransportLimits):
    def create_acknowledge_and_set_limits(self, msg: ua.Hello) -> ua.Acknowledge:
        """Return the sizes of messages; a client with buffers of a few bytes would get millions of them."""
        if min(msg.ReceiveBufferSize, msg.SendBufferSize) < SMALLEST_BUFFER:
            raise ua.UaError("a buffer below the smallest one")
        return super().create_acknowledge_and_set_limits(msg)


class _Connection(OPCUAProtocol):
    def data_received(self, data: bytes) -> None:
        """Take bytes; a client that announces more than a message, or does not take its answers, is left."""
        super().data_received(data)
        if self.transport is not None and max(len(self._buffer), self.transport.get_write_buffer_size()) > 2 * LARGEST:
            self.transport.abort()


class _Listener(BinaryServer):
    def __init__(self, sessions: Sessions, listening: socket.socket, limits: TransportLimits) -> None:
        super().__init__(sessions, *listening.getsockname()[:2], limits)
        self._socket = listening

    def _make_protocol(self) -> OPCUAProtocol:
        return _Connection(self.iserver, self._policies, self.clients, self.closing_tasks, self.limits)

    async def start(self) -> None:
        self._server = await asyncio.get_running_loop().create_server(self._make_protocol, sock=self._socket)
        self.cleanup_task = asyncio.create_task(self._close_task_loop())


class LimitedServer(Server):
    """Server of `Sessions` on a socket that listens."""

    def __init__(self, clients: Clients, listening: socket.socket) -> None:
        super().__init__(Sessions(clients))
        self._listening = listening
        self.limits = _Limits(1 << 16, 1 << 16, 32, LARGEST)

    async def start(self) -> None:
        """Begin to serve."""
        await self._setup_server_nodes()
        await self.iserver.start()
        assert isinstance(self.iserver, Sessions)
        self.bserver = _Listener(self.iserver, self._listening, self.limits)
        self.bserver.set_policies(self._policies)
        await self.bserver.start()
