"""``armident diagnose-suite``: cases, lanes, results, tables."""

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

from armident.configs import ArmidentError, ConfigError, load_suite
from armident.identify.evaluation.cases import Case, all_cases, chosen, healthy_twin
from armident.identify.evaluation.markdown import report
from armident.identify.evaluation.score import score
from armident.identify.evaluation.show import progress, show
from armident.identify.evaluation.store import Record, Store, code_version
from armident.identify.evaluation.tables import COLUMNS, HEALTHY_COLUMNS, OUTSIDE_COLUMNS, Scored, Tables, tables
from armident.identify.evaluation.workers import Lanes

RESULTS, SUMMARY, TABLE, REPORT = "results.jsonl", "suite.json", "suite.csv", "suite.md"
SCHEMA = "armident/suite-result/1"
SHOWN_FAILURES = 3


@dataclass(frozen=True)
class Chosen:
    """What of a suite to run, and where: the options of the command."""

    suite: Path
    out: Path
    quick: bool = False
    only: tuple[str, ...] = ()
    levels: tuple[str, ...] = ()
    jobs: int | None = None
    minutes: float | None = None
    any_version: bool = False


def list_suite(options: Chosen) -> None:
    """Print the cases, one a line."""
    for case in chosen(
        all_cases(load_suite(options.suite)), quick=options.quick, only=options.only, levels=options.levels
    ):
        print(case.key, case.name)


def run_suite(options: Chosen, *, as_json: bool = False) -> Tables:
    """Run what has no result yet, and print and store the tables of all that has.

    Raises
    ------
    ConfigError
        If the suite's file is wrong, or no case is meant.
    ArmidentError
        After the tables, if cases failed.
    """
    suite = load_suite(options.suite)
    cases = chosen(all_cases(suite), quick=options.quick, only=options.only, levels=options.levels)
    if not cases:
        raise ConfigError("no case of the suite is at once of that effect, strength and subset")
    jobs = options.jobs or len(os.sched_getaffinity(0))
    store = Store(options.out / RESULTS, code_version(), any_version=options.any_version)
    waiting = [case for case in cases if store.get(case.key) is None]
    print(
        f"diagnose-suite: {len(cases)} cases, {len(cases) - len(waiting)} done before, {jobs} at a time",
        file=sys.stderr,
    )
    until = None if options.minutes is None else time.monotonic() + 60.0 * options.minutes
    if waiting:
        with progress(len(waiting)) as done:
            Lanes(store, options.out, jobs).run(waiting, done, until)
    scored, failed, missing = judged(cases, store)
    result = tables(scored, failed)
    document = summary(result, scored, failed, len(cases))
    records = [record for case, _ in scored if (record := store.get(case.key)) is not None]
    versions = Counter(str(record["code"]) for record in records)
    text = report(result, scored, len(cases), versions, core_hours(records))
    write(options.out, document, result, text)
    if as_json:
        sys.stdout.write(json.dumps(document) + "\n")
    else:
        show(result, len(cases) - missing, len(cases))
        print(f"results: {options.out / RESULTS}\nsummary: {options.out / SUMMARY}\ntable:   {options.out / TABLE}")
        print(f"report:  {options.out / REPORT}")
    if failed:
        told = "; ".join(f"{c.name}: {(store.failure(c.key) or {}).get('error')}" for c in failed[:SHOWN_FAILURES])
        raise ArmidentError(f"{len(failed)} of {len(cases)} cases failed: {told}")
    return result


def judged(cases: Sequence[Case], store: Store) -> tuple[list[Scored], list[Case], int]:
    """Scores of the cases with a result, those that failed, and how many have not been run."""
    scored: list[Scored] = []
    failed: list[Case] = []
    missing = 0
    for case in cases:
        record: Record | None = store.get(case.key)
        healthy = store.get(healthy_twin(case).key) if case.parts else None
        if record is not None and (healthy is not None or not case.parts):
            scored.append((case, score(case, record, healthy)))
        elif store.failure(case.key) or store.failure(healthy_twin(case).key):
            failed.append(case)
        else:
            missing += 1
    return scored, failed, missing


def summary(result: Tables, scored: Sequence[Scored], failed: Sequence[Case], total: int) -> Record:
    """Everything for machines: the tables, and one line for each case."""
    run = len(scored) + len(failed)
    return {
        "schema": SCHEMA,
        "run": run,
        "not_run": total - run,
        **asdict(result),
        "cases": [{"key": c.key, "case": c.name, "level": c.level, **asdict(s)} for c, s in scored],
        "failed": [{"key": c.key, "case": c.name} for c in failed],
    }


def core_hours(records: Sequence[Record]) -> float:
    """Time that some cases took, one after the other, h."""
    return float(sum(sum(record["seconds"].values()) for record in records)) / 3600.0


def write(out: Path, document: Record, result: Tables, report_text: str) -> None:
    """Write the summary, the tables as CSV, and the report."""
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
