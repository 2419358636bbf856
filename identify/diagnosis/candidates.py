"""Candidate effects with their places, and the columns that they add to the regressor."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from armident.arrays import Array
from armident.identify.diagnosis.stretch import MotionStretch
from armident.identify.diagnosis.study import Study
from armident.identify.effects.effect import Effect, Place
from armident.identify.effects.effect import Shapes as Shapes
from armident.identify.effects.friction import TRANSITION
from armident.identify.effects.registry import catalogue
from armident.identify.effects.terms import effect_terms
from armident.identify.regression.ar_noise import ArModel
from armident.identify.regression.whitening import joints_of, whitened
from armident.identify.robot.motion import Motion

Key = tuple[str, int, int | None]
"""Name of an effect and its place."""
Cached = tuple[str, int, int | None, Shapes, str, str]
Kept = tuple[Array, bool]
"""Columns of one stretch: (M, k) of the joint of their place and ``True``, or (M, n, k) of all joints and ``False``."""


@dataclass(frozen=True)
class Candidate:
    """An effect at a place; ``without``: linear parameters left out, as others of the model have the same torque."""

    effect: Effect
    place: Place
    grid: tuple[Shapes, ...]
    without: tuple[str, ...] = ()

    @property
    def key(self) -> Key:
        """Name and place."""
        return self.effect.key, self.place.joint, self.place.other


@dataclass
class ColumnCache:
    """Cache of the columns of candidates; ``theta`` (b,) predicts the torques on which effects depend."""

    study: Study
    theta: Array
    kept: dict[Cached, tuple[Kept, ...]] = field(default_factory=dict)
    _motions: dict[tuple[MotionStretch, str], Motion] = field(default_factory=dict)

    def instruments(
        self, effect: Effect, place: Place, shapes: Shapes, noise: Sequence[ArModel], *, keep: bool = True
    ) -> Array:
        """Whitened columns (R, k) at the simulated signals of the training data, as the search uses them."""
        return whitened(self.band(effect, place, shapes, "train", "simulated", keep=keep), noise)

    def motion(self, stretch: MotionStretch, kind: str) -> Motion:
        """Signals of a stretch on which the columns of effects depend. ``kind``: ``measured`` or ``simulated``."""
        if (stretch, kind) not in self._motions:
            self._motions[stretch, kind] = self.study.motion(stretch, kind, self.theta)
        return self._motions[stretch, kind]

    def joints(self, candidate: Candidate) -> list[int]:
        """Joints on whose torques a candidate acts."""
        effect, place = candidate.effect, candidate.place
        if not candidate.grid:
            return [place.joint]
        (made,) = self._bands(effect, place, candidate.grid[:1], "train", "simulated", keep=False)
        if made[0][1]:
            return [place.joint]
        return sorted({j for columns, _ in made for j in joints_of(columns)})

    def band(
        self, effect: Effect, place: Place, shapes: Shapes, part: str, kind: str, *, keep: bool = True
    ) -> tuple[Array, ...]:
        """Columns (M, n, k) of every stretch in the band; ``train`` or ``held``, ``measured`` or ``simulated``."""
        (made,) = self._bands(effect, place, (shapes,), part, kind, keep=keep)
        return tuple(self._of_all_joints(columns, place) for columns in made)

    def grid(
        self, effect: Effect, place: Place, grid: Sequence[Shapes], noise: Sequence[ArModel], *, keep: bool = True
    ) -> list[tuple[int, Array]]:
        """Whitened columns (R, G k) of G combinations at the simulated training signals, with each joint's number."""
        made = self._bands(effect, place, grid, "train", "simulated", keep=keep)
        stretches = range(len(self.study.train))
        if made[0][0][1]:
            own = [np.concatenate([columns[s][0] for columns in made], axis=1) for s in stretches]
            return [(place.joint, np.concatenate([noise[place.joint].whiten(x) for x in own]))]
        every = [np.concatenate([columns[s][0] for columns in made], axis=2) for s in stretches]
        acts = sorted({j for x in every for j in joints_of(x)})
        return [(j, np.concatenate([noise[j].whiten(x[:, j]) for x in every])) for j in acts]

    def _bands(
        self, effect: Effect, place: Place, grid: Sequence[Shapes], part: str, kind: str, *, keep: bool
    ) -> list[tuple[Kept, ...]]:
        """Columns of a grid in the band of the comparison, of every shape and every stretch."""
        kind = effect.instrument_signals if kind == "simulated" else kind

        def key(shapes: Shapes) -> Cached:
            return (effect.key, place.joint, place.other, shapes, part, kind)

        missing = [shapes for shapes in grid if key(shapes) not in self.kept]
        stretches = [self._filtered(effect, place, missing, s, kind) for s in getattr(self.study, part)]
        made = {key(shapes): tuple(own[g] for own in stretches) for g, shapes in enumerate(missing)}
        if keep:
            self.kept.update(made)
        return [made[key(shapes)] if key(shapes) in made else self.kept[key(shapes)] for shapes in grid]

    def _filtered(
        self, effect: Effect, place: Place, grid: Sequence[Shapes], stretch: MotionStretch, kind: str
    ) -> list[Kept]:
        """Columns of one stretch in the band of the comparison, of every shape."""
        motion, weights = self.motion(stretch, kind), stretch.weights
        narrow: list[Array] = []
        out: list[Kept] = []
        for shapes in grid:
            columns = effect.columns(motion, place, dict(shapes))[motion.lead :]
            if columns.ndim == 3:
                wide = self._decimated(columns)
                out.append((wide * weights[:, :, None], False))
            else:
                narrow.append(columns)
        if narrow:
            # A filter is hardly slower for many columns than for one.
            sizes = np.cumsum([columns.shape[1] for columns in narrow])[:-1]
            band = self.study.decimation(np.concatenate(narrow, axis=1)) * weights[:, place.joint, None]
            out += [(columns, True) for columns in np.split(band, sizes, axis=1)]
        return out

    def _decimated(self, columns: Array) -> Array:
        """Columns (N, n, k) in the band; joints that they leave alone are not filtered."""
        acts = joints_of(columns)
        if len(acts) == columns.shape[1]:
            return self.study.decimation(columns)
        filtered = self.study.decimation(columns[:, acts])
        whole = np.zeros((filtered.shape[0], *columns.shape[1:]))
        whole[:, acts] = filtered
        return whole

    def _of_all_joints(self, kept: Kept, place: Place) -> Array:
        """Columns (M, n, k), contiguous for each joint, as whitening needs them."""
        columns, own = kept
        if not own:
            return columns
        whole = np.zeros((self.study.robot.n, *columns.shape))
        whole[place.joint] = columns
        return whole.transpose(1, 0, 2)


def candidates(column_cache: ColumnCache) -> Iterator[Candidate]:
    """All effects that the robot lacks and this motion excites, without changes of parameters and exchanged signals."""
    study = column_cache.study
    motion = column_cache.motion(study.train[0], "measured")
    names = study.joints
    present: dict[tuple[str, int, int | None], list[Shapes]] = {}
    for term in effect_terms(study.model):
        here = (term.effect.name, term.place.joint, term.place.other)
        present.setdefault(here, []).append(tuple(term.shapes.items()))
    for effect in catalogue().values():
        if effect.name == TRANSITION and study.sign_given:
            continue
        right = {names.index(entry.joint) for entry in study.recorded if entry.effect == effect.name}
        for place in effect.places(study.robot.n):
            acting = {place.joint, place.other}
            if study.sought is not None and effect.scope != "arm" and acting.isdisjoint(study.sought):
                continue
            there = present.get((effect.name, place.joint, place.other), [])
            if place.joint not in right and effect.may_be_added(motion, place, there):
                yield Candidate(effect.minimal, place, tuple(s for s in effect.grid(motion, place) if s not in there))
