"""Transitions of dry friction at the reversals of the joints: a part of the friction model, found before any effect."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from armident.configs.schema.robot import Effect as Entry
from armident.identify.diagnosis.candidates import ColumnCache, Shapes
from armident.identify.diagnosis.model_state import (
    Fitter,
    ModelState,
    fitted,
    fitted_in_loop_of,
    friction_allowed,
    with_entries,
    without_entry,
)
from armident.identify.effects.effect import Place
from armident.identify.effects.friction import TRANSITION
from armident.identify.effects.registry import known
from armident.identify.effects.terms import entry_of

STEPS = tuple(0.5**k for k in range(1, 6))
"""Steps of the pattern search: logarithm of the velocity, and lead in samples. The last one is 3 %."""
CURVE = "stribeck_friction/table"
"""Free curve of friction over speed."""
ROUNDS = 4
"""Most rounds with one step."""


def with_transitions(state: ModelState, model: Fitter) -> ModelState:
    """Model with the transition of dry friction at the reversals of each joint, where it predicts better.

    A grid for all joints at once; then a pattern search (Hooke, Jeeves 1961, J. ACM 8(2)): the likelihood is narrow.
    Beside another law of the reversal, the smoothed sign looks like Stribeck friction or an early torque.
    """
    search = _Search(state)
    made, clear = search.clear(model)
    kept = _beside_curve(made, clear, model)
    there = {entry.joint for entry in kept}
    large = [place for place in search.large if state.study.joints[place.joint] not in there]
    tied = _tied(state, large, model) if large else []
    joints, own = state.study.joints, state.score.own_log_likelihoods
    while tied:
        study = replace(state.study, tied=frozenset(str(entry.joint) for entry in tied))
        found = fitted(study, with_entries(state.robot, [*kept, *tied]), state)
        gain = found.score.own_log_likelihoods - own
        better = [entry for entry in tied if gain[joints.index(str(entry.joint))] > 0.0]
        if better == tied:
            return found
        tied = better
    return model(with_entries(state.robot, kept), state) or state


def _tied(state: ModelState, places: Sequence[Place], model: Fitter) -> list[Entry]:
    """Transitions of joints whose best transition is too large: those beside a free curve of friction over speed.

    Friction that falls with the speed makes a transition too large, and is no part of it. Until an effect takes its
    place, the transition has the size of the dry friction.
    """
    curved = model(with_entries(state.robot, _curves(state, places)), state)
    if curved is None:
        return []
    return _Search(curved, places).clear(model)[1]


def _curves(state: ModelState, places: Sequence[Place]) -> list[Entry]:
    """Free curves of friction over speed."""
    motion, curve = ColumnCache(state.study, state.fit.theta).motion(state.study.train[0], "measured"), known(CURVE)
    return [entry_of(curve, place, state.robot, dict(curve.grid(motion, place)[0])) for place in places]


def _beside_curve(state: ModelState, entries: list[Entry], model: Fitter) -> list[Entry]:
    """Those of the transitions that no free curve of friction over speed replaces.

    Few reversals do not determine a transition: it may take the place of friction that falls with the speed. Beside the
    curve it is negative then, and the curve alone leaves less than half of the residual's power.
    """

    def curves(some: list[Entry]) -> list[Entry]:
        return _curves(state, [Place(state.study.joints.index(str(entry.joint))) for entry in some])

    both = model(with_entries(state.robot, curves(entries)), state)
    if both is None:
        return entries
    names, at = both.study.model.base.names, state.study.joints.index
    negative = [e for e in entries if both.fit.theta[names.index(both.term_of(e).names[0])] <= 0.0]
    rest = state.robot.model_copy(update={"effects": tuple(e for e in state.robot.effects if e not in negative)})
    alone = model(with_entries(rest, curves(negative)), state) if negative else None
    if alone is None:
        return entries
    power, before = (np.mean(np.concatenate(one.fit.left) ** 2, axis=0) for one in (alone, state))
    replaced = power < (1.0 - state.study.criteria.named_share) * before
    return [e for e in entries if e not in negative or not replaced[at(str(e.joint))]]


class _Search:
    """Best transition of each joint so far, in the loop of the model without them. ``state``: model without them."""

    def __init__(self, state: ModelState, places: Sequence[Place] | None = None) -> None:
        self.state, self.effect = state, known(TRANSITION)
        motion = ColumnCache(state.study, state.fit.theta).motion(state.study.train[0], "measured")
        if places is None:
            present = {entry.joint for entry in state.robot.effects if entry.effect == TRANSITION}
            places = [Place(j) for j, name in enumerate(state.study.joints) if name not in present]
        self.grids = {place: self.effect.grid(motion, place) for place in places}
        self.count = min(map(len, self.grids.values()), default=0)
        self.sample = motion.dt
        self.best: dict[Place, tuple[float, Shapes]] = {}
        self._large: dict[Place, float] = {}

    def clear(self, model: Fitter) -> tuple[ModelState, list[Entry]]:
        """Model with the best transitions, and those that clearly predict better; the model without any if none is."""
        for number in range(self.count):
            self.tried({place: grid[number] for place, grid in self.grids.items()}, self.state)
        made = self.converged(self.state)
        if made is not None:
            made = model(with_entries(self.state.robot, list(self.entries(self.chosen).values())), self.state)
        if made is None:
            return self.state, []
        return made, [
            entry
            for place, entry in self.entries(self.chosen).items()
            if _clear(made, model(without_entry(made.robot, entry), made), entry, place.joint)
        ]

    @property
    def large(self) -> list[Place]:
        """Joints at which a transition that is too large predicts clearly better than none."""
        own, close = self.state.score.own_log_likelihoods, self.state.study.criteria.close
        return [place for place, score in self._large.items() if score - own[place.joint] > close]

    @property
    def chosen(self) -> dict[Place, Shapes]:
        """Nonlinear parameters of the best transitions."""
        return {place: shapes for place, (_, shapes) in self.best.items()}

    def entries(self, shapes: dict[Place, Shapes]) -> dict[Place, Entry]:
        """Entries of transitions. ``shapes``: nonlinear parameters of the transition at each place."""
        return {place: entry_of(self.effect, place, self.state.robot, dict(one)) for place, one in shapes.items()}

    def tried(self, shapes: dict[Place, Shapes], before: ModelState) -> ModelState | None:
        """Model with transitions; each that predicts the torque of its joint better becomes the best one."""
        entries = self.entries(shapes)
        made = fitted_in_loop_of(before, with_entries(self.state.robot, list(entries.values())))
        if made is None:
            return None
        for place, entry in entries.items():
            score = float(made.score.own_log_likelihoods[place.joint])
            least = self.best[place][0] if place in self.best else -np.inf
            value = float(made.values_of(made.term_of(entry))[0][0])
            if not _possible(made, entry):
                if value > 0.0:
                    self._large[place] = max(score, self._large.get(place, -np.inf))
            elif score > least:
                self.best[place] = score, shapes[place]
        return made

    def converged(self, state: ModelState) -> ModelState | None:
        """Model with the transitions that a pattern search finds from the best ones so far."""
        made = self.tried(self.chosen, state)
        for step in STEPS if made else ():
            for _ in range(ROUNDS):
                before = self.chosen
                # Scores of the transitions together; those so far are beside other transitions of the other joints.
                self.best = {place: (-np.inf, shapes) for place, shapes in before.items()}
                made = self.tried(before, state)
                for factor, samples in ((step, 0.0), (-step, 0.0), (0.0, step), (0.0, -step)):
                    self.tried({p: self._moved(p, one, factor, samples) for p, one in before.items()}, state)
                if self.chosen == before:
                    break
        return made

    def _moved(self, place: Place, shapes: Shapes, factor: float, samples: float) -> Shapes:
        """Return a transition beside another one, no less than the grid: a lead of zero would have no uncertainty.

        A motion may reach only a part of the joint's top speed: the largest velocity is the next one of the grid.
        """
        given = dict(shapes)
        speeds, leads = (sorted({dict(one)[name] for one in self.grids[place]}) for name in ("velocity", "lead"))
        velocity = float(np.clip(given["velocity"] * np.exp(factor), speeds[0], speeds[-1] ** 2 / speeds[-2]))
        lead = max(given["lead"] + samples * self.sample, leads[0])
        return (("velocity", velocity), ("lead", lead))


def _clear(state: ModelState, less: ModelState | None, entry: Entry, joint: int) -> bool:
    """True if a transition is possible, and clearly improves the prediction of its joint's torque.

    Each model predicts under noise models of its own, or both under those of the model without it.
    """
    if less is None or not _possible(state, entry):
        return False
    own = (state.score.own_log_likelihoods - less.score.own_log_likelihoods)[joint]
    alike = [one.score.log_likelihoods_under(less.weights)[joint] for one in (state, less)]
    return bool(max(own, alike[0] - alike[1]) > state.study.criteria.close)


def _possible(state: ModelState, entry: Entry) -> bool:
    """True if a transition is positive, and not too large: that is friction that falls with the speed (Stribeck)."""
    term = state.term_of(entry)
    return bool(state.values_of(term)[0][0] > 0.0) and friction_allowed(state, term)
