"""Zenoh sessions: peers on the loopback interface without router and multicast, or with other hosts by mutual TLS."""

import json
import re
import zlib
from pathlib import Path
from typing import Any, Literal

import zenoh

from armident.configs import ConfigError, SessionConfig
from armident.daq.identity import certificates
from armident.daq.identity.access import ROUTER_FILE, access_control, is_loopback, router_name, tls_options
from armident.daq.identity.folder import KeyFolder, key_folder
from armident.daq.identity.plant import plant_of
from armident.daq.streaming.announcer import SENT_IN_ORDER

Role = Literal["capture", "worker", "observer"]

ANY_PORT = "tcp/127.0.0.1:0"
"""Endpoint that listens on a free loopback port."""
LARGEST_MESSAGE = 32 << 20
"""Largest message that a session accepts, bytes; Zenoh drops larger ones (its own limit is 1 GiB)."""
CONNECT_MS = 2000
"""Longest wait of a client for its router, ms; the caller tries again, and Zenoh does after a lost connection."""
_FIRST_PORT = 17_000
_CELLS = 5_000
_ENCRYPTED = ("tls/", "quic/")
_DANGEROUS = re.compile("mtls|verify|certificate|key|expir")
"""Options of an endpoint that would replace those of the session."""

_FILE_KEYS = ("_certificate", "_private_key", "_file")
"""Endings of the keys of a Zenoh configuration that name files."""


def endpoints(session: SessionConfig) -> dict[Role, str]:
    """Return the default endpoints of a cell's capture and worker: two loopback ports derived from the cell's name."""
    port = _FIRST_PORT + 2 * (zlib.crc32(f"{session.cell}/{session.robot.stem}".encode()) % _CELLS)
    return {"capture": f"tcp/127.0.0.1:{port}", "worker": f"tcp/127.0.0.1:{port + 1}"}


