"""Distances between links and of links to boxes along a motion, by the library coal.

Links are capsules: given, from the geometry of a URDF, or from joint to joint.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import coal
import numpy as np
from scipy.spatial.transform import Rotation

from armident.arrays import Array
from armident.configs import ConfigError, RobotConfig
from armident.configs.schema.collision import BASE, Box, Collision, LinkCapsule
from armident.identify.robot.chain import Chain, chain_of, link_frames

JOINT_ZONE = 1.5
"""Distance from a joint's axis, over radii plus clearance, up to which its two links may touch. Beyond it they touch
when the angle between them is below ``2 asin(1 / (2 * 1.5))``, 39 degrees."""

ALWAYS = 0.95
"""Share of random postures in which two bodies overlap by construction: that of the set-up assistant of MoveIt."""

CONTACT_POSTURES = 300
"""Number of these postures."""

STRIDE = 10
"""Samples between two distances where the clearance is not kept."""


@dataclass(frozen=True)
class ClosestApproach:
    """Smallest distance of two named bodies along a motion, m; negative where they overlap."""

    distance: float
    first: str
    second: str
    sample: int

    def __str__(self) -> str:
        return f"{self.distance:.3f} m between {self.first} and {self.second}"


@dataclass(frozen=True, eq=False)
class _Body:
    """Shape on a link: its segment (2, 3) in the link's frame, or a box with its placement in frame 0."""

    name: str
    link: int
    segment: Array
    radius: float
    box: Box | None = None

    @property
    def placement(self) -> Array:
        """Frame of the shape in that of its link, (4, 4)."""
        frame = np.eye(4)
        if self.box is not None:
            frame[:3, :3] = Rotation.from_euler("xyz", self.box.rpy).as_matrix()
            frame[:3, 3] = self.box.center
            return frame
        along = self.segment[1] - self.segment[0]
        if np.linalg.norm(along) > 0.0:
            frame[:3, :3] = Rotation.align_vectors(along[None], [[0.0, 0.0, 1.0]])[0].as_matrix()
        frame[:3, 3] = self.segment.mean(axis=0)
        return frame

    def shape(self) -> object:
        """Return the shape for coal."""
        if self.box is not None:
            return coal.Box(*self.box.size)
        return coal.Capsule(self.radius, float(np.linalg.norm(self.segment[1] - self.segment[0])))


