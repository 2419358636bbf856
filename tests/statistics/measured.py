"""What a diagnosis finds in measured machines, with the defaults that every robot gets.

``python -m tests.statistics.measured`` diagnoses every recording of ``../shared/data`` (``ARMIDENT_SHARED_DATA`` names
another folder) and prints what it states, how far the held-out error falls, and what it leaves unexplained; with names
(``tx40 panda``) only those. Each runs in its own process. A table gives CPU time, memory and flags; ``--json OUT``
writes the same. The exit code is 1 if a flag is set.
"""

import argparse
import json
import multiprocessing
import os
import resource
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from armident.configs import RobotConfig, load_robot
from armident.configs.loading import parse
from armident.daq.interchange.importing import import_recording
from armident.identify.diagnosis.diagnose import DiagnosisResult, run_diagnosis
from armident.identify.identification.from_recording import experiments_from_recording
from armident.identify.signals.experiments import Experiment
from tests.conftest import REPOSITORY
from tests.reproduction.recordings import measured_emps, measured_recording
from tests.tools.markdown import table as markdown_table

MOST_CPU_S = 60.0
"""Most CPU time of a diagnosis, s: one that takes longer is not repeated while a person waits."""
MOST_MEMORY_GB = 2.0
"""Most memory of a diagnosis, GB: the same."""
CERTAIN = 0.9
"""Confidence above which a finding has to take more of its joint's error power than it leaves (issue 21, part D)."""

MOTOR = """
schema: armident/robot/1
name: rolling_motor
description: one brushless motor without load; torques in amperes
gravity: [0.0, 0.0, 0.0]
joints:
  - name: joint_1
    type: revolute
    mdh: {alpha: 0.0, d: 0.0, theta: 0.0, r: 0.0}
    limits: {position: [-1000.0, 1000.0], velocity: 100.0, acceleration: 1000.0, torque: 1.0}
    drive: {signal: current, gain: 1.0, rated: 1.0, counts_per_unit: 100000}
    rotor_inertia: false
transmission: [[1.0]]
friction: {sign_smoothing: 10.0}
"""


@dataclass(frozen=True)
class Measured:
    """Recordings of one machine: those to learn from, those to judge by (or the last third of the former)."""

    robot: RobotConfig
    training: tuple[Experiment, ...]
    validation: tuple[Experiment, ...] = ()

    def diagnosed(self) -> DiagnosisResult:
        """With the defaults."""
        return run_diagnosis(self.training, self.validation, self.robot)


def emps(data: Path, name: str) -> Experiment:
    """EMPS, force in N."""
    found = measured_emps(data, name)
    assert found is not None, name
    return found.experiment


def kuka(data: Path, robot: RobotConfig, number: int) -> Experiment:
    """KUKA LWR4+, torques of its link-side sensors."""
    file = data / "kuka_lwr4" / f"measurements_{number}.npz"
    recording = import_recording(file, robot, rate_hz=200.0, names={"demand": "-"})
    (experiment,), _ = experiments_from_recording(recording, robot)
    return experiment


def panda(data: Path, robot: RobotConfig) -> tuple[Experiment, ...]:
    """Franka Panda, torques of its link-side sensors."""
    positions, torques = (data / "panda" / f"exciting_traj_{name}.txt" for name in ("positions", "torques"))
    recording = import_recording(positions, robot, effort=torques, rate_hz=1000.0, polled=True)
    return tuple(experiments_from_recording(recording, robot)[0])


def motor(data: Path, name: str) -> Experiment:
    """A brushless motor that rolls at constant speed; its rows are even, their time stamps are a host's."""
    columns = np.genfromtxt(data / "cogging_laas" / name, delimiter=",", skip_header=1)
    return Experiment(q=columns[:, 1:2].copy(), tau=columns[:, 3:4].copy(), q_ref=None, dt=1e-3)


def _emps(data: Path, training: str, validation: str | None) -> Measured:
    held = () if validation is None else (emps(data, validation),)
    return Measured(load_robot("emps"), (emps(data, training),), held)


def _tx40(data: Path, *, coupled: bool) -> Measured:
    robot = load_robot("tx40")
    seen = measured_recording(data).experiment
    return Measured(robot if coupled else robot.model_copy(update={"couplings": ()}), (seen,))


def _kuka(data: Path, held: int | None) -> Measured:
    robot = load_robot("kuka_lwr4")
    every = {k: kuka(data, robot, k) for k in (1, 2, 3)}
    validation = () if held is None else (every.pop(held),)
    return Measured(robot, tuple(every.values()), validation)


def _panda(data: Path) -> Measured:
    robot = load_robot("panda")
    return Measured(robot, panda(data, robot))


def _motor(data: Path) -> Measured:
    robot = parse(MOTOR, RobotConfig, "rolling motor")
    return Measured(robot, (motor(data, "rolling_data1.txt"),), (motor(data, "rolling_data2.txt"),))


MACHINES: dict[str, tuple[str, Callable[[Path], Measured]]] = {
    "emps": ("EMPS, its last third held out", lambda data: _emps(data, "DATA_EMPS.mat", None)),
    "emps_pulses": ("EMPS, judged by the pulses", lambda data: _emps(data, "DATA_EMPS.mat", "DATA_EMPS_PULSES.mat")),
    "pulses_emps": ("EMPS pulses, judged by the other", lambda d: _emps(d, "DATA_EMPS_PULSES.mat", "DATA_EMPS.mat")),
    "tx40": ("TX40", lambda data: _tx40(data, coupled=True)),
    "tx40_uncoupled": ("TX40, its model without couplings", lambda data: _tx40(data, coupled=False)),
    "kuka": ("KUKA LWR4+, last thirds held out", lambda data: _kuka(data, None)),
    "kuka_1": ("KUKA LWR4+, judged by recording 1", lambda data: _kuka(data, 1)),
    "kuka_2": ("KUKA LWR4+, judged by recording 2", lambda data: _kuka(data, 2)),
    "kuka_3": ("KUKA LWR4+, judged by recording 3", lambda data: _kuka(data, 3)),
    "panda": ("Panda", _panda),
    "motor": ("rolling motor, judged by another roll", _motor),
}
"""Title, and how it is loaded."""


