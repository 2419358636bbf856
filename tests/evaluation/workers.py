"""Runs the cases of a suite: each worker has a plant process and a diagnosis process and runs one case at a time."""

import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from armident.configs import ArmidentError
from tests.evaluation.cases import BASELINE_SEED, Case, InjectedEffect, healthy_twin
from tests.evaluation.diagnosis_process import DiagnosisProcess
from tests.evaluation.plant_process import PlantProcess
from tests.evaluation.store import CaseResult, Store
from tests.evaluation.tasks import (
    DiagnosisTask,
    IdentificationTask,
    TimedDiagnosis,
    diagnose_file,
    identify_file,
)

TIMEOUT_S = 900.0
"""Time limit of a simulation or a diagnosis, s; the first one includes the compilation of its loops."""

OnResult = Callable[[Case, CaseResult], None]
"""Receives each case with its result or error."""


class Stopped(Exception):
    """The run was stopped before a case had a result."""


class CaseRunner:
    """Runs cases in parallel and stores their results.

    The error of a case is its result and does not end the run. A healthy twin that several cases need is run once.

    ``out``: folder of logs and baselines.
    """

    def __init__(self, store: Store, out: Path, jobs: int) -> None:
        self._store, self._out, self._jobs = store, out, jobs
        self._results: dict[str, Future[CaseResult]] = {}
        self._baselines: dict[Path, Future[None]] = {}
        self._workers: list[_Worker] = []
        self._lock = threading.Lock()
        self._stop = threading.Event()

    def run(self, cases: Sequence[Case], on_result: OnResult, until: float | None = None) -> None:
        """Run every case without a result, and the healthy twins that they need.

        Ctrl-C ends the running cases without a result; the next run repeats them.

        ``on_result``: called from a thread of a worker after each case; ``until``: `time.monotonic` after which no
        further case is started.
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
            logs = self._out / "logs"
            worker = _Worker(
                PlantProcess(logs / f"plant.{number}.log"),
                DiagnosisProcess(logs / f"diagnosis.{number}.log"),
                Path(scratch) / "recording.mcap",
            )
            with self._lock:
                self._workers.append(worker)
            try:
                while not self._stop.is_set() and (until is None or time.monotonic() < until):
                    case = queue.get_nowait()
                    if case.parts:
                        self._case_result(healthy_twin(case), worker)
                    on_result(case, self._case_result(case, worker))
            except (Empty, Stopped):
                return
            finally:
                worker.close()

    def _case_result(self, case: Case, worker: "_Worker") -> CaseResult:
        """Return the result of a case: from the store, from another worker, or by running it."""
        with self._lock:
            stored = self._store.get(case.key)
            if stored is not None:
                return stored
            pending = self._results.get(case.key)
            if pending is None:
                future = self._results[case.key] = Future[CaseResult]()
        if pending is not None:
            return pending.result()
        try:
            result = self._store.add(self._run_case(case, worker))
        except BaseException as error:
            future.set_exception(error)
            raise
        future.set_result(result)
        return result

    def _run_case(self, case: Case, worker: "_Worker") -> CaseResult:
        try:
            baseline = self._baseline(case, worker) if case.baseline else None
            simulated = worker.simulate(case)
            diagnosis = worker.diagnose(case, baseline)
        except ArmidentError as error:
            if self._stop.is_set():
                raise Stopped from error
            return CaseResult(key=case.key, case=case.name, error=str(error))
        finally:
            worker.recording.unlink(missing_ok=True)
        return CaseResult(
            key=case.key,
            case=case.name,
            effects=simulated["effects"],
            truth=simulated["truth"],
            document=diagnosis.document,
            seconds={"simulate": simulated["seconds"], "diagnose": diagnosis.seconds},
        )

    def _baseline(self, case: Case, worker: "_Worker") -> Path:
        """Return the file of the identification of the healthy arm on the case's trajectory, with other noise."""
        healthy = Case(
            "clean", None, case.robot, case.config, case.trajectory, case.repeats, case.period, BASELINE_SEED
        )
        path = self._out / "baselines" / f"{self._store.version}-{healthy.key}.json"
        with self._lock:
            pending = self._baselines.get(path)
            if pending is None:
                future = self._baselines[path] = Future[None]()
        if pending is not None:
            pending.result()
            return path
        try:
            if not path.exists():
                worker.simulate(healthy)
                worker.identify(healthy, path)
        except BaseException as error:
            future.set_exception(error)
            raise
        finally:
            worker.recording.unlink(missing_ok=True)
        future.set_result(None)
        return path


class _Worker:
    """A plant process and a diagnosis process that share one file for the recording."""

    def __init__(self, plant: PlantProcess, diagnosis: DiagnosisProcess, recording: Path) -> None:
        self.plant, self.diagnosis, self.recording = plant, diagnosis, recording

    def simulate(self, case: Case) -> dict[str, Any]:
        """Write the recording of a case."""
        request = {
            "id": case.key,
            "robot": case.config,
            "trajectory": case.trajectory,
            "repeats": case.repeats,
            "period": case.period,
            "seed": case.seed,
            "effects": [_effect(part) for part in case.parts],
            "out": str(self.recording),
        }
        return self.plant.request(request, TIMEOUT_S)

    def diagnose(self, case: Case, baseline: Path | None) -> TimedDiagnosis:
        """Diagnose the recording; the task contains nothing about the hidden effects.

        ``case``: case with robot and reduced model; ``baseline``: identification document of the healthy arm, or
        ``None``.
        """
        joints = [joint for part in case.parts for joint in (part.joint, part.other) if joint]
        task = DiagnosisTask(
            self.recording, case.config, case.leave_out, tuple(joints) if case.leave_out else (), baseline
        )
        return self.diagnosis.run(diagnose_file, task, TIMEOUT_S)

    def identify(self, case: Case, out: Path) -> None:
        """Identify the recording and write the identification document. ``case``: case with the robot."""
        self.diagnosis.run(identify_file, IdentificationTask(self.recording, case.config, out), TIMEOUT_S)

    def kill(self) -> None:
        """End both processes at once, from another thread."""
        self.plant.kill()
        self.diagnosis.kill()

    def close(self) -> None:
        """End both processes."""
        self.plant.close()
        self.diagnosis.close()


def _effect(part: InjectedEffect) -> dict[str, Any]:
    return {
        "effect": part.effect,
        "joint": part.joint,
        "other": part.other,
        "parameters": part.parameters,
        "truth": part.truth,
        "strength": part.strength,
        "hide": part.hide,
    }
