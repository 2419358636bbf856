"""Geometry of a robot from URDF: the chain from base to tip as modified Denavit-Hartenberg parameters.

Only origins, axes, types and limits of the joints are read. Masses, meshes and transmissions are ignored, because the
dynamics are identified.
"""

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from decimal import Decimal, InvalidOperation
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armident.configs.errors import ConfigError
from armident.configs.mdh import MdhChain, modified_dh
from armident.configs.schema.base import FrozenModel
from armident.configs.schema.robot import Drive, Positive
from armident.configs.yaml_loader import is_file

MOVING = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}
"""Joint type of the model by URDF joint type; a chain may have these and ``fixed``."""

ENDLESS = (-2.0 * math.pi, 2.0 * math.pi)
"""Position limits (rad) of a continuous joint if the configuration gives none."""

WRITTEN_DECIMALS = 4
"""Minimum number of decimals of an angle that is rounded to the multiple of 15 degrees with the same decimals."""

LONGEST = 500
"""Maximum length of an attribute in characters; longer ones are refused."""

LARGEST = 1e9
"""Largest magnitude of a number in a URDF, SI units; larger ones are refused."""

Floats = NDArray[np.float64]


class UrdfSource(FrozenModel):
    """Part of a URDF file to read.

    Parameters
    ----------
    file
        Path relative to the configuration.
    base
        First link of the chain; ``None``: the root of the tree.
    tip
        Last link of the chain; ``None``: the chain ends with its last moving joint.
    """

    file: str
    base: str | None = None
    tip: str | None = None


class LimitsGiven(FrozenModel):
    """Limits that replace those of the URDF or add to them; URDF has no limit of acceleration.

    Parameters
    ----------
    position
        Lower and upper limit, rad or m.
    velocity, acceleration
        Largest magnitudes, rad or m, per s and per s^2.
    torque
        Largest magnitude, N m or N.
    """

    position: tuple[float, float] | None = None
    velocity: Positive | None = None
    acceleration: Positive | None = None
    torque: Positive | None = None


class JointGiven(FrozenModel):
    """Additions of a configuration to a joint of the URDF.

    Parameters
    ----------
    name
        Name of the joint in the URDF.
    limits
        Limits that replace those of the URDF or add to them.
    drive, rotor_inertia
        As in `armident.configs.schema.robot.Joint`.
    """

    name: str
    limits: LimitsGiven = LimitsGiven()
    drive: Drive | None = None
    rotor_inertia: bool | None = None


class UrdfGeometry(FrozenModel):
    """Keys of a robot configuration that are combined with a URDF.

    Parameters
    ----------
    urdf
        Part of the URDF to read.
    joints
        Additions to its joints.
    gravity
        Acceleration of gravity in the frame of the base link, m/s^2.
    """

    urdf: UrdfSource
    joints: tuple[JointGiven, ...] = ()
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)


@dataclass(frozen=True)
class UrdfJoint:
    """A moving joint of a chain.

    Parameters
    ----------
    name, type
        As in the file.
    placement
        Frame of the joint, and of the link it moves, in the base link with all variables zero, shape (4, 4).
    axis
        Unit vector in that frame, shape (3,).
    limits
        Limits of the file: ``position`` (rad or m), ``velocity`` (rad/s or m/s), ``torque`` (N m or N).
    """

    name: str
    type: str
    placement: Floats
    axis: Floats
    limits: Mapping[str, Any] = field(default_factory=dict)