def said(found: DiagnosisResult) -> list[str]:
    """Lines that tell a diagnosis."""
    document = found.document
    gap = document.gap.validation
    lines = [f"{document.verdict}; held-out error {gap.before.all:.2f} -> {gap.after.all:.2f} %"]
    torque = found.simulated.torque_before, found.simulated.torque_after
    if np.isfinite(torque).all():
        lines.append("torques of the simulated loop, error by joint " + " -> ".join(_each(t) for t in torque) + " %")
    for f in document.findings:
        where = f.joint if f.other is None else f"{f.joint} and {f.other}"
        values = ", ".join(
            f"{k} {v:.4g}" + (f" +- {f.evidence['std'][k]:.2g}" if k in f.evidence.get("std", {}) else "")
            for k, v in f.parameters.items()
        )
        gap_of_joint = f"{f.gap_before:.2f} -> {f.gap_after:.2f} %"
        lines.append(f"  {f.effect} of {where}, confidence {f.confidence:.2f}, {gap_of_joint}: {values}")
    for u in document.unexplained:
        lines.append(f"  unexplained: {u.joint}, {100 * u.share_of_residual:.0f} % varies with {u.varies_with}")
    return lines


def _each(values: NDArray[np.float64]) -> str:
    return " ".join(f"{v:.2f}" for v in values)


@dataclass(frozen=True)
class Row:
    """Result of one machine.

    ``cpu_s``: CPU time of user and system, all of the process, s; ``memory_gb``: largest resident memory of the
    process, GB; ``before``, ``after``: held-out error of all joints without and with the findings, percent; ``flags``:
    limits that it exceeds; ``lines``: lines that tell the diagnosis.
    """

    name: str
    title: str
    cpu_s: float
    memory_gb: float
    before: float
    after: float
    flags: tuple[str, ...]
    lines: tuple[str, ...]


def flags_of(found: DiagnosisResult, cpu_s: float, memory_gb: float) -> tuple[str, ...]:
    """Limits that a diagnosis exceeds. ``cpu_s``: its CPU time, s; ``memory_gb``: its largest memory, GB."""
    flags = []
    if cpu_s > MOST_CPU_S:
        flags.append(f"over {MOST_CPU_S:.0f} s")
    if memory_gb > MOST_MEMORY_GB:
        flags.append(f"over {MOST_MEMORY_GB:.0f} GB")
    # Powers are squares of errors: a finding takes before^2 - after^2 and leaves after^2.
    flags += [
        f"{f.effect} of {f.joint} leaves more than it takes"
        for f in found.document.findings
        if f.confidence > CERTAIN and f.gap_before**2 - f.gap_after**2 < f.gap_after**2
    ]
    return tuple(flags)


def measured(name: str, data: Path) -> Row:
    """Diagnose one machine; meant for a process of its own. ``data``: folder of the recordings."""
    title, load = MACHINES[name]
    found = load(data).diagnosed()
    used = resource.getrusage(resource.RUSAGE_SELF)
    cpu_s, memory_gb = used.ru_utime + used.ru_stime, used.ru_maxrss * 1024 / 1e9
    gap = found.document.gap.validation
    flags = flags_of(found, cpu_s, memory_gb)
    return Row(name, title, cpu_s, memory_gb, gap.before.all, gap.after.all, flags, tuple(said(found)))


def alone(name: str, data: Path) -> Row:
    """Diagnose one machine in a new process, so that memory and time are its own.

    ``data``: folder of the recordings.
    """
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(measured, name, data).result()


def table(rows: list[Row]) -> str:
    """Markdown table of the results."""
    headings = ["machine", "CPU, s", "memory, GB", "held-out error, %", "flags"]
    return markdown_table(
        headings,
        (
            [r.title, f"{r.cpu_s:.0f}", f"{r.memory_gb:.2f}", f"{r.before:.2f} -> {r.after:.2f}", "; ".join(r.flags)]
            for r in rows
        ),
    )


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.statistics.measured", description=__doc__)
    parser.add_argument("names", nargs="*", choices=[*MACHINES, []], help="machines; default: all")
    parser.add_argument("--json", type=Path, metavar="OUT", help="write the results to this file")
    options = parser.parse_args()
    names = options.names or list(MACHINES)
    data = Path(os.environ.get("ARMIDENT_SHARED_DATA") or REPOSITORY.parent / "shared" / "data")
    if not data.is_dir():
        print(f"the measured data are not here (looked in {data}; ARMIDENT_SHARED_DATA names another folder)")
        return 2
    rows = []
    for k, name in enumerate(names):
        row = alone(name, data)
        rows.append(row)
        print(f"[{k + 1}/{len(names)}] {name}: {row.title} ({row.cpu_s:.0f} s of CPU, {row.memory_gb:.2f} GB)")
        print("\n".join(f"  {line}" for line in (*row.lines, *(f"FLAG: {flag}" for flag in row.flags))), flush=True)
        if options.json:
            options.json.write_text(json.dumps([asdict(one) for one in rows], indent=2) + "\n")
    print(table(rows))
    return int(any(row.flags for row in rows))


if __name__ == "__main__":
    sys.exit(main())
