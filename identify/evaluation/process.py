"""Another room at work for the suite: a process that answers requests as JSON lines."""

import contextlib
import json
import os
import select
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from armident.configs import ArmidentError

Document = dict[str, Any]

STOP_S = 5.0
TAIL_LINES = 4
LARGEST = 2 << 30
"""Bytes of memory of a process that goes on to the next request."""


class Room:
    """A process of one room; started when it is first asked, and again after it died.

    The allocator gives back little of what arrays of many sizes took: over hundreds of requests a process grows to
    several times what one request needs. One that has grown too large is ended after its answer.

    Parameters
    ----------
    module
        Run as ``python -m module``.
    log
        File that gets what the process prints on stderr.
    largest
        Memory of the process [bytes] above which it is not asked again, but started afresh.
    """

    def __init__(self, module: str, log: Path, largest: int = LARGEST) -> None:
        self.module, self.log, self.largest = module, log, largest
        self._process: subprocess.Popen[bytes] | None = None
        self._pending = b""

    def ask(self, request: Document, seconds: float) -> Document:
        """Send one request and wait for its answer.

        Raises
        ------
        ArmidentError
            If the request failed, the process died, or there is no answer within ``seconds``; the process then is
            started afresh for the next request.
        """
        process = self._running()
        assert process.stdin is not None
        try:
            process.stdin.write(json.dumps(request).encode() + b"\n")
            process.stdin.flush()
            line = self._line(process, seconds)
        except (BrokenPipeError, EOFError) as error:
            code = process.wait(STOP_S)
            self.close()
            raise ArmidentError(f"{self.module} died (exit code {code}): {self._tail()}") from error
        except TimeoutError as error:
            self.close()
            raise ArmidentError(f"{self.module}: no answer within {seconds:.0f} s") from error
        if _resident(process.pid) > self.largest:
            self.close()
        answer: Document = json.loads(line)
        if "error" in answer:
            raise ArmidentError(f"{self.module}: {answer['error']}")
        return answer

    def close(self) -> None:
        """End the process."""
        process, self._process, self._pending = self._process, None, b""
        if process is None:
            return
        if process.stdin is not None:
            # It may have died with a request unread.
            with contextlib.suppress(BrokenPipeError):
                process.stdin.close()
        if process.poll() is None:
            process.terminate()
            try:
                process.wait(STOP_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        if process.stdout is not None:
            process.stdout.close()

    def _running(self) -> "subprocess.Popen[bytes]":
        if self._process is None or self._process.poll() is not None:
            self.close()
            self.log.parent.mkdir(parents=True, exist_ok=True)
            # Every lane has a core of its own: threads within a process would only fight over it.
            environment = {**os.environ, "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
            with self.log.open("ab") as log:
                self._process = subprocess.Popen(
                    [sys.executable, "-m", self.module],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=log,
                    env=environment,
                    bufsize=0,
                )
        return self._process

    def _line(self, process: "subprocess.Popen[bytes]", seconds: float) -> bytes:
        assert process.stdout is not None
        until = time.monotonic() + seconds
        while b"\n" not in self._pending:
            left = until - time.monotonic()
            if left <= 0 or not select.select([process.stdout], [], [], left)[0]:
                raise TimeoutError
            chunk = os.read(process.stdout.fileno(), 1 << 16)
            if not chunk:
                raise EOFError
            self._pending += chunk
        line, _, self._pending = self._pending.partition(b"\n")
        return line

    def _tail(self) -> str:
        lines = [line.strip() for line in self.log.read_text(errors="replace").splitlines() if line.strip()]
        return " | ".join(lines[-TAIL_LINES:]) or "it printed nothing"


def _resident(pid: int) -> int:
    """Memory of a process [bytes]; 0 if it has ended."""
    try:
        pages = Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1]
    except (FileNotFoundError, ProcessLookupError):
        return 0
    return int(pages) * os.sysconf("SC_PAGE_SIZE")
