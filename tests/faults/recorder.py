"""Captures as processes that start at once: forked from a process that has loaded and compiled everything."""

import json
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable
from multiprocessing import Pipe
from pathlib import Path
from typing import Any

import numpy as np

from armident.configs import ArmidentError
from armident.daq.capture.capture import run_capture
from armident.daq.matching.assembler import Assembler, TpdoStream
from armident.drivers.can.frames import frames
from armident.drivers.can.socketcan import RawSocket
from armident.drivers.canopen import sync_loop


def warm() -> None:
    """Load the compiled functions of a capture."""
    for buses in (1, 2):
        streams = [TpdoStream("samples", 1, (0x181, 0x182), 8), TpdoStream("demand", 5, (0x281, 0x282), 4)]
        where = (0, buses - 1)
        Assembler(streams, ("a", "b"), 1_000_000, bus_of=where).warm_up(frames(2))
    state, late = np.zeros(sync_loop.STATE_SIZE, np.int64), np.zeros(sync_loop.BINS, np.int64)
    one, other, third, times = np.zeros((4, 1), np.int64)
    sync_loop.Loop(one, 1_000_000, 240, state, late, other, third, times)


class Capture:
    """A capture process."""

    def __init__(self, pid: int, ask: Callable[[int], int | None]) -> None:
        self.pid = pid
        self._ask = ask
        self._code: int | None = None

    @property
    def exitcode(self) -> int | None:
        """Exit code, or the negative number of the signal that ended it; ``None`` while it runs."""
        if self._code is None:
            self._code = self._ask(self.pid)
        return self._code

    def join(self) -> None:
        """Wait for the end of the process."""
        while self.exitcode is None:
            time.sleep(0.01)

    def kill(self) -> None:
        """Send SIGKILL."""
        if self.exitcode is None:
            os.kill(self.pid, signal.SIGKILL)


class Recorders:
    """Starts capture processes by forking a server process that has loaded everything and has no threads.

    Create it before the calling process has threads.
    """

    def __init__(self) -> None:
        self._asking, answering = Pipe()
        self._server = os.fork()
        if self._server == 0:
            try:
                self._asking.close()
                _serve(answering)
            finally:
                os._exit(1)
        answering.close()

    def start(
        self,
        session: Path,
        out: Path,
        log: Path,
        duration: float | None = None,
        receive_buffer: int | None = None,
        listen_only: bool = False,
    ) -> Capture:
        """Start a capture; its stdout and stderr go to ``log`` with the suffixes ``.out`` and ``.err``."""
        return Capture(self._ask((session, out, log, duration, receive_buffer, listen_only)), self._ask)

    def _ask(self, what: Any) -> Any:
        self._asking.send(what)
        return self._asking.recv()

    def close(self) -> None:
        """End the server."""
        self._asking.close()
        os.waitpid(self._server, 0)


def _serve(connection: Any) -> None:
    while True:
        try:
            asked = connection.recv()
        except EOFError:
            os._exit(0)
        if isinstance(asked, int):
            pid, status = os.waitpid(asked, os.WNOHANG)
            connection.send(os.waitstatus_to_exitcode(status) if pid else None)
            continue
        pid = os.fork()
        if pid == 0:
            connection.close()
            try:
                _record(*asked)
            except BaseException:
                traceback.print_exc()
            finally:
                sys.stderr.flush()
                os._exit(70)
        connection.send(pid)


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


def _record(
    session: Path, out: Path, log: Path, duration: float | None, receive_buffer: int | None, listen_only: bool
) -> None:
    for number, suffix in ((1, ".out"), (2, ".err")):
        descriptor = os.open(log.with_suffix(suffix), os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
        os.dup2(descriptor, number)
    sys.stdout, sys.stderr = os.fdopen(1, "w", closefd=False), os.fdopen(2, "w", closefd=False)
    if receive_buffer is not None:
        # A short stop overruns a small buffer.
        assert RawSocket.__init__.__kwdefaults__ is not None
        RawSocket.__init__.__kwdefaults__["receive_buffer"] = receive_buffer
    try:
        run_capture(str(session), out, duration, listen_only, True)
    except ArmidentError as error:
        print(f"armident: {error}", file=sys.stderr, flush=True)
        os._exit(error.exit_code)
    sys.stdout.flush()
    os._exit(0)
