"""Right names after each motion of an investigation of random arms: ``python -m tests.evaluation.asking --help``.

The first recording of a case is given; up to four motions are asked for. ``best`` is the choice of `investigate`,
``excitation`` another exciting trajectory each time, ``random`` a random motion of a random joint: same diagnosis.
"""

import argparse
import json
import multiprocessing
import resource
import shutil
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import closing
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from armident.configs import ArmidentError, DataError, Trajectory
from armident.daq.api import import_recording
from armident.daq.recording import Recording
from armident.identify.diagnosis.criteria import Criteria
from armident.identify.diagnosis.diagnose import DiagnosisResult
from armident.identify.diagnosis.model_state import ModelState
from armident.identify.diagnosis.probabilities import NOTHING
from armident.identify.documents.diagnosis import Explanation
from armident.identify.documents.investigation import MotionChoice
from armident.identify.effects.unnamed import NAME as UNNAMED
from armident.identify.excitation.collision import CollisionModel
from armident.identify.investigation import choice as choices
from armident.identify.investigation.choice import Chosen
from armident.identify.investigation.folder import Progress
from armident.identify.investigation.investigate import Investigating, started
from armident.identify.investigation.motions import FAMILIES
from tests.evaluation.process import ONE_THREAD, ByName, WorkerProcess
from tests.tools.markdown import table

MOTIONS = 4
"""Most motions of a case."""
MINUTES = 6.0
"""Longest motion of a case, min."""
SECONDS = (30.0, 60.0, 120.0)
"""Times of motion after which the share of right names is counted, s."""
RESULTS = "asking.jsonl"
PROGRAM = "tests.evaluation.plants.answer"
"""Module of the arm, whose process shares no code with the diagnosis."""
RIGHT = 0.5
"""Least probability of a name that counts."""
NO_NAME = (UNNAMED, NOTHING)
BINS = (0.0, 0.2, 0.5, 0.8, 0.95, 1.01)
"""Limits of the final probabilities of a table."""
LIMIT_S, LIMIT_BYTES = 600, 6 << 30
"""Limits of a case and way: time of the processor, s, and memory of the process."""


@dataclass
class Asking(Investigating):
    """Asks by the choice of `investigate`; ``first`` (one or none): the diagnosis of the first recording."""

    first: list[DiagnosisResult] = field(default_factory=list)

    def _diagnosed(self, report: Progress) -> DiagnosisResult:
        if len(self.recordings) > 1:
            return super()._diagnosed(report)
        if not self.first:
            self.first.append(super()._diagnosed(report))
        return self.first[0]


class Excited(Asking):
    """Asks for exciting trajectories (D-optimal) within the same limits, each with another seed."""

    def choose(self, state: ModelState, explanations: Sequence[Explanation], done: Sequence[MotionChoice]) -> Chosen:
        """Return another exciting trajectory."""
        reach = choices.reach_of_recordings(state)
        motion, made = choices.excitation_of(state.robot, reach, state.fit.theta, self.collision, seed=len(done))
        return Chosen("", (motion,), None if made is None else motion, made)


class Drawn(Asking):
    """Asks for random motions of random joints."""

    def choose(self, state: ModelState, explanations: Sequence[Explanation], done: Sequence[MotionChoice]) -> Chosen:
        """Return a random motion within the limits."""
        rng = np.random.default_rng([len(done), int(self.recordings[0].sha256[:8], 16)])
        reach = choices.reach_of_recordings(state)
        while True:
            family, joint = FAMILIES[rng.integers(len(FAMILIES))], int(rng.integers(state.robot.n))
            other = (joint + 1) % state.robot.n
            trajectory = family.trajectory(reach, joint, float(rng.choice(family.sizes)), other)
            if choices.excluded(state.robot, trajectory, state.fit.theta, self.collision) is None:
                motion = MotionChoice(motion=family.name, words=family.name, duration_s=trajectory.duration)
                return Chosen("", (motion,), motion, trajectory)


WAYS: dict[str, type[Asking]] = {"best": Asking, "excitation": Excited, "random": Drawn}