def geometry_from_urdf(given: UrdfGeometry, where: Path) -> dict[str, Any]:
    """Convert the geometry of a URDF to ``joints`` and ``gravity`` of a robot configuration.

    Parameters
    ----------
    given
        Keys of the robot configuration that are combined with the URDF.
    where
        Path of the robot configuration.

    Returns
    -------
    dict
        Plain values: ``joints`` with ``mdh``, and ``gravity`` in frame 0 of the chain.

    Raises
    ------
    ConfigError
        If the URDF is wrong or not a serial chain (names file and element), or if a limit is missing in both files.
    """
    file = where.resolve().parent / given.urdf.file
    if not is_file(file):
        raise ConfigError(f"{where}: urdf.file: no such file {given.urdf.file} (looked for {file})")
    joints = read_chain(file, given.urdf.base, given.urdf.tip)
    chain = mdh_of(joints, file)
    named = {joint_name(joint.name): joint for joint in joints}
    if len(named) < len(joints):
        raise ConfigError(
            f"{file}: joint names differ only in case or punctuation: {', '.join(j.name for j in joints)}"
        )
    extra: dict[str, JointGiven] = {}
    for k, more in enumerate(given.joints):
        name = joint_name(more.name)
        if name not in named:
            found = ", ".join(j.name for j in joints)
            raise ConfigError(f"{where}: joints[{k}].name: the chain has no joint {more.name!r}; it has {found}")
        if name in extra:
            raise ConfigError(f"{where}: joints[{k}].name: {more.name!r} is there twice")
        extra[name] = more
    plain = []
    for (name, joint), mdh in zip(named.items(), chain.parameters, strict=True):
        more = extra.get(name, JointGiven(name=name))
        limits = dict(joint.limits) | more.limits.model_dump(exclude_none=True)
        for quantity in LimitsGiven.model_fields:
            if quantity not in limits:
                raise ConfigError(f"{where}: joints: {joint.name}: limits.{quantity}: not in {file.name}, say it here")
        settings = more.model_dump(include={"drive", "rotor_inertia"}, exclude_none=True)
        if joint.name != name:
            settings["source_name"] = joint.name
        plain.append({"name": name, "type": MOVING[joint.type], "mdh": mdh.model_dump(), "limits": limits} | settings)
    gravity = chain.base[:3, :3].T @ np.array(given.gravity)
    return {"joints": plain, "gravity": [float(g) for g in np.where(np.abs(gravity) < 1e-14, 0.0, gravity)]}


def joint_name(name: str) -> str:
    """Name of a joint in a configuration: lower case, with other characters than letters and digits as underscores.

    Parameters
    ----------
    name
        Name of the joint in the URDF.
    """
    plain = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")
    return plain if plain[:1].isalpha() else f"joint_{plain}"


def mdh_of(joints: tuple[UrdfJoint, ...], file: Path) -> MdhChain:
    """Modified Denavit-Hartenberg parameters of a chain, with frames in the base link.

    Parameters
    ----------
    joints
        Moving joints from base to tip.
    file
        Path of the URDF for messages.

    Raises
    ------
    ConfigError
        If two axes are nearly parallel; names ``file`` and joints.
    """
    axes = np.array([joint.placement[:3, :3] @ joint.axis for joint in joints])
    try:
        return modified_dh(axes, np.array([joint.placement[:3, 3] for joint in joints]), [j.name for j in joints])
    except ConfigError as error:
        raise ConfigError(f"{file}: {error}") from error


def read_chain(file: Path, base: str | None = None, tip: str | None = None) -> tuple[UrdfJoint, ...]:
    """Moving joints between two links of a URDF, with fixed joints merged into the placements.

    Side branches that cannot move belong to the link they are fixed to. Branches at the base are ignored, and links
    after the tip are its load.

    Parameters
    ----------
    file
        Path of the URDF.
    base
        First link of the chain; ``None``: the root of the tree.
    tip
        Last link of the chain; ``None``: the chain ends with its last moving joint.

    Raises
    ------
    ConfigError
        If the file is not a URDF or not a tree, if the chain branches, or if a joint is not of a serial chain.
        Names file and element.
    """
    tree = _read_tree(file)
    base = tree.root() if base is None else tree.known(base, "urdf.base")
    path = tree.path_to(base, tree.known(tip, "urdf.tip")) if tip is not None else list(tree.only_way(base))
    placement, chain = np.eye(4), []
    for element in path:
        placement = placement @ tree.origin(element)
        if tree.type_of(element) != "fixed":
            chain.append(tree.moving_joint(element, placement))
    if not chain:
        raise ConfigError(f"{file}: no joint moves between link {base!r} and {'its end' if tip is None else repr(tip)}")
    return tuple(chain)


