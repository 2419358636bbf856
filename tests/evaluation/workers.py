"""Runs cases: each worker has a process of plants and one of diagnoses, and runs one case at a time."""

import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, TypeVar

from armident.configs import ArmidentError
from tests.evaluation.cases import BASELINE_SEED, Case
from tests.evaluation.process import ByName, WorkerProcess
from tests.evaluation.store import CaseResult, Store
from tests.evaluation.tasks import DiagnosisTask, IdentificationTask, TimedDiagnosis, diagnose_file, identify_file

VIRTUAL_ROBOT = ByName("tests.evaluation.plants.two_robots:simulate")
RANDOM_ARM = ByName("tests.evaluation.plants.disk:simulate")
TIMEOUT_S = 900.0
"""Time limit of a simulation and of a diagnosis on the two robots, s; the first ones include the compilation."""
RANDOM_TIMEOUT_S = 120.0
"""Time limit of a diagnosis of a random arm, s; a case at the limit counts as failed."""
COMPILATION_S = 240.0
"""Time that the first diagnosis of a process may take longer, s: it compiles."""

OnResult = Callable[[Case, CaseResult], None]
"""Receives each case with its result or error."""
T = TypeVar("T")


class Stopped(Exception):
    """The run was stopped before a case had a result."""


class CaseRunner:
    """Runs cases with ``jobs`` workers and stores their results; logs and baselines are in folder ``out``.

    The error of a case is its result and does not end the run. A healthy twin that several cases need is run once.
    Without ``twins``, those of random arms are not simulated, and no share of a gap is known.
    """

    def __init__(self, store: Store, out: Path, jobs: int, *, twins: bool = True) -> None:
        self._store, self._out, self._jobs, self._twins = store, out, jobs, twins
        self._once: dict[str, Future[Any]] = {}
        self._workers: list[_Worker] = []
        self._lock = threading.Lock()
        self._stop = threading.Event()

    def run(self, cases: Sequence[Case], on_result: OnResult, until: float | None = None) -> None:
        """Run every case without a result, and the healthy twins that they need.

        Ctrl-C ends the running cases without a result; the next run repeats them. ``on_result`` is called from a thread
        of a worker after each case. No case is started after ``until``, by `time.monotonic`.
        """
        queue: SimpleQueue[Case] = SimpleQueue()
        for case in cases:
            queue.put(case)
        with ThreadPoolExecutor(self._jobs) as pool:
            try:
                threads = [pool.submit(self._work, k, queue, on_result, until) for k in range(self._jobs)]
                for thread in threads:
                    thread.result()
            except BaseException:
                self._stop.set()
                with self._lock:
                    workers = list(self._workers)
                for worker in workers:
                    worker.kill()
                raise

    def _work(self, number: int, queue: "SimpleQueue[Case]", on_result: OnResult, until: float | None) -> None:
        """Run cases of the queue until it is empty, time is up or the run is stopped."""
        with tempfile.TemporaryDirectory(prefix="armident-suite-") as scratch:
            worker = _Worker(self._out / "logs", number, Path(scratch), self._twins)
            with self._lock:
                self._workers.append(worker)
            try:
                while not self._stop.is_set() and (until is None or time.monotonic() < until):
                    case = queue.get_nowait()
                    if case.twin is not None:
                        self._case_result(case.twin, worker)
                    on_result(case, self._case_result(case, worker))
            except (Empty, Stopped):
                return
            finally:
                worker.close()

    def _first(self, key: str, make: Callable[[], T]) -> T:
        """Result of ``make`` for a key, made by the first worker that asks for it."""
        with self._lock:
            pending = self._once.get(key)
            if pending is None:
                future = self._once[key] = Future[T]()
        if pending is not None:
            return pending.result()  # type: ignore[no-any-return]
        try:
            result = make()
        except BaseException as error:
            future.set_exception(error)
            raise
        future.set_result(result)
        return result

    def _case_result(self, case: Case, worker: "_Worker") -> CaseResult:
        """Return the result of a case: from the store, from another worker, or by running it."""
        stored = self._store.get(case.key)
        return stored or self._first(case.key, lambda: self._store.add(self._run_case(case, worker)))

    def _run_case(self, case: Case, worker: "_Worker") -> CaseResult:
        result = CaseResult(key=case.key, case=case.name)
        try:
            baseline = self._baseline(case, worker) if case.baseline else None
            plant = worker.simulate(case)
            # What is hidden in a random arm is known although its diagnosis fails.
            result = result.model_copy(update={k: plant[k] for k in ("effects", "truth", "hidden") if k in plant})
            diagnosis, twin = worker.diagnose(case, plant, baseline)
        except ArmidentError as error:
            if self._stop.is_set():
                raise Stopped from error
            return result.model_copy(update={"error": str(error)})
        seconds = {"simulate": plant["seconds"], "diagnose": diagnosis.seconds}
        found = {"document": diagnosis.document, "twin": None if twin is None else twin.document, "seconds": seconds}
        return result.model_copy(update=found)

    def _baseline(self, case: Case, worker: "_Worker") -> Path:
        """Return the file of the identification of the healthy arm on the case's trajectory, with other noise."""
        healthy = replace(case, kind="clean", level=None, seed=BASELINE_SEED, parts=(), baseline=False, leave_out=None)
        path = self._out / "baselines" / f"{self._store.version}-{healthy.key}.json"

        def make() -> Path:
            if not path.exists():
                worker.simulate(healthy)
                worker.identify(healthy, path)
            return path

        return self._first(str(path), make)