def investigated(half: str, index: int, ways: Sequence[str], out: Path) -> Iterator[dict[str, Any]]:
    """Yield what is said after each motion of a case, with the truth, for every way to ask."""
    resource.setrlimit(resource.RLIMIT_AS, (LIMIT_BYTES, LIMIT_BYTES))
    name = f"{half}_{index:04d}"
    folder = out / name
    shutil.rmtree(folder, ignore_errors=True)
    with closing(WorkerProcess(name, out / "plants.log")) as arm:
        arm.run(ByName(f"{PROGRAM}:first_answer"), (half, index, folder), LIMIT_S)
        truth = json.loads((folder / f"{name}.truth.json").read_text(encoding="utf-8"))
        first = import_recording(folder / f"{name}_a.npz", folder / f"{name}.yaml")
        signal.signal(signal.SIGPROF, _too_long)
        known: list[DiagnosisResult] = []
        for way in ways:
            signal.setitimer(signal.ITIMER_PROF, LIMIT_S)
            begin = time.process_time()
            kept = folder / way
            going = started(first.robot, [first], MOTIONS, MINUTES, Criteria(), CollisionModel(first.robot, []), kept)
            parts = going.robot, going.recordings, going.document, kept, going.criteria, going.collision
            going = WAYS[way](*parts, first=known)
            going.run(_ask(arm, (half, index), first, kept))
            signal.setitimer(signal.ITIMER_PROF, 0.0)
            document = going.document
            _keep(kept, len(document.rounds))
            said = [[entry.names for entry in one.explanations] for one in document.rounds]
            yield {
                "case": name, "way": way, "family": truth["family"], "kind": truth["kind"],
                "accepted": truth["accepted"], "visibility": truth["visibility"], "outcome": document.outcome,
                "said": [*said, [entry.names for entry in document.explanations]],
                "seconds": [0.0, *np.cumsum([one.chosen.duration_s for one in document.rounds])],
                "motions": [one.chosen.motion for one in document.rounds],
                "refused": sum(one.refused is not None for one in document.rounds),
                "cpu_s": time.process_time() - begin,
            }  # fmt: skip


def _ask(
    arm: WorkerProcess, case: tuple[str, int], first: Recording, folder: Path
) -> Callable[[Trajectory], Recording]:
    def ask(trajectory: Trajectory) -> Recording:
        period, number = 1.0 / first.sample_rate_hz, 1 + len(list(folder.glob("reference_*.csv")))
        _keep(folder, number - 1)
        q = trajectory.sample(period)
        reference, answer = folder / f"reference_{number}.csv", folder / f"answer_{number}.npz"
        np.savetxt(reference, np.column_stack([period * np.arange(len(q)), q]), delimiter=",", header="t", comments="")
        try:
            arm.run(ByName(f"{PROGRAM}:answer"), (*case, reference, answer), LIMIT_S)
        except ArmidentError as error:
            raise DataError(str(error)) from error
        return import_recording(answer, first.robot)

    return ask


def _keep(folder: Path, motions: int) -> None:
    """Keep the diagnosis after a number of motions: `calibrate` reads it."""
    if (folder / "diagnosis.json").exists():
        shutil.copy(folder / "diagnosis.json", folder / f"diagnosis_{motions}.json")


def _too_long(_number: int, _frame: FrameType | None) -> None:
    raise TimeoutError(f"no outcome in {LIMIT_S} s of the processor")


def right(case: dict[str, Any], said: Sequence[dict[str, float]]) -> bool:
    """Return True if the most probable name of all joints is right, or rightly none is probable."""
    probability, name = best(said)
    if not case["accepted"]:
        return probability < RIGHT
    return probability >= RIGHT and name in case["accepted"]


def best(said: Sequence[dict[str, float]]) -> tuple[float, str]:
    """Return the most probable name of all joints with its probability; (0, "") if there is none."""
    return max(((p, name) for names in said for name, p in names.items() if name not in NO_NAME), default=(0.0, ""))


def right_after(cases: Sequence[dict[str, Any]]) -> list[str]:
    """Return how many answers of cases are right after each motion; the last answer stays."""
    return [str(sum(right(c, c["said"][min(k, len(c["said"]) - 1)]) for c in cases)) for k in range(MOTIONS + 1)]


