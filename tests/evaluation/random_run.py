"""Runs the suite of random arms: each worker has a process of plants and one of diagnoses."""

import datetime
import json
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, Literal

from armident.configs import ArmidentError
from armident.identify.documents.diagnosis import DiagnosisDocument
from tests.evaluation.diagnosis_process import DiagnosisProcess
from tests.evaluation.plant_process import PlantProcess
from tests.evaluation.random_score import RandomScore, Truth, score_case, truth_from
from tests.evaluation.random_tables import (
    RESULTS_HEADING,
    RandomTables,
    is_correct,
    markdown,
    random_tables,
    results_line,
)
from tests.evaluation.store import code_version
from tests.evaluation.tasks import TimedDiagnosis, ValidatedTask, diagnose_validated

Half = Literal["development", "reserve"]

SERVER = "tests.evaluation.plants.server"
"""Module of the plants; run by name, because plants and diagnosis share no code."""
SIMULATION_S = 300.0
"""Time limit of the simulation of a case, s; the first one includes the compilation of its loops."""
COMPILATION_S = 240.0
"""Time that the first diagnosis of a process may take longer, s: it compiles."""
BLOCK = 88
"""Cases of a block of the suite, in which every kind has its share."""
CASES: dict[Half, int] = {"development": BLOCK, "reserve": 2 * BLOCK}
"""Cases of a run where no number is given."""
SCHEMA = "armident/random-arms-result/1"
RESULTS, REPORT, LINE = "random_arms.json", "random_arms.md", "results_line.md"


@dataclass(frozen=True)
class RandomOptions:
    """Options of ``python -m tests.evaluation --arms random``.

    Parameters
    ----------
    half
        Half of the suite; of the reserve only totals are shown and kept.
    out
        Folder of results, report and logs.
    cases
        Number of cases, from the first; ``None`` for the number of the half.
    jobs
        Cases at a time.
    numbers
        Numbers of the cases, from 0; empty for the first ones.
    twins
        Diagnose the healthy twins too; without them no share of the gap is known.
    limit_s
        Time limit of a diagnosis, s; a case at the limit counts as failed.
    minutes
        Time after which no further case is started, min; ``None`` without limit.
    """

    half: Half
    out: Path
    cases: int | None = None
    jobs: int = 1
    numbers: tuple[int, ...] = ()
    twins: bool = True
    limit_s: float = 120.0
    minutes: float | None = None

    @property
    def selected(self) -> tuple[int, ...]:
        """Numbers of the cases to run."""
        count = self.cases if self.cases is not None else CASES[self.half]
        return self.numbers or tuple(range(count))


@dataclass(frozen=True)
class RandomRun:
    """Scores and tables of a run. ``scores``: scores by number of the case; ``tables``: totals and rows."""

    scores: tuple[RandomScore, ...]
    tables: RandomTables


OnScore = Callable[[RandomScore], None]


def run_cases(options: RandomOptions, on_score: OnScore = lambda score: None) -> RandomRun:
    """Simulate and diagnose the cases of a half. ``on_score``: called from a thread of a worker after each case."""
    queue: SimpleQueue[int] = SimpleQueue()
    for index in options.selected:
        queue.put(index)
    scores: dict[int, RandomScore] = {}
    until = None if options.minutes is None else time.monotonic() + 60.0 * options.minutes
    with tempfile.TemporaryDirectory(prefix="armident-random-arms-") as scratch:
        # Logs name cases: those of the reserve are not kept.
        logs = (Path(scratch) if options.half == "reserve" else options.out) / "logs"
        workers = [_Worker(options, logs, Path(scratch), k) for k in range(options.jobs)]

        def work(worker: "_Worker") -> None:
            try:
                while until is None or time.monotonic() < until:
                    index = queue.get_nowait()
                    scores[index] = worker.score(index)
                    on_score(scores[index])
            except Empty:
                return
            finally:
                worker.close()

        with ThreadPoolExecutor(options.jobs) as pool:
            try:
                for future in [pool.submit(work, worker) for worker in workers]:
                    future.result()
            except BaseException:
                for worker in workers:
                    worker.kill()
                raise
    ordered = tuple(scores[index] for index in sorted(scores))
    return RandomRun(ordered, random_tables(ordered))


