"""Runs the cases: every lane has a plant and a diagnosis of its own, and takes one case after the other."""

import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from armident.configs import ArmidentError
from armident.identify.evaluation.cases import BASELINE_SEED, Case, InjectedEffect, healthy_twin
from armident.identify.evaluation.process import Room
from armident.identify.evaluation.store import Record, Store

PLANT, DIAGNOSIS = "armident.virtual_robot.batch", "armident.identify.diagnosis.batch"
PATIENCE_S = 900.0
"""For one answer; the first one of a machine waits for the compiler."""

Done = Callable[[Case, Record], None]


class Lanes:
    """As many lanes as jobs; results go into the store.

    Parameters
    ----------
    store
        Results so far.
    out
        Folder of logs and baselines.
    jobs
        Number of lanes.
    """

    def __init__(self, store: Store, out: Path, jobs: int) -> None:
        self._store, self._out, self._jobs = store, out, jobs
        self._shared: dict[str, Future[Record]] = {}
        self._lock = threading.Lock()

    def run(self, cases: Sequence[Case], done: Done, until: float | None = None) -> None:
        """Carry out every case that has no result yet, and the healthy twins they need.

        Parameters
        ----------
        done
            Called, from a lane's thread, with every case that now has a result or has failed.
        until
            `time.monotonic` after which no further case is begun.
        """
        queue: SimpleQueue[Case] = SimpleQueue()
        for case in cases:
            queue.put(case)
        stop = threading.Event()
        with ThreadPoolExecutor(self._jobs) as pool:
            lanes = [pool.submit(self._lane, k, queue, done, stop, until) for k in range(self._jobs)]
            try:
                for lane in lanes:
                    lane.result()
            finally:
                stop.set()

    def _lane(
        self, number: int, queue: SimpleQueue[Case], done: Done, stop: threading.Event, until: float | None
    ) -> None:
        rooms = [Room(module, self._out / "logs" / f"{module}.{number}.log") for module in (PLANT, DIAGNOSIS)]
        with tempfile.TemporaryDirectory(prefix="armident-suite-") as scratch:
            bench = _Bench(rooms[0], rooms[1], Path(scratch) / "recording.mcap")
            try:
                while not stop.is_set() and (until is None or time.monotonic() < until):
                    try:
                        case = queue.get_nowait()
                    except Empty:
                        return
                    if case.parts:
                        self._carry_out(healthy_twin(case), bench)
                    done(case, self._carry_out(case, bench))
            finally:
                for room in rooms:
                    room.close()

    def _carry_out(self, case: Case, bench: "_Bench") -> Record:
        """The result of a case: stored, awaited from another lane, or made here."""
        key = case.key
        with self._lock:
            stored = self._store.get(key)
            if stored is not None:
                return stored
            pending = self._shared.get(key)
            mine: Future[Record] | None = None
            if pending is None:
                mine = self._shared[key] = Future()
        if pending is not None:
            return pending.result()
        assert mine is not None
        record: Record
        try:
            record = {"key": key, "case": case.name, **self._result(case, bench)}
        except ArmidentError as error:
            record = {"key": key, "case": case.name, "error": str(error)}
        except BaseException as error:
            mine.set_exception(error)
            raise
        self._store.add(record)
        mine.set_result(record)
        return record

    def _result(self, case: Case, bench: "_Bench") -> Record:
        baseline = self._baseline(case, bench) if case.baseline else None
        made = bench.record(case)
        try:
            answer = bench.diagnose(case, baseline)
        finally:
            bench.recording.unlink(missing_ok=True)
        document = answer["document"]
        for unimportant in ("recordings", "versions", "model"):
            document.pop(unimportant, None)
        return {
            "effects": made["effects"],
            "truth": made["truth"],
            "document": document,
            "seconds": {"simulate": made["seconds"], "diagnose": answer["seconds"]},
        }

    def _baseline(self, case: Case, bench: "_Bench") -> Path:
        """Identification of the healthy arm on the case's trajectory, with other noise."""
        healthy = Case(
            "clean", None, case.robot, case.config, case.trajectory, case.repeats, case.period, BASELINE_SEED
        )
        path = self._out / "baselines" / f"{self._store.version}-{healthy.key}.json"
        with self._lock:
            pending = self._shared.get(str(path))
            mine: Future[Record] | None = None
            if pending is None:
                mine = self._shared[str(path)] = Future()
        if mine is None:
            assert pending is not None
            pending.result()
        else:
            try:
                if not path.exists():
                    bench.record(healthy)
                    bench.identify(healthy, path)
                mine.set_result({})
            except BaseException as error:
                mine.set_exception(error)
                raise
            finally:
                bench.recording.unlink(missing_ok=True)
        return path


class _Bench:
    """A plant and a diagnosis that hand each other one recording."""

    def __init__(self, plant: Room, diagnosis: Room, recording: Path) -> None:
        self._plant, self._diagnosis, self.recording = plant, diagnosis, recording

    def record(self, case: Case) -> Record:
        """Simulate a case."""
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
        return self._plant.ask(request, PATIENCE_S)

    def diagnose(self, case: Case, baseline: Path | None) -> Record:
        """Diagnose what was recorded; nothing of what is hidden goes over."""
        request: dict[str, Any] = {
            "id": case.key,
            "do": "diagnose",
            "recording": str(self.recording),
            "robot": case.config,
            "baseline": None if baseline is None else str(baseline),
        }
        if case.leave_out is not None:
            joints = [j for part in case.parts for j in (part.joint, part.other) if j]
            request |= {"leave_out": case.leave_out, "joints": joints}
        return self._diagnosis.ask(request, PATIENCE_S)

    def identify(self, case: Case, out: Path) -> None:
        """Identify what was recorded."""
        request = {
            "id": case.key, "do": "identify", "recording": str(self.recording), "robot": case.config, "out": str(out),
        }  # fmt: skip
        self._diagnosis.ask(request, PATIENCE_S)


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
