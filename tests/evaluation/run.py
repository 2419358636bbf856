"""Runs the suite of the two robots: selects cases, runs them, and writes results and tables."""

import csv
import io
import json
import os
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from armident.configs import ArmidentError, ConfigError
from tests.evaluation.cases import Case, all_cases, healthy_twin, select_cases
from tests.evaluation.markdown import report
from tests.evaluation.schema import load_suite
from tests.evaluation.score import score
from tests.evaluation.show import progress, show
from tests.evaluation.store import CaseResult, Store, code_version
from tests.evaluation.tables import COLUMNS, HEALTHY_COLUMNS, OUTSIDE_COLUMNS, Scored, Tables, tables
from tests.evaluation.workers import CaseRunner

RESULTS, SUMMARY, TABLE, REPORT = "results.jsonl", "suite.json", "suite.csv", "suite.md"
SCHEMA = "armident/suite-result/1"
SHOWN_FAILURES = 3
"""Number of failed cases in the error message."""


@dataclass(frozen=True)
class SuiteOptions:
    """Options of ``python -m tests.evaluation``.

    Parameters
    ----------
    out
        Folder of results, logs and tables.
    quick
        Only the quick subset.
    only
        Effects or kinds of cases; empty for all.
    levels
        Strengths; empty for all.
    jobs
        Number of cases at a time; ``None`` for the number of processors.
    minutes
        Time after which no further case is started, min; ``None`` without limit.
    any_version
        Use results of other versions of the code.
    """

    suite: Path
    out: Path
    quick: bool = False
    only: tuple[str, ...] = ()
    levels: tuple[str, ...] = ()
    jobs: int | None = None
    minutes: float | None = None
    any_version: bool = False


def list_suite(options: SuiteOptions) -> None:
    """Print key and name of each selected case."""
    for case in select_cases(
        all_cases(load_suite(options.suite)), quick=options.quick, only=options.only, levels=options.levels
    ):
        print(case.key, case.name)


def run_suite(options: SuiteOptions, *, as_json: bool = False) -> Tables:
    """Run the selected cases without a result, and print, write and return the tables of all selected cases.

    ``as_json``: print the summary as JSON instead of tables. Raises ConfigError if the suite file is not valid, or no
    case is selected; ArmidentError: after the tables, if cases failed.
    """
    suite = load_suite(options.suite)
    cases = select_cases(all_cases(suite), quick=options.quick, only=options.only, levels=options.levels)
    if not cases:
        raise ConfigError("the suite has no case with this effect, strength and subset; see --list")
    jobs = options.jobs or len(os.sched_getaffinity(0))
    store = Store(options.out / RESULTS, code_version(), any_version=options.any_version)
    waiting = [case for case in cases if store.get(case.key) is None]
    print(
        f"suite: {len(cases)} cases, {len(cases) - len(waiting)} done before, {jobs} at a time",
        file=sys.stderr,
    )
    until = None if options.minutes is None else time.monotonic() + 60.0 * options.minutes
    if waiting:
        with progress(len(waiting)) as on_result:
            CaseRunner(store, options.out, jobs).run(waiting, on_result, until)
    scored, failed, missing = judged(cases, store)
    result = tables(scored, failed)
    document = summary(result, scored, failed, len(cases))
    results = [stored for case, _ in scored if (stored := store.get(case.key)) is not None]
    versions = Counter(stored.code for stored in results)
    text = report(result, scored, len(cases), versions, core_hours(results))
    write(options.out, document, result, text)
    if as_json:
        sys.stdout.write(json.dumps(document) + "\n")
    else:
        show(result, len(cases) - missing, len(cases))
        print(f"results: {options.out / RESULTS}\nsummary: {options.out / SUMMARY}\ntable:   {options.out / TABLE}")
        print(f"report:  {options.out / REPORT}")
    if failed:
        causes = "; ".join(f"{c.name}: {_cause(c, store)}" for c in failed[:SHOWN_FAILURES])
        raise ArmidentError(f"{len(failed)} of {len(cases)} cases failed: {causes}")
    return result


def _cause(case: Case, store: Store) -> str | None:
    failure = store.failure(case.key) or store.failure(healthy_twin(case).key)
    return None if failure is None else failure.error


def judged(cases: Sequence[Case], store: Store) -> tuple[list[Scored], list[Case], int]:
    """Score the results of cases.

    Returns ``scored``: cases with a result, and their scores; ``failed``: cases that failed, or whose healthy twin
    failed; ``missing``: number of cases that have not been run.
    """
    scored: list[Scored] = []
    failed: list[Case] = []
    missing = 0
    for case in cases:
        result = store.get(case.key)
        healthy = store.get(healthy_twin(case).key) if case.parts else None
        if result is not None and (healthy is not None or not case.parts):
            scored.append((case, score(case, result, healthy)))
        elif _cause(case, store):
            failed.append(case)
        else:
            missing += 1
    return scored, failed, missing


def summary(result: Tables, scored: Sequence[Scored], failed: Sequence[Case], total: int) -> dict[str, Any]:
    """Return the content of ``suite.json``: the tables and one entry per case.

    ``scored``: cases with a result, and their scores; ``total``: number of selected cases.
    """
    run = len(scored) + len(failed)
    return {
        "schema": SCHEMA,
        "run": run,
        "not_run": total - run,
        **asdict(result),
        "cases": [{"key": c.key, "case": c.name, "level": c.level, **asdict(s)} for c, s in scored],
        "failed": [{"key": c.key, "case": c.name} for c in failed],
    }


def core_hours(results: Sequence[CaseResult]) -> float:
    """Return the computing time of cases, h."""
    return float(sum(sum(result.seconds.values()) for result in results)) / 3600.0


def write(out: Path, document: dict[str, Any], result: Tables, report_text: str) -> None:
    """Write the summary, the tables as CSV, and the report.

    ``document``: content of ``suite.json``; ``report_text``: content of ``suite.md``.
    """
    out.mkdir(parents=True, exist_ok=True)
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    for columns, content in (
        (COLUMNS, (*result.effects, *result.pairs)),
        (HEALTHY_COLUMNS, result.healthy),
        (OUTSIDE_COLUMNS, result.outside),
    ):
        if content:
            rows.writerow([title for title, _ in columns])
            rows.writerows([[value(row) for _, value in columns] for row in content])
    files = {SUMMARY: json.dumps(document, indent=1) + "\n", TABLE: text.getvalue(), REPORT: report_text}
    for name, content_text in files.items():
        temporary = out / f".{name}.new"
        temporary.write_text(content_text, encoding="utf-8")
        os.replace(temporary, out / name)
