"""Runs every ``bench_*.py`` beside this file and prints one table; a benchmark never fails on a time.

A module has ``run() -> list[Row]``, and ``NEEDS_VCAN = True`` if it needs ``vcan0``: those run in one process under the
launcher. ``python -m tests.benchmarks.run [NAME...]`` runs only the named ones (``irwsm`` for ``bench_irwsm.py``).
``--runs N`` repeats those without a bus and prints medians with their ranges; those on a bus have rounds of their own.
"""

import argparse
import dataclasses
import importlib
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from types import ModuleType

from armident.drivers.vcan import launcher_command
from tests.benchmarks.harness import Row, median_of_runs

HERE = Path(__file__).parent
IN_CHILD = "--rows-to"


def main(arguments: list[str]) -> int:
    """Run the benchmarks named in ``arguments`` (default: all); 1 if one of them could not be run."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.run", description="Print a table of benchmarks.")
    parser.add_argument("names", nargs="*", metavar="NAME", help="Benchmarks, e.g. irwsm. Default: all.")
    parser.add_argument("--runs", type=int, default=1, help="Number of runs of benchmarks without a bus.")
    parser.add_argument(IN_CHILD, type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.rows_to is not None:
        rows, failed = _run([f"bench_{name}" for name in options.names])
        options.rows_to.write_text(json.dumps([dataclasses.asdict(row) for row in rows]))
        return int(failed)
    names = [f"bench_{name}" for name in options.names] or sorted(path.stem for path in HERE.glob("bench_*.py"))
    on_vcan = [name for name in names if getattr(_module(name), "NEEDS_VCAN", False)]
    runs = [_run([name for name in names if name not in on_vcan]) for _ in range(options.runs)]
    failed = any(failed for _, failed in runs)
    rows = median_of_runs([rows for rows, _ in runs]) if options.runs > 1 else runs[0][0]
    if on_vcan:
        with tempfile.TemporaryDirectory() as folder:
            results = Path(folder) / "rows.json"
            child = [sys.executable, "-m", "tests.benchmarks.run", IN_CHILD, str(results)]
            child += [name.removeprefix("bench_") for name in on_vcan]
            failed |= subprocess.run(launcher_command(child, buses=2), check=False).returncode != 0
            if results.exists():
                rows += [Row(**row) for row in json.loads(results.read_text())]
    _print(rows)
    return int(failed)


def _module(name: str) -> ModuleType:
    return importlib.import_module(f"tests.benchmarks.{name}")


def _run(names: list[str]) -> tuple[list[Row], bool]:
    rows: list[Row] = []
    failed = False
    for name in names:
        print(f"{name} ...", file=sys.stderr, flush=True)
        try:
            rows += _module(name).run()
        except Exception as error:  # the others are still worth running
            print(f"{name}: {type(error).__name__}: {error}", file=sys.stderr)
            failed = True
    return rows, failed


def _print(rows: list[Row]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("benchmark", "ours", "alternative", "ratio", "unit", "note")
    for row in rows:
        alternative = "" if row.alternative is None else f"{row.alternative:.4g}"
        ratio = "" if row.ratio is None else f"{row.ratio:.3g}"
        if row.low is not None and row.high is not None:
            ratio += f" ({row.low:.3g} to {row.high:.3g})"
        ours = f"{row.ours:.4g}"
        if row.fastest is not None and row.slowest is not None:
            ours += f" ({row.fastest:.4g} to {row.slowest:.4g})"
        table.add_row(row.name, ours, alternative, ratio, row.unit, row.note)
    # a redirected table is not squeezed into the width of a terminal that is not there
    Console(width=None if sys.stdout.isatty() else 160).print(table)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
