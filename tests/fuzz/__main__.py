"""``python -m tests.fuzz --target recording --seconds 60``: tries inputs for so long and says what was found.

Inputs that fail are kept in ``tests/fuzz/corpus``, where the quick tests try them again. The inputs run in a process of
their own: one that takes it down, or keeps it busy where no signal ends it, is found too.
"""

import argparse
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.fuzz.harness import Finding, Target, attempt
from tests.fuzz.targets import IMPORTERS, TARGETS

STUCK_S = 30.0
"""A process that computes for so long without another input is killed, s of its processor time."""
WAITING_S = 600.0
"""So is one that sleeps after so long, s; a process of low priority may wait longer for the processor."""
NOTE_S = 0.25
FOUND = 3
"""What the process of the inputs returns where it found something."""


def main() -> int:
    """Fuzz the targets named on the command line; 1 if something was found."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--target", action="append", choices=[*TARGETS, "all", "importers"])
    parser.add_argument("--seconds", type=float, default=60.0, help="for each target")
    parser.add_argument("--minutes", type=float, help="for all targets together, in place of --seconds")
    parser.add_argument("--seed", type=int, default=int(time.time()))
    parser.add_argument("--child", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    wanted = [*(arguments.target or ["all"])]
    wanted += IMPORTERS if "importers" in wanted else ()
    targets = [t for t in TARGETS.values() if t.name in wanted or "all" in wanted]
    if arguments.child is not None:
        return _child(targets[0], arguments.seconds, arguments.seed, Path(arguments.child))
    print(f"seed {arguments.seed}")
    seconds = arguments.seconds if arguments.minutes is None else 60.0 * arguments.minutes / len(targets)
    found = sum(_supervise(target, seconds, arguments.seed) for target in targets)
    return int(found > 0)


def _child(target: Target, seconds: float, seed: int, state: Path) -> int:
    """Try inputs; what is being tried is in the file ``state``."""
    seen: set[str] = set()
    count = accepted = 0
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder, state.open("r+b", buffering=0) as file:
        target.warm_up(Path(folder))
        until = time.monotonic() + seconds
        for data in target.inputs(seed):
            if time.monotonic() > until:
                break
            os.pwrite(file.fileno(), len(data).to_bytes(8, "little") + data, 0)
            os.utime(state)
            result = attempt(target, data, Path(folder))
            count += 1
            accepted += result is True
            if isinstance(result, Finding) and (kind := _kind(result)) not in seen:
                seen.add(kind)
                print(f"FOUND {target.name}: {result.where[:300]}\n  kept as {result.keep()}", flush=True)
                print("    " + result.trace.rstrip().replace("\n", "\n    "), file=sys.stderr, flush=True)
    print(f"{target.name}: {count} inputs in {seconds:.0f} s, {accepted} accepted, {len(seen)} findings", flush=True)
    return FOUND if seen else 0


def _kind(found: Finding) -> str:
    """Findings of the same kind are told once."""
    place, _, said = found.where.partition(": ")
    return place if " at " in place and "Misread" not in place else re.sub(r"\d+|'[^']*'", "#", place + said)[:90]


def _supervise(target: Target, seconds: float, seed: int) -> int:
    """Run the inputs of one target in a process, and in another one where that does not end by itself."""
    found = 0
    until = time.monotonic() + seconds
    while (left := until - time.monotonic()) > 0:
        with tempfile.NamedTemporaryFile(prefix="fuzz-state-") as state:
            command = [sys.executable, "-m", "tests.fuzz", "--target", target.name, "--seconds", str(left)]
            process = subprocess.Popen([*command, "--seed", str(seed), "--child", state.name])
            # By our own clock, not the file's: that one may be set meanwhile.
            begun, last = os.stat(state.name).st_mtime_ns, (0, time.monotonic(), 0.0)
            while process.poll() is None:
                time.sleep(NOTE_S)
                touched = os.stat(state.name).st_mtime_ns
                if touched not in (last[0], begun):
                    last = touched, time.monotonic(), _computed_s(process.pid)
                waited, computed = time.monotonic() - last[1], _computed_s(process.pid) - last[2]
                if (waited > WAITING_S and _sleeps(process.pid)) or (last[0] and computed > STUCK_S):
                    process.send_signal(signal.SIGKILL)
                    process.wait()
            if process.returncode in (0, FOUND):
                return found + (process.returncode == FOUND)
            if process.returncode == 1 or not last[0]:
                raise SystemExit(f"{target.name}: the inputs could not be made")
            raw = Path(state.name).read_bytes()
            data = raw[8 : 8 + int.from_bytes(raw[:8], "little")]
            kept = Finding(target.name, data, "", "").keep()
            print(f"FOUND {target.name}: the process ended with {process.returncode}\n  kept as {kept}", flush=True)
            found, seed = found + 1, seed + 1
    return found


def _computed_s(process: int) -> float:
    """Processor time of a process, s; that of its ended children is not in it."""
    values = _stat(process)
    return (int(values[11]) + int(values[12])) / os.sysconf("SC_CLK_TCK") if values else 0.0


def _sleeps(process: int) -> bool:
    """True if a process neither runs nor waits for a processor."""
    return _stat(process)[:1] != ["R"]


def _stat(process: int) -> list[str]:
    """State and numbers of a process; none if it has ended."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return []


if __name__ == "__main__":
    sys.exit(main())
