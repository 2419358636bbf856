"""Geometry of an arm from a URDF or from the library of robots, as the beginning of a robot configuration."""

import os.path
import re
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from armident.configs import ArmidentError, ConfigError, RobotConfig, config_path, load_robot
from armident.configs.blanks import MARK, without_marks
from armident.configs.loading import checked_robot
from armident.configs.schema.robot import Mdh
from armident.configs.urdf import UrdfGeometry, UrdfSource, geometry_from_urdf, joint_names
from armident.configs.urdf_file import limit_places
from armident.configs.urdf_inertials import held_joints
from armident.configs.urdf_tree import coarse_right_angles, moving_links, orientation, read_tree, serial_tips
from armident.configs.yaml_loader import is_file, read_yaml

UPRIGHT = (0.0, 0.0, -9.81)
"""Acceleration of gravity in the frame of an upright base, m/s^2."""


URDF_SUFFIXES = (".urdf", ".xml", ".xacro")
"""Suffixes of URDF files; a xacro file is refused with the command that expands it."""


@dataclass(frozen=True)
class Geometry:
    """Geometry of an arm: keys of the robot configuration, ``joints`` with names, and the robot they make."""

    source: str
    content: dict[str, Any]
    robot: RobotConfig
    notes: tuple[str, ...] = ()


def from_library(name: str) -> Geometry:
    """Geometry of a robot in ``configs/robots`` by its name, or of another configuration by its path."""
    path = config_path(name, listed=("robots",))
    robot = load_robot(path, "import")
    content = read_yaml(path.read_text(encoding="utf-8"), str(path))
    if "urdf" in content:
        raise ConfigError(f"{path}: takes its geometry from a URDF; give that: armident init {content['urdf']['file']}")
    return Geometry(path.name, content, robot)


def from_urdf(
    file: Path,
    out: Path,
    base: str | None = None,
    tip: str | None = None,
    fits: Callable[[RobotConfig], object] | None = None,
) -> Geometry:
    """Geometry of a URDF, to which the robot configuration in ``out`` refers."""
    if not is_file(file):
        raise ConfigError(f"{file}: no such file")
    if file.suffix.lower() not in URDF_SUFFIXES:
        raise ConfigError(
            f"{file}: expected a URDF ({', '.join(URDF_SUFFIXES)}); --recording gives a recording, --dh a table of "
            "parameters, --robot a robot of the library"
        )
    if tip is not None:
        return _of_chain(file, out, base, tip)
    tips = serial_tips(file, base)
    if not tips:
        # The reader of the chain names the reason.
        return _of_chain(file, out, base, None)
    chains = [(base, one) for one in tips]
    fitting = chains if fits is None else [chain for chain in chains if _is_fit(file, out, chain, fits)]
    if fits is not None and not fitting:
        fitting = _longest_parts(file, out, base, fits)
    if len(fitting) == 1:
        if fits is not None:
            _refuse_recorded_load(file, out, *fitting[0], fits)
        return _chosen(file, out, *fitting[0])
    # Numbered columns fit any part of a chain, names those of several arms on one link.
    if len(chains) == 1 and len({begin for begin, _ in fitting}) != 1:
        return _chosen(file, out, *chains[0])
    listed = "; ".join(
        f"{f'--base {begin} ' if begin else ''}--tip {end} ({', '.join(joint.name for joint in joints)})"
        for begin, end in fitting or chains
        if (joints := _of_chain(file, out, begin, end).robot.joints)
    )
    why = "and the recording fits none of them" if not fitting else "of which one is identified"
    raise ConfigError(f"{file}: has several chains, {why}: {listed}")


def _chosen(file: Path, out: Path, base: str | None, tip: str) -> Geometry:
    """Geometry of a chain; without its ends in the configuration where the file has no other chain."""
    try:
        whole = _of_chain(file, out, None, None)
    except ConfigError:
        whole = None
    part = _of_chain(file, out, base, tip)
    return whole if whole is not None and whole.content["joints"] == part.content["joints"] else part


def _refuse_recorded_load(
    file: Path, out: Path, base: str | None, tip: str, fits: Callable[[RobotConfig], object]
) -> None:
    """Refuse a chain whose load has two recorded joints in series: they are its arm behind a branch, not fingers."""
    held = set(held_joints(file, base, tip))
    for path in moving_links(file, base):
        for (one, begin, _), (other, _, end) in pairwise(path):
            if {one, other} <= held and _is_fit(file, out, (begin, end), fits):
                # The reader of their chain names the branch.
                _of_chain(file, out, base, end)


