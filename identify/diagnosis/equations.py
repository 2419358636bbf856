"""Equations of a diagnosis: regressors of a model with its terms at measured and simulated signals, in one band."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from armident.identify.diagnosis.stretch import Stretch
from armident.identify.diagnosis.study import Study
from armident.identify.effects.terms import effect_terms
from armident.identify.regression.equations import InstrumentedEquations
from armident.identify.regression.iv import JointEquations

Array = NDArray[np.float64]

RIGID_KEPT = 32
"""Rigid regressors kept, one per stretch and kind of signal. Limits the memory, changes no result: measured signals of
up to eight recordings and the latest simulations stay."""

HELD_AT_ZERO = 1e-10
"""Weight by which the parameters of terms are held at zero. Where rigid model and terms give the same torque, as the
offset and all functions of a table over a predicted torque may do, it belongs to the rigid model."""


@dataclass(frozen=True, eq=False)
class Equations:
    """Equations in the band of the comparison, computed when they are first used.

    Parameters
    ----------
    study
        Data with the model.
    theta
        Parameters (b,) that predict the torques on which terms depend; ``None`` if no term does.
    """

    study: Study
    theta: Array | None

    @property
    def parameters(self) -> int:
        """Number of parameters of the model, b."""
        return self.study.model.base.b

    @property
    def held_at_zero(self) -> Array:
        """Weight by which each parameter is held at zero, (b,): see `HELD_AT_ZERO`."""
        model = self.study.model
        return np.repeat([0.0, HELD_AT_ZERO], [model.base.b - model.e, model.e])

    @cached_property
    def train(self) -> tuple[InstrumentedEquations, ...]:
        """Training equations, one entry per stretch."""
        return tuple(self._of(s) for s in self.study.train)

    @cached_property
    def held(self) -> tuple[InstrumentedEquations, ...]:
        """Held-out equations, one entry per stretch."""
        return tuple(self._of(s) for s in self.study.held)

    @cached_property
    def joints(self) -> tuple[JointEquations, ...]:
        """The training equations joint by joint, without the columns that are zero there."""
        return tuple(JointEquations.of(self.train, j, copied=True) for j in range(self.study.robot.n))

    def with_held(self, study: Study) -> "Equations":
        """Equations of the same training part with another held-out part.

        Parameters
        ----------
        study
            Data with the same training stretches.
        """
        other = Equations(study, self.theta)
        other.__dict__.update({name: self.__dict__[name] for name in ("train", "joints") if name in self.__dict__})
        return other

    def release(self) -> None:
        """Free the equations; they are computed again, with the same values, when they are next used."""
        for name in ("train", "held", "joints"):
            self.__dict__.pop(name, None)

    def _of(self, stretch: Stretch) -> InstrumentedEquations:
        x, z = regressors(self.study, stretch, self.theta)
        return InstrumentedEquations(stretch.y, x, np.ones(stretch.y.shape, dtype=np.bool_), stretch.t, z)


def regressors(study: Study, stretch: Stretch, theta: Array | None) -> tuple[Array, Array]:
    """Regressor (M, n, b) at measured and at simulated signals, in the band of the comparison.

    Effects that depend on accelerations or torques are computed at simulated signals in both. Effects with jumps, which
    a simulation does not reproduce to the sample, are computed at measured signals in both.

    Parameters
    ----------
    study
        Data with the model.
    stretch
        A stretch of the study.
    theta
        Parameters (b,) that predict the torques on which terms depend; ``None`` if no term does.
    """
    out: list[Array] = []
    terms: dict[str, Array] = {}
    for kind in ("measured", "simulated"):
        signals = getattr(stretch, kind)
        key = (id(signals), study.model.base.names[: -study.model.e or None], tuple(study.robot.sign_smoothing))
        # Kept with the signals: their identity is the key only while they exist.
        kept = study.rigid.pop(key, None) or (
            signals,
            study.decimation(study.model.rigid_regressor(signals.q, signals.qd, signals.qdd)),
        )
        study.rigid[key] = kept
        while len(study.rigid) > RIGID_KEPT:
            # The one that was not used for the longest time: a simulation of a model that was rejected.
            del study.rigid[next(iter(study.rigid))]
        rigid = kept[1]
        if study.model.e:
            terms[kind] = _filtered_terms(study, stretch, kind, theta)
            made = terms[kind]
            if out:
                every = [t.effect for t in effect_terms(study.model) for _ in t.names]
                sudden = np.flatnonzero([e.instrument_signals == "measured" for e in every])
                made[:, :, sudden] = terms["measured"][:, :, sudden]
                # Measured signals differentiated twice carry more noise than such an effect has torque.
                dynamic = np.flatnonzero([e.regressor_signals == "simulated" for e in every])
                first = out[0].shape[2] - study.model.e
                moving = stretch.moving[:, :, None]
                out[0][:, :, first + dynamic] = made[:, :, dynamic] * moving
            rigid = np.concatenate([rigid, made], axis=2)
        out.append(rigid * stretch.moving[:, :, None])
    return out[0], out[1]


def _filtered_terms(study: Study, stretch: Stretch, kind: str, theta: Array | None) -> Array:
    """Columns (M, n, e) of the model's terms in the band of the comparison; those of one joint are filtered alone."""
    columns = study.terms(stretch, kind, theta)
    acts = np.flatnonzero(np.any(columns, axis=0))
    flat = columns.reshape(columns.shape[0], -1)[:, acts]
    band = study.decimation(np.ascontiguousarray(flat))
    whole = np.zeros((band.shape[0], columns.shape[1] * columns.shape[2]))
    whole[:, acts] = band
    return whole.reshape(band.shape[0], *columns.shape[1:])
