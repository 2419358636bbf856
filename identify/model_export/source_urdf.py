"""The URDF that a robot configuration comes from: its link frames, and its elements."""

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from armident.configs import ConfigError, RobotConfig
from armident.configs.loading import config_path
from armident.configs.mdh import PARALLEL
from armident.configs.urdf import UrdfSource, joint_name, mdh_of
from armident.configs.urdf_inertials import INERTIAL, read_inertials
from armident.configs.urdf_tree import MOVING, UrdfJoint, read_chain
from armident.configs.yaml_loader import read_yaml
from armident.identify.model_export.link_frames import LinkFrames, mdh_transform
from armident.identify.robot.arm import ArmModel
from armident.identify.robot.chain import Floats

SAME_GEOMETRY = 1e-5
"""Largest difference of the same joint axis in two descriptions, rad and m: rounding to five digits."""


@dataclass(frozen=True)
class SourceUrdf:
    """URDF and the identified chain in it; ``base`` ``None``: the root; ``tip`` ``None``: the last link that moves."""

    file: Path
    base: str | None = None
    tip: str | None = None

    def root(self) -> ET.Element:
        """Return the root element with the comments of the file."""
        return ET.parse(self.file, ET.XMLParser(target=ET.TreeBuilder(insert_comments=True))).getroot()


def source_of(robot: str | Path) -> SourceUrdf | None:
    """Return the URDF that a loaded robot configuration (path or shipped name) names, if any."""
    path = config_path(robot)
    data = read_yaml(path.read_text(encoding="utf-8"), str(path))
    if not isinstance(data, dict) or "urdf" not in data:
        return None
    part = UrdfSource.model_validate(data["urdf"])
    return SourceUrdf(path.resolve().parent / part.file, part.base, part.tip)


def source_for(robot: RobotConfig, file: Path) -> SourceUrdf:
    """Return the chain of a URDF that ends with the last joint of a robot; ConfigError if it has no such joint."""
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
    """Return the frames of the URDF's links; frame 0 of the configuration may be anywhere.

    Raises ConfigError if the URDF cannot be read, or its arm differs from that of the configuration.
    """
    joints = read_chain(source.file, source.base, source.tip)
    ours = np.stack(list(accumulate((mdh_transform(joint.mdh) for joint in robot.joints), np.matmul)))
    frame_0 = _frame_0(source, joints, robot, ours)
    root = source.root()
    children = {str(joint.get("name")): joint.find("child") for joint in root.findall("joint")}
    links = tuple(str(child.get("link")) for child in (children[joint.name] for joint in joints) if child is not None)
    absolute = np.stack([joint.placement for joint in joints])
    before = np.concatenate([np.eye(4)[None], absolute[:-1]])
    return LinkFrames(
        base=source.base or _root_link(root),
        links=links,
        joints=tuple(joint.name for joint in joints),
        placements=np.asarray(np.linalg.solve(before, absolute), dtype=np.float64),
        axes=np.stack([joint.axis for joint in joints]),
        from_mdh=np.asarray(np.linalg.solve(absolute, frame_0 @ ours), dtype=np.float64),
        frame_0=frame_0[:3, :3],
        gravity=frame_0[:3, :3] @ np.array(robot.gravity),
        endless=tuple(joint.type == "continuous" for joint in joints),
    )


def known_bodies(source: SourceUrdf, arm: ArmModel, frames: LinkFrames) -> Floats | None:
    """Return the URDF's masses as standard parameters (p,), others zero; ``None`` if a link has no possible mass."""
    try:
        given = read_inertials(source.file, source.base, source.tip)
    except ConfigError:
        return None
    if given.massless or given.impossible:
        return None
    joints = read_chain(source.file, source.base, source.tip)
    theirs = mdh_of(joints, source.file).frames
    known = np.zeros(len(arm.names))
    for k, (joint, columns) in enumerate(zip(joints, arm.columns.inertial, strict=True)):
        xx, xy, xz, yy, yz, zz, mx, my, mz, m = (given.standard[f"{name}{k + 1}"] for name in INERTIAL)
        inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        body = np.zeros((4, 4))
        body[:3, :3] = 0.5 * np.trace(inertia) * np.eye(3) - inertia
        body[:3, 3] = body[3, :3] = mx, my, mz
        body[3, 3] = m
        frame = np.linalg.solve(joint.placement @ frames.from_mdh[k], theirs[k])
        body = frame @ body @ frame.T
        inertia = np.trace(body[:3, :3]) * np.eye(3) - body[:3, :3]
        known[columns] = [*inertia[np.triu_indices(3)], *body[:3, 3], body[3, 3]]
    return known


