"""Process of plants or of diagnoses: a process pool of one worker with limits of time and memory."""

import multiprocessing
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Generic, TypeVar, cast

from armident.configs import ArmidentError

TASKS_PER_PROCESS = 200
"""Number of tasks after which a worker process is replaced at any memory size."""
MEMORY_LIMIT = 2 << 30
"""Resident memory above which a process is replaced, bytes: the allocator returns little of arrays of many sizes."""
ONE_THREAD = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
"""Environment of a process that computes with one thread: each processor runs one case."""

T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True)
class ByName:
    """Function ``module:function`` whose module only the worker process imports: plants and diagnosis share no code."""

    name: str

    def __call__(self, task: Any) -> Any:
        module, _, function = self.name.partition(":")
        return getattr(import_module(module), function)(task)


@dataclass(frozen=True)
class _Outcome(Generic[R]):
    """Result or error of a task, and the memory of the process after it, bytes."""

    result: R | None
    error: str | None
    memory: int


class WorkerProcess:
    """Runs tasks in a process pool of one worker, one at a time; errors begin with the process's name.

    The worker is started at the first task, and appends its output to ``log``. It is replaced after its end, after a
    task without a result in time, after `TASKS_PER_PROCESS` tasks, and where its memory exceeds ``memory_limit``,
    bytes. A pool of one worker confines the end of the worker to one case: a shared pool loses all running tasks.
    """

    def __init__(self, name: str, log: Path, memory_limit: int = MEMORY_LIMIT) -> None:
        self.name, self.log, self.memory_limit = name, log, memory_limit
        self._pool: ProcessPoolExecutor | None = None
        self._killed = False

    @property
    def pid(self) -> int | None:
        """Number of the worker process, ``None`` without one."""
        processes = self._processes()
        return processes[0].pid if processes else None

    def run(self, function: Callable[[T], R], task: T, timeout: float) -> R:
        """Run ``function(task)`` in the worker and return the result; wait ``timeout`` s at most.

        Raises ArmidentError if the function raises, the worker ends, or there is no result in time.
        """
        if self._pool is None:
            self.log.parent.mkdir(parents=True, exist_ok=True)
            # spawn: a forked child would inherit the locks of the other threads.
            self._pool = ProcessPoolExecutor(
                1, multiprocessing.get_context("spawn"), _initialize, (self.log,), max_tasks_per_child=TASKS_PER_PROCESS
            )
        try:
            future: Future[_Outcome[R]] = self._pool.submit(_run, function, task)
            if self._killed:
                self._kill_worker()
            outcome = future.result(timeout)
        except TimeoutError as error:
            self._kill_worker()
            self.close()
            raise ArmidentError(f"{self.name}: no result within {timeout:.0f} s") from error
        except BrokenProcessPool as error:
            self.close()
            raise ArmidentError(f"{self.name}: the worker process ended; see {self.log}") from error
        if outcome.memory > self.memory_limit:
            self.close()
        if outcome.error is not None:
            raise ArmidentError(f"{self.name}: {outcome.error}")
        # Without an error there is a result, which is None for some functions.
        return cast(R, outcome.result)

    def kill(self) -> None:
        """End the worker at once, from another thread; a task in progress and all later ones fail."""
        self._killed = True
        self._kill_worker()

    def close(self) -> None:
        """End the worker after its task."""
        pool, self._pool = self._pool, None
        if pool is not None:
            pool.shutdown()

    def _kill_worker(self) -> None:
        for process in self._processes():
            process.kill()

    def _processes(self) -> list[multiprocessing.process.BaseProcess]:
        # The processes of a pool have no public name; Python 3.14 has kill_workers.
        pool = self._pool
        processes = None if pool is None else pool._processes
        return list(processes.values()) if processes else []


def _initialize(log: Path) -> None:
    """Prepare a worker: one thread, output to the log, no reaction to Ctrl-C, end with the parent."""
    os.environ.update(ONE_THREAD)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with log.open("ab") as file:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
            os.dup2(file.fileno(), stream.fileno())
    threading.Thread(target=_end_with_parent, name="end-with-parent", daemon=True).start()


def _end_with_parent() -> None:
    """End this process when its parent ends: the queue of the pool does not report the end of a killed parent."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _run(function: Callable[[T], R], task: T) -> _Outcome[R]:
    """Run a task in the worker."""
    result, message = None, None
    try:
        result = function(task)
    except Exception as error:
        if not isinstance(error, ArmidentError):
            traceback.print_exc()
        message = f"{type(error).__name__}: {' '.join(str(error).split())}"
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return _Outcome(result, message, pages * os.sysconf("SC_PAGE_SIZE"))