def configuration(
    session: SessionConfig, role: Role, *, any_port: bool = False, identity: certificates.Role | None = None
) -> zenoh.Config:
    """Return the Zenoh configuration of a role: the session's file, peers on loopback, or the client of a router.

    ``any_port``: listen on a free loopback port in place of the role's, which other peers learn from those they know.
    ``identity``: role of the certificate that other hosts see, by default that of ``role``; an observer is a viewer.
    ConfigError if other hosts could connect without a certificate of the plant.
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
    listens = options.listen if role != "observer" and not any_port else ()
    by_tls = options.config is None and any(place.startswith(_ENCRYPTED) for place in (*listens, *options.connect))
    if listens or by_tls:
        config.insert_json5("listen/endpoints", json.dumps(listens))
    if options.connect or by_tls:
        config.insert_json5("connect/endpoints", json.dumps(options.connect))
    if by_tls and not listens:
        config.insert_json5("mode", '"client"')
    if _mode(config) == "client":
        config.insert_json5("connect/timeout_ms", str(CONNECT_MS))
    _protect(config, session, identity or ("viewer" if role == "observer" else role))
    return config


def open_session(
    session: SessionConfig, role: Role, *, any_port: bool = False, identity: certificates.Role | None = None
) -> zenoh.Session:
    """Open a Zenoh session; capture and worker, one each per cell, start in any order; an observer only connects."""
    config = configuration(session, role, any_port=any_port, identity=identity)
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        if _mode(config) == "client":
            router = ", ".join(_places(config, "connect"))
            raise ConfigError(
                f"zenoh: cannot connect to {router} as {identity or role} of cell {session.cell}: does the router run, "
                f"and does armident keys check find no fault here and there? ({_short(error)})"
            ) from error
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


def _protect(config: zenoh.Config, session: SessionConfig, role: certificates.Role) -> None:
    """Complete mutual TLS and access control from the folder of keys where other hosts can connect; else ConfigError.

    Own settings of a Zenoh file are kept if they are as strict. On loopback without TLS nothing changes.
    """
    file = session.zenoh.config or "zenoh"
    multicast = json.loads(config.get_json("scouting/multicast/enabled"))
    if multicast is not False and json.loads(config.get_json("scouting/multicast/interface")) != "lo":
        raise ConfigError(f"{file}: multicast finds other hosts; set scouting: {{multicast: {{enabled: false}}}}")
    listen, connect = _places(config, "listen"), _places(config, "connect")
    places = [*listen, *connect]
    if all(is_loopback(place) and not place.startswith(_ENCRYPTED) for place in places):
        return
    for place in sorted(places, key=is_loopback):
        if not place.startswith(_ENCRYPTED):
            far = place if not is_loopback(place) else f"{place} beside endpoints of other hosts"
            raise ConfigError(f"{file}: {far}: expected tls/HOST:PORT; for its keys: armident keys enrol {role}")
        if _DANGEROUS.search(place.partition("#")[2]):
            raise ConfigError(f"{file}: {place}: expected no options of certificates; the folder of keys has them")
    tls = json.loads(config.get_json("transport/link/tls"))
    if tls["root_ca_certificate"] is None:
        folder = key_folder(session.zenoh.keys)
        config.insert_json5("transport/link/tls", json.dumps(_tls_of(folder, role, session.cell)))
        config.insert_json5("access_control", json.dumps(_access_of(folder.path, listens=bool(listen))))
    else:
        wanted = {"enable_mtls": tls["enable_mtls"]}
        wanted["verify_name_on_connect"] = tls["verify_name_on_connect"] is not False
        wanted |= {f"connect_{part}": tls[f"connect_{part}"] for part in ("certificate", "private_key") if connect}
        wanted |= {f"listen_{part}": tls[f"listen_{part}"] for part in ("certificate", "private_key") if listen}
        access = json.loads(config.get_json("access_control"))
        wanted["access_control.enabled"] = access["enabled"]
        wanted["access_control.default_permission: deny"] = access["default_permission"] == "deny"
        if missing := [key for key, value in wanted.items() if not value]:
            raise ConfigError(f"{file}: needs {', '.join(missing)}, or no tls section: then the folder of keys is used")
    config.insert_json5("transport/link/protocols", json.dumps([part.rstrip("/") for part in _ENCRYPTED]))


def _tls_of(folder: KeyFolder, role: certificates.Role, cell: str) -> dict[str, Any]:
    """Return the TLS options of a role from a folder of a plant."""
    if folder.local:
        raise ConfigError(
            f"zenoh: other hosts need keys of the plant, {folder.path} has those of this machine; "
            f"run where the authority is: armident keys enrol {role} --cell {cell}, or armident keys init"
        )
    folder.authority_certificates()
    return tls_options(f"{folder.path.absolute()}/", folder.identity(role, cell).name)


def _access_of(folder: Path, *, listens: bool) -> dict[str, Any]:
    """Return the access control of a session: that beside its keys, or without one that of the router alone.

    Clients trust public authorities beside that of the plant (Zenoh 1.10), hence the name of the router is needed.
    """
    path = folder / ROUTER_FILE
    if path.is_file():
        found: dict[str, Any] = json.loads(_from_file(path).get_json("access_control"))
        return found
    if listens:
        raise ConfigError(f"{path}: no such file; who listens for other hosts needs it: copy it from the authority")
    return access_control((), router_name(plant_of(folder)))


def _mode(config: zenoh.Config) -> str:
    return str(json.loads(config.get_json("mode")) or "peer")


def _places(config: zenoh.Config, side: Literal["listen", "connect"]) -> list[str]:
    """Return all endpoints on which a configuration listens or to which it connects."""

    def flat(found: Any) -> list[str]:
        if isinstance(found, str):
            return [found]
        if isinstance(found, dict):
            found = found.get(_mode(config), found.get("locators"))
        return [place for each in found or [] for place in flat(each)]

    return flat(json.loads(config.get_json(f"{side}/endpoints")))


def _from_file(path: Path) -> zenoh.Config:
    try:
        return zenoh.Config.from_file(str(path))
    except zenoh.ZError as error:
        raise ConfigError(f"{path}: not a Zenoh configuration: {_short(error)}") from error


def _short(error: Exception) -> str:
    return str(error).splitlines()[0].split(" at ")[0][:160]
