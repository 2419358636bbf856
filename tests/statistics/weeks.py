"""Is the same arm called the same, week after week? Runs on vcan, then ``reidentify`` of them, and of a worn arm.

``python -m armident.drivers.vcan -n 2 -- python -m tests.statistics.weeks record --runs 200 --out weeks`` moves a
virtual TX40 as often along the shipped trajectory as ``reidentify`` does, with guard and capture as processes of their
own. Every bus has an arm of its own with other noise, and a last run has a tenth more friction in joint 2.
``python -m tests.statistics.weeks judge --out weeks`` identifies them all by ``armident reidentify --recordings`` and
compares them with the first at the default setting. A campaign that was stopped goes on where it was. Exit code 1 if
an unchanged arm was called changed, or the worn one was not.
"""

import argparse
import json
import multiprocessing
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
import yaml

from armident.configs import ArmidentError, config_path
from armident.identify.monitoring.reidentify.record_run import record_run
from tests.fixtures.processes import ForkedProcess, armident

PERIOD_US = 2000
"""SYNC period: six axes on a bus of a guest with one CPU, beside guard, capture and arm."""
HEARTBEAT_MS = 1000
"""All share one CPU: a drive that is late is not a drive that is lost."""
FIRST_SEED = 7000
WORN = {
    "schema": "armident/scenario/1",
    "description": "a tenth more friction in joint 2",
    "effects": [{"effect": "friction_drift", "joint": "joint_2", "parameters": {"change": 0.1, "time_constant": 1e-6}}],
}


def cell_file(folder: Path, bus: str, cell: str, shipped: str = "tx40_cell.yaml", **changes: Any) -> Path:
    """The shipped cell on one bus, at the rate of the campaign."""
    data = yaml.safe_load(config_path(shipped).read_text(encoding="utf-8"))
    data |= {"cell": cell, "robot": str(config_path(data["robot"])), "bus": {"channel": bus}}
    data |= {"sync": {"period_us": PERIOD_US}, "heartbeat_ms": HEARTBEAT_MS}
    for drive in data["drives"]:
        drive["eds"] = str(config_path(drive["eds"]))
    if "demand" in data["streams"]:
        data["streams"]["demand"]["every"] = 1
    data["setpoints"] |= {"trajectory": str(config_path(data["setpoints"]["trajectory"])), "every": 1}
    path = folder / f"{cell}.yaml"
    path.write_text(yaml.safe_dump(data | changes), encoding="utf-8")
    return path


def start_forked(words: Sequence[str], out: IO[bytes], err: IO[bytes]) -> ForkedProcess:
    """As `armident.identify.monitoring.reidentify.record_run.start_process`, without the time for imports."""
    return armident(*words, stdout=out, stderr=err)


def robot_on(config: Path, log: Path, seed: int, scenario: Path | None) -> ForkedProcess:
    """The virtual arm of a lane, ready."""
    words = ["robot", "--config", str(config), "--seed", str(seed)]
    with log.open("wb+") as file:
        robot = armident(*words, *([] if scenario is None else ["--scenario", scenario]), stdout=file, stderr=file)
        until = time.monotonic() + 120
        while b"ready" not in log.read_bytes():
            if robot.poll() is not None or time.monotonic() > until:
                raise ArmidentError(f"no virtual arm: {log.read_text(encoding='utf-8', errors='replace')}")
            time.sleep(0.05)
    return robot


def lane(number: int, out: Path, runs: Sequence[int], scenario: Path | None, name: str) -> None:
    """Move the arm on bus ``vcan<number>`` once for each of ``runs``; the recordings are ``<name><run>.mcap``."""
    config = cell_file(out, f"vcan{number}", f"{name}_{number}")
    # An arm that starts again must not repeat the noise of the one before.
    seed = FIRST_SEED + 1000 * number + runs[0] + (10_000 if scenario else 0)
    robot = robot_on(config, out / f"{name}_{number}.log", seed, scenario)
    try:
        for run in runs:
            begin, said = time.monotonic(), list[str]()
            try:
                recording = record_run(config, out / f"lane{number}", said.append, start_forked)
            except ArmidentError as error:
                print(f"{name} {run}: {error}", flush=True)
                continue
            assert recording.path is not None
            recording.path.rename(out / f"{name}{run:04d}.mcap")
            print(f"{name} {run}: {said[-1]} ({time.monotonic() - begin:.1f} s)", flush=True)
    finally:
        robot.send_signal(signal.SIGTERM)
        robot.wait(60)


