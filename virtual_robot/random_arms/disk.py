"""Files of a case: configuration, two recordings, and the truth."""

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np
import yaml

from armident.virtual_robot.random_arms.cases import RandomCase, make_case
from armident.virtual_robot.random_arms.halves import HALVES


def write_case(case: RandomCase, out: Path) -> None:
    """Write ``NAME.yaml``, ``NAME_a.npz``, ``NAME_b.npz`` and ``NAME.truth.json``.

    Parameters
    ----------
    case
        The case.
    out
        Folder of the files.
    """
    out.mkdir(parents=True, exist_ok=True)
    name = case.truth.name
    robot = case.robot.model_dump(mode="json", by_alias=True, exclude_defaults=True)
    (out / f"{name}.yaml").write_text(yaml.safe_dump({"schema": case.robot.schema_} | robot), encoding="utf-8")
    for part, recording in zip("ab", case.recordings, strict=True):
        np.savez_compressed(out / f"{name}_{part}.npz", **recording)  # type: ignore[arg-type]
    (out / f"{name}.truth.json").write_text(json.dumps(case.truth_document(), indent=1) + "\n", encoding="utf-8")


def main() -> None:
    """Write cases of one half into a folder."""
    parser = argparse.ArgumentParser(prog="python -m armident.virtual_robot.random_arms", description=main.__doc__)
    parser.add_argument("--half", choices=list(HALVES), default="development")
    parser.add_argument("--cases", type=int, default=10, help="number of cases")
    parser.add_argument("--first", type=int, default=0, help="number of the first case, from 0")
    parser.add_argument("--out", type=Path, required=True, help="folder of the files")
    options = parser.parse_args()
    for index in range(options.first, options.first + options.cases):
        begin = time.perf_counter()
        case = make_case(options.half, index)
        write_case(case, options.out)
        truth = case.truth
        print(
            f"{truth.name} {truth.family} {truth.kind} {' '.join(truth.joints) or 'arm'} "
            f"visibility {truth.visibility:.2f}, {time.perf_counter() - begin:.1f} s",
            file=sys.stderr,
            flush=True,
        )
