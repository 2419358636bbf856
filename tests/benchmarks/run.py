"""Runs every ``bench_*.py`` beside this file and prints one table; a benchmark never fails on a time.

A module has ``run() -> list[Row]``, and ``NEEDS_VCAN = True`` if it needs ``vcan0``: those run in one process under the
launcher. ``python -m tests.benchmarks.run [NAME...]`` runs only the named ones (``irwsm`` for ``bench_irwsm.py``).
"""

import dataclasses
import importlib
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from types import ModuleType

from armident.drivers.vcan import launcher_command
from tests.benchmarks.harness import Row

HERE = Path(__file__).parent
IN_CHILD = "--rows-to"


def main(arguments: list[str]) -> int:
    """Run the benchmarks named in ``arguments`` (default: all); 1 if one of them could not be run."""
    if arguments[:1] == [IN_CHILD]:
        rows, failed = _run(arguments[2:])
        Path(arguments[1]).write_text(json.dumps([dataclasses.asdict(row) for row in rows]))
        return int(failed)
    names = [f"bench_{name}" for name in arguments] or sorted(path.stem for path in HERE.glob("bench_*.py"))
    on_vcan = [name for name in names if getattr(_module(name), "NEEDS_VCAN", False)]
    rows, failed = _run([name for name in names if name not in on_vcan])
    if on_vcan:
        with tempfile.TemporaryDirectory() as folder:
            results = Path(folder) / "rows.json"
            child = [sys.executable, "-m", "tests.benchmarks.run", IN_CHILD, str(results), *on_vcan]
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
        table.add_row(row.name, f"{row.ours:.4g}", alternative, ratio, row.unit, row.note)
    # a redirected table is not squeezed into the width of a terminal that is not there
    Console(width=None if sys.stdout.isatty() else 160).print(table)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
