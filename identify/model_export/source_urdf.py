"""The URDF that a robot configuration comes from: its link frames, and its elements."""

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from armident.configs import ConfigError, RobotConfig
from armident.configs.loading import config_path
from armident.configs.urdf import UrdfSource, joint_name, mdh_of
from armident.configs.urdf_tree import MOVING, UrdfJoint, read_chain
from armident.configs.yaml_loader import read_yaml
from armident.identify.model_export.link_frames import LinkFrames

SAME_GEOMETRY = 1e-6
"""Largest difference of the parameters of the same chain, rad and m; angles written with six digits differ so."""


@dataclass(frozen=True)
class SourceUrdf:
    """URDF of an arm, and the chain in it that was identified.

    Parameters
    ----------
    file
        The URDF.
    base, tip
        First and last link of the chain; ``None``: the root, and the last link that moves.
    """

    file: Path
    base: str | None = None
    tip: str | None = None

    def root(self) -> ET.Element:
        """Return the root element with the comments of the file."""
        return ET.parse(self.file, ET.XMLParser(target=ET.TreeBuilder(insert_comments=True))).getroot()


def source_of(robot: str | Path) -> SourceUrdf | None:
    """Return the URDF that a robot configuration names, ``None`` if it names none.

    Parameters
    ----------
    robot
        Path or shipped name of the configuration; it has been loaded before.
    """
    path = config_path(robot)
    data = read_yaml(path.read_text(encoding="utf-8"), str(path))
    if not isinstance(data, dict) or "urdf" not in data:
        return None
    part = UrdfSource.model_validate(data["urdf"])
    return SourceUrdf(path.resolve().parent / part.file, part.base, part.tip)


def source_for(robot: RobotConfig, file: Path) -> SourceUrdf:
    """Return the chain of a URDF that ends with the last joint of a robot.

    Parameters
    ----------
    robot
        Configuration of the robot.
    file
        The URDF.

    Raises
    ------
    ConfigError
        If there is no such file, or the URDF has no such joint.
    """
    if not file.is_file():
        raise ConfigError(f"--urdf: {file}: no such file")
    last = robot.joints[-1].source_name or robot.joints[-1].name
    try:
        joints = SourceUrdf(file).root().findall("joint")
    except (ET.ParseError, LookupError, ValueError) as error:
        raise ConfigError(f"{file}: not valid XML") from error
    for joint in joints:
        child = joint.find("child")
        if child is not None and last.lower() in (joint.get("name", ""), joint_name(joint.get("name", "")).lower()):
            return SourceUrdf(file, None, child.get("link"))
    named = ", ".join(joint.get("name", "") for joint in joints if joint.get("type") in MOVING)
    raise ConfigError(f"{file}: no joint {last!r}, the last one of {robot.name}; its joints are {named}")


def source_frames(source: SourceUrdf, robot: RobotConfig) -> LinkFrames:
    """Return the frames of the URDF's links.

    Parameters
    ----------
    source
        URDF and chain.
    robot
        Configuration with the geometry of this chain, n joints.

    Raises
    ------
    ConfigError
        If the URDF cannot be read, or has another geometry than the configuration.
    """
    joints = read_chain(source.file, source.base, source.tip)
    chain = mdh_of(joints, source.file)
    _check_geometry(source, joints, robot)
    children = {str(joint.get("name")): joint.find("child") for joint in source.root().findall("joint")}
    links = tuple(str(child.get("link")) for child in (children[joint.name] for joint in joints) if child is not None)
    absolute = np.stack([joint.placement for joint in joints])
    before = np.concatenate([np.eye(4)[None], absolute[:-1]])
    return LinkFrames(
        base=source.base or _root_link(source.root()),
        links=links,
        joints=tuple(joint.name for joint in joints),
        placements=np.asarray(np.linalg.solve(before, absolute), dtype=np.float64),
        axes=np.stack([joint.axis for joint in joints]),
        from_mdh=np.asarray(np.linalg.solve(absolute, chain.frames), dtype=np.float64),
        gravity=chain.base[:3, :3] @ np.array(robot.gravity),
        endless=tuple(joint.type == "continuous" for joint in joints),
    )


def _check_geometry(source: SourceUrdf, joints: tuple[UrdfJoint, ...], robot: RobotConfig) -> None:
    """Refuse a URDF with another geometry than the configuration that was identified."""
    types = [MOVING[joint.type] for joint in joints]
    names = ", ".join(joint.name for joint in joints)
    hint = "give the configuration that names the URDF with --robot"
    if types != [joint.type for joint in robot.joints]:
        raise ConfigError(f"{source.file}: its chain has the joints {names}; {robot.name} has {robot.n} others: {hint}")
    for ours, theirs, name in zip(robot.joints, mdh_of(joints, source.file).parameters, names.split(", "), strict=True):
        for key, value in theirs.model_dump().items():
            if abs(value - getattr(ours.mdh, key)) > SAME_GEOMETRY:
                raise ConfigError(
                    f"{source.file}: joint {name}: {key} is {value:.6g}, in {robot.name} {getattr(ours.mdh, key):.6g}: "
                    f"the model was identified with another geometry; {hint}"
                )


def _root_link(root: ET.Element) -> str:
    """Return the name of the link that no joint moves."""
    moved = {child.get("link") for child in root.iterfind("joint/child")}
    return next(str(link.get("name")) for link in root.findall("link") if link.get("name") not in moved)
