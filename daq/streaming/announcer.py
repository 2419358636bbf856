"""Announcements on Zenoh that neither a late listener nor the end of this process loses."""

import json
import time
from typing import Any

import zenoh

from armident.daq.identity.signatures import Signer
from armident.daq.streaming.keys import Keys

SENT_IN_ORDER: dict[str, Any] = {"transport/unicast/qos/enabled": False, "transport/link/tx/queue/size/data": 1}
"""Settings of a session that announces: one queue for all messages to a peer, with room for one batch of them."""
RETRY_S = 4.0
"""Longest interval between two attempts of Zenoh to connect if its configuration gives none, s."""
CONNECTING_S = 1.0
"""Time in which a connection between peers is made, s."""


class Announcer:
    """Publishes signed messages that are not repeated, such as results; ``session`` has the settings `SENT_IN_ORDER`.

    ``put`` of Zenoh returns before the message is sent, so that a killed process loses it. Here a declaration follows
    each message in the same queue; it is taken when the operating system has taken the message. Zenoh also forgets
    messages if nobody listens: lost listeners get ``retry_s``, the longest interval between attempts to connect, s.
    """

    def __init__(self, session: zenoh.Session, keys: Keys, retry_s: float, signer: Signer) -> None:
        self._session, self._keys, self._signer = session, keys, signer
        self._ready = time.monotonic() + retry_s + CONNECTING_S

    @property
    def ready_in_s(self) -> float:
        """Time until all listeners have had time to connect, s; 0 afterwards."""
        return max(0.0, self._ready - time.monotonic())

    def announce(self, *messages: tuple[str, bytes]) -> None:
        """Publish messages (key expression, content), and return when the operating system has taken them."""
        for key, content in messages:
            # Express: not batched with later messages. Block: not dropped if the queue is full.
            self._session.put(
                key,
                content,
                attachment=self._signer.attachment(key, content),
                express=True,
                congestion_control=zenoh.CongestionControl.BLOCK,
            )
        self._session.declare_subscriber(self._keys.sent, _ignore).undeclare()


def longest_retry_s(config: zenoh.Config) -> float:
    """Return the longest interval between two attempts to connect, s."""
    longest = (json.loads(config.get_json("connect/retry")) or {}).get("period_max_ms")
    # One number, or one for each mode of a node.
    numbers = longest.values() if isinstance(longest, dict) else [longest]
    return max((number / 1e3 for number in numbers if number is not None), default=RETRY_S)


def _ignore(_sample: zenoh.Sample) -> None:
    """Take a message of a key on which nothing is published."""
