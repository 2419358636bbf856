"""Configuration files: what is accepted says what the file says, and what is refused is refused in one line."""

import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

from armident.configs import load_robot, load_session, load_trajectory
from armident.configs.loading import HERE, load_scenario
from armident.configs.schema.limits import NO_LIMIT
from armident.configs.yaml_loader import read_yaml
from armident.daq.init.dh_table import from_dh_table
from tests.fuzz.harness import MisreadError, Target
from tests.fuzz.mutate import either, spoil_text, spoil_tree
from tests.urdf_chains import random_urdf

Load = Callable[[Path], BaseModel]
URDF_ROBOT = """schema: armident/robot/1
name: chain
urdf: {file: chain.urdf}
joints:
%stransmission: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
"""
URDF_JOINT = "  - {name: joint_%d, limits: {position: [-3, 3], acceleration: 10.0}}\n"


def _shipped(*patterns: str) -> Callable[[], list[bytes]]:
    return lambda: [path.read_bytes() for pattern in patterns for path in sorted(HERE.glob(pattern))]


def _beside(folder: Path) -> Path:
    """A place where the relative paths of shipped sessions lead to files."""
    place = folder / "configs"
    if not place.exists():
        for name in ("eds", "trajectories", "zenoh", "robots"):
            (place / name).mkdir(parents=True, exist_ok=True)
            for path in (p for p in (HERE / name).iterdir() if p.is_file()):
                shutil.copy(path, place / name)
    return place


def _check(load: Load) -> Callable[[bytes, Path], bool]:
    def check(data: bytes, folder: Path) -> bool:
        path = _beside(folder) / "fuzzed.yaml"
        path.write_bytes(data)
        try:
            model = load(path)
        except ValueError:
            raise
        except Exception as error:
            if str(folder) not in str(error) and hasattr(error, "exit_code"):
                raise AssertionError(f"an error that does not say where: {error}") from error
            raise
        _compare(read_yaml(data.decode(), path.name), json.loads(model.model_dump_json(by_alias=True)), "")
        return True

    return check


def _compare(said: Any, understood: Any, where: str) -> None:
    """Refuse a value that was understood otherwise than it was written."""
    if isinstance(said, dict) and isinstance(understood, dict):
        for key, value in said.items():
            if _is_no_limit(value, f"{where}.{key}") and str(key) not in understood:
                continue  # JSON has no word for it
            if str(key) not in understood and f"0x{key}" not in understood:
                raise MisreadError(f"{where}.{key} was not taken")
            _compare(value, understood[str(key)], f"{where}.{key}")
    elif isinstance(said, list) and isinstance(understood, list):
        if len(said) != len(understood):
            raise MisreadError(f"{where}: {len(said)} entries, {len(understood)} taken")
        for k, (one, other) in enumerate(zip(said, understood, strict=True)):
            _compare(one, other, f"{where}[{k}]")
    elif isinstance(said, bool) or isinstance(understood, bool) or said is None or understood is None:
        if said is not understood:
            raise MisreadError(f"{where}: {said!r} taken as {understood!r}")
    elif isinstance(understood, int | float):
        if not _is_no_limit(said, where) and not math.isclose(float(said), understood, rel_tol=1e-15):
            raise MisreadError(f"{where}: {said!r} taken as {understood!r}")
    elif where == ".robot" and Path(str(understood)).stem == said:
        return  # the name of a shipped robot
    elif not str(understood).endswith(str(said).removeprefix("./").removeprefix("../")) and "/" not in str(said):
        raise MisreadError(f"{where}: {said!r} taken as {understood!r}")


def _is_no_limit(said: Any, where: str) -> bool:
    number = isinstance(said, int | float) and not isinstance(said, bool)
    return number and (said == math.inf or (".limits." in where and abs(said) >= NO_LIMIT))


def _load_trajectory(path: Path) -> BaseModel:
    trajectory = load_trajectory(path)
    for robot in ("tx40.yaml", "emps.yaml"):
        if len(trajectory.start) == load_robot(robot).n:
            trajectory.check(load_robot(robot), str(path))
    return trajectory


def _urdf_seeds() -> list[bytes]:
    return [random_urdf(np.random.default_rng(k), 3, right_angles=bool(k % 2)).encode() for k in range(4)]


def _check_urdf(data: bytes, folder: Path) -> bool:
    (folder / "chain.urdf").write_bytes(data)
    path = folder / "robot.yaml"
    path.write_text(URDF_ROBOT % "".join(URDF_JOINT % k for k in (1, 2, 3)))
    robot = load_robot(path)
    for joint in robot.joints:
        values = [*joint.mdh.model_dump().values(), *joint.limits.position]
        if not np.isfinite(values).all():
            raise MisreadError(f"{joint.name} has no finite geometry")
    return True


DH_TABLES = (
    "name; theta [deg]; d [mm]; a [mm]; alpha [deg]\na; 0; 162.5; 0; 90\nb; 0; 0; -425; 0\nc; 0; 0; -392.2; 0\n",
    "theta,d,a,alpha\n0,0.1,0,pi/2\n-pi/2,0,0.3,0\n0,0.2,0.05,-pi/2\n",
    "type,alpha,d,theta,r\nprismatic,0,0,0,0\nrevolute,90,0,0,0.3\n",
)


def _check_dh_table(data: bytes, folder: Path) -> bool:
    path = folder / "table.csv"
    path.write_bytes(data)
    robot = from_dh_table(path, None).robot
    for joint in robot.joints:
        if not np.isfinite([*joint.mdh.model_dump().values()]).all():
            raise MisreadError(f"{joint.name} has no finite geometry")
    return True


def _target(name: str, seeds: Callable[[], list[bytes]], load: Load) -> Target:
    return Target(name, seeds, either(spoil_text, spoil_tree), _check(load))


TARGETS = (
    _target("robot", _shipped("robots/tx40.yaml", "robots/emps.yaml", "robots/kuka*.yaml"), load_robot),
    _target("session", _shipped("cells/*.yaml"), load_session),
    _target("trajectory", _shipped("trajectories/*.yaml"), _load_trajectory),
    _target("scenario", _shipped("scenarios/*.yaml"), load_scenario),
    Target("urdf", _urdf_seeds, spoil_text, _check_urdf),
    Target("dh-table", lambda: [table.encode() for table in DH_TABLES], spoil_text, _check_dh_table),
)
