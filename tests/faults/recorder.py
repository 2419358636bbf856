"""Captures as processes that start at once, with a receive buffer of any size."""

import json
import sys
from pathlib import Path

from armident.configs import ArmidentError
from armident.daq.capture.capture import run_capture
from armident.drivers.can.socketcan import RawSocket
from tests.fixtures.processes import ForkedProcess, start


def start_capture(
    session: Path,
    out: Path,
    log: Path,
    duration: float | None = None,
    receive_buffer: int | None = None,
    listen_only: bool = False,
) -> ForkedProcess:
    """Start a capture; its stdout and stderr go to ``log`` with the suffixes ``.out`` and ``.err``.

    ``log``: path of the two files of output, without suffix. ``duration``: length of the capture, s; ``None``: until it
    is stopped. ``receive_buffer``: receive buffer of the sockets, bytes; a short stop of the process overruns a small
    one. ``listen_only``: send nothing.
    """
    arguments = session, out, duration, receive_buffer, listen_only
    with log.with_suffix(".out").open("wb") as output, log.with_suffix(".err").open("wb") as errors:
        return start(_capture, *arguments, stdout=output, stderr=errors)


def log_text(log: Path) -> str:
    """Return the stderr of a capture so far."""
    try:
        return log.with_suffix(".err").read_text(errors="replace")
    except FileNotFoundError:
        return ""


def result(log: Path) -> tuple[list[Path], dict[str, int]]:
    """Return files and counters of a capture that has ended."""
    document = json.loads(log.with_suffix(".out").read_text())
    return [Path(path) for path in document["recordings"]], document["counters"]


def _capture(session: Path, out: Path, duration: float | None, receive_buffer: int | None, listen_only: bool) -> None:
    if receive_buffer is not None:
        assert RawSocket.__init__.__kwdefaults__ is not None
        RawSocket.__init__.__kwdefaults__["receive_buffer"] = receive_buffer
    try:
        run_capture(str(session), out, duration, listen_only, True)
    except ArmidentError as error:
        print(f"armident: {error}", file=sys.stderr, flush=True)
        raise SystemExit(error.exit_code) from error