class CollisionModel:
    """Pairs of bodies of an arm and its cell; ``geometry``: capsules, in frames j, of links without given ones."""

    def __init__(self, robot: RobotConfig, geometry: Sequence[LinkCapsule] = ()) -> None:
        self.settings = robot.collision or Collision()
        self.clearance = self.settings.clearance
        self._chain = chain_of(robot)
        self._names = [BASE, *(joint.name for joint in robot.joints)]
        links, self.without_geometry = self._links(geometry)
        self._bodies: list[_Body] = []
        self._pairs: list[tuple[int, int]] = []
        self.touching: list[str] = []
        self._add_links(links)
        self._add_boxes(links)
        self._shapes = [body.shape() for body in self._bodies]
        self._placements = np.array([body.placement for body in self._bodies]).reshape(-1, 4, 4)
        self._request = coal.DistanceRequest()
        self._leave_out_touching(robot)

    @property
    def pairs(self) -> int:
        """Number of pairs of bodies that are compared."""
        return len(self._pairs)

    def closest(self, q: Array) -> ClosestApproach | None:
        """Return the smallest distance along postures (N, n); ``None`` if there is nothing to compare."""
        if not self._pairs:
            return None
        frames, travel = self._motion(q)
        best, sample, pair = np.inf, 0, 0
        k = 0
        while k < q.shape[0]:
            distance, closest = self._distance(frames[k])
            if distance < best:
                best, sample, pair = distance, k, closest
            k = self._next(travel, k, distance - best)
        one, two = (self._bodies[b].name for b in self._pairs[pair])
        return ClosestApproach(float(best), one, two, sample)

    def profile(self, q: Array) -> Array:
        """Return the smallest distance of all pairs at each posture, m, (N,). ``q``: postures (N, n), rad or m."""
        frames, _ = self._motion(q)
        return np.array([self._distance(frame)[0] for frame in frames])

    def shortfall(self, q: Array) -> float:
        """Return the mean distance, m, by which postures (N, n) miss the clearance; 0 where they keep it."""
        if not self._pairs:
            return 0.0
        frames, travel = self._motion(q)
        missing, k = 0.0, 0
        while k < q.shape[0]:
            distance, _ = self._distance(frames[k])
            if distance < self.clearance:
                missing += (self.clearance - distance) * min(STRIDE, q.shape[0] - k)
                k += STRIDE
            else:
                k = self._next(travel, k, distance - self.clearance)
        return float(missing / q.shape[0])

    def _motion(self, q: Array) -> tuple[Array, Array]:
        """Frames of all bodies (N, B, 4, 4), and a bound of the distance (N,) that any of their points has covered."""
        frames = link_frames(self._chain, q)[:, [body.link for body in self._bodies]]
        segments = np.array([body.segment for body in self._bodies])
        ends = np.einsum("kbij,bej->kbei", frames[:, :, :3, :3], segments) + frames[:, :, None, :3, 3]
        steps = np.linalg.norm(np.diff(ends, axis=0), axis=3).max(axis=(1, 2), initial=0.0)
        return frames @ self._placements, np.concatenate([[0.0], np.cumsum(steps)])

    def _distance(self, frames: Array) -> tuple[float, int]:
        """Smallest distance of all pairs at one posture (B, 4, 4), m, and its pair."""
        result, request, shapes = coal.DistanceResult(), self._request, self._shapes
        places = [coal.Transform3s(frame[:3, :3], frame[:3, 3]) for frame in frames]
        best, pair = float(np.inf), 0
        for number, (a, b) in enumerate(self._pairs):
            result.clear()
            distance = float(coal.distance(shapes[a], places[a], shapes[b], places[b], request, result))
            if distance < best:
                best, pair = distance, number
        return best, pair

    @staticmethod
    def _next(travel: Array, k: int, room: float) -> int:
        """Return the first sample at which two bodies may have come nearer by ``room``: each covers half of it."""
        return max(k + 1, int(np.searchsorted(travel, travel[k] + max(room, 0.0) / 2.0)))

    def _links(self, geometry: Sequence[LinkCapsule]) -> tuple[list[list[_Body]], list[str]]:
        """Capsules of each link, and the names of the links without any."""
        links: list[list[_Body]] = []
        missing = []
        for number, name in enumerate(self._names):
            given = [c for c in self.settings.capsules if c.link == name] or [c for c in geometry if c.link == name]
            label = BASE if number == 0 else f"link of {name}"
            own = [_Body(label, number, np.array([c.start, c.end]), c.radius) for c in given]
            if not own and self.settings.radius is not None:
                own = [_Body(label, number, _to_next_joint(self._chain, number), self.settings.radius)]
            if not own:
                missing.append(label)
            links.append(own)
        return links, missing

    def _add_links(self, links: list[list[_Body]]) -> None:
        """Add the pairs of different links; links at a joint are compared outside the zone around its axis."""
        first = 0
        indices = []
        for own in links:
            self._bodies += own
            indices.append(range(first, first + len(own)))
            first += len(own)
        for j, k in combinations(range(len(links)), 2):
            if k > j + 1:
                self._pairs += [(a, b) for a in indices[j] for b in indices[k]]
            elif self._chain.prismatic[j]:
                self.touching += [f"{one.name} and {two.name}" for one in links[j][:1] for two in links[k][:1]]
            else:
                self._add_neighbours(links[j], links[k], k)

    def _add_neighbours(self, before: list[_Body], after: list[_Body], joint: int) -> None:
        """Add the pairs of the two links of a revolute joint (from 1)."""
        j = joint - 1
        ca, sa = self._chain.cos_alpha[j], self._chain.sin_alpha[j]
        axis_before = np.array([0.0, -sa, ca]), np.array([self._chain.d[j], 0.0, 0.0])
        axis_after = np.array([0.0, 0.0, 1.0]), np.zeros(3)
        compared = False
        for one in before:
            for two in after:
                zone = JOINT_ZONE * (one.radius + two.radius + self.clearance)
                parts = [_outside(one, *axis_before, zone), _outside(two, *axis_after, zone)]
                first = len(self._bodies)
                self._bodies += [*parts[0], *parts[1]]
                middle, last = first + len(parts[0]), len(self._bodies)
                self._pairs += [(a, b) for a in range(first, middle) for b in range(middle, last)]
                compared = compared or bool(parts[0] and parts[1])
        if before and after and not compared:
            self.touching.append(f"{before[0].name} and {after[0].name}")

    def _add_boxes(self, links: list[list[_Body]]) -> None:
        """Add the pairs of boxes and moving links; the arm's base may stand on or in a box."""
        moving = [k for k, body in enumerate(self._bodies[: sum(map(len, links))]) if body.link > 0]
        for number, box in enumerate(self.settings.boxes, start=1):
            name = f"box {number}" if box.name is None else f"box {box.name!r}"
            self._bodies.append(_Body(name, 0, np.zeros((2, 3)), 0.0, box))
            self._pairs += [(k, len(self._bodies) - 1) for k in moving]

    def _leave_out_touching(self, robot: RobotConfig) -> None:
        """Leave out pairs that overlap in nearly every posture, such as the links of a wrist."""
        if not self._pairs:
            return
        bounds = np.clip(np.array([joint.limits.position for joint in robot.joints]), -2 * np.pi, 2 * np.pi)
        q = np.random.default_rng(0).uniform(bounds[:, 0], bounds[:, 1], (CONTACT_POSTURES, robot.n))
        frames, every = self._motion(q)[0], self._pairs
        touching: list[tuple[int, int]] = []
        for pair in every:
            self._pairs = [pair]
            if np.mean([self._distance(frame)[0] < self.clearance for frame in frames]) >= ALWAYS:
                touching.append(pair)
        self._pairs = [pair for pair in every if pair not in touching]
        compared = {self._words(pair) for pair in self._pairs}
        for pair in touching:
            one, two = (self._bodies[b] for b in pair)
            if two.box is not None and one.link > 1:
                raise ConfigError(f"collision: {two.name} reaches the {one.name} in nearly every posture; correct it")
            words = self._words(pair)
            if words not in compared and words not in self.touching:
                self.touching.append(words)

    def _words(self, pair: tuple[int, int]) -> str:
        return f"{self._bodies[pair[0]].name} and {self._bodies[pair[1]].name}"


