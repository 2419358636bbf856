"""Capsules around the links of an arm, from the shapes of its URDF."""

from collections.abc import Iterable

import coal
import numpy as np

from armident.arrays import Array
from armident.configs.schema.collision import LinkCapsule
from armident.configs.urdf_shapes import UrdfShape

SMALLEST = 1e-3
"""Smallest radius of a capsule, m; flat and thin shapes have this one."""


def capsules_of(shapes: Iterable[UrdfShape]) -> tuple[list[LinkCapsule], list[str]]:
    """Return a capsule around each shape, in the frame of its link, and the names of meshes that cannot be read."""
    capsules: list[LinkCapsule] = []
    unread: list[str] = []
    for shape in shapes:
        points = points_of(shape)
        if points is None:
            unread.append("" if shape.mesh is None else f"{shape.mesh.name} of the link of {shape.link}")
            continue
        segment, radius = bounding_capsule(points)
        if shape.kind == "sphere":
            radius = shape.size[0]
        start, end = segment @ shape.placement[:3, :3].T + shape.placement[:3, 3]
        capsules.append(
            LinkCapsule(link=shape.link, start=tuple(start), end=tuple(end), radius=max(float(radius), SMALLEST))
        )
    return capsules, unread


def bounding_capsule(points: Array) -> tuple[Array, float]:
    """Return segment (2, 3) and radius of a capsule around points (K, 3) along their largest extent, m."""
    middle = (points.min(axis=0) + points.max(axis=0)) / 2.0
    axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    boxed = (points - middle) @ axes.T
    axes, centre = axes[np.argsort(-np.ptp(boxed, axis=0))], middle
    boxed = (points - centre) @ axes.T
    centre = centre + (boxed.min(axis=0) + boxed.max(axis=0)) / 2.0 @ axes
    boxed = (points - centre) @ axes.T
    across = np.linalg.norm(boxed[:, 1:], axis=1)
    radius = float(across.max())
    room = np.sqrt(np.maximum(radius**2 - across**2, 0.0))
    low, high = float((boxed[:, 0] + room).min()), float((boxed[:, 0] - room).max())
    if low >= high:
        return np.array([centre, centre]), float(np.linalg.norm(boxed, axis=1).max())
    return centre + np.outer([low, high], axes[0]), radius


def points_of(shape: UrdfShape) -> Array | None:
    """Return points (K, 3) whose capsule contains a shape, in its frame, m; ``None`` for an unreadable mesh."""
    if shape.kind == "sphere":
        return np.zeros((1, 3))
    if shape.kind == "box":
        corners = np.stack(np.meshgrid(*([[-0.5, 0.5]] * 3), indexing="ij"), axis=-1).reshape(-1, 3)
        return np.asarray(corners * np.array(shape.size))
    if shape.kind == "cylinder":
        radius, length = shape.size
        angle = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
        rim = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
        return np.vstack([np.column_stack([rim, np.full(angle.size, end * length)]) for end in (-0.5, 0.5)])
    try:
        mesh = coal.MeshLoader().load(str(shape.mesh), np.array(shape.size))
        points = np.asarray(mesh.vertices(), dtype=np.float64).reshape(-1, 3)
    except (RuntimeError, ValueError):
        return None
    return points if points.size and np.isfinite(points).all() else None
