"""Files of a case: configuration, two recordings, and the truth; ``python -m tests.evaluation.plants``."""

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from armident.configs import RobotConfig
from armident.daq.recording import Field, Recording, Stream, write_recording
from tests.evaluation.plants.cases import RandomCase, make_case
from tests.evaluation.plants.cases import Recording as Arrays
from tests.evaluation.plants.halves import HALVES

PARTS = ("a", "b")
"""Recordings of a case: to learn from, and to judge by."""


def write_case(case: RandomCase, out: Path) -> None:
    """Write ``NAME.yaml``, ``NAME_a.npz``, ``NAME_b.npz`` and ``NAME.truth.json``."""
    out.mkdir(parents=True, exist_ok=True)
    name = case.truth.name
    write_robot(case.robot, out / f"{name}.yaml")
    for part, arrays in zip(PARTS, case.recordings, strict=True):
        np.savez_compressed(out / f"{name}_{part}.npz", **arrays)  # type: ignore[arg-type]
    (out / f"{name}.truth.json").write_text(json.dumps(case.truth_document(), indent=1) + "\n", encoding="utf-8")


def write_robot(robot: RobotConfig, path: Path) -> None:
    """Write a robot configuration."""
    content = robot.model_dump(mode="json", by_alias=True, exclude_defaults=True)
    path.write_text(yaml.safe_dump({"schema": robot.schema_} | content), encoding="utf-8")


def as_recording(robot: RobotConfig, arrays: Arrays) -> Recording:
    """Recording with the arrays as ``armident import`` reads them, without its checks of units.

    ``arrays``: arrays by name, SI as far as the case has no mistake of units, joint side.
    """
    names = {"position": "q", "torque": "tau", "demand": "qr"}
    revolute = all(joint.type == "revolute" for joint in robot.joints)
    position, effort = ("rad", "N m") if revolute else ("m", "N")
    fields, raw = {}, {}
    for quantity, prefix in names.items():
        if f"{prefix}1" in arrays:
            unit = effort if quantity == "torque" else position
            fields[quantity] = Field(quantity, quantity, unit, "joint", (1.0,) * robot.n)  # type: ignore[arg-type]
            raw[quantity] = np.column_stack([arrays[f"{prefix}{j + 1}"] for j in range(robot.n)])
    t = arrays["t"]
    rate = float((t.size - 1) / (t[-1] - t[0]))
    sync = np.arange(t.size, dtype=np.int64)
    samples = Stream("samples", 1, sync, np.round(sync * (1e9 / rate)).astype(np.int64), fields, raw)
    return Recording(None, robot, None, rate, {"samples": samples})


def write_recordings(case: RandomCase, out: Path, prefix: str) -> dict[str, str]:
    """Write configuration and recordings of a case as ``armident diagnose`` reads them.

    ``prefix``: beginning of the names of the files. Returns paths by ``robot``, ``a`` and ``b``.
    """
    paths = {"robot": out / f"{prefix}.yaml"} | {part: out / f"{prefix}_{part}.mcap" for part in PARTS}
    write_robot(case.robot, paths["robot"])
    for part, arrays in zip(PARTS, case.recordings, strict=True):
        write_recording(as_recording(case.robot, arrays), paths[part])
    return {name: str(path) for name, path in paths.items()}


def simulate(request: dict[str, Any]) -> dict[str, Any]:
    """Simulate case ``index`` of a ``half``, with its healthy twin if asked to, and write both into folder ``out``.

    The answer has the keys ``case``, ``twin`` (each with the paths ``robot``, ``a`` and ``b``), ``hidden``: the truth,
    and ``seconds``.
    """
    begin, out = time.perf_counter(), Path(request["out"])
    case = make_case(request["half"], request["index"], with_twin=request["twin"])
    return {
        "case": write_recordings(case, out, "case"),
        "twin": None if case.twin is None else write_recordings(case.twin, out, "twin"),
        "hidden": case.truth_document(),
        "seconds": time.perf_counter() - begin,
    }


def main() -> None:
    """Write cases of one half into a folder."""
    parser = argparse.ArgumentParser(prog="python -m tests.evaluation.plants", description=main.__doc__)
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
