"""Geometry of a robot from URDF: the chain from base to tip as modified Denavit-Hartenberg parameters.

Masses are ignored, because the dynamics are identified; only the virtual arm reads them (`urdf_inertials`).
"""

import re
import unicodedata
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ConfigDict

from armident.arrays import Array
from armident.configs.errors import ConfigError
from armident.configs.mdh import MdhChain, modified_dh
from armident.configs.schema.base import FrozenModel
from armident.configs.schema.collision import BASE, Box, Collision, LinkCapsule
from armident.configs.schema.limits import Positive
from armident.configs.schema.robot import Drive
from armident.configs.urdf_origin import fixed_axis_angles, rotation
from armident.configs.urdf_tree import MOVING, UrdfJoint, read_chain
from armident.configs.yaml_loader import is_file


class UrdfSource(FrozenModel):
    """Part of a URDF file; ``base``, ``tip``: links of the chain, ``None``: root of the tree, last moving joint."""

    file: str
    base: str | None = None
    tip: str | None = None


class LimitsGiven(FrozenModel):
    """Limits, SI, that replace those of the URDF or add to them; URDF has no limit of acceleration.

    None is needed to learn from a recording; an arm that is to be moved needs all of them.
    """

    model_config = ConfigDict(allow_inf_nan=True)

    position: tuple[float, float] | None = None
    velocity: Positive | None = None
    acceleration: Positive | None = None
    torque: Positive | None = None


class JointGiven(FrozenModel):
    """Additions to a joint of the URDF; ``name``: that in the URDF, or as in the configuration (see `joint_name`)."""

    name: str
    limits: LimitsGiven = LimitsGiven()
    drive: Drive | None = None
    rotor_inertia: bool | None = None


class UrdfGeometry(FrozenModel):
    """Keys combined with a URDF; ``gravity``, m/s^2, and boxes in that of the base link, capsules in the links'."""

    urdf: UrdfSource
    joints: tuple[JointGiven, ...] = ()
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    collision: Collision | None = None


def geometry_from_urdf(given: UrdfGeometry, where: Path) -> dict[str, Any]:
    """Convert a URDF to ``joints``, ``gravity`` and ``collision`` of a configuration; ConfigError if it is wrong."""
    file = urdf_file(given, where)
    joints = read_chain(file, given.urdf.base, given.urdf.tip)
    chain = mdh_of(joints, file)
    names = joint_names([joint.name for joint in joints], file)
    extra = _additions(given, joints, names, where)
    plain = []
    for name, joint, mdh in zip(names, joints, chain.parameters, strict=True):
        more = extra.get(name, JointGiven(name=name))
        limits = dict(joint.limits) | more.limits.model_dump(exclude_none=True)
        settings = more.model_dump(include={"drive", "rotor_inertia"}, exclude_none=True, exclude_unset=True)
        settings |= {"source_name": joint.name} if joint.name != name else {}
        plain.append({"name": name, "type": MOVING[joint.type], "mdh": mdh.model_dump(), "limits": limits} | settings)
    gravity = chain.base[:3, :3].T @ np.array(given.gravity)
    bodies = {}
    if given.collision is not None:
        frames = link_placements(joints, names, chain)
        bodies["collision"] = _in_frames_of_the_chain(given.collision, frames, where).model_dump()
    return {"joints": plain, "gravity": [float(g) for g in np.where(np.abs(gravity) < 1e-14, 0.0, gravity)]} | bodies


def link_placements(joints: tuple[UrdfJoint, ...], names: list[str], chain: MdhChain) -> dict[str, Array]:
    """Frames (4, 4) of the moved links of a URDF, and of its base link, in the frames of the chain, by link."""
    moved = zip(names, chain.frames, joints, strict=True)
    base: dict[str, Array] = {BASE: np.asarray(np.linalg.inv(chain.base))}
    return base | {name: np.asarray(np.linalg.solve(frame, joint.placement)) for name, frame, joint in moved}


