"""`identify` of a six-axis recording of about 7.5 s at 5 kHz: wall time and peak memory, in a process of its own."""

import json
import subprocess
import sys

from tests.benchmarks.harness import Row

MEASURE = """
import json, resource, time
from configs import config_path, load_robot, load_trajectory
from identify.from_recording import experiments_from_recording
from identify.options import Options
from identify.run import identify_experiment
from virtual_robot.offline import simulate_recording

robot = load_robot("tx40")
trajectory = load_trajectory(str(config_path("tx40.yaml").parent / "trajectories" / "tx40_excitation.yaml"))
experiments, _ = experiments_from_recording(simulate_recording(robot, trajectory, seed=1), robot)
figures = {"samples": sum(e.q.shape[0] for e in experiments)}
for method in ("idim-ls", "idim-iv", "idim-piv"):
    best = float("inf")
    for _ in range(2):
        start = time.perf_counter()
        result = identify_experiment(experiments, robot, Options(method=method))
        best = min(best, time.perf_counter() - start)
    figures[method] = best
    figures[method + " iterations"] = result.iterations
figures["memory"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
print(json.dumps(figures))
"""


def run() -> list[Row]:
    """Warm wall time of the three methods and peak memory of the whole process."""
    done = subprocess.run([sys.executable, "-c", MEASURE], capture_output=True, text=True, check=True)
    figures = json.loads(done.stdout.splitlines()[-1])
    rows = [
        Row(
            f"identify, {method}",
            figures[method],
            None,
            None,
            "s",
            f"{figures['samples']} samples x 6 axes at 5 kHz, {figures[method + ' iterations']} iterations, warm",
        )
        for method in ("idim-ls", "idim-iv", "idim-piv")
    ]
    return [*rows, Row("identify, peak memory", figures["memory"], None, None, "MB", "whole process, plant included")]
