"""Addresses at which a server of the plant listens."""

import ipaddress
import socket
from pathlib import Path

from armident.configs import ConfigError
from armident.daq.identity.folder import KeyFolder, key_folder


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


def keys_for(host: str, listen: str, keys: Path | None) -> KeyFolder | None:
    """Return the keys of the plant, which other machines need, ``None`` on loopback; ConfigError if there are none."""
    folder = None if is_loopback(host) else key_folder(keys)
    if folder is not None and folder.local:
        reason = "other machines may only connect with keys of a plant; run: armident keys init"
        raise ConfigError(f"--listen {listen}: {reason}")
    return folder


def bound(host: str, port: int, listen: str) -> socket.socket:
    """Return a socket that listens; ConfigError if the address is taken or not of this machine."""
    try:
        family = socket.AF_INET6 if host.startswith("[") else socket.AF_INET
        return socket.create_server((host.strip("[]"), port), family=family, backlog=128)
    except OSError as error:
        raise ConfigError(f"--listen {listen}: {error.strerror}; choose another address or port") from error