def _in_frames_of_the_chain(given: Collision, frames: dict[str, Array], where: Path) -> Collision:
    """Bodies with boxes in frame 0 and capsules in frames j."""
    boxes, capsules = [], []
    for box in given.boxes:
        turn = frames[BASE][:3, :3] @ rotation(*box.rpy)
        center, rpy = _point(frames[BASE], box.center), fixed_axis_angles(turn)
        boxes.append(Box(name=box.name, center=center, size=box.size, rpy=rpy))
    for capsule in given.capsules:
        if capsule.link not in frames:
            raise ConfigError(f"{where}: collision: no link {capsule.link!r}; links are {', '.join(frames)}")
        start, end = (_point(frames[capsule.link], point) for point in (capsule.start, capsule.end))
        capsules.append(LinkCapsule(link=capsule.link, start=start, end=end, radius=capsule.radius))
    return given.model_copy(update={"boxes": tuple(boxes), "capsules": tuple(capsules)})


def _point(frame: Array, point: tuple[float, float, float]) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in frame[:3, :3] @ point + frame[:3, 3])
    return x, y, z


def urdf_file(given: UrdfGeometry, where: Path) -> Path:
    """Path of the URDF of a robot configuration; raises ConfigError if there is no such file."""
    file = where.resolve().parent / given.urdf.file
    if not is_file(file):
        raise ConfigError(f"{where}: urdf.file: no such file {given.urdf.file!s:.400} (looked for {file!s:.400})")
    return file


def _additions(
    given: UrdfGeometry, joints: tuple[UrdfJoint, ...], names: list[str], where: Path
) -> dict[str, JointGiven]:
    """Additions of the configuration by name of the joint; ConfigError if a joint is unknown or a duplicate."""
    known = {joint_name(name).lower(): name for name in names}
    known |= {joint.name: name for joint, name in zip(joints, names, strict=True)}
    extra: dict[str, JointGiven] = {}
    for k, more in enumerate(given.joints):
        found = known.get(more.name, known.get(joint_name(more.name).lower()))
        if found is None:
            listed = ", ".join(joint.name for joint in joints)
            raise ConfigError(f"{where}: joints[{k}].name: the chain has no joint {more.name!r}; it has {listed}")
        if found in extra:
            raise ConfigError(f"{where}: joints[{k}].name: duplicate joint {more.name!r}")
        extra[found] = more
    return extra


def joint_names(names: list[str], file: Path) -> list[str]:
    """Names of joints in Latin letters, else ``joint_1``, ...; ConfigError if only case or punctuation differs."""
    plain = [joint_name(name) for name in names]
    for k, name in enumerate(names):
        twins = [other for other in plain if other.lower() == plain[k].lower()]
        if not plain[k] or (len(twins) > 1 and not name.isascii()):
            plain[k] = f"joint_{k + 1}"
    lower = [name.lower() for name in plain]
    if twins := [f"{name:.60}" for name, key in zip(names, lower, strict=True) if lower.count(key) > 1]:
        raise ConfigError(f"{file}: joint names differ only in case or punctuation: {', '.join(twins[:10])}")
    return plain


def joint_name(name: str) -> str:
    """Name of a joint in a configuration: letters without accents, digits and underscores of that in the URDF."""
    letters = "".join(c for c in unicodedata.normalize("NFKD", name) if not unicodedata.combining(c))
    plain = re.sub(r"[^A-Za-z0-9]+", "_", letters).strip("_")
    return plain if not plain or plain[0].isalpha() else f"joint_{plain}"


def mdh_of(joints: tuple[UrdfJoint, ...], file: Path) -> MdhChain:
    """MDH parameters of a chain, with frames in the base link; raises ConfigError if two axes are nearly parallel."""
    axes = np.array([joint.placement[:3, :3] @ joint.axis for joint in joints])
    try:
        return modified_dh(axes, np.array([joint.placement[:3, 3] for joint in joints]), [j.name for j in joints])
    except ConfigError as error:
        raise ConfigError(f"{file}: {error}") from error
