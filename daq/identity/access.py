"""Access control of Zenoh that follows from the permissions: for routers, for sessions, and in words."""

import json
from collections import defaultdict
from collections.abc import Iterable
from ipaddress import ip_address
from typing import Any, Literal

from armident.daq.identity.certificates import ANY_CELL, Role
from armident.daq.identity.permissions import PERMISSIONS

ROUTER_FILE = "router.json5"
"""File in a folder of keys: the configuration of a plant's router."""
ROUTER_PORT = 7447
"""TCP port of a router (Zenoh's own)."""

Flow = Literal["ingress", "egress"]
_EVERY = (
    "put", "delete", "declare_subscriber", "query", "reply", "declare_queryable", "liveliness_token",
    "liveliness_query", "declare_liveliness_subscriber",
)  # fmt: skip
"""Messages that Zenoh tells apart."""
_LIVE = ("liveliness_query", "declare_liveliness_subscriber")
_LOCAL = ("unixsock-stream", "unixpipe")
"""Protocols that do not leave the machine."""
_WORDS = {"result/*": "results", "command/*": "commands"}


def is_loopback(endpoint: str) -> bool:
    """Return True if an endpoint of Zenoh, such as ``tcp/127.0.0.1:7447``, cannot be reached from other machines."""
    protocol, _, _ = endpoint.partition("/")
    host = host_of(endpoint)
    try:
        return protocol in _LOCAL or host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False


def host_of(endpoint: str) -> str:
    """Return the host name or IP address of an endpoint."""
    address = endpoint.partition("/")[2].partition("#")[0].partition("?")[0]
    return address.rpartition(":")[0].strip("[]")


def router_name(plant: str) -> str:
    """Return the name in the certificate of a plant's routers, by which sessions know them."""
    return f"router.{plant}"


def access_control(enrolled: Iterable[tuple[Role, str, str]], router: str) -> dict[str, Any]:
    """Return the access control of a Zenoh node: what enrolled peers (role, cell, name) may; all else is denied.

    It holds at a router and at every other node: a message comes in from a peer that may send it, and goes out to one
    that may receive it. ``router``: name of the routers, which forward everything.
    """
    names: dict[tuple[Role, str], list[str]] = defaultdict(list)
    for role, cell, name in enrolled:
        if role not in ("router", "opcua"):
            names[role, cell].append(name)
    rules = [_rule("all", ("ingress", "egress"), _EVERY, ("**", "**/@adv/**"))]
    subjects = [{"id": "router", "cert_common_names": [router]}]
    policies = [{"rules": ["all"], "subjects": ["router"]}]
    for (role, cell), of_role in sorted(names.items()):
        subject = f"{role} of {'all cells' if cell == ANY_CELL else cell}"
        own = _rules(role, cell, subject)
        rules += own
        subjects.append({"id": subject, "cert_common_names": sorted(of_role)})
        policies.append({"rules": [rule["id"] for rule in own], "subjects": [subject]})
    return {
        "enabled": True, "default_permission": "deny", "rules": rules, "subjects": subjects, "policies": policies,
    }  # fmt: skip


