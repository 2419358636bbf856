"""Moves and records the arm of a session: a guard and a capture, each a process of its own, as in a plant."""

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import IO, Protocol

from armident.configs import ArmidentError, ConfigError, DataError
from armident.daq.recording import Recording, join_parts, read_recording

READY_S = 120.0
"""How long the guard may take to be ready: its loop may have to be compiled."""
CAPTURE_ENDS_S = 180.0
"""How long a capture that was told to end may take: drives that are behind are waited for."""
GUARD_ENDS_S = 10.0
LOOK_S = 0.05
_ERRORS: dict[int, type[ArmidentError]] = {2: ConfigError, 3: DataError}

Say = Callable[[str], None]


class Process(Protocol):
    """A command that was started, as `subprocess.Popen` has it."""

    def poll(self) -> int | None:
        """Its exit code, once it has ended."""
        ...

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end; ``subprocess.TimeoutExpired`` if that takes longer."""
        ...

    def send_signal(self, sig: int) -> None:
        """Send it a signal."""
        ...

    def kill(self) -> None:
        """End it at once."""
        ...


Start = Callable[[Sequence[str], IO[bytes], IO[bytes]], Process]
"""Starts an armident command, by its words, with its standard output and error in files."""


def start_process(words: Sequence[str], out: IO[bytes], err: IO[bytes]) -> Process:
    """Start an armident command with an interpreter of its own.

    Signals of the terminal reach us alone: the guard has to have its own before the capture has one.
    """
    command = [sys.executable, "-m", "armident.daq.cli", *words]
    return subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=out, stderr=err, start_new_session=True)


class Interrupted(ArmidentError):
    """SIGINT or SIGTERM came while the arm moved; the drives were stopped."""

    exit_code = 130


def play(config: Path, out: Path, say: Say, start: Start = start_process) -> Recording:
    """Play the set points of a session once, watched by a guard; the recording of it.

    Parameters
    ----------
    config
        Session, checked.
    out
        Folder of the recording.
    say
        Takes lines that tell how it goes.
    start
        How guard and capture are started.

    Raises
    ------
    ConfigError
        If bus or drives are not there, or not as configured.
    ArmidentError
        If the guard stopped the arm, or a drive failed; says why. The recording is kept.
    Interrupted
        On SIGINT and SIGTERM.
    """
    # The guard comes before the first motion, and leaves after the last.
    with _interruptible(), _command(["guard", "--config", str(config)], start) as guard:
        _until_ready(guard)
        say("guard: ready")
        options = ["capture", "--config", str(config), "--out", str(out), "--json"]
        with _command(options, start) as capture:
            try:
                while capture.running and guard.running:
                    time.sleep(LOOK_S)
            except BaseException:
                guard.tell(signal.SIGINT)
                raise
            if capture.running:
                capture.tell(signal.SIGTERM)
                capture.wait(CAPTURE_ENDS_S)
                raise ArmidentError(_kept(guard.last_word(), capture))
            guard.tell(signal.SIGUSR1)
            guard.wait(GUARD_ENDS_S)
            if guard.code == 1:
                # It was faster than the capture, which then ended because of it.
                raise ArmidentError(_kept(guard.last_word(), capture))
            if capture.code:
                raise _ERRORS.get(capture.code, ArmidentError)(capture.last_word())
            say(capture.errors().strip().splitlines()[-1])
            return join_parts([read_recording(Path(path)) for path in _recordings(capture)])


def _recordings(capture: "_Command") -> list[str]:
    try:
        paths = json.loads(capture.output())["recordings"]
    except (ValueError, KeyError) as error:
        raise ArmidentError(f"capture: said nothing of its recording: {capture.output()[:200]!r}") from error
    if not paths:
        raise DataError("capture: nothing was recorded; does the session have recording.trigger?")
    return list(paths)


def _kept(why: str, capture: "_Command") -> str:
    with suppress(ArmidentError):
        return f"{why} (recording: {_recordings(capture)[-1]})"
    return why


def _until_ready(guard: "_Command") -> None:
    until = time.monotonic() + READY_S
    while "ready" not in guard.output():
        if not guard.running:
            raise _ERRORS.get(guard.code or 1, ArmidentError)(guard.last_word())
        if time.monotonic() > until:
            raise ArmidentError(f"guard: was not ready within {READY_S:.0f} s")
        time.sleep(LOOK_S)


class _Command:
    """A command of ours, running."""

    def __init__(self, words: Sequence[str], start: Start, out: IO[bytes], err: IO[bytes]) -> None:
        self.name = words[0]
        self._out, self._err = out, err
        self._process = start(words, out, err)

    @property
    def running(self) -> bool:
        """Whether it has not ended yet."""
        return self._process.poll() is None

    @property
    def code(self) -> int | None:
        """Its exit code."""
        return self._process.poll()

    def output(self) -> str:
        """Standard output so far."""
        return _text(self._out)

    def errors(self) -> str:
        """Standard error so far."""
        return _text(self._err)

    def last_word(self) -> str:
        """Its one line of error, or the last line that it printed."""
        lines = [line for line in self.errors().splitlines() if line.strip()]
        own = [line.removeprefix("armident: ") for line in lines if line.startswith("armident: ")]
        return (own or lines or [f"{self.name}: ended with exit code {self.code}"])[-1]

    def tell(self, number: signal.Signals) -> None:
        """Send a signal, if it still runs."""
        if self.running:
            self._process.send_signal(number)

    def wait(self, seconds: float) -> None:
        """Wait for its end, and make it end after so long."""
        try:
            self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


@contextmanager
def _command(words: Sequence[str], start: Start) -> Iterator[_Command]:
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        command = _Command(words, start, out, err)
        try:
            yield command
        finally:
            command.tell(signal.SIGTERM)
            command.wait(CAPTURE_ENDS_S)


def _text(file: IO[bytes]) -> str:
    # Reading must not move the offset: the process writes where it stands.
    return os.pread(file.fileno(), os.fstat(file.fileno()).st_size, 0).decode(errors="replace")


@contextmanager
def _interruptible() -> Iterator[None]:
    """SIGINT and SIGTERM as an exception, meanwhile."""

    def interrupt(number: int, _frame: FrameType | None) -> None:
        raise Interrupted(f"interrupted ({signal.Signals(number).name}); the drives were stopped")

    before = {number: signal.signal(number, interrupt) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
