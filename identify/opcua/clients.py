"""Limits of the clients of the server: who signs in, that they only read, and how much they may occupy."""

import asyncio
import logging
import secrets
import socket
from dataclasses import dataclass
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
from armident.daq.identity.certificates import identity_of
from armident.daq.identity.folder import KeyFolder
from armident.daq.streaming import Refusals

log = logging.getLogger(__name__)

CONNECTIONS, SESSIONS, SUBSCRIPTIONS, ITEMS, NODES = 32, 16, 4, 2000, 500
"""Most connections and sessions, subscriptions of a session, items of one of these, and nodes of a request to read."""
FASTEST_MS, SLOWEST_MS, TIMEOUT_MS = 500.0, 60_000.0, 120_000.0
"""Shortest and longest publishing interval, and longest session without a request, ms."""
LARGEST, SMALLEST_BUFFER = 1 << 20, 8192
"""Largest message, and smallest buffer of a client (OPC 10000-6, 7.1.2.3), bytes."""


@dataclass
class _User(User):
    """User, with the certificate (DER) by which he signed in; on loopback perhaps none."""

    certificate: bytes | None = None


class Clients(UserManager):
    """Those who may sign in: on loopback anybody; with the keys of a plant, holders of a certificate of ``opcua``."""

    def __init__(self, folder: KeyFolder | None) -> None:
        self.folder, self._refusals = folder, Refusals(log)

    def check(self, certificate: bytes | None) -> None:
        """Raise ServiceError unless a certificate (DER) is one of the plant for OPC UA, not revoked, and valid now."""
        if self.folder is None:
            return
        try:
            role, _, name = identity_of(self.folder.trusted(certificate or b"", datetime.now(UTC)))
            if role != "opcua":
                raise DataError(f"{name}: a certificate of the role {role}, not of opcua")
        except (DataError, ConfigError) as error:
            self._refusals.refuse("client", f"a client is refused: {error}")
            raise ServiceError(ua.StatusCodes.BadCertificateUntrusted) from error

    def get_user(
        self, iserver: InternalServer, username: Any = None, password: Any = None, certificate: Any = None
    ) -> User:
        """Return the user of a session; with the keys of a plant, the user has signed with ``certificate``."""
        self.check(certificate)
        return _User(UserRole.User, certificate=certificate)


class _Session(InternalSession):
    """Session that only reads. Nobody guesses its token, and it takes nothing that belongs to another one."""

    def __init__(self, *arguments: Any, **more: Any) -> None:
        super().__init__(*arguments, **more)
        # asyncua counts; who knows the token of a session continues it.
        self.iserver.unregister_external_session(self)
        self.auth_token = ua.NodeId(secrets.token_bytes(32))
        self.iserver.register_external_session(self)
        self._peer: bytes | None = None

    async def create_session(self, params: ua.CreateSessionParameters, sockname: Any = None) -> ua.CreateSessionResult:
        # In this order also NaN, whose timer would not rest.
        params.RequestedSessionTimeout = min(TIMEOUT_MS, params.RequestedSessionTimeout)
        return await super().create_session(params, sockname)

    def activate_session(self, params: Any, peer_certificate: bytes | None) -> ua.ActivateSessionResult:
        # The peer has proved to hold its certificate; asyncua does not check whose it is.
        clients: Any = self.iserver.user_manager
        clients.check(peer_certificate)
        if self.is_activated() and peer_certificate != self._peer:
            raise ServiceError(ua.StatusCodes.BadSecurityChecksFailed)
        self._peer = peer_certificate
        return super().activate_session(params, peer_certificate)

    async def read(self, params: ua.ReadParameters) -> Any:
        if len(params.NodesToRead) > NODES:
            raise ServiceError(ua.StatusCodes.BadTooManyOperations)
        return await super().read(params)

    async def create_subscription(self, params: Any, callback: Any, request_callback: Any = None) -> Any:
        service = self.subscription_service
        if sum(each.session_id == self.session_id for each in service.subscriptions.values()) >= SUBSCRIPTIONS:
            raise ServiceError(ua.StatusCodes.BadTooManySubscriptions)
        params.RequestedPublishingInterval = max(FASTEST_MS, min(SLOWEST_MS, params.RequestedPublishingInterval))
        # A number is all that a request needs: those of other sessions are not to be guessed.
        service._sub_id_counter = secrets.randbits(31)
        return await super().create_subscription(params, callback, request_callback)

    async def create_monitored_items(self, params: ua.CreateMonitoredItemsParameters) -> Any:
        found = self.subscription_service.subscriptions.get(params.SubscriptionId)
        if found and len(found.monitored_item_srv._monitored_items) + len(params.ItemsToCreate) > ITEMS:
            raise ServiceError(ua.StatusCodes.BadTooManyMonitoredItems)
        return await super().create_monitored_items(params)

    async def close_session(self, delete_subs: bool = True) -> None:
        await super().close_session(True)


