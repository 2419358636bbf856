"""Search for the corrections of a set-up: best-first over single mistakes, and over whole permutations."""

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import product

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array
from armident.identify.setup import assignment, gravity, moves, scales
from armident.identify.setup.bench import Bench
from armident.identify.setup.fit import Hypothesis, fit, fit_shares, held_out, joint_errors, misfit
from armident.identify.setup.limited_least_squares import FLOOR
from armident.identify.setup.plausible import (
    LEAST_ODDS,
    equal_shares,
    log_plausibility,
    passed_limits,
    plausible_factor,
    worst_change,
)
from armident.identify.setup.prior import Mistake, between, composed, cost, wiring_cost

MOST_MISTAKES = 6
"""Largest number of mistakes that are corrected one after the other."""

LEAST_DROP = float(np.log(2.0))
"""Least drop of the held-out residual power for a finding, nats, summed over the joints: half of one joint's."""

LEAST_DROP_LATE = 0.2
"""The same for torques that are late by one time: the phase of a few milliseconds is small in the band of a motion."""

LEAST_DROP_EARLY = 2.0
"""The same for torques that are early: noise in a closed loop, and current loops that lag, resemble it."""

LEAST_TOGETHER = 1.5
"""Least factor by which the structured residual power of one joint, and of all joints together, must fall."""

MOST_OF_ONE = float(np.log(4.0))
"""Largest fall or rise of the structured residual power of one joint that counts, nats: its residual halves."""

LEAST_TOGETHER_LATE = 1.2
"""The same for torques that are late: friction and gravity hardly change with a delay."""

CLEAR_TILT = 3.0
"""Drop from which a direction of gravity needs no `LEAST_TOGETHER`, nats: a tilt shows at few joints."""

LEAST_TILT = float(np.radians(1.0))
"""Least angle between a direction of gravity and the configured one: floors and stands are level within a degree."""

WHITE = 0.05
"""Least correlation of neighbouring residuals that counts as structure: below it, estimates are noise."""

NOT_UNDERSTOOD = 1.0 / 3.0
"""Largest relative error of a joint that the rigid model explains (a third is more than friction or a load takes)."""

WELL_UNDERSTOOD = 0.2
"""Largest relative error of a joint for which no whole orders and no mistakes of several joints are tried."""

STRUCTURED = 0.3
"""Correlation of neighbouring residuals above which a large residual is no white noise of the torque."""

RANKED_ROWS = 100.0
"""Independent rows that weigh the fit against the plausibility of units in the ranking."""

EXHAUSTIVE = 4
"""Largest number of joints of which all orders are tried; with more, a search by exchanges starts from several."""

CLIMBS = 4
"""Number of the best usual orders from which it starts: it found all of 55 random orders of five to seven joints, at a
tenth of the orders tried."""

EACH_OWN = "every torque is in a unit of its own drive"

CANDIDATES = 4
"""Number of best-ranked mistakes whose held-out score is computed."""

ORDERS_KEPT = 2
"""Number of best orders, and of best mistakes of several joints, from which the search continues."""

MOST_IN_SETS = 8
"""Largest number of joints of which all sets are tried: 247 sets with ten mistakes each take seconds."""

FEW_ROWS = 150
"""Instants with which mistakes and orders are ranked first; the best `CANDIDATES` times four are ranked with all."""

CLOCKS = (1e-3, 1e-6, 1e-9, 1e3)
"""Units of time that are tried: ms, us and ns taken for s, and s taken for ms."""


@dataclass(frozen=True, eq=False)
class Step:
    """A hypothesis with the mistakes that lead to it from ``start``.

    ``rank``: criterion, in-sample nats per row: lower is better. ``shift_std``: of a common torque shift, s; NaN if
    from the best prediction. ``shift_decisive``: prediction gains enough by it for a mistake. ``shift_measured``: by
    undisturbed references, or confirmed by two joints. ``order_gain``: that of an exchange `within_limits`, nats.
    """

    start: Hypothesis
    mistakes: tuple[Mistake, ...] = ()
    rank: float = np.inf
    shift_std: float = np.nan
    shift_decisive: bool = True
    shift_measured: bool = False
    order_gain: float = np.nan

    @cached_property
    def h(self) -> Hypothesis:
        """The set-up with all mistakes corrected."""
        return composed(self.start, self.mistakes)

    @property
    def families(self) -> tuple[str, ...]:
        """Families of the mistakes."""
        return tuple(mistake.family for mistake in self.mistakes)

    @property
    def each_own(self) -> bool:
        """True if every torque is in a unit of its own drive: its common factor is not determined by the motion."""
        return "torque_scales" in self.families

    def without(self, places: Collection[int]) -> "Step":
        """Return the step without some of its mistakes."""
        kept = tuple(mistake for k, mistake in enumerate(self.mistakes) if k not in places)
        return replace(self, mistakes=kept, rank=np.inf)


