"""Tree of links and joints of a URDF file, and the chain of moving joints between two links."""

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from armident.arrays import Array
from armident.configs.errors import ConfigError
from armident.configs.suspected_units import FULL_TURN, LONGEST_LINK
from armident.configs.urdf_element import end_link, only, words
from armident.configs.urdf_file import parse_urdf
from armident.configs.urdf_origin import rotation, rotation_of_quaternion, rounded_angle

MOVING = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}
"""Joint type of the model by URDF joint type; a chain may have these and ``fixed``."""

ENDLESS = (-math.inf, math.inf)
"""Position limits of a joint that has none."""

COARSE = 1e-4
"""Rounding of an angle, rad, from which on it is named: four decimals or more are what files usually have."""


@dataclass(frozen=True)
class UrdfJoint:
    """A moving joint of a chain; ``limits``: ``position``, ``velocity``, ``torque``, SI.

    ``placement`` (4, 4): its frame in the base link, all variables zero; ``axis`` (3,): unit vector in that frame.
    """

    name: str
    type: str
    placement: Array
    axis: Array
    limits: Mapping[str, Any] = field(default_factory=dict)


def read_chain(file: Path, base: str | None = None, tip: str | None = None) -> tuple[UrdfJoint, ...]:
    """Moving joints between two links of a URDF, with fixed joints merged into the placements; else ConfigError.

    Fixed side branches belong to their link, links after the tip are its load; branches at the base are ignored.
    """
    tree = read_tree(file)
    base, path = tree.path(base, tip)
    placement, chain = np.eye(4), []
    for element in path:
        placement = placement @ tree.origin(element, only(file, element, "origin"))
        if tree.type_of(element) != "fixed":
            chain.append(tree.moving_joint(element, placement))
    if not chain:
        raise ConfigError(f"{file}: no joint moves between link {base!r} and {'its end' if tip is None else repr(tip)}")
    return tuple(chain)


def serial_tips(file: Path, base: str | None = None) -> dict[str, tuple[str, ...]]:
    """Names of the moving joints to each link at which a serial chain can end: ends of branches, and their forks.

    Chains that cannot be identified are left out, and all but one with the same joints.
    """
    tree = read_tree(file)
    found: dict[str, tuple[str, ...]] = {}
    base = tree.root() if base is None else tree.known(base, "urdf.base")
    todo: list[str] = [base]
    for link in todo:
        ways = [element for element in tree.below.get(link, []) if tree.moves(element)]
        todo += [end_link(element, "child") for element in ways]
        if len(ways) != 1 and link != base:
            with suppress(ConfigError):
                joints = tuple(joint.name for joint in read_chain(file, base, link))
                if joints not in found.values():
                    found[link] = joints
    return found


def moving_links(file: Path, base: str | None) -> list[list[tuple[str, str, str]]]:
    """Name of each moving joint, and the links before and after it, from the base to each end of a branch."""
    tree = read_tree(file)
    ends: list[list[tuple[str, str, str]]] = []
    root = tree.root() if base is None else tree.known(base, "urdf.base")
    todo: list[tuple[str, list[tuple[str, str, str]]]] = [(root, [])]
    for link, path in todo:
        ways = [element for element in tree.below.get(link, []) if tree.moves(element)]
        ends += [] if ways else [path]
        for element in ways:
            joint = (str(element.get("name")), link, end_link(element, "child"))
            todo.append((joint[2], path if tree.type_of(element) == "fixed" else [*path, joint]))
    return ends


def orientation(file: Path, link: str) -> Array:
    """Rotation (3, 3) of a link in the root of a URDF with all joints at zero; raises ConfigError if it is missing."""
    tree = read_tree(file)
    turned = np.eye(3)
    element = tree.above.get(tree.known(link, "urdf.base"))
    while element is not None:
        turned = tree.origin(element, only(file, element, "origin"))[:3, :3] @ turned
        element = tree.above.get(end_link(element, "parent"))
    return turned


def coarse_right_angles(file: Path) -> set[str]:
    """Angles of the joints of a URDF, as written, that are right angles with two or three decimals."""
    found = set()
    for element in read_tree(file).above.values():
        origin = only(file, element, "origin")
        if origin is not None and origin.get("rpy") is not None:
            written = words(file, element, origin, "rpy")
            found |= {word for word in written if abs(rounded_angle(word) - float(word)) > COARSE}
    return found