async def _refuse(*_: object) -> None:
    raise ServiceError(ua.StatusCodes.BadUserAccessDenied)


for _service in (
    "write", "call", "add_nodes", "delete_nodes", "add_references", "delete_references", "history_read",
    "transfer_subscriptions",
):  # fmt: skip
    setattr(_Session, _service, _refuse)


class _Sessions(InternalServer):
    """Address space with the sessions of its clients, one for each connection."""

    def __init__(self, clients: Clients) -> None:
        super().__init__(clients)
        self.supported_tokens = (ua.AnonymousIdentityToken if clients.folder is None else ua.X509IdentityToken,)
        self.max_connections, self.max_subscriptions = CONNECTIONS, SESSIONS * SUBSCRIPTIONS
        self.max_pending_messages_per_connection, self.max_pending_activation_seconds = 100, 10.0
        self.max_monitored_item_queue_size = self.max_unacked_messages_per_subscription = 100
        self.max_lifetime_count = 600

    def create_session(self, name: str, user: Any = None, external: bool = False) -> InternalSession:
        # The name is the address of a connection: it has one session at a time.
        if len(self._external_sessions) >= SESSIONS or name in {each.name for each in self._external_sessions.values()}:
            raise ServiceError(ua.StatusCodes.BadTooManySessions)
        return _Session(self, self.aspace, self.subscription_service, name, external=external)

    def register_server(self, server: Any, conf: Any = None) -> None:
        raise ServiceError(ua.StatusCodes.BadServiceUnsupported)


class _Limits(TransportLimits):
    """Limits without buffers of a few bytes, for which an answer would be cut into as many parts."""

    def create_acknowledge_and_set_limits(self, msg: ua.Hello) -> ua.Acknowledge:
        if min(msg.ReceiveBufferSize, msg.SendBufferSize) < SMALLEST_BUFFER:
            raise ua.UaError("a buffer below the smallest one")
        return super().create_acknowledge_and_set_limits(msg)


class _Connection(OPCUAProtocol):
    """Connection that leaves a client which announces more than a message, or does not take its answers."""

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        if self.transport is not None and max(len(self._buffer), self.transport.get_write_buffer_size()) > 2 * LARGEST:
            self.transport.abort()


class _Listener(BinaryServer):
    listening: socket.socket

    def _make_protocol(self) -> OPCUAProtocol:
        return _Connection(self.iserver, self._policies, self.clients, self.closing_tasks, self.limits)

    async def start(self) -> None:
        self._server = await asyncio.get_running_loop().create_server(self._make_protocol, sock=self.listening)
        self.cleanup_task = asyncio.create_task(self._close_task_loop())


class LimitedServer(Server):
    """Server for ``clients``, on a socket that listens."""

    def __init__(self, clients: Clients, listening: socket.socket) -> None:
        super().__init__(_Sessions(clients))
        self._listening, self.limits = listening, _Limits(1 << 16, 1 << 16, 32, LARGEST)

    def sign_out(self) -> None:
        """End the connections of clients whose certificate has been revoked or has ended."""
        for each in tuple(self.bserver.clients):
            session: Any = each.processor and each.processor.session
            if session and session.is_activated():
                try:
                    for certificate in (session._peer, session.user.certificate):
                        self.iserver.user_manager.check(certificate)
                except ServiceError:
                    each.transport.abort()

    async def start(self) -> None:
        """Begin to serve."""
        await self._setup_server_nodes()
        await self.iserver.start()
        self.bserver = listener = _Listener(self.iserver, "", 0, self.limits)
        listener.listening = self._listening
        listener.set_policies(self._policies)
        await listener.start()
