"""Command ``armident page``: its addresses, its keys, and the server."""

import ipaddress
import logging
import signal
import socket
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from types import FrameType

import uvicorn

from armident.configs import ConfigError
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
    if not is_loopback(host):
        raise ConfigError(f"--listen {listen}: other machines may only connect with keys of the plant; give --keys")
    cells = cells_in(configs, out, database)
    with closing(Notifier()) as notifier, closing(_bound(host, port, listen)) as listening:
        with Plant(cells, lambda: notifier.progress(f"{len(cells)} cells")) as plant:
            options = uvicorn.Config(
                site(plant, LOOPBACK),
                log_config=None,
                access_log=False,
                server_header=False,
                limit_concurrency=CONNECTIONS,
                timeout_keep_alive=30,
                timeout_graceful_shutdown=3,
            )
            number = listening.getsockname()[1]
            print(f"page: http://{host}:{number}/ ({len(cells)} cells)", flush=True)
            notifier.ready(f"{len(cells)} cells at {host}:{number}")
            # The server repeats a signal when it has ended, for the handler of before.
            for each in (signal.SIGTERM, signal.SIGINT):
                signal.signal(each, _ended)
            uvicorn.Server(options).run(sockets=[listening])
            notifier.stopping()


def _ended(_number: int, _frame: FrameType | None) -> None:
    log.debug("page: ended by a signal")


def address_of(listen: str) -> tuple[str, int]:
    """Return host and port of ``HOST:PORT``; an IPv6 address stands in brackets."""
    host, colon, port = listen.rpartition(":")
    if not colon or not host or not port.isdecimal() or int(port) > 65_535 or (":" in host) != host.startswith("["):
        raise ConfigError(f"--listen {listen}: expected HOST:PORT, such as 127.0.0.1:8484 or [::1]:8484")
    return host, int(port)


def is_loopback(host: str) -> bool:
    """Return True if only programs of this machine reach a host."""
    try:
        return host == "localhost" or ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def _bound(host: str, port: int, listen: str) -> socket.socket:
    """Return a socket that listens; ConfigError if the address is taken or not of this machine."""
    try:
        family = socket.AF_INET6 if host.startswith("[") else socket.AF_INET
        return socket.create_server((host.strip("[]"), port), family=family, backlog=128)
    except OSError as error:
        raise ConfigError(f"--listen {listen}: {error.strerror}; choose another address or port") from error