@dataclass(frozen=True)
class UrdfTree:
    """Links and joints of a URDF; ``above``, ``below``: joint elements by child link, and by parent link."""

    file: Path
    links: Mapping[str, ET.Element]
    above: Mapping[str, ET.Element]
    below: Mapping[str, list[ET.Element]]
    name: str = ""

    def known(self, link: str, key: str) -> str:
        """Return the name of a link of the file; raises ConfigError, with the key that names it, if there is none."""
        if link not in self.links:
            raise ConfigError(f"{self.file}: no link {link!r} ({key}); links are {', '.join(sorted(self.links))}")
        return link

    def root(self) -> str:
        """Return the only link that no joint moves."""
        roots = sorted(self.links.keys() - self.above.keys())
        if len(roots) != 1:
            found = f"{len(roots)} ({', '.join(roots)})" if roots else "none: the joints form a loop"
            raise ConfigError(f"{self.file}: expected one link that no joint moves, found {found}")
        return roots[0]

    def path(self, base: str | None, tip: str | None) -> tuple[str, list[ET.Element]]:
        """First link of a chain, and all its joints, fixed ones included; raises ConfigError if there is none."""
        base = self.root() if base is None else self.known(base, "urdf.base")
        if tip is None:
            return base, list(self.only_way(base))
        return base, self.path_to(base, self.known(tip, "urdf.tip"))

    def path_to(self, base: str, tip: str) -> list[ET.Element]:
        """Joints from base to tip; ConfigError if the base does not move the tip, or a joint branches off between."""
        path: list[ET.Element] = []
        link = tip
        while link != base:
            element = self.above.get(link)
            if element is None:
                raise ConfigError(f"{self.file}: link {tip!r} (urdf.tip) is not moved by link {base!r}")
            path.insert(0, element)
            link = end_link(element, "parent")
        moving = [k for k, element in enumerate(path) if self.type_of(element) != "fixed"]
        # Branches before the first moving joint carry nothing of the chain, those after the last one are its load.
        for following in path[moving[0] + 1 : moving[-1] + 1] if moving else ():
            link = end_link(following, "parent")
            self._refuse_branch(link, [following, *(j for j in self.below[link] if j is not following)])
        return path

    def only_way(self, base: str) -> Iterator[ET.Element]:
        """Joints from base to the last that moves."""
        link = base
        while True:
            ways = [element for element in self.below.get(link, []) if self.moves(element)]
            if not ways:
                return
            self._refuse_branch(link, ways)
            yield ways[0]
            link = end_link(ways[0], "child")

    def _refuse_branch(self, link: str, joints: list[ET.Element]) -> None:
        """Refuse a second moving joint or subtree at a link; the first one given is the chain's."""
        others = [element for element in joints[1:] if self.moves(element)]
        if others:
            names = " and ".join(repr(element.get("name")) for element in [joints[0], *others])
            raise ConfigError(
                f"{self.file}: link {link!r} branches into joints {names}; only serial chains can be identified "
                "(urdf.base and urdf.tip choose a part; joints that stand still can be fixed ones in the URDF)"
            )

    def moves(self, element: ET.Element) -> bool:
        """Return True if this joint or any joint after it moves."""
        return self.type_of(element) != "fixed" or any(
            self.moves(after) for after in self.below.get(end_link(element, "child"), [])
        )

    def type_of(self, element: ET.Element) -> str:
        """Return the URDF type of a joint."""
        return element.get("type", "")

    def origin(self, element: ET.Element, found: ET.Element | None) -> Array:
        """Placement (4, 4) of a joint in its parent link, or of an inertia in its link; ``None``: no offset."""
        frame = np.eye(4)
        if found is not None:
            frame[:3, :3] = self._orientation(element, found)
            frame[:3, 3] = [float(w) for w in words(self.file, element, found, "xyz")]
            self._refuse_millimetres(element, frame[:3, 3])
        return frame

    def _orientation(self, element: ET.Element, origin: ET.Element) -> Array:
        """Rotation of a joint's frame in its parent link, by ``rpy`` or (URDF 1.1) ``quat_xyzw``, shape (3, 3)."""
        where = f"{self.file}: {element.tag} {element.get('name')!r}: origin"
        for key in sorted(set(origin.keys()) - {"xyz", "rpy", "quat_xyzw"}):
            if re.search("quat|rpy|rot|euler", key, re.IGNORECASE):
                raise ConfigError(f"{where}: unknown attribute {key:.40}; expected xyz, and rpy or quat_xyzw")
        if origin.get("quat_xyzw") is None:
            angles = [rounded_angle(w) for w in words(self.file, element, origin, "rpy")]
            if max(abs(angle) for angle in angles) > FULL_TURN:
                raise ConfigError(f"{where} rpy: {origin.get('rpy')!r:.80} looks like degrees; expected rad")
            return rotation(*angles)
        if origin.get("rpy") is not None:
            raise ConfigError(f"{where}: both rpy and quat_xyzw; expected one of them")
        try:
            return rotation_of_quaternion([float(w) for w in words(self.file, element, origin, "quat_xyzw", count=4)])
        except ValueError as error:
            raise ConfigError(f"{where} quat_xyzw: {error}") from error

    def _refuse_millimetres(self, element: ET.Element, xyz: Array) -> None:
        """Refuse a distance between joints that no arm has; the frame of the first joint may be anywhere."""
        farthest = float(np.abs(xyz).max())
        if farthest > LONGEST_LINK and end_link(element, "parent") in self.above:
            where = f"{self.file}: {element.tag} {element.get('name')!r}: origin xyz"
            raise ConfigError(f"{where}: {farthest:g} looks like millimetres; expected m")

    def moving_joint(self, element: ET.Element, placement: Array) -> UrdfJoint:
        """Return a moving joint with its frame (4, 4) in the base link, all variables zero; ConfigError if unusable."""
        where = f"{self.file}: {element.tag} {element.get('name')!r}"
        kind = self.type_of(element)
        if kind not in MOVING:
            raise ConfigError(f"{where}: type {kind!r} cannot be identified; expected {', '.join(MOVING)} or fixed")
        if element.find("mimic") is not None:
            raise ConfigError(f"{where}: follows another joint (mimic), which a serial chain does not")
        found = only(self.file, element, "axis")
        axis = np.array([1.0, 0.0, 0.0])
        if found is not None:
            axis = np.array([float(w) for w in words(self.file, element, found, "xyz", default=None)])
        length = float(np.linalg.norm(axis))
        if not length > 0.0:
            raise ConfigError(f"{where}: axis: expected a direction, found 0 0 0")
        return UrdfJoint(str(element.get("name")), kind, placement, axis / length, self._limits(element))

    def _limits(self, element: ET.Element) -> dict[str, Any]:
        """Limits of the file; zero and negative velocities and efforts are placeholders."""
        limits: dict[str, Any] = {}
        found = only(self.file, element, "limit")
        values = {
            key: self._limit(element, found, key)
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

    def _limit(self, element: ET.Element, found: ET.Element, key: str) -> float:
        """Value of a limit; infinite and huge values are placeholders, which the schema of limits takes as none."""
        text = found.get(key, "").strip()
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if math.isnan(value) or "_" in text:
            words(self.file, element, found, key, count=1)
        return value


def read_tree(file: Path) -> UrdfTree:
    """Links and joints of a URDF file; raises ConfigError, with file and element, unless they are a tree."""
    root = parse_urdf(file)
    if root.tag != "robot":
        raise ConfigError(f"{file}: expected a URDF with the root element robot, found {root.tag:.40}")
    links: dict[str, ET.Element] = {}
    for found in root.findall("link"):
        if links.setdefault(str(found.get("name")), found) is not found:
            raise ConfigError(f"{file}: link {found.get('name')!r}: there are two of this name")
    above: dict[str, ET.Element] = {}
    below: dict[str, list[ET.Element]] = {}
    names: set[str] = set()
    ends: tuple[Literal["parent", "child"], ...] = ("parent", "child")
    for k, element in enumerate(root.findall("joint"), start=1):
        name = element.get("name")
        if not name:
            raise ConfigError(f"{file}: joint number {k}: has no name")
        if name in names:
            raise ConfigError(f"{file}: joint {name!r}: there are two of this name")
        names.add(name)
        for end in ends:
            only(file, element, end)
            if end_link(element, end) not in links:
                raise ConfigError(f"{file}: joint {name!r}: {end}: no link {end_link(element, end)!r}")
        child = end_link(element, "child")
        if child in above:
            raise ConfigError(
                f"{file}: link {child!r} is moved by two joints, {above[child].get('name')!r} and {name!r}"
            )
        above[child] = element
        below.setdefault(end_link(element, "parent"), []).append(element)
    tree = UrdfTree(file, links, above, below, root.get("name", ""))
    reached = [tree.root()]
    for link in reached:
        reached += [end_link(element, "child") for element in below.get(link, [])]
    if len(reached) < len(links):
        raise ConfigError(f"{file}: links {', '.join(sorted(links.keys() - set(reached)))} form a loop")
    return tree
