"""Equations of a diagnosis: regressors of a model with its terms at measured and simulated signals, in one band."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, TypeVar

import numpy as np

from armident.arrays import Array
from armident.identify.diagnosis.regressor_cache import Arrays
from armident.identify.diagnosis.stretch import KINDS, MotionStretch
from armident.identify.diagnosis.study import Study
from armident.identify.effects.friction import TRANSITION
from armident.identify.effects.terms import Term, effect_terms
from armident.identify.regression.equations import InstrumentedEquations
from armident.identify.regression.iv import JointEquations
from armident.identify.robot.motion import Motion
from armident.identify.signals.differentiate import Derivatives

T = TypeVar("T")

HELD_AT_ZERO = 1e-10
"""Weight by which the parameters of terms are held at zero. Where rigid model and terms give the same torque, as the
offset and all functions of a table over a predicted torque may do, it belongs to the rigid model."""


@dataclass(frozen=True, eq=False)
class Equations:
    """Equations in the band; ``theta`` (b,) predicts the torques on which terms depend (``None`` if no term does)."""

    study: Study
    theta: Array | None
    _parts: dict[str, Any] = field(default_factory=dict, repr=False)

    @property
    def parameters(self) -> int:
        """Number of parameters of the model, b."""
        return self.study.model.base.b

    @property
    def held_at_zero(self) -> Array:
        """Weight by which each parameter is held at zero, (b,): see `HELD_AT_ZERO`."""
        model = self.study.model
        return np.repeat([0.0, HELD_AT_ZERO], [model.base.b - model.e, model.e])

    @property
    def tied(self) -> tuple[tuple[int, int], ...]:
        """Pairs of parameters of one value: the transition and the dry friction of the joints `Study.tied`."""
        names, tied = self.study.model.base.names, {self.study.joints.index(joint) for joint in self.study.tied}
        every = [t for t in effect_terms(self.study.model) if t.effect.name == TRANSITION and t.place.joint in tied]
        return tuple((names.index(t.names[0]), names.index(f"fc{t.place.joint + 1}")) for t in every)

    @property
    def train(self) -> tuple[InstrumentedEquations, ...]:
        """Training equations, one entry per stretch."""
        return self._part("train", lambda: tuple(self._of(s) for s in self.study.train))

    @property
    def held(self) -> tuple[InstrumentedEquations, ...]:
        """Held-out equations, one entry per stretch."""
        return self._part("held", lambda: tuple(self._of(s) for s in self.study.held))

    @property
    def joints(self) -> tuple[JointEquations, ...]:
        """The training equations joint by joint, without the columns that are zero there."""
        joints = range(self.study.robot.n)
        return self._part("joints", lambda: tuple(JointEquations.of(self.train, j, copied=True) for j in joints))

    def of_study(self, study: Study) -> "Equations":
        """Equations of the same training part with another held-out part."""
        parts = self._parts
        if study.held is not self.study.held:
            parts = {name: part for name, part in parts.items() if name != "held"}
        return Equations(study, self.theta, parts)

    def release(self) -> None:
        """Free the equations; they are computed again, with the same values, when they are next used."""
        self._parts.clear()

    def _part(self, name: str, made: Callable[[], T]) -> T:
        if name not in self._parts:
            self._parts[name] = made()
        part: T = self._parts[name]
        return part

    def _of(self, stretch: MotionStretch) -> InstrumentedEquations:
        x, z = regressors(self.study, stretch, self.theta)
        return InstrumentedEquations(stretch.y, x, np.ones(stretch.y.shape, dtype=np.bool_), stretch.t, z)


def regressors(study: Study, stretch: MotionStretch, theta: Array | None) -> tuple[Array, Array]:
    """Regressors (M, n, b) at measured and at simulated signals in the band; ``theta`` (b,) predicts torques for terms.

    Effects of accelerations or torques are simulated in both; effects with irreproducible jumps measured in both.
    """
    model = study.model
    terms = effect_terms(model)
    first = model.base.b - model.e
    motions = {kind: _Signals(study, stretch, kind, None if theta is None else theta[:first]) for kind in KINDS}
    x, z = (np.empty((*stretch.y.shape, model.base.b)) for _ in KINDS)
    for whole, kind in zip((x, z), KINDS, strict=True):
        whole[:, :, :first] = motions[kind].rigid
    for term in terms:
        last = first + len(term.names)
        instruments = term.effect.instrument_signals
        # Measured signals differentiated twice carry more noise than a dynamic effect has torque.
        own = instruments if term.effect.regressor_signals == "simulated" else "measured"
        for whole, kind in ((x, own), (z, instruments)):
            motions[kind].fill(term, whole[:, :, first:last])
        first = last
    for whole in (x, z):
        whole *= stretch.weights[:, :, None]
    return x, z


@dataclass(frozen=True)
class _Signals:
    """Signals of a stretch, ``measured`` or ``simulated``, with their regressors; ``theta``: rigid model, for terms."""

    study: Study
    stretch: MotionStretch
    kind: str
    theta: Array | None

    @cached_property
    def motion(self) -> Motion:
        """The motion from which terms compute their columns, with that before the stretch."""
        theta = self.theta
        if theta is not None:
            theta = np.concatenate([theta, np.zeros(self.study.model.e)])
        return self.study.motion(self.stretch, self.kind, theta)

    @property
    def rigid(self) -> Array:
        """Regressor of the rigid model in the band of the comparison, (M, n, b - e)."""
        model, signals = self.study.model, self._own
        key = (signals, model.base.names[: -model.e or None], self._smoothing)

        def made() -> Arrays:
            return (self.study.decimation(model.rigid_regressor(signals.q, signals.qd, signals.qdd)),)

        return self.study.regressors.get(key, made)[0]

    def fill(self, term: Term, out: Array) -> None:
        """Write the columns (M, n, k) of a term in the band; columns of one joint are filtered alone."""
        signals, model = self._signals, self.study.model
        torques = (model.base.names[: -model.e or None], self._theta_bytes) if term.depends_on_torque else None
        place = (term.effect.key, term.place.joint, term.place.other, tuple(term.shapes.items()), term.kept)
        key = (*signals, place, self._smoothing, torques)

        def made() -> Arrays:
            columns = term.columns(self.motion)[self.motion.lead :]
            flat = columns.reshape(columns.shape[0], -1)
            acts = np.flatnonzero(np.any(flat, axis=0))
            return acts, self.study.decimation(np.ascontiguousarray(flat[:, acts]))

        acts, band = self.study.regressors.get(key, made)
        whole = np.zeros((out.shape[0], out.shape[1] * out.shape[2]))
        whole[:, acts] = band
        out[...] = whole.reshape(out.shape)

    @property
    def _own(self) -> Derivatives:
        signals: Derivatives = getattr(self.stretch, self.kind)
        return signals

    @property
    def _signals(self) -> tuple[Derivatives, ...]:
        """The signals of the stretch, and those before it."""
        before = self.stretch.before
        return (self._own,) if before is None else (self._own, before[KINDS.index(self.kind)])

    @property
    def _smoothing(self) -> tuple[float, ...]:
        return tuple(self.study.robot.sign_smoothing)

    @property
    def _theta_bytes(self) -> bytes:
        return b"" if self.theta is None else self.theta.tobytes()
