"""A fleet on this machine: ``python -m tests.evaluation.fleet --arms 100 --workers 1 2 --out DIR``.

Virtual arms of ten kinds, each with masses, friction and noise of its own, are recorded once and identified by
``armident reidentify --recordings``. Two recordings more fail: of an arm at rest, and one larger than the memory of a
worker. In the middle one worker is killed. Every recording must have one result or one reason. Arms whose motion or
torques do not determine a model are refused, too. The share of true intervals by verdict tells if verdicts are right.
"""

import argparse
import json
import os
import resource
import signal
import subprocess
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
import sqlalchemy as sa
from numpy.typing import NDArray
from pyarrow import parquet

import armident
from armident.configs import RobotConfig, Trajectory, load_robot, load_trajectory
from armident.configs.loading import load_inertials
from armident.daq.recording import Recording, RecordingWriter, StreamLayout
from armident.identify.documents.files import load_document
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.effects.terms import arm_model
from armident.virtual_robot.plausible_motion import plausible_trajectory
from armident.virtual_robot.twin import complete
from tests.evaluation.process import ONE_THREAD
from tests.evaluation.run import commit
from tests.tools.markdown import table

KINDS = ("emps", "tx40", "ur3e", "ur5e", "ur10e", "panda", "iiwa14", "kinova_gen3", "kuka_lwr4", "xarm6")
PERIOD_S = 4e-3
"""Sampling period of the recordings, s."""
REST, LARGE = "cell_rest/rest.mcap", "cell_large/large.mcap"
"""Recordings that fail: of an arm at rest, and one whose arrays a worker has no memory for."""
WORKER_BYTES = 1 << 30
"""Memory of a worker, bytes."""
LARGE_ROWS = 16_000_000
"""Rows of the large recording, 64 bytes each in memory: they take more than `WORKER_BYTES`."""
POLL_S = 0.25
TICKS = os.sysconf("SC_CLK_TCK")


@dataclass
class Process:
    """A process of the command: time of the processor, s, and largest resident memory, bytes."""

    worker: bool = False
    cpu_s: float = 0.0
    peak: int = 0


@dataclass(frozen=True)
class Outcome:
    """Figures of one run. ``cpu_s``: of the workers by healthy arm; ``other_cpu_s``: of scheduler and comparison."""

    workers: int
    arms: int
    seconds: float
    arms_per_hour: float
    cpu_s: float
    other_cpu_s: float
    peak_mb: float
    command_peak_mb: float
    load_before: float
    load_after: float
    killed_after: int
    exit_code: int
    failed: dict[str, str] = field(default_factory=dict)
    violations: list[str] = field(default_factory=list)
    covered: dict[str, tuple[int, float]] = field(default_factory=dict)
    """Results by verdict, and share of their intervals of two standard deviations that hold the true value."""


def motion(kind: str, number: int) -> Trajectory:
    """Return the excitation of a kind that has one, else a motion within the limits of the arm."""
    if kind in ("emps", "tx40"):
        return load_trajectory(f"trajectories/{kind}_excitation.yaml")
    robot, _, _ = complete(load_robot(kind, "robot"), inertials=load_inertials(kind), seed=number)
    return plausible_trajectory(robot, number)


def recorded(number: int) -> tuple[str, Recording]:
    """Return name and recording of an arm."""
    kind = KINDS[number % len(KINDS)]
    made = armident.simulate_recording(kind, motion(kind, number), seed=number, arm_seed=number, period=PERIOD_S)
    cell = f"cell_{number:03d}"
    return f"{cell}/{kind}.mcap", replace(made, metadata={**made.metadata, "cell": cell})


def at_rest(robot: RobotConfig) -> Recording:
    """Return the recording of an arm that does not move."""
    t = np.arange(2000) * PERIOD_S
    return Recording.from_arrays(t, np.full((t.size, robot.n), 0.1), np.full((t.size, robot.n), 1.0), robot)


def write_large(path: Path, like: Recording) -> None:
    """Write a recording of `LARGE_ROWS` rows in few bytes: the arm stands still for days."""
    samples = like.samples
    layout = StreamLayout.of(samples, [joint.name for joint in like.robot.joints])
    rows = 1_000_000
    raw = {name: np.repeat(values[:1], rows, axis=0) for name, values in samples.raw.items()}
    with RecordingWriter(path, like.robot, None, like.sample_rate_hz, [layout], {}, 2**62) as writer:
        for begin in range(0, LARGE_ROWS, rows):
            sync = np.arange(begin, begin + rows)
            writer.append("samples", sync, sync * 1_000_000, raw)
            writer.flush()
        writer.close({})