def _to_next_joint(chain: Chain, link: int) -> Array:
    """Segment (2, 3) from a link's frame to the next without a rail's travel; a point for the last link."""
    segment = np.zeros((2, 3))
    if link < chain.d.size:
        r = 0.0 if chain.prismatic[link] else chain.r[link]
        segment[1] = chain.d[link], -chain.sin_alpha[link] * r, chain.cos_alpha[link] * r
    return segment


def _outside(body: _Body, axis: Array, point: Array, zone: float) -> list[_Body]:
    """Return the parts of a capsule whose segment is farther than ``zone`` from an axis through a point."""
    across = np.eye(3) - np.outer(axis, axis)
    start, along = across @ (body.segment[0] - point), across @ (body.segment[1] - body.segment[0])
    a, b, c = along @ along, 2.0 * start @ along, start @ start - zone**2
    root = b * b - 4.0 * a * c
    if a <= 0.0 or root <= 0.0:
        return [body] if c > 0.0 else []
    cuts = np.clip([(-b - np.sqrt(root)) / (2.0 * a), (-b + np.sqrt(root)) / (2.0 * a)], 0.0, 1.0)
    whole = body.segment[1] - body.segment[0]
    spans = [(low, high) for low, high in ((0.0, cuts[0]), (cuts[1], 1.0)) if high - low > 1e-9]
    return [
        _Body(body.name, body.link, body.segment[0] + np.outer([low, high], whole), body.radius) for low, high in spans
    ]
