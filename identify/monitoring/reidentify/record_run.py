"""Moves and records the arm of a session: a guard and a capture, each a process of its own, as in a plant."""

import json
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import IO

from armident.configs import ArmidentError, ConfigError, DataError
from armident.daq.recording import Recording, join_parts, read_recording
from armident.processes import CommandProcess, Process, ProcessEnded, Start, start_command

READY_S = 120.0
"""How long the guard may take to be ready: its loop may have to be compiled."""
CAPTURE_ENDS_S = 180.0
"""How long a capture that was told to end may take: drives that are behind are waited for."""
GUARD_ENDS_S = 10.0
LOOK_S = 0.05
_ERRORS: dict[int, type[ArmidentError]] = {2: ConfigError, 3: DataError}

Say = Callable[[str], None]


def start_process(words: Sequence[str], out: IO[bytes], err: IO[bytes]) -> Process:
    """Start an armident command in a session of its own.

    Signals of the terminal then reach this process only, which signals the guard before the capture.

    Parameters
    ----------
    words
        Words of the command.
    out, err
        Files of standard output and standard error.
    """
    return start_command(words, out, err, own_session=True)


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
                guard.send_signal(signal.SIGINT)
                raise
            if capture.running:
                capture.stop(CAPTURE_ENDS_S)
                raise ArmidentError(_kept(guard.last_error(), capture))
            guard.stop(GUARD_ENDS_S, signal.SIGUSR1)
            if guard.exit_code == 1:
                # It was faster than the capture, which then ended because of it.
                raise ArmidentError(_kept(guard.last_error(), capture))
            if capture.exit_code:
                raise _ERRORS.get(capture.exit_code, ArmidentError)(capture.last_error())
            say(capture.errors().strip().splitlines()[-1])
            return join_parts([read_recording(Path(path)) for path in _recordings(capture)])


def _recordings(capture: CommandProcess) -> list[str]:
    try:
        paths = json.loads(capture.output())["recordings"]
    except (ValueError, KeyError) as error:
        raise ArmidentError(f"capture: said nothing of its recording: {capture.output()[:200]!r}") from error
    if not paths:
        raise DataError("capture: nothing was recorded; does the session have recording.trigger?")
    return list(paths)


def _kept(why: str, capture: CommandProcess) -> str:
    with suppress(ArmidentError):
        return f"{why} (recording: {_recordings(capture)[-1]})"
    return why


def _until_ready(guard: CommandProcess) -> None:
    try:
        guard.wait_for_line("guard: ready", READY_S)
    except ProcessEnded as error:
        raise _ERRORS.get(guard.exit_code or 1, ArmidentError)(guard.last_error()) from error


@contextmanager
def _command(words: Sequence[str], start: Start) -> Iterator[CommandProcess]:
    command = CommandProcess(words, start=start).start()
    try:
        yield command
    finally:
        command.stop(CAPTURE_ENDS_S)


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
