"""Selects the cases of a suite, runs them, and writes results and tables."""

import datetime
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from armident.configs import ArmidentError, ConfigError
from tests.evaluation.cases import Case, Half, all_cases, random_cases, revealed, select_cases
from tests.evaluation.report import Progress, report, results_row
from tests.evaluation.schema import SUITE, load_suite
from tests.evaluation.score import score
from tests.evaluation.store import Store, code_version
from tests.evaluation.tables import Scored, Tables, is_right, tables
from tests.evaluation.workers import CaseRunner

RESULTS, SUMMARY, REPORT = "results.jsonl", "suite.json", "suite.md"
SCHEMA = "armident/suite-result/2"
SHOWN_FAILURES = 3
"""Number of failed cases in the error message."""


@dataclass(frozen=True)
class SuiteOptions:
    """Options of ``python -m tests.evaluation``, see `tests.evaluation.command.suite`; ``None`` for the default."""

    out: Path
    arms: Literal["two-robots", "random"] = "two-robots"
    suite: Path = SUITE
    half: Half = "development"
    cases: int | None = None
    quick: bool = False
    only: tuple[str, ...] = ()
    levels: tuple[str, ...] = ()
    jobs: int | None = None
    minutes: float | None = None
    any_version: bool = False

    @property
    def reserve(self) -> bool:
        """``True`` for the half of which only totals are shown and kept."""
        return self.arms == "random" and self.half == "reserve"

    def selected(self) -> list[Case]:
        """Selected cases; a ConfigError if there are none, or the suite file is not valid."""
        if self.arms == "random":
            return random_cases(self.half, self.cases)
        every = all_cases(load_suite(self.suite))
        chosen = select_cases(every, quick=self.quick, only=self.only, levels=self.levels)[: self.cases]
        if not chosen:
            raise ConfigError("the suite has no case with this effect, strength and subset; see --list")
        return chosen


def run_suite(options: SuiteOptions, *, as_json: bool = False) -> Tables:
    """Run the selected cases without a result, and print, write and return the tables of all selected cases.

    ``as_json`` prints the summary as JSON instead of the report. If cases failed, an ArmidentError follows the tables,
    but for random arms, of which failures count as wrong.
    """
    cases = options.selected()
    jobs = options.jobs or len(os.sched_getaffinity(0))
    options.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="armident-reserve-") as scratch:
        # Results and logs name cases: those of the reserve are not kept.
        kept = Path(scratch) if options.reserve else options.out
        store = Store(kept / RESULTS, code_version(), any_version=options.any_version)
        waiting = [case for case in cases if store.get(case.key) is None]
        counts = f"{len(cases)} cases, {len(cases) - len(waiting)} done before, {jobs} at a time"
        print(f"suite: {options.arms}, {counts}", file=sys.stderr)
        until = None if options.minutes is None else time.monotonic() + 60.0 * options.minutes
        if waiting:
            CaseRunner(store, kept, jobs).run(waiting, Progress(len(waiting), names=not options.reserve), until)
    return _finish(options, cases, store, as_json=as_json)


def _finish(options: SuiteOptions, cases: Sequence[Case], store: Store, *, as_json: bool) -> Tables:
    scored, failed = judged(cases, store)
    result = tables(scored, [case for case, _ in failed])
    results = [stored for case, _ in scored if (stored := store.get(case.key)) is not None]
    suite = f"random, {options.half}" if options.arms == "random" else options.arms
    of, date = commit(), datetime.datetime.now(datetime.UTC).date().isoformat()
    run = len(scored) + len(failed)
    document: dict[str, Any] = {"schema": SCHEMA, "suite": suite, "commit": of, "date": date}
    document |= {"run": run, "not_run": len(cases) - run, "failures": len(failed), **asdict(result)}
    if not options.reserve:
        document["cases"] = [
            {"key": c.key, "case": c.name, "level": c.level, "right": is_right(c, s), **asdict(s)} for c, s in scored
        ]
        document["failed"] = [{"key": c.key, "case": c.name, "error": error} for c, error in failed]
    versions = Counter(stored.code for stored in results)
    title = f"Detection of simulated effects: {suite}, commit {of}, {date}"
    text = report(title, result, scored, failed, len(cases), results, versions, names=not options.reserve)
    for name, content in ((SUMMARY, json.dumps(document, indent=1) + "\n"), (REPORT, text)):
        temporary = options.out / f".{name}.new"
        temporary.write_text(content, encoding="utf-8")
        os.replace(temporary, options.out / name)
    if as_json:
        sys.stdout.write(json.dumps(document) + "\n")
    else:
        print(f"{text}\nfor docs/results.md:\n{results_row(result.aims, suite, run, len(failed), date, of)}")
        print(f"summary: {options.out / SUMMARY}\nreport:  {options.out / REPORT}")
    if failed and options.arms != "random":
        causes = "; ".join(f"{c.name}: {error}" for c, error in failed[:SHOWN_FAILURES])
        raise ArmidentError(f"{len(failed)} of {len(cases)} cases failed: {causes}")
    return result


def judged(cases: Sequence[Case], store: Store) -> tuple[list[Scored], list[tuple[Case, str]]]:
    """Cases with their scores, and cases that failed, or whose healthy twin failed, with the error."""
    scored: list[Scored] = []
    failed: list[tuple[Case, str]] = []
    for case in cases:
        needed = [case] if case.twin is None else [case, case.twin]
        results = [found for each in needed if (found := store.get(each.key)) is not None]
        failures = [found for each in needed if (found := store.failure(each.key)) is not None]
        if len(results) == len(needed):
            shown = revealed(case, results[0].hidden)
            healthy = results[0].twin if case.random else results[1].diagnosis if case.twin is not None else None
            scored.append((shown, score(shown, results[0], healthy)))
        elif failures:
            failed.append((revealed(case, failures[0].hidden), str(failures[0].error)))
    return scored, failed


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