@dataclass(eq=False)
class Search:
    """Search over the hypotheses of one set of recordings.

    ``tried``: counts of families tried. ``met``: the best hypotheses of every step, each with the step before it.
    ``scores``: held-out shares, kept for repeated use.
    """

    bench: Bench
    tried: dict[str, int] = field(default_factory=dict)
    met: list[tuple[Step, Step]] = field(default_factory=list)
    scores: dict[bytes, Array] = field(default_factory=dict)

    def rank(self, h: Hypothesis) -> float:
        """Criterion of the ranking: misfit in sample minus plausibility of the units, nats per row."""
        return _rank(self.bench, h)

    @cached_property
    def few(self) -> Bench:
        """Few instants, with which all single mistakes are ranked first."""
        return self.bench.coarse(FEW_ROWS)

    def run(self, start: Hypothesis) -> Step:
        """Return the corrected set-up. ``start``: the set-up as configured."""
        first = replace(Step(start), rank=self.rank(start))
        best = self._greedy(first)
        explained = self._explained(best.h)
        starts: list[Step] = []
        if self.bench.moving.sum() > 1:
            # An exchange that needs a second mistake beside it may be a part of another order.
            if not explained or (len(best.families) > 1 and {"exchange", "assignment"} & set(best.families)):
                starts += self._orders(first)
            # Several mistakes may be one that a set of joints shares.
            if not explained or len(best.families) > 1:
                starts += self._sets(first)
                starts += [self._ranked(s, self.bench) for s in self._torque_scales(first)]
        # An order or a set that explains no more than the configuration is no part of an explanation.
        starts = sorted((s for s in starts if s.rank < first.rank), key=lambda s: s.rank)
        self.met += [(first, s) for s in starts]
        for k, step in enumerate(starts):
            other = self._greedy(step)
            needed = 0.0 if best.families else LEAST_ODDS
            better = all(self.gain(best, other, b)[0] > needed for b in (self.bench, self.bench.everywhere))
            if better and self._material(first.h, other.h, LEAST_TOGETHER) and self._uncontradicted(first, other):
                best = other
            clear = all(0.5 * RANKED_ROWS * (s.rank - step.rank) > LEAST_ODDS for s in starts[k + 1 : k + 2])
            if clear and self._explained(best.h):
                break
        return best

    def within_limits(self, step: Step) -> Step:
        """Return the step with an exchange that keeps the positions within their limits, if all instants prefer it.

        Axes of the same size hardly differ in their torques, but no effect moves a joint past its stops.
        """
        if not passed_limits(self.bench, step.h).any():
            return step
        found = [(0.0, step)]
        for move in moves.exchange_moves(self.bench.robot, [int(j) for j in np.flatnonzero(self.bench.moving)]):
            other = self._made(step, move.family, move.words, move(step.h), move.drives)
            if not passed_limits(self.bench, other.h).any() and self._material(step.h, other.h, 1.0):
                gain = self.gain(step, other, self.bench.everywhere)[0]
                found += [(gain, replace(other, order_gain=gain))] if gain >= LEAST_ODDS else []
        return max(found, key=lambda one: one[0])[1]

    def _explained(self, h: Hypothesis) -> bool:
        """True if the model predicts every joint's torque where all move, or leaves little of it apart from noise."""
        # Torques of another order are wrong at rest, too.
        errors, memory = joint_errors(self.bench.everywhere, h, free=True)
        errors = np.minimum(np.where(memory > STRUCTURED, errors, 0.0), np.sqrt(self.held_out(h)))
        return bool(np.all(errors[self.bench.moving] <= WELL_UNDERSTOOD))

    def _greedy(self, step: Step) -> Step:
        while len(step.mistakes) < MOST_MISTAKES:
            found = sorted(self._neighbours(step), key=lambda s: s.rank)[: 4 * CANDIDATES]
            found = sorted((self._ranked(s, self.bench) for s in found), key=lambda s: s.rank)
            taken = self._taken(step, found)
            if taken is None:
                return step
            step = taken
        return step

    def _taken(self, step: Step, found: list[Step]) -> Step | None:
        """Best neighbour that is a mistake of the set-up, certain and material; those that rank no better are none."""
        for best in [s for s in found[:CANDIDATES] if s.rank < step.rank]:
            taken = self._accepted(step, best, [s for s in found[: 2 * CANDIDATES] if s is not best])
            if taken is not None:
                return taken
        return None

    def _accepted(self, step: Step, best: Step, found: list[Step]) -> Step | None:
        gain, drop, plausible = self.gain(step, best)
        least, together = LEAST_DROP, LEAST_TOGETHER
        if best.families[-1] == "time_shift":
            shift = float(best.h.shift[self.bench.moving][0] - step.h.shift[self.bench.moving][0])
            if shift > 0.0:
                least, together = LEAST_DROP_LATE, LEAST_TOGETHER_LATE
            else:
                least = LEAST_DROP_EARLY
            if abs(shift) < self.bench.period or gain < LEAST_ODDS or drop < least:
                return None
            one = self._one_late(step)
            if one is not None and one.rank < best.rank:
                # The delay of one drive alone is an effect of its own, and no clock of the set-up.
                best, least, together = one, LEAST_DROP, LEAST_TOGETHER
                gain, drop, plausible = self.gain(step, best)
        if best.families[-1] == "gravity_direction":
            if angle_between(step.h.gravity, best.h.gravity) < LEAST_TILT:
                return None
            if drop >= CLEAR_TILT:
                together = 1.0
        material = drop >= least and self._material(step.h, best.h, together)
        if gain < LEAST_ODDS or not (material or plausible >= LEAST_ODDS):
            return None
        self.met += [(step, other) for other in (best, *found)]
        return best

    def _material(self, old: Hypothesis, new: Hypothesis, least: float) -> bool:
        """True if a correction makes no joint implausible, and more joints improve by a factor than get worse.

        With and without the free terms: helping these alone only fits an effect that the model lacks.
        """
        if worst_change(self.bench, old, new) < -LEAST_ODDS:
            return False
        return all(self._improved(old, new, free=free) >= np.log(least) for free in (True, False))

    def _improved(self, old: Hypothesis, new: Hypothesis, *, free: bool = True) -> float:
        """Fall of the structured residual power, nats: of the joint that improves most, and of all joints together.

        The covariance of neighbouring residuals is the power of their structured part, without white noise. Each joint
        counts in its own residual, and as `MOST_OF_ONE` at most: a joint with little torque outvotes no two others.
        """
        powers = []
        for h in (old, new):
            residual, torque = fit(self.bench, h, free=free).residual, self.bench.torque(h.shift)
            white = WHITE * (residual**2).sum(axis=0) + FLOOR * (torque**2).sum(axis=0)
            power = np.maximum((residual[1:] * residual[:-1]).sum(axis=0), white)
            powers.append(power / np.maximum((torque**2).sum(axis=0), 1e-300))
        falls = np.log(powers[0] / powers[1])[self.bench.moving]
        return float(min(falls.max(), np.clip(falls, -MOST_OF_ONE, MOST_OF_ONE).sum()))

    def _uncontradicted(self, first: Step, other: Step) -> bool:
        """True if no torque that another order or set changes is predicted worse by `LEAST_ODDS`."""
        changed = np.any((first.h.position != other.h.position) | (first.h.torque != other.h.torque), axis=0)
        drops = np.log(self.held_out(first.h) / self.held_out(other.h))
        gains = 0.5 * independent_rows(fit(self.bench, other.h).residual) * drops
        return bool(np.all(gains[changed & self.bench.moving] > -LEAST_ODDS))

    def _one_late(self, step: Step) -> Step | None:
        """Best delay of one drive alone; ``None`` for a single joint."""
        n, names = self.bench.n, [joint.name for joint in self.bench.robot.joints]
        if self.bench.moving.sum() < 2:
            return None
        alone = [
            self._made(
                step,
                "one_late",
                f"torque of {names[j]} late",
                gravity.best_shift(step.h, self.rank, self.bench.period, np.arange(n) == j),
            )
            for j in np.flatnonzero(self.bench.moving)
        ]
        return min((self._ranked(s, self.bench) for s in alone), key=lambda s: s.rank)

    def gain(self, old: Step, new: Step, bench: Bench | None = None) -> tuple[float, float, float]:
        """Gain of the score, drop of the held-out residual power, and gain of plausibility, nats each."""
        bench = self.bench if bench is None else bench
        moving, n = bench.moving, bench.n
        before, after = self.held_out(old.h, bench)[moving], self.held_out(new.h, bench)[moving]
        if not (np.isfinite(before).all() and np.isfinite(after).all()):
            return -np.inf, 0.0, 0.0
        rows = independent_rows(fit(bench, new.h).residual)[moving]
        drops = np.log(before / after)
        plausible = log_plausibility(bench, new.h) - log_plausibility(bench, old.h)
        dearer = cost(new.mistakes, n) - cost(old.mistakes, n)
        return float(0.5 * rows @ drops + plausible - dearer), float(drops.sum()), plausible

    def held_out(self, h: Hypothesis, bench: Bench | None = None) -> Array:
        """Held-out residual share (n,) of every torque, see `fit.held_out`; infinite where no fit exists."""
        bench = self.bench if bench is None else bench
        parts = (h.position, h.torque, h.gravity, h.shift, h.clock, bench.at_rest)
        key = b"".join(np.asarray(part).tobytes() for part in parts)
        if key not in self.scores:
            try:
                self.scores[key] = held_out(bench, h)
            except np.linalg.LinAlgError:
                self.scores[key] = np.full(bench.n, np.inf)
        return self.scores[key]

    def _neighbours(self, step: Step) -> Iterator[Step]:
        bench, h = self.bench, step.h
        robot = bench.robot
        joints = [int(j) for j in np.flatnonzero(bench.moving)]
        singles: Iterable[moves.Move] = (
            *moves.sign_moves(robot, joints),
            *moves.exchange_moves(robot, joints),
            *moves.unit_moves(robot),
            *moves.single_unit_moves(robot, joints),
            *(
                move
                for j in joints
                if len(joints) > 1
                for move in scales.scale_moves(robot, j, h, partial(_rank, self.few), self.rank)
            ),
        )
        for move in singles:
            yield self._made(step, move.family, move.words, move(h), move.drives)
        if len(joints) > 1:
            yield self._made(step, "assignment", "torques in another order", assignment.by_rows(bench, h))
        if h.gravity.any():
            yield self._made(step, "gravity_missing", "torques without gravity", replace(h, gravity=np.zeros(3)))
        if len(joints) > 1:
            yield from self._torque_scales(step, equal_shares(bench, h))
        turned = gravity.best_direction(h, partial(misfit, bench, turned=True))
        yield self._made(step, "gravity_direction", "another direction of gravity", turned)
        for clock in CLOCKS:
            yield self._made(step, "time_unit", f"time in units of {clock:g} s", replace(h, clock=h.clock * clock))
        late = gravity.best_shift(h, self.rank, bench.period, bench.moving)
        yield self._made(step, "time_shift", "all torques late by the same time", late)

    def _torque_scales(self, step: Step, near: Array | None = None) -> Iterator[Step]:
        """All torques in a unit of each drive's own: per mille of unknown rated torques, currents of the motors."""
        bench, h = self.bench, step.h
        sizes = np.sqrt(bench.power(h.shift))
        factors = scales.torque_scales(h, partial(misfit, bench), near, sizes, bench.moving)
        if factors is None:
            return
        scaled = replace(h, torque=factors[:, None] * h.torque)
        factors = factors * plausible_factor(bench, scaled)
        yield self._made(step, "torque_scales", EACH_OWN, replace(h, torque=factors[:, None] * h.torque))

    def _made(self, step: Step, family: str, words: str, h: Hypothesis, raw: bool = False) -> Step:
        self.tried[family] = self.tried.get(family, 0) + 1
        mistake = between(step.h, h, family, words, raw)
        return self._ranked(replace(step, mistakes=(*step.mistakes, mistake)), self.few)

    def _ranked(self, step: Step, bench: Bench) -> Step:
        return replace(step, rank=_rank(bench, step.h) + 2.0 * cost(step.mistakes, bench.n) / RANKED_ROWS)

    def _sets(self, first: Step) -> list[Step]:
        """Best mistakes of sign, unit or side that several joints share."""
        robot, joints = self.bench.robot, [int(j) for j in np.flatnonzero(self.bench.moving)]
        if len(joints) > MOST_IN_SETS:
            return []
        made = [self._made(first, move.family, move.words, move(first.h)) for move in moves.set_moves(robot, joints)]
        best = sorted(made, key=lambda s: s.rank)[: 4 * ORDERS_KEPT]
        return sorted((self._ranked(s, self.bench) for s in best), key=lambda s: s.rank)[:ORDERS_KEPT]

    def _orders(self, first: Step) -> list[Step]:
        """Best orders of all joints, with torques in the order of positions, or as their friction assigns them."""
        n, start = self.bench.n, first.h
        coarse = self.bench.everywhere.coarse(FEW_ROWS)
        relative = [np.eye(n)]
        by_friction = assignment.by_friction(self.bench, start)
        if not np.array_equal(by_friction, np.eye(n)):
            relative.append(by_friction)
        seen: dict[bytes, tuple[float, Hypothesis]] = {}

        def at(order: Array, own: Array) -> float:
            key = np.concatenate([order, own]).tobytes()
            if key not in seen:
                self.tried["order"] = self.tried.get("order", 0) + 1
                h = replace(start, position=order @ start.position, torque=order @ own @ start.torque)
                seen[key] = _rank(coarse, h) + 2.0 * wiring_cost(order, order @ own) / RANKED_ROWS, h
            return seen[key][0]

        if self.bench.moving.sum() <= EXHAUSTIVE:
            # The equations of one order of the positions serve all orders of the torques.
            for order, own in product(assignment.orders(self.bench.moving), relative):
                at(order, own)
        else:
            usual = product(assignment.usual_orders(self.bench.moving), relative)
            for begin, own in sorted(usual, key=lambda pair: at(*pair))[:CLIMBS]:
                _climb(begin, self.bench.moving, partial(at, own=own))
        best = sorted(seen.values(), key=lambda pair: pair[0])[: 4 * ORDERS_KEPT]
        steps = [self._made(first, "order", "joints in another order", h) for _, h in best]
        return sorted((self._ranked(s, self.bench) for s in steps), key=lambda s: s.rank)[:ORDERS_KEPT]