def write_recordings(arms: int, folder: Path) -> list[str]:
    """Write the recordings that a former run has not written, and return the names of those that must succeed."""
    names = []
    for number in range(arms):
        kind = KINDS[number % len(KINDS)]
        name = f"cell_{number:03d}/{kind}.mcap"
        names.append(name)
        if not (folder / name).exists():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            recorded(number)[1].save(folder / name)
            print(f"recorded {name}", file=sys.stderr, flush=True)
    for name in (REST, LARGE):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
    if not (folder / LARGE).exists():
        _, like = recorded(KINDS.index("tx40"))
        at_rest(like.robot).save(folder / REST)
        write_large(folder / LARGE, like)
    return names


def processes_of(root: int) -> dict[int, Process]:
    """Return a process and those that descend from it, with what they have used so far."""
    found: dict[int, Process] = {}
    waiting = [root]
    while waiting:
        place = Path(f"/proc/{waiting.pop()}")
        try:
            used = (place / "stat").read_text().rpartition(")")[2].split()
            status = (place / "status").read_text()
            worker = b"spawn_main" in (place / "cmdline").read_bytes()
            for thread in (place / "task").iterdir():
                waiting += map(int, (thread / "children").read_text().split())
        except OSError:
            continue
        peak = next((int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM")), 0)
        found[int(place.name)] = Process(worker, (int(used[11]) + int(used[12])) / TICKS, 1024 * peak)
    return found


def limit_memory(workers: int) -> None:
    """Limit what Dask takes for the memory of this machine: each worker has the share of its processor."""
    size = WORKER_BYTES * max(workers, len(os.sched_getaffinity(0)))
    resource.setrlimit(resource.RLIMIT_RSS, (size, size))


def run(recordings: Path, out: Path, workers: int, names: Sequence[str], failing: Sequence[str]) -> Outcome:
    """Identify all recordings with some workers, kill one in the middle, and judge the results.

    ``failing``: names of the recordings that must fail; ``names``: of the others.
    """
    out.mkdir(parents=True, exist_ok=True)
    words = ["reidentify", "--recordings", str(recordings / "*" / "*.mcap"), "--workers", str(workers), "--json"]
    words += ["--store", f"sqlite:///{out}/history.sqlite", "--out", str(out / "results")]
    words += ["--results", str(out / "table")]
    seen: dict[int, Process] = {}
    lines: list[str] = []
    killed_after = 0
    load_before, begin = os.getloadavg()[0], time.monotonic()
    with (out / "stderr").open("w+", encoding="utf-8") as log, (out / "runs.json").open("w") as document:
        command = subprocess.Popen(
            [sys.executable, "-m", "armident.daq.cli", *words],
            stdout=document,
            stderr=log,
            env={**os.environ, **ONE_THREAD},
            preexec_fn=lambda: limit_memory(workers),
        )
        try:
            while command.poll() is None:
                seen |= processes_of(command.pid)
                lines = [
                    line for line in (out / "stderr").read_text(encoding="utf-8").splitlines() if ".mcap: " in line
                ]
                alive = [(p.peak, pid) for pid, p in processes_of(command.pid).items() if p.worker]
                # A single worker may just have ended for want of memory.
                if alive and not killed_after and len(lines) >= max(1, len(names) // 2):
                    killed_after = len(lines)
                    # The one with the largest memory is identifying.
                    os.kill(max(alive)[1], signal.SIGKILL)
                time.sleep(POLL_S)
        finally:
            command.kill()
            command.wait()
    seconds = time.monotonic() - begin
    of_workers = [process for process in seen.values() if process.worker]
    others = [process for process in seen.values() if not process.worker]
    runs = json.loads((out / "runs.json").read_text())["runs"]
    failed = {str(Path(one["recording"]).relative_to(recordings)): one["error"] for one in runs if one["error"]}
    return Outcome(
        workers=workers,
        arms=len(names),
        seconds=seconds,
        arms_per_hour=3600 * len(names) / seconds,
        cpu_s=sum(p.cpu_s for p in of_workers) / len(names),
        other_cpu_s=sum(p.cpu_s for p in others) / len(names),
        peak_mb=max(p.peak for p in of_workers) / 1e6,
        command_peak_mb=seen[command.pid].peak / 1e6,
        load_before=load_before,
        load_after=os.getloadavg()[0],
        killed_after=killed_after,
        exit_code=command.returncode,
        failed=failed,
        violations=violations(out, [str(recordings / name) for name in (*names, *failing)], runs, failed, failing),
    )


def violations(
    out: Path, expected: Sequence[str], runs: Sequence[dict[str, str]], failed: dict[str, str], failing: Sequence[str]
) -> list[str]:
    """Return what is not as it must be: one line, table entry and history entry each, and failures said once."""
    wrong = []
    said = Counter(line.split(": ")[0] for line in (out / "stderr").read_text().splitlines() if ".mcap: " in line)
    if sorted(one["recording"] for one in runs) != sorted(expected):
        wrong.append(f"{len(runs)} entries in the document, {len(expected)} recordings")
    if said != Counter(expected):
        wrong.append(f"not one line each: {said - Counter(expected) or Counter(expected) - said}")
    if passed := set(failing) - failed.keys():
        wrong.append(f"not failed: {', '.join(sorted(passed))}")
    rows = parquet.read_table(out / "table").to_pylist()
    once = Counter((row["recording"], row["parameter"]) for row in rows)
    if max(once.values()) > 1 or {recording for recording, _ in once} != set(expected):
        wrong.append("the table has not every recording once")
    with sa.create_engine(f"sqlite:///{out}/history.sqlite").connect() as connection:
        found = connection.execute(sa.text("select recording, count(*) from identifications group by recording")).all()
    identified = {row["recording"] for row in rows if row["parameter"]}
    if {recording for recording, _ in found} != identified or any(count != 1 for _, count in found):
        wrong.append("the history has not every result once")
    return wrong


def covered(results: Path, names: Sequence[str]) -> dict[str, tuple[int, float]]:
    """Return `Outcome.covered` of the base parameters of the recordings."""
    inside = defaultdict[str, list[NDArray[np.bool_]]](list)
    for number, name in enumerate(names):
        file = results / Path(name).with_suffix(".identification") / "identification.json"
        if file.exists():
            kind = KINDS[number % len(KINDS)]
            robot, plant, _ = complete(load_robot(kind, "robot"), inertials=load_inertials(kind), seed=number)
            model = arm_model(robot)
            truth = model.base.regroup @ np.array([plant.standard.get(each, 0.0) for each in model.names])
            found = load_document(file, IdentificationDocument)
            values, std = (np.array([getattr(p, key) for p in found.parameters]) for key in ("value", "std"))
            inside[str(found.verdict)].append(np.abs(values - truth) < 2.0 * std)
    return {verdict: (len(each), float(np.concatenate(each).mean())) for verdict, each in sorted(inside.items())}


def shown(outcomes: Sequence[Outcome], seconds: Sequence[float]) -> str:
    """Return the figures as Markdown."""
    head = (
        "workers",
        "arms",
        "arms per hour",
        "CPU per arm, s",
        "comparison, CPU s",
        "worker, MB",
        "command, MB",
        "load",
    )
    body = [
        (
            str(one.workers), str(one.arms), f"{one.arms_per_hour:.0f}", f"{one.cpu_s:.1f}", f"{one.other_cpu_s:.2f}",
            f"{one.peak_mb:.0f}", f"{one.command_peak_mb:.0f}", f"{one.load_before:.1f} to {one.load_after:.1f}",
        )
        for one in outcomes
    ]  # fmt: skip
    wrong = [f"{one.workers} workers: {each}" for one in outcomes for each in one.violations]
    failed = [f"{name}: {error}" for name, error in (outcomes[-1].failed.items() if outcomes else ())]
    verdicts = [
        f"{one.workers} workers: {count} {verdict}, {100.0 * share:.1f} % of the two-sigma intervals hold the truth"
        for one in outcomes
        for verdict, (count, share) in one.covered.items()
    ]
    return "\n".join(
        [
            f"commit {commit()}; recordings of {min(seconds):.1f} to {max(seconds):.1f} s at {1 / PERIOD_S:g} Hz",
            "",
            table(head, body),
            "",
            *verdicts,
            "",
            "failed:",
            *failed,
            "",
            f"violations: {len(wrong)}",
            *wrong,
        ]
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Record the arms, identify them with each number of workers, print and write the figures."""
    parser = argparse.ArgumentParser(prog="python -m tests.evaluation.fleet", description=__doc__)
    parser.add_argument("--arms", type=int, default=100)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument(
        "--out", type=Path, required=True, help="Folder, new for a run; recordings in it are used again."
    )
    options = parser.parse_args(arguments)
    folder = (options.out / "recordings").resolve()
    names = write_recordings(options.arms, folder)
    read = (armident.read_recording(folder / name) for name in names)
    seconds = [one.samples.sync.size / one.sample_rate_hz for one in read]
    outcomes = []
    for workers in options.workers:
        place = options.out.resolve() / f"workers_{workers}_{time.strftime('%Y%m%dT%H%M%S')}"
        found = run(folder, place, workers, names, (REST, LARGE))
        outcomes.append(replace(found, covered=covered(place / "results", names)))
        (options.out / "fleet.json").write_text(json.dumps([asdict(one) for one in outcomes], indent=1) + "\n")
        (options.out / "fleet.md").write_text(shown(outcomes, seconds) + "\n")
    print(shown(outcomes, seconds))
    if any(one.violations for one in outcomes):
        sys.exit(1)


if __name__ == "__main__":
    main()