def _rules(role: Role, cell: str, subject: str) -> list[dict[str, Any]]:
    """Return the rules of a role in a cell: messages that a node accepts of it (ingress) or sends to it (egress)."""
    may = PERMISSIONS[role]

    def keys(patterns: Iterable[str], below_adv: str = "**") -> list[str]:
        return [
            f"armident/{cell}/*/{pattern.removesuffix('*')}{(below_adv if '@adv' in pattern else '**')}"
            if pattern.endswith("/*")
            else f"armident/{cell}/*/{pattern}"
            for pattern in patterns
        ]

    # Tokens say who is alive, and below @adv which publishers and subscribers there are.
    tokens = [key for key in may.publish if _is_token(key)]
    messages = [key for key in may.publish if not key.startswith("alive/")]
    heard = [key for key in may.read if _is_token(key)]
    read = [key for key in may.read if not key.startswith("alive/")]
    ask = [key for key in may.ask if not key.startswith("alive/")]
    # Only publishers are below pub/, so that no reader passes for one.
    published, answered = keys(messages, "pub/**"), keys(may.answer, "pub/**")
    table: list[tuple[Flow, tuple[str, ...], list[str]]] = [
        ("ingress", ("put",), published),
        ("ingress", ("declare_queryable",), answered),
        # A reply has the key of its content: an earlier message has that under which it was published.
        ("ingress", ("reply",), [*answered, *published]),
        ("ingress", ("query",), keys(ask)),
        ("ingress", ("declare_subscriber",), keys(read, "pub/**")),
        ("ingress", ("liveliness_token",), keys(tokens, "pub/**")),
        ("ingress", _LIVE, keys(heard, "pub/**")),
        ("egress", ("put",), keys(read, "pub/**")),
        ("egress", ("reply",), [*keys(ask), *keys(read, "pub/**")]),
        ("egress", ("query",), keys(may.answer)),
        ("egress", ("declare_queryable",), keys(ask)),
        ("egress", ("declare_subscriber",), published),
        ("egress", ("liveliness_token",), keys(heard, "pub/**")),
        ("egress", _LIVE, keys(tokens, "pub/**")),
    ]
    return [
        _rule(f"{subject}: {flow} {messages[0]}", (flow,), messages, sorted(set(found)))
        for flow, messages, found in table
        if found
    ]


def _is_token(key: str) -> bool:
    return key.startswith("alive/") or "@adv" in key


def _rule(name: str, flows: Iterable[Flow], messages: Iterable[str], keys: Iterable[str]) -> dict[str, Any]:
    return {
        "id": name, "permission": "allow", "flows": [*flows], "messages": [*messages], "key_exprs": [*keys],
    }  # fmt: skip


def router_file(enrolled: Iterable[tuple[Role, str, str]], plant: str) -> str:
    """Return the configuration of a plant's router, JSON5; it is started in the folder of its keys."""
    router = router_name(plant)
    content = {
        "mode": "router",
        "listen": {"endpoints": [f"tls/0.0.0.0:{ROUTER_PORT}"]},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "timestamping": {"enabled": True},
        "transport": {"link": {"protocols": ["tls"], "tls": tls_options("", router)}},
        "access_control": access_control(enrolled, router),
    }
    head = (
        "// Router of Zenoh: who may do what, by the names of certificates. Written by armident keys; do not edit.\n"
        f"// Start it in the folder with authority.pem, {router}.pem and {router}.key: zenohd --config {ROUTER_FILE}\n"
    )
    return head + json.dumps(content, indent=2) + "\n"


def tls_options(folder: str, name: str) -> dict[str, Any]:
    """Return the section ``transport/link/tls`` of a node whose certificate has this name."""
    certificate, key = f"{folder}{name}.pem", f"{folder}{name}.key"
    return {
        "root_ca_certificate": f"{folder}authority.pem",
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
        "listen_certificate": certificate,
        "listen_private_key": key,
        "connect_certificate": certificate,
        "connect_private_key": key,
    }


def explained(role: Role, cell: str, name: str) -> str:
    """Return what an identity may do, in words."""
    if role == "router":
        return f"{name}: forwards between the others; publishes, reads and commands nothing of its own"
    if role == "opcua":
        return (
            f"{name}: serves or reads the verdicts of all cells over OPC UA; publishes, reads and commands nothing else"
        )
    may = PERMISSIONS[role]
    where = "all cells" if cell == ANY_CELL else f"cell {cell}"
    parts = [
        f"{verb} {_words(patterns)}"
        for verb, patterns in (
            ("reads", may.read),
            ("publishes", may.publish),
            ("answers", may.answer),
            ("sends", [pattern for pattern in may.ask if pattern not in may.read]),
        )
    ]
    return f"{name} ({role} of {where}): {'; '.join(parts)}"


def _words(patterns: Iterable[str]) -> str:
    """Return the names of keys in words, without those that only serve the others."""
    return ", ".join(
        _WORDS.get(key, key) for key in patterns if "@adv" not in key and not key.startswith("alive/") and key != "sent"
    ) or "nothing"  # fmt: skip
