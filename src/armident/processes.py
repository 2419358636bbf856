"""Child processes: start an ``armident`` command, wait for its output, stop it."""

import ctypes
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO, Protocol, Self

from armident.configs.errors import ArmidentError

COMMAND_LINE = "armident.daq.cli"
"""Module of the command line, run as ``python -m armident.daq.cli``."""
ERROR_PREFIX = "armident: "
"""Beginning of the error line of a command."""
STOP_S = 10.0
"""Time between the signal and the kill in `CommandProcess.stop`, s."""
POLL_S = 0.02
"""Time between two looks at the output of a process, s."""
TAIL_LINES = 8
"""Lines of output in an error message."""
PARENT_VARIABLE = "ARMIDENT_PARENT"
"""Environment variable with the number of the process that a command ends with."""
_PR_SET_PDEATHSIG = 1
"""Option of prctl(2): signal that the kernel sends when the parent ends."""


class Process(Protocol):
    """A started process: the part of `subprocess.Popen` that `CommandProcess` uses."""

    def poll(self) -> int | None:
        """Return the exit code, ``None`` while the process runs."""
        ...

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the end and return the exit code; raise `subprocess.TimeoutExpired` after ``timeout`` seconds."""
        ...

    def send_signal(self, sig: int) -> None:
        """Send a signal."""
        ...

    def kill(self) -> None:
        """End the process at once."""
        ...


Start = Callable[[Sequence[str], IO[bytes], IO[bytes]], Process]
"""Starts a command, given its words and the files of its standard output and standard error."""


def start_command(
    words: Sequence[str],
    out: IO[bytes],
    err: IO[bytes],
    *,
    module: str = COMMAND_LINE,
    niceness: int = 0,
    own_session: bool = False,
    with_parent: bool = False,
    environment: Mapping[str, str] | None = None,
) -> "subprocess.Popen[bytes]":
    """Start ``python -m module words...`` with this interpreter, its output in the files ``out`` and ``err``.

    ``own_session``: signals of the terminal (Ctrl-C) do not reach it. ``with_parent``: SIGTERM when the starting thread
    ends, also by SIGKILL (Linux). ``environment``: variables added.
    """
    nice = ["nice", "-n", str(niceness)] if niceness else []
    parent = {PARENT_VARIABLE: str(os.getpid())} if with_parent else {}
    return subprocess.Popen(
        [*nice, sys.executable, "-m", module, *words],
        stdin=subprocess.DEVNULL,
        stdout=out,
        stderr=err,
        env={**os.environ, **parent, **(environment or {})},
        start_new_session=own_session,
        bufsize=0,
    )


def end_with_parent() -> None:
    """Ask the kernel for SIGTERM when the parent ends, if it started this process by ``with_parent``; see prctl(2)."""
    parent = os.environ.pop(PARENT_VARIABLE, None)
    if parent is None:
        return
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if str(os.getppid()) != parent:
        # It ended before the kernel was asked.
        os.kill(os.getpid(), signal.SIGTERM)


class ProcessEnded(ArmidentError):
    """A process ended before it printed the expected line."""


class ProcessTimeout(ArmidentError):
    """A process did not print the expected line in time."""


class CommandProcess:
    """A child process whose output goes to files, started and stopped as a context manager.

    ``name``: in error messages, by default the first word. ``log``: file of standard error, appended to, by default a
    temporary one; ``merge`` adds standard output. ``start``: `start_command` with options, or a replacement in tests.
    """

    def __init__(
        self,
        words: Sequence[str],
        *,
        name: str | None = None,
        log: Path | None = None,
        merge: bool = False,
        start: Start = start_command,
    ) -> None:
        self.words = tuple(words)
        self.name = self.words[0] if name is None else name
        self.log = log
        self._merge = merge
        self._start = start
        self._process: Process | None = None
        self._files: tuple[IO[bytes], IO[bytes]] | None = None
        self._offset = 0
        self._consumed = 0
        self._final = (b"", b"")

    def start(self) -> Self:
        """Start the process and return this object. Raises ArmidentError if the process is running already."""
        if self.running:
            raise ArmidentError(f"{self.name} is running already")
        if self.log is None:
            err: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 (open until the process ends)
        else:
            self.log.parent.mkdir(parents=True, exist_ok=True)
            err = self.log.open("ab+")
        self._offset = os.fstat(err.fileno()).st_size
        self._consumed = 0
        self._files = (err if self._merge else tempfile.TemporaryFile(), err)  # noqa: SIM115 (as above)
        try:
            self._process = self._start(self.words, *self._files)
        except BaseException:
            self._close_files()
            raise
        return self

    def __enter__(self) -> Self:
        """Start the process."""
        return self.start()

    def __exit__(self, *_: object) -> None:
        """Stop the process."""
        self.stop()

    @property
    def process(self) -> Process:
        """The started process. Raises ArmidentError: before `start`."""
        if self._process is None:
            raise ArmidentError(f"{self.name} has not been started")
        return self._process

    @property
    def running(self) -> bool:
        """``True`` between start and end of the process."""
        return self._process is not None and self._process.poll() is None

    @property
    def exit_code(self) -> int | None:
        """Exit code, ``None`` before the end; minus the number of the signal that ended the process."""
        return None if self._process is None else self._process.poll()

    def output(self) -> str:
        """Return the standard output so far."""
        return self._content(0).decode(errors="replace")

    def errors(self) -> str:
        """Return the standard error so far; with ``merge`` the standard output too."""
        return self._content(1).decode(errors="replace")

    def tail(self, lines: int = TAIL_LINES) -> str:
        """Return the last lines of standard error that are not empty, joined by ``" | "``."""
        text = [line.strip() for line in self.errors().splitlines() if line.strip()]
        return " | ".join(text[-lines:]) or "it printed nothing"

    def last_error(self) -> str:
        """Return the ``armident: ...`` error line, otherwise the last line of standard error."""
        lines = [line for line in self.errors().splitlines() if line.strip()]
        own = [line.removeprefix(ERROR_PREFIX) for line in lines if line.startswith(ERROR_PREFIX)]
        return (own or lines or [f"{self.name}: ended with exit code {self.exit_code}"])[-1]

    def failure(self, problem: str) -> ArmidentError:
        """Return an error of name, problem (``"ended with exit code 1"``), log file and end of standard error."""
        return ArmidentError(self._message(problem))

    def wait_for_line(self, text: str, timeout: float) -> str:
        """Consume standard output up to the next line that begins with ``text``, and return that line."""
        until = time.monotonic() + timeout
        expected = f"before it printed {text!r}" if text else "before it printed a line"
        while True:
            # The state is read before the output, so that the last lines of a process are seen.
            ended = not self.running
            content = self._content(0)
            while (end := content.find(b"\n", self._consumed)) >= 0:
                line = content[self._consumed : end].decode(errors="replace")
                self._consumed = end + 1
                if line.startswith(text):
                    return line
            if ended:
                raise ProcessEnded(self._message(f"ended with exit code {self.exit_code} {expected}"))
            if time.monotonic() >= until:
                raise ProcessTimeout(self._message(f"did not print {text!r} within {timeout:.0f} s"))
            time.sleep(POLL_S)

    def send_signal(self, number: signal.Signals) -> None:
        """Send a signal; does nothing after the end of the process."""
        if self.running:
            self.process.send_signal(number)

    def stop(self, timeout: float = STOP_S, number: signal.Signals = signal.SIGTERM) -> None:
        """End the process: send a signal, wait ``timeout`` (s), and kill it if it still runs."""
        if self._process is None:
            return
        stdin = getattr(self._process, "stdin", None)
        if stdin is not None:
            with suppress(BrokenPipeError):
                stdin.close()
        self.send_signal(number)
        try:
            self._process.wait(timeout)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._close_files()

    def _message(self, problem: str) -> str:
        log = "" if self.log is None else f" (log: {self.log})"
        return f"{self.name} {problem}{log}: {self.tail()}"

    def _content(self, which: int) -> bytes:
        if self._files is None:
            return self._final[which]
        file = self._files[which]
        start = self._offset if file is self._files[1] else 0
        # Reading must not move the file offset: the process writes at it.
        return os.pread(file.fileno(), os.fstat(file.fileno()).st_size - start, start)

    def _close_files(self) -> None:
        if self._files is None:
            return
        self._final = (self._content(0), self._content(1))
        files, self._files = self._files, None
        for file in files:
            file.close()
