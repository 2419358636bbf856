"""Process that simulates the recordings of the suite: client of ``tests.evaluation.plants.json_server``."""

import json
import os
import signal
import sys
from functools import partial
from pathlib import Path
from typing import Any

from armident.configs import ArmidentError
from armident.processes import CommandProcess, ProcessEnded, ProcessTimeout, Start, resident_bytes, start_command

SERVER = "tests.evaluation.plants.json_server"
"""Module of the server; run by name, because plants and diagnosis share no code."""
MEMORY_LIMIT = 2 << 30
"""Resident memory above which a process is restarted before the next request, bytes."""
ONE_THREAD = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
"""Environment of a process that computes with one thread: each processor runs one case."""
STOP_S = 5.0
"""Time between SIGTERM and SIGKILL, s."""


class PlantProcess:
    """Simulates recordings in a child process, one at a time.

    The process is started at the first request. It is restarted after its end, after a request without an answer in
    time, and after an answer with which its memory exceeds ``memory_limit``: the allocator returns little of the
    memory of arrays of many sizes, so that a process grows over hundreds of requests.

    ``log``: file to which the process appends its standard error; ``memory_limit``: resident memory, bytes; ``module``:
    module of the server.
    """

    def __init__(self, log: Path, memory_limit: int = MEMORY_LIMIT, module: str = SERVER) -> None:
        self.log, self.memory_limit, self.module = log, memory_limit, module
        self._process: CommandProcess | None = None
        self._killed = False

    @property
    def pid(self) -> int | None:
        """Number of the running process, ``None`` without one."""
        return None if self._process is None else getattr(self._process.process, "pid", None)

    def request(self, request: dict[str, Any], timeout: float) -> dict[str, Any]:
        """Send a request and return the answer.

        ``request``: request as described in `tests.evaluation.plants.json_server`; ``timeout``: longest time to wait
        for the answer, s. Raises ArmidentError if the simulation fails, the process ends, or there is no answer in
        time.
        """
        if self._process is None or not self._process.running:
            self.close()
            # As multiprocessing does for its processes: the module may be found by the path of this process only.
            environment = ONE_THREAD | {"PYTHONPATH": os.pathsep.join(sys.path)}
            # A session of its own: Ctrl-C reaches the suite, which then stops the process.
            start: Start = partial(
                start_command, module=self.module, stdin=True, own_session=True, environment=environment
            )
            self._process = CommandProcess([], name="plant", log=self.log, start=start).start()
        process = self._process
        if self._killed:
            process.send_signal(signal.SIGKILL)
        try:
            process.send_line(json.dumps(request))
            line = process.wait_for_line("", timeout)
        except ProcessEnded:
            self.close()
            raise
        except ProcessTimeout as error:
            self.close()
            raise ArmidentError(f"plant: no answer within {timeout:.0f} s") from error
        if resident_bytes(self.pid or 0) > self.memory_limit:
            self.close()
        answer: dict[str, Any] = json.loads(line)
        if "error" in answer:
            raise ArmidentError(f"plant: {answer['error']}")
        return answer

    def kill(self) -> None:
        """End the process at once, from another thread; a request in progress and all later ones fail."""
        self._killed = True
        process = self._process
        if process is not None:
            process.send_signal(signal.SIGKILL)

    def close(self) -> None:
        """End the process."""
        process, self._process = self._process, None
        if process is not None:
            process.stop(STOP_S)
