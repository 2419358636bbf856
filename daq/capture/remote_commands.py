"""Commands to a running capture over Zenoh: save the last seconds, set a mark, reload, stop."""

import logging
import queue
import time
from dataclasses import dataclass
from typing import Literal, get_args

import zenoh

from armident.configs import ArmidentError, ConfigError, DataError, SessionConfig
from armident.daq.identity.signatures import NONCE_BYTES, Signed, Signer, Trust, new_nonce, signer_for, trust_for
from armident.daq.streaming import Keys, Refusals, open_session

CommandName = Literal["save", "mark", "reload", "stop"]
COMMANDS: tuple[CommandName, ...] = get_args(CommandName)
_LONGEST_TEXT = 500
"""Largest length of a command's text, bytes."""
_MOST_WAITING = 32
"""Largest number of waiting commands; the capture takes them at every read of the buses, some 50 times a second."""
ACCEPTED = b"accepted"
ANSWER_S = 5.0
"""Longest wait for an answer, s."""
FRESH_S = 30.0
"""Largest difference between the time of a command and the clock of the capture, s."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Command:
    """A command to a capture: ``save``, ``mark``, ``reload`` or ``stop``, and the text of a mark or a save's note."""

    name: CommandName
    text: str = ""


class Commands:
    """Receives the commands of an operator for a capture, if ``allowed`` (``zenoh.commands`` of the session).

    A command counts once: its nonce is remembered while its time is fresh, and it is not older than this object.
    """

    def __init__(self, keys: Keys, allowed: bool) -> None:
        self._waiting: queue.SimpleQueue[Command] = queue.SimpleQueue()
        self._keys = keys
        self.allowed = allowed
        self._began_ns = time.time_ns()
        self._seen: dict[bytes, int] = {}
        self._refusals = Refusals(log)

    def declare(self, zenoh_session: zenoh.Session, signer: Signer, trust: Trust) -> None:
        """Answer commands on a Zenoh session, until it is closed."""
        self._signer, self._trust = signer, trust
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
            # The payload is read only after these checks: it may have any size.
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
                content = b"" if query.payload is None else bytes(query.payload)
                try:
                    signed = self._trust.check("ask", query.key_expr, content, query.attachment)
                    self._check_fresh(signed)
                except DataError as error:
                    self._refusals.refuse("commands", error)
                    query.reply_err(str(error))
                    return
                self._waiting.put(Command(known, content.decode(errors="replace")))
                key = str(query.key_expr)
                query.reply(key, ACCEPTED, attachment=self._signer.attachment(key, ACCEPTED, signed.nonce))

    def _check_fresh(self, signed: Signed) -> None:
        """Check that a command was signed just now, and has not been here; DataError otherwise."""
        now = time.time_ns()
        off_s = abs(now - signed.time_ns) / 1e9
        if off_s > FRESH_S:
            raise DataError(
                f"the command of {signed.name} is {off_s:.0f} s off the clock of the capture; check both clocks"
            )
        if signed.time_ns < self._began_ns:
            raise DataError(f"the command of {signed.name} is older than this capture; repeat it")
        self._seen = {nonce: when for nonce, when in self._seen.items() if now - when <= FRESH_S * 1e9}
        if len(signed.nonce) != NONCE_BYTES or signed.nonce in self._seen:
            raise DataError(f"the command of {signed.name} was received before: repeated by somebody else")
        self._seen[signed.nonce] = signed.time_ns


def send_command(session: SessionConfig, robot: str, command: Command, answer_s: float = ANSWER_S) -> None:
    """Send a command and wait until a capture accepts it; ConfigError if none answers, DataError if it refuses."""
    keys, nonce, content = Keys(session.cell, robot), new_nonce(), command.text.encode()
    signer, trust = signer_for(session, "operator"), trust_for(session, keys.base)
    with open_session(session, "observer") as zenoh_session:
        key = keys.command(command.name)
        try:
            querier = zenoh_session.declare_querier(key, timeout=answer_s)
            _wait_for_capture(querier, answer_s)
            replies = list(querier.get(payload=content, attachment=signer.attachment(key, content, nonce)))
        except zenoh.ZError as error:
            raise ArmidentError(f"zenoh: {error}") from error
    problem: ArmidentError = ConfigError(f"no capture of cell {session.cell}, robot {robot}, answers")
    for reply in replies:
        if reply.err is not None:
            problem = DataError(f"the capture refuses: {bytes(reply.err.payload).decode(errors='replace')}")
            continue
        assert reply.ok is not None
        try:
            trust.check("answer", key, bytes(reply.ok.payload), reply.ok.attachment, nonce=nonce)
        except DataError as error:
            problem = DataError(f"an answer that is not of the capture: {error}")
        else:
            return
    raise problem


def _wait_for_capture(querier: zenoh.Querier, seconds: float) -> None:
    """Wait until the querier has found a capture, or the time is over."""
    until = time.monotonic() + seconds
    while not querier.matching_status and time.monotonic() < until:
        time.sleep(0.02)
