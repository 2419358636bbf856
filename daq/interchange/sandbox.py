"""Protection against damaged files of other tools: readers in a subprocess, and their errors in one line."""

import faulthandler
import json
import os
import signal
import tempfile
import time
from collections.abc import Callable, Mapping
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

LONGEST_S = 120.0
"""Time limit of a reader in a subprocess, s."""
_REFUSED = 3


def error_line(error: Exception) -> str:
    """Return the text of a reader's error in one line of limited length; the name of the error if it has no text."""
    text = " ".join("".join(c if c.isprintable() else " " for c in str(error)).split())
    return text[:200] if text else type(error).__name__


def read_in_subprocess(read: Callable[[], Mapping[str, Any]], longest_s: float = LONGEST_S) -> dict[str, NDArray[Any]]:
    """Return the arrays of a reader in a subprocess; ValueError if it fails, crashes or exceeds ``longest_s``."""
    with tempfile.TemporaryFile() as file:
        process = os.fork()
        if process == 0:
            os._exit(_read_into(file, read))
        status = _wait(process, longest_s)
        file.seek(0)
        if status == _REFUSED:
            raise ValueError(file.read().decode(errors="replace"))
        if status != 0:
            raise ValueError(f"its reader ended with {'no result' if status > 0 else signal.Signals(-status).name}")
        names = json.loads(file.readline())
        return {name: np.load(file, allow_pickle=False) for name in names}


def _read_into(file: IO[bytes], read: Callable[[], Mapping[str, Any]]) -> int:
    """Write the arrays of a reader, or its error, to a file; return the exit status of the subprocess."""
    # The parent process reports crashes.
    faulthandler.disable()
    try:
        try:
            found = {
                name: value
                for name, value in read().items()
                if isinstance(value, np.ndarray) and value.dtype.kind in "iuf" and value.size
            }
            file.write(json.dumps(list(found)).encode() + b"\n")
            for value in found.values():
                np.save(file, value, allow_pickle=False)
            file.flush()
            return 0
        except Exception as error:  # readers raise various errors
            file.seek(0)
            file.truncate()
            file.write(error_line(error).encode(errors="replace"))
            file.flush()
            return _REFUSED
    except BaseException:  # the subprocess must not continue
        return 1


def _wait(process: int, longest_s: float) -> int:
    """Return the exit status of a process, negative for a signal; it is killed after the time limit."""
    until = time.monotonic() + longest_s
    pause = 1e-4
    while True:
        done, status = os.waitpid(process, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() > until:
            os.kill(process, signal.SIGKILL)
            until = float("inf")
        time.sleep(pause)
        pause = min(2 * pause, 0.05)
