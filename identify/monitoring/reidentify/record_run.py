"""Motion and recording of the arm of a session by two processes, guard and capture."""

import json
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import IO

from armident.configs import ArmidentError, ConfigError, DataError, MotionStopped
from armident.daq.recording import Recording, join_parts, read_recording
from armident.processes import CommandProcess, Process, ProcessEnded, Start, start_command

READY_S = 120.0
"""Time limit of the start of the guard, s: its loop may have to be compiled."""
CAPTURE_ENDS_S = 180.0
"""Time limit of the end of a capture after its signal, s: it waits for late drives."""
GUARD_ENDS_S = 10.0
"""Time limit of the end of the guard after its signal, s."""
POLL_S = 0.05
"""Polling period of both processes, s."""
_ERRORS: dict[int, type[ArmidentError]] = {2: ConfigError, 3: DataError}

Say = Callable[[str], None]
"""Function that receives a line of progress."""


def start_process(words: Sequence[str], out: IO[bytes], err: IO[bytes]) -> Process:
    """Start a command in a session of its own, away from the terminal; it stops the arm if this process is killed."""
    return start_command(words, out, err, own_session=True, with_parent=True)


class Interrupted(ArmidentError):
    """SIGINT or SIGTERM during the motion; the drives were stopped."""

    exit_code = 130


def record_run(config: Path, out: Path, say: Say, start: Start = start_process) -> Recording:
    """Play the set points of a session once under a guard and return the recording, which is always kept."""
    # The guard runs from before the first motion until after the last.
    with _interruptible(), running(["guard", "--config", str(config)], start) as guard:
        _until_ready(guard)
        say("guard: ready")
        options = ["capture", "--config", str(config), "--out", str(out), "--json"]
        with running(options, start) as capture:
            try:
                while capture.running and guard.running:
                    time.sleep(POLL_S)
            except BaseException:
                guard.send_signal(signal.SIGINT)
                raise
            if capture.running:
                capture.stop(CAPTURE_ENDS_S)
                raise MotionStopped(_kept(guard.last_error(), capture))
            guard.stop(GUARD_ENDS_S, signal.SIGUSR1)
            if guard.exit_code == 1:
                # The guard stopped the drives, and the capture ended for that reason.
                raise MotionStopped(_kept(guard.last_error(), capture))
            if capture.exit_code:
                raise _ERRORS.get(capture.exit_code, ArmidentError)(capture.last_error())
            say(capture.errors().strip().splitlines()[-1])
            return join_parts([read_recording(Path(path)) for path in _recordings(capture)])


def _recordings(capture: CommandProcess) -> list[str]:
    try:
        paths = json.loads(capture.output())["recordings"]
    except (ValueError, KeyError) as error:
        raise ArmidentError(f"capture: printed no recording: {capture.output()[:200]!r}") from error
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
def running(words: Sequence[str], start: Start = start_process) -> Iterator[CommandProcess]:
    """Run a command of ours inside the block, and end it in time to stop the arm and to finish its files."""
    command = CommandProcess(words, start=start).start()
    try:
        yield command
    finally:
        command.stop(CAPTURE_ENDS_S)


@contextmanager
def _interruptible() -> Iterator[None]:
    """Raise `Interrupted` on SIGINT and SIGTERM inside the block."""

    def interrupt(number: int, _frame: FrameType | None) -> None:
        raise Interrupted(f"interrupted ({signal.Signals(number).name}); the drives were stopped")

    before = {number: signal.signal(number, interrupt) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
