"""``python -m tests.statistics.late_torques``: what the set-up check says of torques that are all late.

The virtual TX40 and EMPS play shipped trajectories at 1 kHz. Their torques are moved by whole samples. The check runs
with the recorded references and without them.
"""

import argparse
from dataclasses import replace

from armident.configs import load_robot
from armident.identify.identification.from_recording import experiments_from_recording
from armident.identify.setup.check import check_setup
from armident.identify.signals.experiments import Experiment
from tests.fixtures.arms import FAST, recording

MOTIONS = (("tx40", "tx40_excitation"), ("tx40", "tx40_1"), ("tx40", "tx40_2"), ("emps", "emps_1"))


def moved(e: Experiment, samples: int) -> Experiment:
    """Experiment whose torques are late by a number of samples; early if it is negative."""
    count = e.q.shape[0] - abs(samples)
    positions, torques = slice(max(samples, 0), None), slice(max(-samples, 0), None)
    q_ref = None if e.q_ref is None else e.q_ref[positions][:count]
    return Experiment(e.q[positions][:count], e.tau[torques][:count], q_ref, e.dt)


def found(robot_name: str, motion: str, seed: int, samples: int, *, referenced: bool) -> str:
    """Findings of the check in one line."""
    robot = load_robot(robot_name)
    experiments, _ = experiments_from_recording(recording(robot_name, motion, seed, period=FAST), robot)
    late = [moved(e, samples) for e in experiments]
    check = check_setup(late if referenced else [replace(e, q_ref=None) for e in late], robot)
    return "; ".join(finding.message for finding in check.findings) or "no finding"


def main() -> None:
    """Print one line for each motion, delay and kind of recording."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=4)
    asked = parser.parse_args()
    for robot, motion in MOTIONS:
        for samples in (0, 4, 8, 16, -8):
            for referenced in (True, False):
                what = "with" if referenced else "without"
                said = found(robot, motion, asked.seed, samples, referenced=referenced)
                print(f"{motion}, torques {samples} ms late, {what} references: {said}", flush=True)


if __name__ == "__main__":
    main()
