"""Frames of links and joints in an exported file: those of the source URDF, or modified Denavit-Hartenberg frames."""

from dataclasses import dataclass

import numpy as np

from armident.configs import RobotConfig
from armident.configs.schema.robot import Mdh
from armident.identify.robot.chain import Floats, cos_sin


@dataclass(frozen=True, eq=False)
class LinkFrames:
    """Frames of n links and their joints, all joint variables zero.

    ``placements`` (n, 4, 4): of each link in the link before it, the first in the base link. ``axes`` (n, 3): unit
    vectors in the link's frame. ``from_mdh`` (n, 4, 4): modified Denavit-Hartenberg frame in the link's. ``frame_0``
    (3, 3): rotation of the configuration's frame 0 in the base link. ``gravity`` (3,): in the base link, m/s^2.
    ``endless`` (n,): joints that turn without end.
    """

    base: str
    links: tuple[str, ...]
    joints: tuple[str, ...]
    placements: Floats
    axes: Floats
    from_mdh: Floats
    frame_0: Floats
    gravity: Floats
    endless: tuple[bool, ...]

    @property
    def free_base(self) -> str:
        """Name of the base link for formats in which ``world`` is the world itself."""
        free = (
            name for name in (self.base, "base_link", "mount_link", "arm_base") if name not in ("world", *self.links)
        )
        return next(free)


def mdh_link_frames(robot: RobotConfig) -> LinkFrames:
    """Return the modified Denavit-Hartenberg frames of a robot as link frames; links are named after joints."""
    n = robot.n
    links = tuple(f"{joint.name}_link" for joint in robot.joints)
    return LinkFrames(
        base="base_link" if "base_link" not in links else "mount_link",
        links=links,
        joints=tuple(joint.source_name or joint.name for joint in robot.joints),
        placements=np.stack([mdh_transform(joint.mdh) for joint in robot.joints]),
        axes=np.tile([0.0, 0.0, 1.0], (n, 1)),
        from_mdh=np.tile(np.eye(4), (n, 1, 1)),
        frame_0=np.eye(3),
        gravity=np.array(robot.gravity),
        endless=tuple(j.type == "revolute" and not np.isfinite(j.limits.position).all() for j in robot.joints),
    )


def mdh_transform(mdh: Mdh) -> Floats:
    """Return frame j in frame j-1 at position zero, ``Rot(x, alpha) Trans(x, d) Rot(z, theta) Trans(z, r)`` (2.1.1)."""
    (ca, sa), (ct, st) = cos_sin(mdh.alpha), cos_sin(mdh.theta)
    return np.array(
        [
            [ct, -st, 0.0, mdh.d],
            [ca * st, ca * ct, -sa, -sa * mdh.r],
            [sa * st, sa * ct, ca, ca * mdh.r],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