def record(out: Path, runs: int, lanes: int, scenario: Path | None, name: str) -> None:
    """Record what is missing, each lane in a process of its own."""
    missing = [run for run in range(runs) if not (out / f"{name}{run:04d}.mcap").exists()]
    processes = [
        multiprocessing.get_context("spawn").Process(target=lane, args=(k, out, missing[k::lanes], scenario, name))
        for k in range(lanes)
        if missing[k::lanes]
    ]
    for process in processes:
        process.start()
    for process in processes:
        process.join()


def judge(out: Path, name: str, *options: str) -> tuple[list[dict[str, Any]], int]:
    """Identify and compare all recordings of a name; what came of each, and the exit code."""
    store = f"sqlite:///{out.resolve()}/{name}.sqlite"
    (out / f"{name}.sqlite").unlink(missing_ok=True)
    command = [sys.executable, "-m", "armident.daq.cli", "reidentify", "--recordings", str(out / f"{name}[0-9]*.mcap")]
    command += ["--store", store, "--workers", "1", "--out", str(out / "results"), "--json", *options]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    return json.loads(done.stdout)["runs"] if done.stdout else [], done.returncode


def summary(out: Path) -> bool:
    """Print what came of it; whether that is as it should be."""
    rows, code = judge(out, "week")
    failed, compared = [row for row in rows if row["error"]], [row for row in rows if row["drift"]]
    alarms = [row for row in compared if row["drift"]["drifted"]]
    chi = np.array([row["drift"]["chi_square"] for row in compared])
    degrees = compared[0]["drift"]["degrees"]
    p = [row["drift"]["p_joint"] for row in compared]
    print(f"{len(compared)} runs compared with the first: {len(alarms)} alarms, {len(failed)} failed; exit code {code}")
    print(f"chi-square {chi.mean():.1f} +- {chi.std():.1f}, greatest {chi.max():.1f}; of chance {degrees} +- ", end="")
    print(f"{np.sqrt(2 * degrees):.1f}; smallest chance of all parameters together {min(p):.2g}")
    residual = [row["drift"]["p_residuals"] for row in compared if row["drift"]["structure_compared"]]
    if residual:
        print(f"residuals compared in {len(residual)} runs; smallest corrected chance {min(residual):.2g}")
    for row in alarms + failed:
        print(f"  {row['recording']}: {row['error'] or '; '.join(row['words'])}")
    worn, code = judge(
        out, "worn", "--baseline", str(out / "results" / "week0000.identification" / "identification.json")
    )
    found = [row for row in worn if row["drift"] and row["drift"]["drifted"]]
    for row in worn:
        print(f"a tenth more friction in joint 2: exit code {code}; {'; '.join(row['words'])}")
    return code == 4 and not alarms and not failed and len(found) == len(worn) > 0


def main() -> int:
    """Record, or judge."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("step", choices=["record", "judge"])
    parser.add_argument("--runs", type=int, default=200, help="weeks of the unchanged arm")
    parser.add_argument("--worn", type=int, default=1, help="runs of the worn arm")
    parser.add_argument("--lanes", type=int, default=2, help="buses, each with an arm")
    parser.add_argument("--out", type=Path, default=Path("weeks"), help="folder of recordings and results")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    if options.step == "judge":
        return 0 if summary(options.out) else 1
    scenario = options.out / "worn.yaml"
    scenario.write_text(yaml.safe_dump(WORN), encoding="utf-8")
    record(options.out, options.worn, 1, scenario, "worn")
    record(options.out, options.runs, options.lanes, None, "week")
    return 0


if __name__ == "__main__":
    sys.exit(main())
