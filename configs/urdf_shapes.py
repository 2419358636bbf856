"""Shapes of the links of a robot from URDF, in the frames of the identified model."""

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote, urlsplit

import numpy as np

from armident.arrays import Array
from armident.configs.errors import ConfigError
from armident.configs.schema.collision import BASE
from armident.configs.urdf import joint_names, link_placements, mdh_of
from armident.configs.urdf_element import words
from armident.configs.urdf_inertials import carried_links
from armident.configs.urdf_tree import UrdfTree, read_chain, read_tree
from armident.configs.yaml_loader import is_file


@dataclass(frozen=True, eq=False)
class UrdfShape:
    """One shape of a link, named by its joint (or ``base``); ``placement``: in frame j of the link (4, 4).

    ``size``: edges of a box, radius and length of a cylinder, or radius of a sphere, m; scale of a mesh.
    """

    link: str
    placement: Array
    kind: str
    size: tuple[float, ...]
    mesh: Path | None = None


@dataclass(frozen=True, eq=False)
class UrdfShapes:
    """Shapes of the links of a chain: ``collision``, else ``visual`` ones; ``missing``: mesh files with their links."""

    shapes: tuple[UrdfShape, ...]
    missing: tuple[str, ...]


def read_shapes(file: Path, base: str | None = None, tip: str | None = None) -> UrdfShapes:
    """Shapes of the links between two links of a URDF, each with those fixed to it; ConfigError if one is wrong."""
    joints = read_chain(file, base, tip)
    given = [joint.name for joint in joints]
    names = joint_names(given, file)
    placements = link_placements(joints, names, mdh_of(joints, file))
    tree = read_tree(file)
    first, _ = tree.path(base, tip)
    # Placements in the base link of the links as they stand with all variables at zero.
    stands = {BASE: np.eye(4)} | {name: joint.placement for name, joint in zip(names, joints, strict=True)}
    shapes: list[UrdfShape] = []
    missing: list[str] = []
    for link, owner, frame, _ in [(first, -1, np.eye(4), None), *carried_links(tree, first, given)]:
        name = BASE if owner < 0 else names[owner]
        own = placements[name] @ np.linalg.solve(stands[name], frame)
        for shape in _shapes_of(tree, tree.links[link], name, own):
            if shape.mesh is not None and not is_file(shape.mesh):
                missing.append(f"{shape.mesh.name} of link {link}")
            else:
                shapes.append(shape)
    return UrdfShapes(tuple(shapes), tuple(missing))


def _shapes_of(tree: UrdfTree, link: ET.Element, name: str, frame: Array) -> Iterator[UrdfShape]:
    """Shapes of one link element whose frame is given in frame j."""
    for element in link.findall("collision") or link.findall("visual"):
        geometry = element.find("geometry")
        found = None if geometry is None else next(iter(geometry), None)
        if found is None:
            continue
        placement = frame @ tree.origin(link, element.find("origin"))
        if found.tag == "mesh":
            scale = tuple(float(w) for w in words(tree.file, link, found, "scale", default="1 1 1"))
            yield UrdfShape(name, placement, "mesh", scale, _mesh_file(tree.file, found.get("filename", "")))
        elif found.tag in ("box", "cylinder", "sphere"):
            yield UrdfShape(name, placement, found.tag, _size(tree, link, found))


def _size(tree: UrdfTree, link: ET.Element, found: ET.Element) -> tuple[float, ...]:
    keys = {"box": (("size", 3),), "cylinder": (("radius", 1), ("length", 1)), "sphere": (("radius", 1),)}[found.tag]
    numbers = [w for key, count in keys for w in words(tree.file, link, found, key, count=count, default=None)]
    size = tuple(float(number) for number in numbers)
    if min(size) < 0.0:
        raise ConfigError(f"{tree.file}: link {link.get('name')!r}: {found.tag}: expected positive lengths")
    return size


def _mesh_file(urdf: Path, name: str) -> Path:
    """Path of a mesh, which may not exist: relative to the URDF, or in a package above or beside its folders."""
    parts = urlsplit(name)
    if parts.scheme == "file":
        return Path(unquote(parts.path))
    if parts.scheme not in ("package", "model"):
        return urdf.resolve().parent / name
    inside = unquote(parts.path).lstrip("/")
    for folder in urdf.resolve().parents:
        for candidate in (folder / inside if folder.name == parts.netloc else None, folder / parts.netloc / inside):
            if candidate is not None and is_file(candidate):
                return candidate
    return urdf.resolve().parent / inside