class _Worker:
    """A plant process and a diagnosis process with a folder for the files of a case."""

    def __init__(self, options: RandomOptions, logs: Path, scratch: Path, number: int) -> None:
        self._options = options
        self._plant = PlantProcess(logs / f"plant.{number}.log", module=SERVER)
        self._diagnosis = DiagnosisProcess(logs / f"diagnosis.{number}.log")
        self._folder = scratch / f"case.{number}"
        self._folder.mkdir(parents=True)
        self._compiled = False

    def score(self, index: int) -> RandomScore:
        """Simulate, diagnose and score a case; a failure is a score too."""
        request = {
            "id": index,
            "half": self._options.half,
            "index": index,
            "twin": self._options.twins,
            "out": str(self._folder),
        }
        truth = Truth(f"case {index}", "healthy", "not simulated", (), (), 1.0)
        try:
            answer = self._plant.request(request, SIMULATION_S)
            truth = truth_from(answer["truth"])
            found = self._diagnose(answer["case"])
            twin: DiagnosisDocument | None = None
            if answer["twin"] is not None:
                twin = self._diagnose(answer["twin"]).document
            return score_case(truth, found.document, twin, found.seconds)
        except ArmidentError as error:
            return RandomScore(truth, error=str(error))

    def _diagnose(self, paths: dict[str, str]) -> TimedDiagnosis:
        limit = self._options.limit_s + (0.0 if self._compiled else COMPILATION_S)
        task = ValidatedTask(Path(paths["a"]), Path(paths["b"]), paths["robot"])
        found = self._diagnosis.run(diagnose_validated, task, limit)
        self._compiled = True
        return found

    def kill(self) -> None:
        """End both processes at once."""
        self._plant.kill()
        self._diagnosis.kill()

    def close(self) -> None:
        """End both processes."""
        self._plant.close()
        self._diagnosis.close()


def run_random_suite(options: RandomOptions, *, as_json: bool = False) -> RandomRun:
    """Run the suite, and print and write its results; of the reserve only totals and the table by effect.

    ``as_json``: print the results as JSON instead of Markdown.
    """
    count = len(options.selected)
    print(f"suite: {count} random arms, {options.half} half, {options.jobs} at a time", file=sys.stderr)
    found = run_cases(options, _Progress(count, options.half))
    date = datetime.datetime.now(datetime.UTC).date().isoformat()
    title = f"Random arms, {options.half} half, commit {commit()}, {date}"
    text = markdown(found.tables, title)
    line = results_line(found.tables, options.half, commit(), date)
    document = {"schema": SCHEMA, "half": options.half, "commit": commit(), "date": date, **asdict(found.tables)}
    if options.half == "development":
        document["cases_by_name"] = [_entry(score) for score in found.scores]
        text += _shortfalls(found.scores)
    options.out.mkdir(parents=True, exist_ok=True)
    for name, content in (
        (RESULTS, json.dumps(document, indent=1) + "\n"),
        (REPORT, text),
        (LINE, f"{RESULTS_HEADING}\n{line}\n"),
    ):
        (options.out / name).write_text(content, encoding="utf-8")
    if as_json:
        sys.stdout.write(json.dumps(document) + "\n")
    else:
        print(text)
        print(f"for docs/results.md:\n{line}\nresults: {options.out / RESULTS}\nreport:  {options.out / REPORT}")
    return found


def _entry(score: RandomScore) -> dict[str, Any]:
    right = is_correct(score) and not score.error
    return asdict(score) | {"claims": [str(claim) for claim in score.claims], "right": right}


def _shortfalls(scores: tuple[RandomScore, ...]) -> str:
    """Table of the cases of the development half with a wrong answer or a failure."""
    lines = ["", "| case | hidden | visibility | answer | closed % |", "| --- | --- | --- | --- | --- |"]
    for score in scores:
        truth = score.truth
        if truth.visible and (score.error or not is_correct(score) or score.worse):
            hidden = " ".join((truth.kind, *truth.joints))
            answer = score.error or "; ".join((score.verdict, *map(str, score.claims)))
            closed = "-" if score.closed is None else f"{100.0 * score.closed:.0f}"
            lines.append(
                f"| {truth.name} | {hidden} | {truth.visibility:.2f} | {answer} | {closed} |".replace("\n", " ")
            )
    return "\n".join(lines) + "\n"


class _Progress:
    """Prints a line per case of the development half, and a count every minute of the reserve."""

    def __init__(self, total: int, half: Half) -> None:
        self._total, self._half = total, half
        self._lock, self._begin, self._done, self._shown = threading.Lock(), time.monotonic(), 0, time.monotonic()

    def __call__(self, score: RandomScore) -> None:
        with self._lock:
            self._done += 1
            now = time.monotonic()
            head = f"suite: {self._done} of {self._total}, {now - self._begin:.0f} s"
            if self._half == "development":
                right = "failed: " + score.error if score.error else "right" if is_correct(score) else "wrong"
                print(f"{head}: {score.truth.name} {score.truth.kind}: {right}", file=sys.stderr, flush=True)
            elif now - self._shown > 60.0 or self._done == self._total:
                self._shown = now
                print(head, file=sys.stderr, flush=True)


def commit() -> str:
    """Short hash of the commit that the code is of, with ``+`` after changes; the version of the code without Git."""
    here = Path(__file__).resolve().parent

    def git(*arguments: str) -> str:
        return subprocess.run(
            ["git", *arguments], cwd=here, capture_output=True, text=True, check=True, timeout=20.0
        ).stdout.strip()

    try:
        return git("rev-parse", "--short", "HEAD") + ("+" if git("status", "--porcelain", "-uno") else "")
    except (OSError, subprocess.SubprocessError):
        return code_version()
