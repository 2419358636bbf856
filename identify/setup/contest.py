"""Competition of whole set-ups: the share of them that contains a correction, and what the corrected model explains."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from armident.arrays import Array
from armident.identify.setup.fit import Hypothesis, fit, joint_errors
from armident.identify.setup.moves import signs_of
from armident.identify.setup.plausible import log_plausibility
from armident.identify.setup.prior import WIRING, Mistake, cost
from armident.identify.setup.result import WIRED
from armident.identify.setup.search import Search, Step, angle_between, independent_rows

EQUAL = float(np.log(10.0))
"""Nats below the best set-up down to which another one explains the recordings equally well."""

SAME_FACTOR = 0.1
"""Largest difference of the logarithms of two factors that are one correction."""

SAME_PROPORTION = float(np.log(1.5))
"""The same where every torque is in a unit of its own: joints that share few links determine their factor less."""

SAME_DIRECTION = float(np.radians(6.0))
"""Largest angle between two directions of gravity that are one correction, rad."""

SAME_SHIFT = (0.4, 1.5e-3)
"""Largest difference of two common shifts that are one correction: share of the larger, and s."""

LEAST_ERROR = 0.01
"""Error of a joint below which a smaller one is no better explanation: noise of usual torque signals."""

FRICTIONLESS = 1e-3
"""Friction power over that of velocity times torque (rms) below which the fit is at its bound of dissipation."""


@dataclass(frozen=True, eq=False)
class Explained:
    """Result of a hypothesis: relative errors (n,) with free terms, and serial correlations (n,) of the residuals.

    ``frictionless``: share of the moving joints whose friction is at its bound: they would dissipate nothing.
    """

    errors: Array
    memory: Array
    frictionless: float


class Contest:
    """Whole set-ups with their log weights: the found one first, those without one mistake, rivals, the configured."""

    def __init__(self, search: Search, found: Step, *, each_own: bool = False) -> None:
        """``found``: the step that the search ended with. ``each_own``: every torque is in a unit of its own drive."""
        self.bench, self.found, self.each_own = search.bench, found, each_own
        self.moving = np.flatnonzero(self.bench.moving)
        self.rows = independent_rows(fit(self.bench, found.h).residual)[self.moving]
        self.wholes = list(_wholes(search, found))
        weights = [self._weight(search, step) for step in self.wholes]
        # What explains more than the mistakes found may be true beside them.
        better = [step for step, weight in zip(self.wholes, weights, strict=True) if weight > weights[0]]
        beside = [replace(found, mistakes=(*found.mistakes, *step.mistakes[-1:])) for step in better]
        self.wholes += beside
        self.weights = np.array([*weights, *(self._weight(search, step) for step in beside)])
        self.before, self.after = (self._explained(h) for h in (found.start, found.h))
        # At rest, dry friction holds any load, whatever the set-up.
        self.in_motion = [joint_errors(self.bench, h, free=True)[0] for h in (found.start, found.h)]
        self.more_plausible = log_plausibility(self.bench, found.h) - log_plausibility(self.bench, found.start)

    def _weight(self, search: Search, step: Step) -> float:
        shares = search.held_out(step.h)[self.moving]
        fitted = -0.5 * self.rows @ np.log(shares) if np.isfinite(shares).all() else -np.inf
        return float(fitted + log_plausibility(self.bench, step.h) - cost(step.mistakes, self.bench.n))

    def _explained(self, h: Hypothesis) -> Explained:
        bench, moving = self.bench, self.moving
        errors, memory = joint_errors(bench.everywhere, h, free=True)
        velocity, torque = bench.recorded[1] @ h.position.T, bench.recorded[2] @ h.torque.T
        sizes = np.sqrt((velocity**2).mean(axis=0) * (torque**2).mean(axis=0))[moving]
        friction = (bench.rows(h.position).physical @ fit(bench, h).theta)[bench.n : 2 * bench.n][moving]
        return Explained(errors, memory, float(np.mean(friction < FRICTIONLESS * sizes)))

    def equal(self, kind: str, joints: Sequence[int]) -> list[Step]:
        """Whole set-ups without this correction of the wiring that explain the recordings equally well."""
        least = self.weights[0] - EQUAL
        return [
            step
            for step, weight in zip(self.wholes[1:], self.weights[1:], strict=True)
            if weight > least and step.mistakes and step.mistakes[-1].family in WIRING
            and kind in WIRED and not self._contains(step, kind, joints)
        ]  # fmt: skip

    def log_odds(self, kind: str, joints: Sequence[int], equal: Sequence[Step]) -> float:
        """Log odds of a finding: weight of the whole set-ups that contain it, or are equal, over that of the others."""
        inside = [self._contains(step, kind, joints) or step in equal for step in self.wholes]
        outside = self.weights[~np.array(inside)]
        most = float(logsumexp(outside)) if outside.size else -np.inf
        return float(logsumexp(self.weights[inside])) - most

    def _contains(self, step: Step, kind: str, joints: Sequence[int]) -> bool:
        h = step.h
        if step.each_own and not self.each_own:
            # The common factor of a unit of every drive is free.
            sizes = [np.abs(one.torque).max(axis=1)[self.moving] for one in (h, self.found.h)]
            h = replace(h, torque=h.torque / float(np.median(sizes[0] / sizes[1])))
        return same_correction(kind, joints, h, self.found.h, each_own=self.each_own)

    def own(self, joints: Sequence[int]) -> list[int]:
        """Those of some joints that move; all that move, if none of them does."""
        return [j for j in joints if j in self.moving] or [int(j) for j in self.moving]

    def features(self, log_odds: float) -> Array:
        """Features from which the probability of a finding is estimated, see `calibration.FEATURES`."""
        before, after = (np.maximum(e.errors[self.moving], LEAST_ERROR) for e in (self.before, self.after))
        return np.array(
            [
                np.arcsinh(0.5 * np.clip(log_odds, -1e3, 1e3)),
                np.log(after.max()),
                np.log(before / after).max(),
                self.after.frictionless,
                np.arcsinh(0.5 * self.more_plausible),
            ]
        )


def _wholes(search: Search, found: Step) -> Iterator[Step]:
    """The found set-up, those with a mistake less or another one in its place, and those that the search has met."""
    steps = [found, replace(found, mistakes=()), *(found.without({k}) for k in range(len(found.mistakes)))]
    for k, mistake in enumerate(found.mistakes):
        if mistake.gravity is not None and mistake.gravity.any():
            # Opposite directions fit equally where the first moments may change their sign.
            opposite = replace(mistake, gravity=-mistake.gravity)
            steps.append(replace(found, mistakes=(*found.mistakes[:k], opposite, *found.mistakes[k + 1 :])))
    steps += _other_signs(search, found)
    for parent, met in search.met:
        place = len(parent.mistakes)
        if found.mistakes[:place] == parent.mistakes and len(found.mistakes) > place:
            # A rival of one mistake competes together with the mistakes that were found after it.
            later = found.mistakes[place + 1 :]
            steps.append(replace(found, mistakes=(*parent.mistakes, *later, met.mistakes[-1])))
        else:
            steps.append(met)
    seen: set[bytes] = set()
    for step in steps:
        key = _key(step.h)
        if key not in seen:
            seen.add(key)
            yield step


def _key(h: Hypothesis) -> bytes:
    """Return the same bytes for equal set-ups."""
    parts = (h.position, h.torque, h.gravity, h.shift)
    return b"".join(np.round(part, 6).tobytes() for part in parts) + np.float64(h.clock).tobytes()


def _other_signs(search: Search, found: Step) -> Iterator[Step]:
    """The found set-up with the other signals of its turned joints: symmetries exchange position and torque."""
    places = [k for k, family in enumerate(found.families) if family in ("position_sign", "torque_sign")]
    if not places:
        return
    position, torque = (
        np.prod([np.diag(getattr(found.mistakes[k], signal)) for k in places], axis=0)
        for signal in ("position", "torque")
    )
    turned = np.flatnonzero(position * torque < 0) if np.any(position * torque < 0) else np.flatnonzero(torque < 0)
    own = np.eye(search.bench.n)
    for move in signs_of(search.bench.robot, [int(j) for j in turned]):
        position, torque = (own if m is None else m for m in (move.position, move.torque))
        other = Mistake(move.family, move.words, position, torque, np.zeros(search.bench.n))
        yield replace(found, mistakes=(*found.without(places).mistakes, other))


def same_correction(kind: str, joints: Sequence[int], a: Hypothesis, b: Hypothesis, *, each_own: bool = False) -> bool:
    """True if two hypotheses correct a kind alike at some joints; ``each_own``: of torques only proportions count."""
    if kind.startswith("gravity"):
        if not (a.gravity.any() and b.gravity.any()):
            return not a.gravity.any() and not b.gravity.any()
        return angle_between(a.gravity, b.gravity) < SAME_DIRECTION
    if kind == "time_unit":
        return bool(abs(np.log(a.clock / b.clock)) < SAME_FACTOR)
    if kind == "time_shift":
        x, y = (float(np.median(h.shift)) for h in (a, b))
        share, least = SAME_SHIFT
        return x * y > 0 and abs(x - y) <= max(share * max(abs(x), abs(y)), least)
    return all(
        _same_signals(kind, getattr(a, signal)[list(joints)], getattr(b, signal)[list(joints)], proportion)
        for signal, proportion in (("position", False), ("torque", each_own))
    )


def _same_signals(kind: str, a: Array, b: Array, proportion: bool) -> bool:
    """True if rows of two corrections take the same signals, with the same sign, or in the same scale."""
    rows, first, second = np.arange(len(a)), np.abs(a).argmax(axis=1), np.abs(b).argmax(axis=1)
    if kind == "joint_order":
        return bool(np.array_equal(first, second))
    x, y = a[rows, first], b[rows, second]
    if kind in ("position_sign", "torque_sign"):
        return bool(np.array_equal(np.sign(x), np.sign(y)))
    off = np.log(np.abs(x)) - np.log(np.abs(y))
    if proportion:
        off = off - np.median(off)
    return bool(np.abs(off).max() <= (SAME_PROPORTION if proportion else SAME_FACTOR))