def _frame_0(source: SourceUrdf, joints: tuple[UrdfJoint, ...], robot: RobotConfig, ours: Floats) -> Floats:
    """Frame 0 (4, 4) of the configuration in the base link by coinciding axes; ConfigError if the arms differ."""
    names = ", ".join(joint.name for joint in joints)
    hint = "give the URDF of this arm, or the configuration that names it with --config"
    if [MOVING[joint.type] for joint in joints] != [joint.type for joint in robot.joints]:
        raise ConfigError(f"{source.file}: its chain has the joints {names}; {robot.name} has {robot.n} others: {hint}")
    chain = mdh_of(joints, source.file)
    if chain.parameters == tuple(joint.mdh for joint in robot.joints):
        return chain.base
    axes, points = chain.frames[:, :3, 2], chain.frames[:, :3, 3]
    revolute = np.array([joint.type == "revolute" for joint in robot.joints])
    placed = _aligned(ours[:, :3, 2], ours[:, :3, 3], axes, points, revolute)
    moved = placed @ ours
    apart = np.where(revolute[:, None], _across(axes, moved[:, :3, 3] - points), 0.0)
    error = np.maximum(np.abs(moved[:, :3, 2] - axes).max(axis=1), np.abs(apart).max(axis=1))
    if error.max() > SAME_GEOMETRY:
        worst = int(np.argmax(error))
        raise ConfigError(
            f"{source.file}: the axis of {joints[worst].name} differs from that in {robot.name} by {error[worst]:.2g} "
            f"(rad or m) at position zero: the model was identified with another geometry; {hint}"
        )
    return placed


def _aligned(axes: Floats, points: Floats, onto: Floats, onto_points: Floats, revolute: NDArray[np.bool_]) -> Floats:
    """Least-squares motion (4, 4) of joint axes (n, 3), each with a point, onto others; prismatic: no point."""
    vectors, images = axes, onto
    if np.linalg.norm(np.cross(axes, axes[0]), axis=1).max() < PARALLEL and revolute.any():
        # Parallel axes leave the angle about them free; the distances of the axes determine it.
        place = int(np.argmax(revolute))
        vectors = np.vstack([axes, _across(axes, points - points[place])[revolute]])
        images = np.vstack([onto, _across(onto, onto_points - onto_points[place])[revolute]])
    # Kabsch 1976, Acta Cryst. A32: the rotation nearest to the correlation of both sets.
    u, _, vt = np.linalg.svd(images.T @ vectors)
    motion = np.eye(4)
    motion[:3, :3] = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    if revolute.any():
        across = np.eye(3) - onto[revolute][:, :, None] * onto[revolute][:, None, :]
        apart = _across(onto, onto_points - points @ motion[:3, :3].T)[revolute]
        motion[:3, 3] = np.linalg.lstsq(across.reshape(-1, 3), apart.ravel(), rcond=None)[0]
    return motion


def _across(axes: Floats, vectors: Floats) -> Floats:
    """Parts of vectors (n, 3) orthogonal to unit vectors (n, 3)."""
    across: Floats = vectors - np.sum(vectors * axes, axis=1)[:, None] * axes
    return across


def _root_link(root: ET.Element) -> str:
    """Return the name of the link that no joint moves."""
    moved = {child.get("link") for child in root.iterfind("joint/child")}
    return next(str(link.get("name")) for link in root.findall("link") if link.get("name") not in moved)
