"""`identify` of a six-axis recording of about 7.5 s at 5 kHz: wall time and peak memory of every method."""

import json
import subprocess
import sys

from armident.identify.estimators.methods import METHODS
from tests.benchmarks.harness import Row

MEASURE = """
import json, resource, sys, time
from armident.configs import config_path, load_robot, load_trajectory
from armident.identify.identification.from_recording import experiments_from_recording
from armident.identify.identification.options import Options
from armident.identify.identification.pipeline import identify_experiment
from armident.virtual_robot.offline import simulate_recording

robot = load_robot("tx40")
trajectory = load_trajectory("trajectories/tx40_excitation.yaml")
experiments, _ = experiments_from_recording(simulate_recording(robot, trajectory, seed=1), robot)
figures = {"samples": sum(e.q.shape[0] for e in experiments)}
for method in sys.argv[1:]:
    name, _, factor = method.partition(":")
    controller = "parametric" if name in ("clie", "cloe") else "crc"
    options = Options(method=name, controller=controller, decimation=int(factor) if factor else None)
    best = float("inf")
    for _ in range(2):
        start = time.perf_counter()
        result = identify_experiment(experiments, robot, options)
        best = min(best, time.perf_counter() - start)
    figures[method] = best
    figures[method + " iterations"] = result.iterations
figures["memory"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
print(json.dumps(figures))
"""


FULL_RATE = "idim-piv:1"
"""IDIM-PIV on every sample."""


def run() -> list[Row]:
    """Warm wall time of every method, from positions to the finished result, and peak memory of the whole process."""
    methods = [*METHODS, FULL_RATE]
    done = subprocess.run([sys.executable, "-c", MEASURE, *methods], capture_output=True, text=True, check=True)
    figures = json.loads(done.stdout.splitlines()[-1])
    rows = [
        Row(
            f"identify, {method.replace(':1', ' at full rate')}",
            figures[method],
            None,
            None,
            "s",
            f"{figures['samples']} samples x 6 axes at 5 kHz, {figures[method + ' iterations']} iterations, warm",
        )
        for method in methods
    ]
    return [*rows, Row("identify, peak memory", figures["memory"], None, None, "MB", "whole process, plant included")]
