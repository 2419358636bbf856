"""Masses and friction of a robot from URDF, as standard parameters in the frames of the identified model."""

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from armident.arrays import Array
from armident.configs.errors import ConfigError
from armident.configs.urdf import mdh_of
from armident.configs.urdf_element import end_link, only, words
from armident.configs.urdf_tree import UrdfTree, read_chain, read_tree

INERTIAL = ("xx", "xy", "xz", "yy", "yz", "zz", "mx", "my", "mz", "m")
"""Standard inertial parameters of a link: inertia about the origin of its frame, first moment, mass (thesis 2.1.2)."""

ROUNDING = 0.01
"""Share of a moment of inertia by which rounded numbers may break the triangle inequality: two written digits."""


@dataclass(frozen=True)
class UrdfInertials:
    """Masses and friction of a chain of a URDF; SI, joint side.

    ``standard`` (``xx1`` to ``m6``) is in MDH frames; ``friction`` (``fv1``, ``fc1``) has the positive values. Joints
    ``massless``, from 1, move no mass before the next joint. No body has the moments of ``impossible`` links. Joints
    ``held`` after the tip carry a rigid load. ``of_base``: masses and first moments (``m1``, ``mx1``) if all centres of
    mass of the file are given in the frame of the base link.
    """

    standard: dict[str, float]
    of_base: dict[str, float]
    friction: dict[str, float]
    massless: tuple[int, ...]
    impossible: tuple[str, ...]
    held: tuple[str, ...]


def read_inertials(file: Path, base: str | None = None, tip: str | None = None) -> UrdfInertials:
    """Masses of the links between two links of a URDF, and friction of its joints; errors name file and element."""
    joints = read_chain(file, base, tip)
    frames = mdh_of(joints, file).frames
    tree = read_tree(file)
    first, path = tree.path(base, tip)
    names = [joint.name for joint in joints]
    bodies, moments_of_base = np.zeros((len(joints), 4, 4)), np.zeros((len(joints), 4))
    impossible: list[str] = []
    held: list[str] = []
    for link, owner, placement, held_joint in carried_links(tree, first, names):
        held += [] if held_joint is None else [held_joint]
        if owner < 0:
            continue
        moments, possible = _moments(tree, tree.links[link])
        impossible += [] if possible else [link]
        frame = np.linalg.solve(frames[owner], placement)
        bodies[owner] += frame @ moments @ frame.T
        moments_of_base[owner] += np.linalg.solve(frames[owner], moments[:, 3])
    standard: dict[str, float] = {}
    for k, body in enumerate(bodies, start=1):
        inertia = np.trace(body[:3, :3]) * np.eye(3) - body[:3, :3]
        values = (*inertia[np.triu_indices(3)], *body[:3, 3], body[3, 3])
        standard |= {f"{name}{k}": float(value) for name, value in zip(INERTIAL, values, strict=True)}
    of_base = {
        f"{name}{k}": float(value)
        for k, moments in enumerate(moments_of_base, start=1)
        for name, value in zip(("mx", "my", "mz", "m"), moments, strict=True)
    }
    return UrdfInertials(
        standard=standard,
        of_base=of_base,
        friction=_friction(tree, path, names),
        massless=tuple(k for k, body in enumerate(bodies, start=1) if not body[3, 3] > 0.0),
        impossible=tuple(impossible),
        held=tuple(held),
    )


def held_joints(file: Path, base: str | None = None, tip: str | None = None) -> tuple[str, ...]:
    """Names of the moving joints after a chain of a URDF: what they move is a load, with these joints at zero."""
    tree = read_tree(file)
    links = carried_links(tree, tree.path(base, tip)[0], [joint.name for joint in read_chain(file, base, tip)])
    return tuple(joint for _, _, _, joint in links if joint is not None)


def carried_links(tree: UrdfTree, base: str, chain: list[str]) -> Iterator[tuple[str, int, Array, str | None]]:
    """Links below the base: name, index of the joint that moves it (-1: none), placement, joint that is held still."""
    todo: list[tuple[str, int, Array]] = [(base, -1, np.eye(4))]
    while todo:
        link, owner, placement = todo.pop()
        for element in tree.below.get(link, []):
            name, moves = str(element.get("name")), tree.type_of(element) != "fixed"
            if moves and name not in chain and owner < 0:
                continue  # a branch at the base
            here = chain.index(name) if name in chain else owner
            child, frame = (
                end_link(element, "child"),
                placement @ tree.origin(element, only(tree.file, element, "origin")),
            )
            yield child, here, frame, name if moves and name not in chain else None
            todo.append((child, here, frame))


def _moments(tree: UrdfTree, link: ET.Element) -> tuple[Array, bool]:
    """Pseudo-inertia (4, 4) of a link (Wensing, Kim and Slotine 2018), and False if no body has such moments."""
    inertial = only(tree.file, link, "inertial")
    if inertial is None:
        return np.zeros((4, 4)), True
    where = f"{tree.file}: link {link.get('name')!r}: inertial"
    mass = _number(tree, link, only(tree.file, inertial, "mass", link), "value")
    cells = only(tree.file, inertial, "inertia", link)
    inertia = np.zeros((3, 3))
    for i, j in zip(*np.triu_indices(3), strict=True):
        inertia[i, j] = inertia[j, i] = _number(tree, link, cells, f"i{'xyz'[i]}{'xyz'[j]}")
    smallest = float(np.linalg.eigvalsh(inertia)[0])
    largest = float(np.abs(inertia).max())
    if mass < 0.0 or smallest < -ROUNDING * largest:
        raise ConfigError(f"{where}: mass and moments of inertia must not be negative; correct them in the URDF")
    second = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    frame = tree.origin(link, only(tree.file, inertial, "origin", link))
    body = np.zeros((4, 4))
    body[:3, :3], body[3, 3] = second, mass
    return frame @ body @ frame.T, bool(np.linalg.eigvalsh(second)[0] >= -ROUNDING * largest)


def _number(tree: UrdfTree, link: ET.Element, found: ET.Element | None, key: str) -> float:
    return 0.0 if found is None else float(words(tree.file, link, found, key, count=1, default="0")[0])


def _friction(tree: UrdfTree, path: list[ET.Element], chain: list[str]) -> dict[str, float]:
    """Friction of the moving joints from ``dynamics``; zero and negative values are placeholders."""
    out = {}
    for element in path:
        found = only(tree.file, element, "dynamics")
        if found is None or element.get("name") not in chain:
            continue
        number = chain.index(str(element.get("name"))) + 1
        for name, key in (("fv", "damping"), ("fc", "friction")):
            value = float(words(tree.file, element, found, key, count=1, default="0")[0])
            if value > 0.0:
                out[f"{name}{number}"] = value
    return out