@dataclass
class _Worker:
    """A process of plants and one of diagnoses that share a folder for recordings."""

    logs: Path
    number: int
    folder: Path
    twins: bool

    def __post_init__(self) -> None:
        self.plants = WorkerProcess("plant", self.logs / f"plant.{self.number}.log")
        self.diagnoses = WorkerProcess("diagnosis", self.logs / f"diagnosis.{self.number}.log")
        self.recording = self.folder / "recording.mcap"
        self._compiled = False

    def simulate(self, case: Case) -> dict[str, Any]:
        """Write the recordings of a case, and return the answer of the plants."""
        if case.random:
            request = {"half": case.robot, "index": case.seed, "twin": self.twins, "out": str(self.folder)}
            return self.plants.run(RANDOM_ARM, request, TIMEOUT_S)
        fields = ("trajectory", "repeats", "period", "seed")
        request = {"robot": case.config, "out": str(self.recording)} | {name: getattr(case, name) for name in fields}
        return self.plants.run(VIRTUAL_ROBOT, request | {"effects": [asdict(p) for p in case.parts]}, TIMEOUT_S)

    def diagnose(
        self, case: Case, plant: dict[str, Any], baseline: Path | None
    ) -> tuple[TimedDiagnosis, TimedDiagnosis | None]:
        """Diagnose the recordings of a case, and of the twin of a random arm; tasks do not know the hidden effects."""
        if not case.random:
            joints = tuple(joint for part in case.parts for joint in (part.joint, part.other) if joint)
            left_out = joints if case.leave_out else ()
            return self._run(DiagnosisTask(self.recording, case.config, case.leave_out, left_out, baseline)), None
        found, twin = (
            None
            if (paths := plant[arm]) is None
            else self._run(DiagnosisTask(Path(paths["a"]), paths["robot"], validation=Path(paths["b"])))
            for arm in ("case", "twin")
        )
        assert found is not None
        return found, twin

    def _run(self, task: DiagnosisTask) -> TimedDiagnosis:
        limit = TIMEOUT_S if task.validation is None else RANDOM_TIMEOUT_S
        found = self.diagnoses.run(diagnose_file, task, limit if self._compiled else limit + COMPILATION_S)
        self._compiled = True
        return found

    def identify(self, case: Case, out: Path) -> None:
        """Identify the recording and write the identification document."""
        self.diagnoses.run(identify_file, IdentificationTask(self.recording, case.config, out), TIMEOUT_S)

    def kill(self) -> None:
        """End both processes at once, from another thread."""
        self.plants.kill()
        self.diagnoses.kill()

    def close(self) -> None:
        """End both processes."""
        self.plants.close()
        self.diagnoses.close()
