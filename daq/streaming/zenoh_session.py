"""Zenoh sessions between peers on the loopback interface, without router and multicast."""

import json
import re
import zlib
from pathlib import Path
from typing import Any, Literal

import zenoh

from armident.configs import ConfigError, SessionConfig
from armident.daq.streaming.announcer import SENT_IN_ORDER

Role = Literal["capture", "worker", "observer"]

ANY_PORT = "tcp/127.0.0.1:0"
"""Endpoint that listens on a free loopback port."""
LARGEST_MESSAGE = 32 << 20
"""Largest message that a session accepts, bytes; Zenoh drops larger ones (its own limit is 1 GiB)."""
_FIRST_PORT = 17_000
_CELLS = 5_000

_FILE_KEYS = ("_certificate", "_private_key", "_file")
"""Endings of the keys of a Zenoh configuration that name files."""


def endpoints(session: SessionConfig) -> dict[Role, str]:
    """Return the default endpoints of a cell's capture and worker: two loopback ports derived from the cell's name."""
    port = _FIRST_PORT + 2 * (zlib.crc32(f"{session.cell}/{session.robot.stem}".encode()) % _CELLS)
    return {"capture": f"tcp/127.0.0.1:{port}", "worker": f"tcp/127.0.0.1:{port + 1}"}


def configuration(session: SessionConfig, role: Role, *, any_port: bool = False) -> zenoh.Config:
    """Return the Zenoh configuration of a role: the session's file, or peers on the loopback interface.

    ``any_port``: listen on a free loopback port in place of the role's, which other peers learn from those they know.
    """
    options = session.zenoh
    if options.config is not None:
        config = _from_file(options.config)
    else:
        config = zenoh.Config()
        own = endpoints(session)
        listen = [own[role]] if role in own else []
        defaults = {
            "mode": "peer",
            "scouting/multicast/enabled": False,
            "timestamping/enabled": True,
            "listen/endpoints": [ANY_PORT] if any_port else listen,
            "connect/endpoints": [place for name, place in own.items() if name != role or any_port],
            "connect/timeout_ms": -1,
            "connect/exit_on_failure": False,
            "transport/link/rx/max_message_size": LARGEST_MESSAGE,
            "connect/retry": {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2},
        }
        for key, value in defaults.items():
            config.insert_json5(key, json.dumps(value))
    if any_port and options.config is not None:
        config.insert_json5(
            "listen/endpoints", json.dumps(_on_any_port(json.loads(config.get_json("listen/endpoints"))))
        )
    if role == "worker":
        for key, value in SENT_IN_ORDER.items():
            config.insert_json5(key, json.dumps(value))
    if options.listen and role != "observer" and not any_port:
        config.insert_json5("listen/endpoints", json.dumps(options.listen))
    if options.connect:
        config.insert_json5("connect/endpoints", json.dumps(options.connect))
    return config


def open_session(session: SessionConfig, role: Role, *, any_port: bool = False) -> zenoh.Session:
    """Open a Zenoh session; capture and worker, one each per cell, start in any order; an observer only connects.

    ``any_port``: as in `configuration`, for a second worker. ConfigError if another process of that role runs.
    """
    config = configuration(session, role, any_port=any_port)
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        place = ", ".join(session.zenoh.listen) or endpoints(session).get(role, "")
        raise ConfigError(
            f"zenoh: cannot open a session as {role} at {place}, "
            f"is another {role} of cell {session.cell} running? ({_short(error)})"
        ) from error


def unreadable_files(config: zenoh.Config) -> list[str]:
    """Key, path and reason of each file in a Zenoh configuration that cannot be opened: certificates, keys, users."""
    found: list[str] = []
    for section in ("transport/link/tls", "transport/auth/usrpwd", "transport/auth/pubkey"):
        for key, value in (json.loads(config.get_json(section)) or {}).items():
            if isinstance(value, str) and value and key.endswith(_FILE_KEYS):
                try:
                    Path(value).open("rb").close()
                except OSError as error:
                    found.append(f"{section}/{key} {value} ({error.strerror})")
    return found


def _on_any_port(endpoints: Any) -> Any:
    """Return endpoints, or lists of them, with a free port in place of their own; `None` if there are none."""
    if isinstance(endpoints, str):
        return re.sub(r":\d+(?=$|[?#])", ":0", endpoints)
    if isinstance(endpoints, dict):
        return {mode: _on_any_port(each) for mode, each in endpoints.items()}
    return endpoints and [_on_any_port(each) for each in endpoints]


def _from_file(path: Path) -> zenoh.Config:
    try:
        return zenoh.Config.from_file(str(path))
    except zenoh.ZError as error:
        raise ConfigError(f"{path}: not a Zenoh configuration: {_short(error)}") from error


def _short(error: Exception) -> str:
    return str(error).splitlines()[0].split(" at ")[0][:160]