def _rank(bench: Bench, h: Hypothesis) -> float:
    try:
        shares = fit_shares(bench, h)
    except np.linalg.LinAlgError:
        return np.inf
    return float(np.log(shares[bench.moving]).sum()) - 2.0 * log_plausibility(bench, h) / RANKED_ROWS


def _climb(order: Array, moving: NDArray[np.bool_], criterion: "assignment.OrderCriterion") -> None:
    """Exchange two joints as long as the criterion falls."""
    least, chosen = criterion(order), np.flatnonzero(moving)
    while True:
        swapped = [assignment.exchanged(order, i, k) for i in map(int, chosen) for k in map(int, chosen) if k < i]
        values = [criterion(other) for other in swapped]
        k = int(np.argmin(values))
        if values[k] >= least:
            return
        order, least = swapped[k], values[k]


def angle_between(a: Array, b: Array) -> float:
    """Angle between two vectors (3,), rad; pi where one of them is zero."""
    sizes = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(np.arccos(np.clip(a @ b / sizes, -1.0, 1.0))) if sizes > 0 else float(np.pi)


def independent_rows(residual: Array) -> Array:
    """Number (n,) of independent rows with the serial correlation of residuals (M, n), at least 4.

    ``M (1 - r) / (1 + r)`` for the correlation r of neighbouring rows (Bartlett 1946).
    """
    power = np.maximum((residual**2).sum(axis=0), 1e-300)
    r = np.clip((residual[1:] * residual[:-1]).sum(axis=0) / power, 0.0, 0.99)
    rows: Array = np.maximum(residual.shape[0] * (1 - r) / (1 + r), 4.0)
    return rows
