"""Command ``armident opcua``: its address, its keys, and the server."""

import asyncio
import logging
import signal
import socket
import threading
from collections.abc import Sequence
from contextlib import closing, suppress
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path

from asyncua import ua
from cryptography import x509

from armident.configs import ConfigError
from armident.daq.identity.certificates import ANY_CELL
from armident.daq.identity.folder import KeyFolder, key_folder
from armident.identify.opcua.clients import Clients, LimitedServer
from armident.identify.opcua.nodes import Nodes
from armident.identify.page.addresses import address_of, bound, is_loopback
from armident.identify.page.cells import cells_in
from armident.identify.page.plant import Plant
from armident.systemd import Notifier

ROUND_S = 1.0
"""Interval at which what is read is compared with what clients know, s."""
POLICIES = [
    ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt,
    ua.SecurityPolicyType.Aes128Sha256RsaOaep_SignAndEncrypt,
    ua.SecurityPolicyType.Aes256Sha256RsaPss_SignAndEncrypt,
]
"""Security policies for other machines."""


def run_opcua(configs: Sequence[Path], out: Path | None, database: str | None, listen: str, keys: Path | None) -> None:
    """Carry out ``armident opcua`` until SIGTERM or SIGINT; ConfigError if address, keys or sessions are wrong."""
    host, port = address_of(listen)
    folder = None if is_loopback(host) else _of_plant(key_folder(keys), listen)
    cells, read = cells_in(configs, out, database), threading.Event()
    # It reports each refused request of a stranger with a traceback.
    logging.getLogger("asyncua").setLevel(logging.CRITICAL)
    with closing(bound(host, port, listen)) as listening, Plant(cells, read.set, listens=False) as plant:
        asyncio.run(_serve(plant, Clients(folder), host, listening, read))


def _of_plant(folder: KeyFolder, listen: str) -> KeyFolder:
    if folder.local:
        raise ConfigError(
            f"--listen {listen}: other machines may only connect with keys of a plant; run: armident keys init"
        )
    return folder


async def _serve(plant: Plant, clients: Clients, host: str, listening: socket.socket, read: threading.Event) -> None:
    """Serve until a signal; ``read`` is set when the folders have been read again, which the watchdog hears of."""
    stopped, loop = asyncio.Event(), asyncio.get_running_loop()
    for each in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(each, stopped.set)
    server = LimitedServer(clients, listening)
    await server.init()
    server.name, server.product_uri = "armident", "urn:armident"
    server.application_type = ua.ApplicationType.Server
    version = metadata.version("armident")
    await server.set_build_info(server.product_uri, "armident", "armident", version, version, datetime.now(UTC))
    url = f"opc.tcp://{host}:{listening.getsockname()[1]}/"
    server.set_endpoint(url)
    await _identify(server, clients.folder)
    nodes, number = Nodes(server), "1 cell" if len(plant.cells) == 1 else f"{len(plant.cells)} cells"
    await nodes.build(plant.cells.values())
    with closing(Notifier()) as notifier:
        async with server:
            print(f"opcua: {url} ({number})", flush=True)
            notifier.ready(f"{number} at {url}")
            while not stopped.is_set():
                for name in plant.cells:
                    await nodes.update(plant.view(name))
                if read.is_set():
                    read.clear()
                    notifier.progress(number)
                with suppress(TimeoutError):
                    await asyncio.wait_for(stopped.wait(), ROUND_S)
            notifier.stopping()


async def _identify(server: LimitedServer, folder: KeyFolder | None) -> None:
    """Give the server its name and channels: with keys of a plant, those of its certificate of ``opcua``."""
    server.set_security_policy([ua.SecurityPolicyType.NoSecurity] if folder is None else POLICIES)
    if folder is None:
        await server.set_application_uri("urn:armident:opcua")
        return
    try:
        identity = folder.identity("opcua", ANY_CELL)
    except ConfigError as error:
        raise ConfigError(f"{folder.path}: no key of opcua") from error
    names = identity.certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    await server.set_application_uri(names.get_values_for_type(x509.UniformResourceIdentifier)[0])
    await server.load_certificate(folder.path / f"{identity.name}.pem")
    await server.load_private_key(folder.path / f"{identity.name}.key")
