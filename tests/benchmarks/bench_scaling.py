"""How time and memory of `identify` grow with the recording: 10, 100 and 1000 s of six axes at 5 kHz."""

import json
import subprocess
import sys

from tests.benchmarks.harness import Row

SECONDS = (10, 100, 1000)

MEASURE = """
import json, resource, sys, time
import numpy as np
from armident.configs import config_path, load_robot, load_trajectory
from armident.identify.signals.experiments import Experiment
from armident.identify.identification.from_recording import experiments_from_recording
from armident.identify.identification.options import Options
from armident.identify.identification.pipeline import identify_experiment
from armident.virtual_robot.offline import simulate_recording

robot = load_robot("tx40")
trajectory = load_trajectory("trajectories/tx40_excitation.yaml")
(one,), _ = experiments_from_recording(simulate_recording(robot, trajectory, seed=1), robot)
wanted = round(float(sys.argv[1]) / one.dt)
# The motion ends where it began and stands still there: repeated, it is one long motion.
repeat = lambda x: np.concatenate([x] * (wanted // len(x) + 1))[:wanted]
long = Experiment(repeat(one.q), repeat(one.tau), repeat(one.q_ref), one.dt)
identify_experiment(one, robot, Options(method="idim-iv"))
held = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
start = time.perf_counter()
identify_experiment(long, robot, Options(method="idim-iv"))
print(json.dumps([time.perf_counter() - start, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024]))
"""


def run() -> list[Row]:
    """IDIM-IV; beside each figure stands ten times the one before: a ratio of 1 or more is linear growth at most."""
    rows: list[Row] = []
    before: tuple[float, float] | None = None
    for seconds in SECONDS:
        done = subprocess.run([sys.executable, "-c", MEASURE, str(seconds)], capture_output=True, text=True, check=True)
        time_s, memory = json.loads(done.stdout.splitlines()[-1])
        for name, ours, old, unit in (
            ("time", time_s, before and 10 * before[0], "s"),
            ("peak memory", memory, before and 10 * before[1], "MB"),
        ):
            ratio = None if old is None else old / ours
            rows.append(
                Row(f"identify {seconds} s of 5 kHz, {name}", ours, old, ratio, unit, "beside ten times the last")
            )
        before = time_s, memory
    return rows
