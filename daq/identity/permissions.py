"""Permissions of each role: the keys that it may publish, answer, ask and read."""

from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Literal

from armident.daq.identity.certificates import Role

Action = Literal["publish", "answer", "ask", "read", "sign"]


@dataclass(frozen=True)
class Permission:
    """Keys below ``armident/CELL/ROBOT/`` for each action; ``*`` stands for one or more parts of a key.

    ``publish``: messages and liveliness tokens. ``answer``: replies to queries. ``ask``: queries. ``read``:
    subscriptions, also of liveliness. A reader of samples and events asks for those that it missed below ``@adv``.
    ``sign``: ``documents``, which are files.
    """

    publish: tuple[str, ...] = ()
    answer: tuple[str, ...] = ()
    ask: tuple[str, ...] = ()
    read: tuple[str, ...] = ()
    sign: tuple[str, ...] = ()


_STREAMS = ("samples", "events", "samples/@adv/*", "events/@adv/*")
_ALL = (*_STREAMS, "health", "status", "result/*", "alive/*")

PERMISSIONS: dict[Role, Permission] = {
    "capture": Permission(
        publish=(*_STREAMS, "health", "status", "alive/capture"),
        answer=("command/*", "samples/@adv/*", "events/@adv/*"),
        ask=("alive/capture",),
        read=("alive/*",),
    ),
    "worker": Permission(
        publish=("result/*", "status", "sent", "alive/worker", "alive/watch"),
        answer=("result/*",),
        ask=(*_STREAMS, "result/*", "alive/*"),
        read=(*_STREAMS, "result/*", "status", "sent", "alive/*"),
        sign=("documents",),
    ),
    "operator": Permission(ask=("command/*", "result/*", *_STREAMS, "alive/*"), read=_ALL, sign=("documents",)),
    "viewer": Permission(ask=("result/*", *_STREAMS, "alive/*"), read=_ALL),
    "router": Permission(),
    "opcua": Permission(),
}
"""Permissions by role; an operator or viewer of all cells has them in each cell. All else is forbidden.

A re-identification and ``armident watch`` have the role of a worker. An application of OPC UA has no part in Zenoh.
"""


def may(role: Role, action: Action, key: str) -> bool:
    """Return True if a role may do this with a key, given without ``armident/CELL/ROBOT/``."""
    return any(fnmatchcase(key, pattern) for pattern in getattr(PERMISSIONS[role], action))
