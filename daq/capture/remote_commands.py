"""Commands to a running capture over Zenoh: save the last seconds, set a mark, reload, stop."""

import queue
import time
from dataclasses import dataclass
from typing import Literal, get_args

import zenoh

from armident.configs import ArmidentError, ConfigError, DataError, SessionConfig
from armident.daq.streaming import Keys, open_session

CommandName = Literal["save", "mark", "reload", "stop"]
COMMANDS: tuple[CommandName, ...] = get_args(CommandName)
_LONGEST_TEXT = 500
"""Largest length of a command's text, bytes."""
_MOST_WAITING = 32
"""Largest number of waiting commands; the capture takes them at every read of the buses, some 50 times a second."""
ANSWER_S = 5.0
"""Longest wait for an answer, s."""


@dataclass(frozen=True)
class Command:
    """A command to a capture: ``save``, ``mark``, ``reload`` or ``stop``, and the text of a mark or a save's note."""

    name: CommandName
    text: str = ""


class Commands:
    """Receives the commands for a capture, if ``allowed`` (``zenoh.commands`` of the session)."""

    def __init__(self, keys: Keys, allowed: bool) -> None:
        self._waiting: queue.SimpleQueue[Command] = queue.SimpleQueue()
        self._keys = keys
        self.allowed = allowed

    def declare(self, zenoh_session: zenoh.Session) -> None:
        """Answer commands on a Zenoh session, until it is closed."""
        self._queryable = zenoh_session.declare_queryable(self._keys.command("*"), self._answer)

    def pending(self) -> list[Command]:
        """Return the commands since the last call."""
        found = []
        while not self._waiting.empty():
            found.append(self._waiting.get())
        return found

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            name = str(query.key_expr).rsplit("/", 1)[-1]
            known = next((command for command in COMMANDS if command == name), None)
            # The payload is decoded only after these checks: it may have any size.
            size = 0 if query.payload is None else len(query.payload)
            if not self.allowed:
                query.reply_err("commands are not enabled; set zenoh.commands: true in the session configuration")
            elif known is None:
                query.reply_err(f"no command {name[:40]!r}; there are {', '.join(COMMANDS)}")
            elif size > _LONGEST_TEXT:
                query.reply_err(f"a text of {size} bytes is longer than {_LONGEST_TEXT}")
            elif self._waiting.qsize() >= _MOST_WAITING:
                query.reply_err(f"{_MOST_WAITING} commands are waiting already; try again later")
            else:
                text = "" if query.payload is None else bytes(query.payload).decode(errors="replace")
                self._waiting.put(Command(known, text))
                query.reply(query.key_expr, "accepted")


def send_command(session: SessionConfig, robot: str, command: Command, answer_s: float = ANSWER_S) -> None:
    """Send a command and wait until a capture accepts it; ConfigError if none answers, DataError if it refuses."""
    with open_session(session, "observer") as zenoh_session:
        key = Keys(session.cell, robot).command(command.name)
        replies: queue.SimpleQueue[zenoh.Reply] = queue.SimpleQueue()
        try:
            querier = zenoh_session.declare_querier(key, timeout=answer_s)
            _wait_for_capture(querier, answer_s)
            for reply in querier.get(payload=command.text.encode()):
                replies.put(reply)
        except zenoh.ZError as error:
            raise ArmidentError(f"zenoh: {error}") from error
    if replies.empty():
        raise ConfigError(f"no capture of cell {session.cell}, robot {robot}, answers")
    reply = replies.get()
    if reply.err is not None:
        raise DataError(f"the capture refuses: {bytes(reply.err.payload).decode(errors='replace')}")


def _wait_for_capture(querier: zenoh.Querier, seconds: float) -> None:
    """Wait until the querier has found a capture, or the time is over."""
    until = time.monotonic() + seconds
    while not querier.matching_status and time.monotonic() < until:
        time.sleep(0.02)