@dataclass(frozen=True)
class _Tree:
    """Joint elements by child link (``above``) and by parent link (``below``)."""

    file: Path
    links: frozenset[str]
    above: Mapping[str, ET.Element]
    below: Mapping[str, list[ET.Element]]

    def known(self, link: str, key: str) -> str:
        """Return the name of a link that the file contains.

        Parameters
        ----------
        link
            Name of the link.
        key
            Key of the configuration that names the link, for messages.

        Raises
        ------
        ConfigError
            If the file has no such link.
        """
        if link not in self.links:
            raise ConfigError(f"{self.file}: no link {link!r} ({key}); links are {', '.join(sorted(self.links))}")
        return link

    def root(self) -> str:
        """Return the only link that no joint moves."""
        roots = sorted(self.links - self.above.keys())
        if len(roots) != 1:
            found = f"{len(roots)} ({', '.join(roots)})" if roots else "none: the joints form a loop"
            raise ConfigError(f"{self.file}: expected one link that no joint moves, found {found}")
        return roots[0]

    def path_to(self, base: str, tip: str) -> list[ET.Element]:
        """Joints from base to tip; branches that move are refused on the way.

        Parameters
        ----------
        base, tip
            First and last link of the chain.

        Raises
        ------
        ConfigError
            If the base does not move the tip, or a second moving joint branches off.
        """
        path: list[ET.Element] = []
        link = tip
        while link != base:
            element = self.above.get(link)
            if element is None:
                raise ConfigError(f"{self.file}: link {tip!r} (urdf.tip) is not moved by link {base!r}")
            path.insert(0, element)
            link = _end(element, "parent")
        carried = False
        for element, following in pairwise(path):
            carried = carried or self.type_of(element) != "fixed"
            link = _end(element, "child")
            if carried:
                self._refuse_branch(link, [following, *(j for j in self.below[link] if j is not following)])
        return path

    def only_way(self, base: str) -> Iterator[ET.Element]:
        """Joints from base to the last that moves."""
        link = base
        while True:
            ways = [element for element in self.below.get(link, []) if self._moves(element)]
            if not ways:
                return
            self._refuse_branch(link, ways)
            yield ways[0]
            link = _end(ways[0], "child")

    def _refuse_branch(self, link: str, joints: list[ET.Element]) -> None:
        """Refuse a second moving joint or subtree at a link; the first one given is the chain's."""
        others = [element for element in joints[1:] if self._moves(element)]
        if others:
            names = " and ".join(repr(element.get("name")) for element in [joints[0], *others])
            raise ConfigError(
                f"{self.file}: link {link!r} branches into joints {names}; only serial chains can be identified "
                "(urdf.base and urdf.tip choose a part)"
            )

    def _moves(self, element: ET.Element) -> bool:
        """Return True if this joint or any joint after it moves."""
        return self.type_of(element) != "fixed" or any(
            self._moves(after) for after in self.below.get(_end(element, "child"), [])
        )

    def type_of(self, element: ET.Element) -> str:
        """Return the URDF type of a joint."""
        return element.get("type", "")

    def origin(self, element: ET.Element) -> Floats:
        """Placement of a joint in its parent link, homogeneous, shape (4, 4)."""
        found = element.find("origin")
        frame = np.eye(4)
        if found is not None:
            frame[:3, :3] = rotation(*(_angle(w) for w in self._words(element, found, "rpy")))
            frame[:3, 3] = [float(w) for w in self._words(element, found, "xyz")]
        return frame

    def moving_joint(self, element: ET.Element, placement: Floats) -> UrdfJoint:
        """Return a moving joint of the chain.

        Parameters
        ----------
        element
            Element of the joint.
        placement
            Frame of the joint in the base link with all variables zero, shape (4, 4).

        Raises
        ------
        ConfigError
            If the joint is of another type, follows another joint, or has no usable axis.
        """
        where = f"{self.file}: joint {element.get('name')!r}"
        kind = self.type_of(element)
        if kind not in MOVING:
            raise ConfigError(f"{where}: type {kind!r} cannot be identified; expected {', '.join(MOVING)} or fixed")
        if element.find("mimic") is not None:
            raise ConfigError(f"{where}: follows another joint (mimic), which a serial chain does not")
        found = element.find("axis")
        axis = np.array([1.0, 0.0, 0.0])
        if found is not None:
            axis = np.array([float(w) for w in self._words(element, found, "xyz", default=None)])
        length = float(np.linalg.norm(axis))
        if not length > 0.0:
            raise ConfigError(f"{where}: axis: expected a direction, found 0 0 0")
        return UrdfJoint(str(element.get("name")), kind, placement, axis / length, self._limits(element))

    def _limits(self, element: ET.Element) -> dict[str, Any]:
        """Limits of the file; zero velocities and efforts are placeholders."""
        limits: dict[str, Any] = {}
        found = element.find("limit")
        values = {
            key: float(self._words(element, found, key, count=1)[0])
            for key in ("lower", "upper", "velocity", "effort")
            if found is not None and found.get(key) is not None
        }
        if self.type_of(element) == "continuous":
            limits["position"] = ENDLESS
        elif values.get("lower", 0.0) != values.get("upper", 0.0):
            limits["position"] = (values.get("lower", 0.0), values.get("upper", 0.0))
        for key, quantity in (("velocity", "velocity"), ("effort", "torque")):
            if values.get(key, 0.0) > 0.0:
                limits[quantity] = values[key]
        return limits

    def _words(
        self, element: ET.Element, child: ET.Element, key: str, *, count: int = 3, default: str | None = "0 0 0"
    ) -> list[str]:
        """Finite numbers of an attribute, as written."""
        text = child.get(key, default)
        words = (text or "").split()
        if len(words) != count or not all(_is_finite(word) for word in words):
            expected = "a number" if count == 1 else f"{count} numbers"
            hint = "; expand the xacro first" if "$" in (text or "") else ""
            where = f"{self.file}: joint {element.get('name')!r}: {child.tag} {key}"
            raise ConfigError(f"{where}: expected {expected}, found {text!r:.80}{hint}")
        return words


