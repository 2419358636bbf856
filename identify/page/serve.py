"""Command ``armident page``: its addresses, its keys, and the server."""

import logging
import signal
import ssl
from collections.abc import Sequence
from contextlib import closing
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

import uvicorn
from cryptography import x509
from starlette.responses import PlainTextResponse
from uvicorn.protocols.http.h11_impl import H11Protocol

from armident.configs import ConfigError, DataError
from armident.daq.identity.certificates import ANY_CELL, identity_of
from armident.daq.identity.folder import KeyFolder
from armident.daq.streaming import Refusals
from armident.identify.page.addresses import address_of, bound, keys_for
from armident.identify.page.cells import cells_in
from armident.identify.page.plant import Plant
from armident.identify.page.site import site
from armident.systemd import Notifier

log = logging.getLogger(__name__)

LOOPBACK = ("localhost", "127.0.0.1", "[::1]")
CONNECTIONS = 64
"""Most connections at a time; a browser opens six."""


def run_page(configs: Sequence[Path], out: Path | None, database: str | None, listen: str, keys: Path | None) -> None:
    """Carry out ``armident page`` until SIGTERM or SIGINT; ConfigError if address, keys or sessions are wrong."""
    host, port = address_of(listen)
    folder = keys_for(host, listen, keys)
    hosts, security = (LOOPBACK, {}) if folder is None else _sign_in(folder)
    cells = cells_in(configs, out, database)
    number = "1 cell" if len(cells) == 1 else f"{len(cells)} cells"
    with (
        closing(Notifier()) as notifier,
        closing(bound(host, port, listen)) as listening,
        Plant(cells, lambda: notifier.progress(number)) as plant,
    ):
        options = uvicorn.Config(
            site(plant, hosts),
            log_config=None,
            access_log=False,
            server_header=False,
            limit_concurrency=CONNECTIONS,
            timeout_graceful_shutdown=3,
            **security,
        )
        url = f"{'https' if security else 'http'}://{host}:{listening.getsockname()[1]}/"
        print(f"page: {url} ({number})", flush=True)
        notifier.ready(f"{number} at {url}")
        # The server repeats a signal when it has ended, for the handler of before.
        for each in (signal.SIGTERM, signal.SIGINT):
            signal.signal(each, _ended)
        uvicorn.Server(options).run(sockets=[listening])
        notifier.stopping()


def _sign_in(folder: KeyFolder) -> tuple[Sequence[str], dict[str, Any]]:
    """Return the names in the certificate of the page, a viewer of all cells, and the options of mutual TLS."""
    identity = folder.identity("viewer", ANY_CELL)
    try:
        names = identity.certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound as error:
        raise ConfigError(
            f"{folder.path}: the certificate of {identity.name} has no address, under which browsers ask for the page"
        ) from error
    addresses = names.get_values_for_type(x509.IPAddress)
    hosts = [*names.get_values_for_type(x509.DNSName), *(f"[{a}]" if a.version == 6 else str(a) for a in addresses)]
    files = {
        f"ssl_{kind}file": folder.path / f"{identity.name}.{end}" for kind, end in (("cert", "pem"), ("key", "key"))
    }
    authority = folder.path / "authority.pem"
    tls = {"ssl_ca_certs": authority, "ssl_cert_reqs": ssl.CERT_REQUIRED}
    return hosts, files | tls | {"http": partial(_Connection, folder, Refusals(log))}


class _Connection(H11Protocol):
    """Connection of a browser, whose certificate must count at each request: it is revoked or ends meanwhile."""

    def __init__(self, folder: KeyFolder, refusals: Refusals, **options: Any) -> None:
        super().__init__(**options)
        self._folder, self._refusals = folder, refusals

    def data_received(self, data: bytes) -> None:
        certificate = self.transport.get_extra_info("ssl_object").getpeercert(binary_form=True)
        try:
            role, cell, name = identity_of(self._folder.trusted(certificate, datetime.now(UTC)))
            if role not in ("viewer", "operator") or cell != ANY_CELL:
                raise DataError(f"{name}: not a viewer or operator of all cells, which this page shows")
        except (DataError, ConfigError) as error:
            self._refusals.refuse("browser", f"a browser is refused: {error}")
            self.app = PlainTextResponse(
                f"{error}\nrun where the authority is: armident keys enrol viewer --name NAME\n", 403
            )
        super().data_received(data)


def _ended(_number: int, _frame: FrameType | None) -> None:
    log.debug("page: ended by a signal")