def _longest_parts(
    file: Path, out: Path, base: str | None, fits: Callable[[RobotConfig], object]
) -> list[tuple[str | None, str]]:
    """Ends of the longest parts of chains whose joints are the recorded ones; several if that does not decide."""
    links = moving_links(file, base)
    for length in range(max(map(len, links)), 0, -1):
        parts = {
            (chain[first][1], chain[first + length - 1][2])
            for chain in links
            for first in range(len(chain) - length + 1)
        }
        found = sorted(part for part in parts if _is_fit(file, out, part, fits))
        if found:
            return list(found)
    return []


def _is_fit(file: Path, out: Path, chain: tuple[str | None, str], fits: Callable[[RobotConfig], object]) -> bool:
    try:
        fits(_of_chain(file, out, *chain).robot)
    except ArmidentError:
        return False
    return True


def _of_chain(file: Path, out: Path, base: str | None, tip: str | None) -> Geometry:
    part_file = file.resolve()
    part = UrdfSource(file=str(part_file), base=base, tip=tip)
    made = geometry_from_urdf(UrdfGeometry(urdf=part), out / "robot.yaml")
    urdf = {"file": os.path.relpath(part.file, out.resolve()), **part.model_dump(exclude={"file"}, exclude_none=True)}
    name = name_from(read_tree(file).name or file.stem)
    robot = checked_robot({"schema": "armident/robot/1", "name": name, **made}, str(file))
    robot = robot.with_urdf_facts(limit_places(file, [joint.source_name or joint.name for joint in robot.joints]))
    content: dict[str, Any] = {
        "schema": "armident/robot/1",
        "name": name,
        "urdf": urdf,
        "joints": [{"name": joint.source_name or joint.name} for joint in robot.joints],
    }
    ends = " ".join(f"{word} link {link}" for word, link in (("from", base), ("up to", tip)) if link is not None)
    if base is not None:
        down = orientation(part_file, base).T @ UPRIGHT
        content["gravity"] = [float(f"{g:.9g}") + 0.0 for g in np.where(np.abs(down) < 1e-9, 0.0, down)]
    notes = [f"chain {ends}"] if ends else []
    held = held_joints(part_file, base, tip)
    if held:
        notes.append(f"load of the last joint, all at zero: what {', '.join(held)} move")
    if base is not None:
        notes.append(f"gravity is that of an upright root of the URDF with the joints before link {base} at zero")
    coarse = sorted(coarse_right_angles(part_file))
    if coarse:
        notes.append(f"angles {', '.join(coarse)} of the URDF are rounded right angles and taken as such")
    return Geometry(file.name, content, robot, tuple(notes))


def of_rows(source: str, name: str, rows: list[tuple[str, str, Mdh]]) -> Geometry:
    """Geometry of modified Denavit-Hartenberg rows (name, type, parameters) of the joints, base to tip."""
    names = joint_names([joint for joint, _, _ in rows], Path(source))
    content = {
        "schema": "armident/robot/1",
        "name": name,
        "joints": [
            {"name": joint, "type": kind, "mdh": mdh.model_dump()}
            for joint, (_, kind, mdh) in zip(names, rows, strict=True)
        ],
    }
    return Geometry(source, content, checked_robot(content, source))


def of_axes(count: int) -> Geometry:
    """Geometry that is not known yet: joints with blank parameters. Raises ConfigError if there is none."""
    if count < 1:
        raise ConfigError(f"--axes: expected the number of joints, found {count}")
    content = {
        "schema": "armident/robot/1",
        "name": "arm",
        "joints": [{"name": f"joint_{k}", "type": "revolute", "mdh": MARK} for k in range(1, count + 1)],
    }
    robot, blanks = without_marks(content)
    return Geometry("a number of joints", content, RobotConfig.model_validate({**robot, "blanks": blanks}))


def name_from(text: str) -> str:
    """Name of a robot or cell: lower-case letters, digits and underscores, beginning with a letter."""
    plain = re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_")[:60]
    return plain if plain and plain[0].isalpha() else f"arm_{plain}".rstrip("_")