def _read_tree(file: Path) -> _Tree:
    try:
        root = ET.parse(file).getroot()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file}: cannot be read: {error}") from error
    except (ET.ParseError, LookupError, ValueError) as error:
        raise ConfigError(f"{file}: not valid XML: {error}") from error
    for element in root.iter():
        for key, value in element.items():
            if len(value) > LONGEST:
                raise ConfigError(f"{file}: {element.tag:.40} {key:.40}: {len(value)} characters, expected {LONGEST}")
    if root.tag != "robot":
        raise ConfigError(f"{file}: expected a URDF with the root element robot, found {root.tag:.40}")
    links = frozenset(str(link.get("name")) for link in root.findall("link"))
    above: dict[str, ET.Element] = {}
    below: dict[str, list[ET.Element]] = {}
    names: set[str] = set()
    for k, element in enumerate(root.findall("joint"), start=1):
        name = element.get("name")
        if not name:
            raise ConfigError(f"{file}: joint number {k}: has no name")
        if name in names:
            raise ConfigError(f"{file}: joint {name!r}: there are two of this name")
        names.add(name)
        for end in ("parent", "child"):
            if _end(element, end) not in links:
                raise ConfigError(f"{file}: joint {name!r}: {end}: no link {_end(element, end)!r}")
        child = _end(element, "child")
        if child in above:
            raise ConfigError(
                f"{file}: link {child!r} is moved by two joints, {above[child].get('name')!r} and {name!r}"
            )
        above[child] = element
        below.setdefault(_end(element, "parent"), []).append(element)
    tree = _Tree(file, links, above, below)
    reached = [tree.root()]
    for link in reached:
        reached += [_end(element, "child") for element in below.get(link, [])]
    if len(reached) < len(links):
        raise ConfigError(f"{file}: links {', '.join(sorted(links - set(reached)))} form a loop")
    return tree


def rotation(roll: float, pitch: float, yaw: float) -> Floats:
    """Rotation matrix of URDF's fixed-axis angles, exact for right angles: ``Rot(z, y) Rot(y, p) Rot(x, r)``.

    Parameters
    ----------
    roll, pitch, yaw
        Angles, rad.

    Returns
    -------
    ndarray
        Rotation matrix, shape (3, 3).
    """
    (cr, sr), (cp, sp), (cy, sy) = (_cos_sin(angle) for angle in (roll, pitch, yaw))
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    about_y = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    about_z = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    matrix: Floats = about_z @ about_y @ about_x
    return matrix


def _cos_sin(angle: float) -> tuple[float, float]:
    c, s = math.cos(angle), math.sin(angle)
    return (float(round(c)), float(round(s))) if min(abs(c), abs(s)) < 1e-15 else (c, s)


def _angle(word: str) -> float:
    """Angle (rad) as written, or the multiple of 15 degrees of which it is a rounded or truncated value."""
    value = float(word)
    multiple = round(value / (math.pi / 12)) * (math.pi / 12)
    exponent = Decimal(word).as_tuple().exponent
    if isinstance(exponent, int) and exponent <= -WRITTEN_DECIMALS and abs(value - multiple) < 10.0**exponent:
        return multiple
    return value


def _is_finite(word: str) -> bool:
    try:
        return abs(Decimal(word)) <= LARGEST
    except InvalidOperation:
        return False


def _end(element: ET.Element, end: str) -> str:
    """Name of the ``parent`` or ``child`` link of a joint; empty if it has none."""
    found = element.find(end)
    return "" if found is None else found.get("link", "")