def by_family(cases: Sequence[dict[str, Any]]) -> str:
    """Return the right answers by way and family, after each motion and after seconds of motion.

    ``open``: cases that the first recording does not decide; the figures of effects are those of open cases, too.
    """
    rows = []
    for way, family in sorted({(case["way"], case["family"]) for case in cases}):
        every = [case for case in cases if (case["way"], case["family"]) == (way, family)]
        for name, own in ((family, every), (f"{family}, open", [case for case in every if case["motions"]])):
            timed = []
            for limit in SECONDS:
                last = [int(np.flatnonzero(np.array(c["seconds"]) <= limit)[-1]) for c in own]
                timed.append(str(sum(right(c, c["said"][k]) for c, k in zip(own, last, strict=True))))
            rows.append((way, name, str(len(own)), *right_after(own), *timed))
    after, seconds = (f"after {k}" for k in range(MOTIONS + 1)), (f"{s:g} s" for s in SECONDS)
    return table(("way", "family", "cases", *after, *seconds), rows)


def by_kind(cases: Sequence[dict[str, Any]]) -> str:
    """Return the right answers of each kind, the motions that were asked for, and the last answers that are wrong."""
    rows = []
    for way, kind in sorted({(case["way"], case["kind"]) for case in cases}):
        own = [case for case in cases if (case["way"], case["kind"]) == (way, kind)]
        asked = Counter(motion for case in own for motion in case["motions"])
        wrong = [
            f"{best(c['said'][-1])[1] or 'none'} {best(c['said'][-1])[0]:.2f}"
            for c in own
            if not right(c, c["said"][-1])
        ]
        told = ", ".join(f"{motion} {count}" for motion, count in asked.most_common())
        rows.append((way, kind, str(len(own)), *right_after(own), told, ", ".join(wrong)))
    return table(("way", "kind", "cases", *(f"after {k}" for k in range(MOTIONS + 1)), "motions", "wrong"), rows)


def calibration_of(cases: Sequence[dict[str, Any]]) -> str:
    """Return the share of right names by the final probability of the most probable one."""
    said = np.array([best(case["said"][-1])[0] for case in cases])
    hit = np.array([best(case["said"][-1])[1] in case["accepted"] for case in cases])
    rows = []
    for low, high in pairwise(BINS):
        own = (said >= low) & (said < high)
        if own.any():
            rows.append(
                (
                    f"{low:.2f} to {min(high, 1.0):.2f}",
                    str(own.sum()),
                    f"{said[own].mean():.2f}",
                    f"{hit[own].mean():.2f}",
                )
            )
    return table(("final probability", "cases", "mean", "right"), rows)


def _entered(half: str, index: int, ways: Sequence[str], out: Path) -> None:
    """Investigate a case and append each result to the file."""
    for one in investigated(half, index, ways, out):
        with (out / RESULTS).open("a", encoding="utf-8") as file:
            file.write(json.dumps(one) + "\n")


def main() -> None:
    """Investigate random arms and print how many names are right after each motion."""
    parser = argparse.ArgumentParser(prog="python -m tests.evaluation.asking", description=main.__doc__)
    parser.add_argument("--half", default="development")
    parser.add_argument("--cases", type=int, nargs="+", required=True, help="numbers of the cases, from 0")
    parser.add_argument("--ways", nargs="+", choices=list(WAYS), default=["best"])
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path, required=True, help="folder of recordings and results; goes on in it")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    results = options.out / RESULTS
    done = [json.loads(line) for line in results.read_text().splitlines()] if results.exists() else []
    known = {(case["case"], case["way"]) for case in done}
    todo = {k: [w for w in options.ways if (f"{options.half}_{k:04d}", w) not in known] for k in options.cases}
    context = multiprocessing.get_context("spawn")
    # A process for each case: memory that a diagnosis has freed counts towards the limit of the next one.
    with ProcessPoolExecutor(options.jobs, context, max_tasks_per_child=1) as pool:
        futures = {pool.submit(_entered, options.half, k, ways, options.out): k for k, ways in todo.items() if ways}
        for number, future in enumerate(as_completed(futures), 1):
            error = future.exception()
            print(f"{number} of {len(futures)}: {futures[future]} {error or ''}", file=sys.stderr, flush=True)
    done = [json.loads(line) for line in results.read_text().splitlines()]
    for way in options.ways:
        own = [case for case in done if case["way"] == way]
        print("\n\n".join(made(own) for made in (by_family, by_kind, calibration_of)) + "\n")


if __name__ == "__main__":
    import os

    os.environ.update(ONE_THREAD)
    main()
