"""Zeros of encoders in the set-up check: ``python -m tests.evaluation.setup_zeros DIR``.

DIR has cases of ``python -m tests.evaluation.plants --half development --out DIR``. Each arm without a mistake of the
set-up gets an offset of 2 to 30 degrees at two of its joints, one after the other; the joint of the finding is
compared with it.
"""

import argparse
import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from armident.configs import DataError, load_robot
from armident.daq.interchange.importing import import_recording
from armident.identify.effects.wiring import PositionOffset
from armident.identify.identification.from_recording import experiments_from_recording
from armident.identify.setup.check import check_setup
from armident.identify.setup.result import SetupFinding

SIZES = np.radians([2.0, 30.0])


def findings(folder: Path) -> Iterator[tuple[str, SetupFinding | None]]:
    """Name of the joint with an offset, and the finding of an offset, for every case and joint."""
    for truth in sorted(folder.glob("*.truth.json")):
        name = truth.name.removesuffix(".truth.json")
        if json.loads(truth.read_text())["family"] == "setup":
            continue
        robot = load_robot(folder / f"{name}.yaml")
        try:
            experiments, _ = experiments_from_recording(import_recording(folder / f"{name}_a.npz", robot), robot)
        except DataError:
            continue
        rng = np.random.default_rng([int(part) for part in name.split("_") if part.isdigit()])
        joints = [j for j in range(1, robot.n) if robot.joints[j].type == "revolute"]
        for j in rng.permutation(joints)[:2]:
            offset = np.zeros(robot.n)
            offset[j] = rng.choice([-1.0, 1.0]) * np.exp(rng.uniform(*np.log(SIZES)))
            wrong = [
                replace(e, q=e.q - offset, q_ref=None if e.q_ref is None else e.q_ref - offset) for e in experiments
            ]
            found = [f for f in check_setup(wrong, robot).findings if f.kind == PositionOffset.name]
            yield robot.joints[j].name, found[0] if found else None


def main(arguments: Sequence[str] | None = None) -> None:
    """Print how many findings are right, by a rival, wrong, and how many offsets are not found."""
    parser = argparse.ArgumentParser(prog="python -m tests.evaluation.setup_zeros", description=__doc__)
    parser.add_argument("folder", type=Path, help="Folder of the cases.")
    counts: Counter[str] = Counter()
    for joint, finding in findings(parser.parse_args(arguments).folder):
        if finding is None:
            counts["not found"] += 1
        elif joint in finding.joints:
            counts["right"] += 1
        else:
            counts["right by a rival" if joint in finding.message else "wrong"] += 1
    print(", ".join(f"{what}: {count}" for what, count in sorted(counts.items())))


if __name__ == "__main__":
    main()
