"""Which effects could sit where, and the columns they would add."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray

from identify.catalogue.effect import Effect, Place
from identify.catalogue.motion import Motion
from identify.catalogue.registry import catalogue
from identify.discrepancy.stretch import Stretch
from identify.discrepancy.study import Study
from identify.discrepancy.whitening import whitened
from identify.estimators.noise import ArModel

Array = NDArray[np.float64]
Shapes = tuple[tuple[str, float], ...]
Key = tuple[str, int, int | None, Shapes, str, str]


@dataclass(frozen=True)
class Candidate:
    """An effect at a place; the nonlinear parameters are those of the grid that are to be tried."""

    effect: Effect
    place: Place
    grid: tuple[Shapes, ...]

    @property
    def key(self) -> tuple[str, int, int | None]:
        """Name and place."""
        return self.effect.name, self.place.joint, self.place.other

    def closer(self) -> "Candidate":
        """The candidate for a loop that has it inside, with what is worth trying there."""
        shapes = self.effect.shapes
        axes = [sorted({tried[k][1] for tried in self.grid} | {*s.closer}) for k, s in enumerate(shapes)]
        if not any(shape.closer for shape in shapes):
            return self
        named = ([(s.name, value) for value in axis] for s, axis in zip(shapes, axes, strict=True))
        return replace(self, grid=tuple(product(*named)))


@dataclass(frozen=True)
class Columns:
    """Whitened columns of a candidate, (R, k) each: training rows and held-out rows, measured and simulated."""

    x: Array
    z: Array
    held_x: Array
    held_z: Array


@dataclass
class Workshop:
    """Makes columns of candidates, and keeps what can be used again.

    Parameters
    ----------
    study
        The stretches.
    theta
        Parameters by which effects that depend on the model's torques predict them.
    """

    study: Study
    theta: Array
    kept: dict[Key, tuple[Array, ...]] = field(default_factory=dict)
    _motions: dict[tuple[int, str], Motion] = field(default_factory=dict)

    def with_theta(self, study: Study, theta: Array) -> "Workshop":
        """The same after a refit; columns that depend neither on theta nor on another simulation stay."""
        moved = any(a.simulated is not b.simulated for a, b in zip(study.train, self.study.train, strict=True))
        still = {
            key: value
            for key, value in self.kept.items()
            if not _predicts(key[0]) and not (moved and key[5] == "simulated")
        }
        return Workshop(study, theta, still)

    def instruments(
        self, effect: Effect, place: Place, shapes: Shapes, noise: Sequence[ArModel], *, keep: bool = True
    ) -> Array:
        """Whitened columns (R, k) at the simulated signals of the training data: what a search looks at."""
        return whitened(self.band(effect, place, shapes, "train", "simulated", keep=keep), noise)

    def columns(self, effect: Effect, place: Place, shapes: Shapes, noise: Sequence[ArModel]) -> Columns:
        """Whitened columns of an effect."""
        parts = (
            whitened(self.band(effect, place, shapes, part, kind), noise)
            for part in ("train", "held")
            for kind in ("measured", "simulated")
        )
        return Columns(*parts)

    def motion(self, stretch: Stretch, kind: str) -> Motion:
        """A stretch as effects see it."""
        key = (id(stretch), kind)
        if key not in self._motions:
            self._motions[key] = self.study.motion(stretch, kind, self.theta)
        return self._motions[key]

    def band(
        self, effect: Effect, place: Place, shapes: Shapes, part: str, kind: str, *, keep: bool = True
    ) -> tuple[Array, ...]:
        """Columns in the band of the comparison, (M, n, k) of every stretch.

        Parameters
        ----------
        part, kind
            ``train`` or ``held``; ``measured`` or ``simulated``.
        keep
            Whether they may be asked for again.
        """
        kind = "measured" if effect.sudden else kind
        key = (effect.name, place.joint, place.other, shapes, part, kind)
        if key in self.kept:
            return self.kept[key]
        made = tuple(self._filtered(effect, place, shapes, self.motion(s, kind)) for s in getattr(self.study, part))
        if keep:
            self.kept[key] = made
        return made

    def _filtered(self, effect: Effect, place: Place, shapes: Shapes, motion: Motion) -> Array:
        """Columns in the band of the comparison; joints that the effect leaves alone are not filtered."""
        columns = effect.columns(motion, place, **dict(shapes))[motion.lead :]
        if columns.ndim == 3:
            return self.study.decimation(columns)
        own = self.study.decimation(columns)
        # Joint by joint in memory, as it is whitened.
        whole = np.zeros((motion.n, own.shape[0], own.shape[1]))
        whole[place.joint] = own
        return whole.transpose(1, 0, 2)


def _predicts(name: str) -> bool:
    effect = catalogue().get(name)
    return effect is None or effect.predicts


def candidates(workshop: Workshop) -> Iterator[Candidate]:
    """All effects of the catalogue at all places of the robot that it does not have there already.

    Left out are effects that are nothing but other numbers, exchanges of signals, and those that say of themselves
    that this motion cannot show them.
    """
    study = workshop.study
    motion = workshop.motion(study.train[0], "measured")
    names = study.joints
    present: dict[tuple[str, int, int | None], list[Shapes]] = {}
    for term in study.model.terms:
        here = (term.effect.name, term.place.joint, term.place.other)
        present.setdefault(here, []).append(tuple(term.shapes.items()))
    coupled = {frozenset(names.index(j) for j in c.joints) for c in study.robot.couplings}
    for effect in catalogue().values():
        if effect.rewires or effect.numbers is not None:
            continue
        right = {names.index(stanza.joint) for stanza in study.recorded if stanza.effect == effect.name}
        for place in places(effect, study.robot.n):
            if place.joint in right:
                continue
            if effect.scope == "pair" and frozenset((place.joint, place.other)) in coupled:
                continue
            there = present.get((effect.name, place.joint, place.other), [])
            if there and not effect.together:
                continue
            if effect.visible is not None and effect.visible(motion, place) is not None:
                continue
            yield Candidate(effect.essence, place, tuple(s for s in grid(effect, motion, place) if s not in there))


def places(effect: Effect, n: int) -> list[Place]:
    """Where an effect can sit in an arm of n joints."""
    if effect.scope == "pair":
        return [Place(i, j) for i, j in combinations(range(n), 2)]
    if effect.scope == "arm":
        return [Place(0)]
    return [Place(j) for j in range(n)]


def grid(effect: Effect, motion: Motion, place: Place) -> tuple[Shapes, ...]:
    """All combinations of nonlinear parameters to try."""
    axes = [[(shape.name, float(v)) for v in shape.grid(motion, place.joint)] for shape in effect.shapes]
    return tuple(product(*axes))
