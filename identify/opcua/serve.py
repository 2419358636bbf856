"""Command ``armident opcua``: its address, its keys, and the server."""

import asyncio
import logging
import signal
import threading
from collections.abc import Sequence
from contextlib import closing, suppress
from pathlib import Path

from asyncua import ua
from cryptography import x509

from armident.daq.identity.certificates import ANY_CELL, Identity
from armident.identify.opcua.clients import Clients, LimitedServer
from armident.identify.opcua.nodes import Nodes
from armident.identify.page.addresses import address_of, bound, keys_for
from armident.identify.page.cells import cells_in
from armident.identify.page.plant import Plant
from armident.systemd import Notifier

ROUND_S = 1.0
"""Interval at which what was read is compared with what clients know, s."""
POLICIES = [
    ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt,
    ua.SecurityPolicyType.Aes128Sha256RsaOaep_SignAndEncrypt,
    ua.SecurityPolicyType.Aes256Sha256RsaPss_SignAndEncrypt,
]
"""Security policies for other machines."""


def run_opcua(configs: Sequence[Path], out: Path | None, database: str | None, listen: str, keys: Path | None) -> None:
    """Carry out ``armident opcua`` until SIGTERM or SIGINT; ConfigError if address, keys or sessions are wrong."""
    host, port = address_of(listen)
    folder = keys_for(host, listen, keys)
    identity = None if folder is None else folder.identity("opcua", ANY_CELL)
    cells, read = cells_in(configs, out, database), threading.Event()
    # It reports each wrong request of a stranger with a traceback.
    logging.getLogger("asyncua").setLevel(logging.CRITICAL)
    with closing(bound(host, port, listen)) as listening, Plant(cells, read.set, listens=False) as plant:
        server = LimitedServer(Clients(folder), listening)
        asyncio.run(_serve(server, identity, plant, f"opc.tcp://{host}:{listening.getsockname()[1]}/", read))


async def _serve(
    server: LimitedServer, identity: Identity | None, plant: Plant, url: str, read: threading.Event
) -> None:
    """Serve until a signal; ``read`` is set when the folders have been read again, which the watchdog hears of."""
    stopped, number = asyncio.Event(), "1 cell" if len(plant.cells) == 1 else f"{len(plant.cells)} cells"
    for each in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(each, stopped.set)
    await server.init()
    server.name, server.product_uri, server.application_type = "armident", "urn:armident", ua.ApplicationType.Server
    server.set_endpoint(url)
    server.set_security_policy([ua.SecurityPolicyType.NoSecurity] if identity is None else POLICIES)
    uri = "urn:armident:opcua"
    if identity is not None:
        server.iserver.certificate, server.iserver.private_key = identity.certificate, identity.key
        names = identity.certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        uri = names.get_values_for_type(x509.UniformResourceIdentifier)[0]
    await server.set_application_uri(uri)
    nodes = Nodes(server)
    await nodes.build(plant.cells.values())
    with closing(Notifier()) as notifier:
        async with server:
            print(f"opcua: {url} ({number})", flush=True)
            notifier.ready(f"{number} at {url}")
            while not stopped.is_set():
                server.sign_out()
                for name in plant.cells:
                    await nodes.update(plant.view(name))
                if read.is_set():
                    read.clear()
                    notifier.progress(number)
                with suppress(TimeoutError):
                    await asyncio.wait_for(stopped.wait(), ROUND_S)
            notifier.stopping()
